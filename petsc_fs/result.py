"""Result: what a solve came to, and whether that is a solution."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from petsc_fs.system import FieldArrays


@dataclass
class Result:
    """What a solve did.

    A solution counts as converged if, with the matrix and the right-hand side as they were given,

    - its residual is small: |b - A x| <= max(rtol |b|, atol), or as small as rounding allows, and
    - its backward error is small in every field f: |b_f - A_f x| <= tolerance * | |A_f| |x| + |b_f| |.

    Attributes:
        iterations: of the Krylov method, all passes together.
        converged: see above.
        reason: PETSc's name of the reason why the Krylov method stopped.
        rtol: relative tolerance that was asked for.
        tolerance: what `true_relative_residual` is held against, max(rtol, atol / |b|).
        field_tolerance: what `backward_error_by_field` is held against.
        true_relative_residual: |b - A x| / |b|.
        residual_by_field: |b_f - A_f x| / |b|.
        backward_error_by_field: |b_f - A_f x| / | |A_f| |x| + |b_f| |, or a little more.
        estimated_error_by_field: an estimate of the relative error: of one correction by the preconditioner, or by the
            Krylov method where that cast doubt. Empty where the residual is not small.
        error_by_field: |x - reference| / |reference|, where a reference is known; the absolute error where that is 0.
        passes: iterations of each run of the Krylov method: the first, corrections, and what measured the error.
        setup_seconds: building PETSc's matrices and setting the preconditioner up, for this solve.
        solve_seconds: the Krylov method and the checks.
        solution: local rows of each field, in the order of the layout; `System.gather` gives the scene's.
        notes: what was done beyond the options, and what is wrong, a line each.
    """

    iterations: int
    converged: bool
    reason: str
    rtol: float
    tolerance: float
    field_tolerance: float
    true_relative_residual: float
    residual_by_field: dict[str, float]
    backward_error_by_field: dict[str, float]
    estimated_error_by_field: dict[str, float]
    error_by_field: dict[str, float]
    passes: tuple[int, ...]
    setup_seconds: float
    solve_seconds: float
    solution: FieldArrays
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<Result {self.verdict}; {self.iterations} iterations ({self.reason})>"

    @property
    def verdict(self) -> str:
        """One line for people."""
        worst = max(self.backward_error_by_field, key=lambda f: self.backward_error_by_field[f])
        small = self.true_relative_residual <= self.tolerance
        limit = "" if small or not self.converged else ", which is the limit of rounding"
        return (
            f"{'converged' if self.converged else 'NOT CONVERGED'}: residual {self.true_relative_residual:.2e} of the "
            f"right-hand side (asked for {self.tolerance:.2e}){limit}, backward error at most "
            f"{self.backward_error_by_field[worst]:.1e} ({worst}; asked for {self.field_tolerance:.1e})"
        )

    def report(self) -> dict[str, Any]:
        """All of it but the solution, for strict JSON: numbers that are not finite become None."""
        found = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "solution"}
        report: dict[str, Any] = finite(found) | {"verdict": self.verdict}
        return report


def finite(value: Any) -> Any:
    """A report as strict JSON can hold it: null for numbers that are not finite. Local."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
