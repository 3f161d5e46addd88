"""Judgement: whether what a Krylov method came to is a solution, by the true residual and the error of each field."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from petsc4py import PETSc

from petsc_fs.diagnostics import broken_level, explain_weakness, weakest_entries
from petsc_fs.dm import Blocks
from petsc_fs.errors import SolveError
from petsc_fs.petsc_errors import reason_name, translate
from petsc_fs.scene import Scene
from petsc_fs.system import FieldArrays, System

ROUNDING_UNITS = 10
"""A residual this many times the rounding level of the system cannot be told from zero."""

ERROR_FACTOR = 1e7
"""Estimated relative error of a field, per unit of tolerance, beyond which a solution does not count as one.

Solutions of well-behaved scenes stay below 1e4.
"""
ENOUGH = 1e-3
"""Estimated relative error that is never too large: rounding in the residual alone may amount to it."""
EPS = float(np.finfo(np.float64).eps)
USUAL = 1e-5
"""Least singular values of J M^-1 above this occur where only the units of fields differ; they cast no doubt."""
NOT_FINITE = ("DIVERGED_NANORINF", "DIVERGED_PCSETUP_FAILED", "DIVERGED_PC_FAILED")
"""PETSc's reasons that point at a level which broke down."""


@dataclass
class Result:
    """What a solve did.

    Attributes:
        iterations: of the outer Krylov method, restarts by -petsc_fs_restarts and rungs of -petsc_fs_fallback included.
        converged: whether the true residual of the untransformed system meets the tolerance.
        reason: PETSc's name of the reason why the Krylov method stopped, or STAGNATED, see `petsc_fs.stagnation`.
        true_relative_residual: |b - J x| / |b|.
        rtol: relative tolerance that the Krylov method had.
        tolerance: what `true_relative_residual` is held against: the larger of the relative
            tolerance and the absolute one / |b|; or, where rounding forbids to meet that, ten units
            of rounding, |J| |x| + |b| taken entry by entry.
        limited_by_rounding: whether that last resort was needed.
        estimated_error_by_field: |M^-1 (b - J x)| / |x| per field, with one application of the preconditioner M, over
            the least singular value of J M^-1 that GMRES has seen, if that is below 1e-5: an estimate of the error that
            no units and no other field can hide. Infinite where a field that is zero should not be. Empty where the
            residual misses its tolerance.
        error_tolerance: what these are held against; infinite where the tolerance is too loose to tell.
        fallback: rung of -petsc_fs_fallback that found the solution; "" if none was needed.
        notes: what was done beyond the options, and what is wrong, a line each.
        residual_by_field: |b - J x| restricted to each field / |b|.
        error_by_field: |x - reference| / |reference| per field, where a reference is known; the
            absolute error where the reference is zero.
        setup_seconds: building PETSc's matrices and setting the preconditioner up, for this solve.
        solve_seconds: the Krylov method.
        solution: local rows of each field, in the order of the layout; `System.gather` gives the scene's.
    """

    iterations: int
    converged: bool
    reason: str
    true_relative_residual: float
    tolerance: float
    limited_by_rounding: bool
    residual_by_field: dict[str, float]
    error_by_field: dict[str, float]
    setup_seconds: float
    solve_seconds: float
    solution: FieldArrays = field(repr=False)
    rtol: float = 0.0
    estimated_error_by_field: dict[str, float] = field(default_factory=dict)
    error_tolerance: float = math.inf
    fallback: str = ""
    notes: tuple[str, ...] = ()

    def report(self) -> dict[str, Any]:
        """All of it but the solution, for JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "solution"}


@dataclass(frozen=True)
class Criteria:
    """What a solution has to meet.

    Attributes:
        rtol: relative tolerance of the Krylov method.
        true_rtol: relative tolerance of the true residual.
        error_factor: estimated relative error of each field that is allowed, per unit of `rtol`; 0 for any.
    """

    rtol: float
    true_rtol: float
    error_factor: float

    @property
    def error_tolerance(self) -> float:
        """Estimated relative error that each field may have; infinite where so loose a `rtol` promises nothing."""
        if not self.error_factor:
            return math.inf
        allowed = max(self.error_factor * self.rtol, ENOUGH)
        return allowed if allowed < 1.0 else math.inf


def judge(  # noqa: PLR0917
    system: System,
    ksp: PETSc.KSP,
    x: PETSc.Vec,
    criteria: Criteria,
    scene: Scene,
    divisors: Blocks,
    stagnated: str = "",
) -> Result:
    """Judge where a KSP stopped; iterations are those of its last solve, seconds are left at 0. Collective.

    Args:
        system: with the matrix and the right-hand side.
        ksp: has just stopped.
        x: at which it did.
        criteria: what a solution has to meet.
        scene: with the reference, if known, and what is known of cells.
        divisors: blocks by pairs of fields that the preconditioner divides by.
        stagnated: in words, if that is why it stopped.

    Raises:
        SolveError: the residual is not finite, or the preconditioner failed.
    """
    reason = "STAGNATED" if stagnated else reason_name(ksp)
    iterations = ksp.getIterationNumber()
    residual = system.b.duplicate()
    system.J.mult(x, residual)
    residual.aypx(-1.0, system.b)
    norms = system.field_norms(system.by_field(residual))
    size = system.b.norm() or 1.0
    relative = residual.norm() / size
    where = ""
    if reason in NOT_FINITE or not math.isfinite(relative):
        where = broken_level(ksp.getPC()) or _overflow(system, ksp)
    if not math.isfinite(relative):
        residual.destroy()
        raise SolveError(
            f"the solution is not finite after {iterations} iterations ({reason})" + (f"; {where}" if where else "")
        )
    atol = ksp.getTolerances()[1]
    tolerance = max(criteria.true_rtol, atol / size)
    solution = system.by_field(x)
    limited = False
    if relative > tolerance:
        floor = ROUNDING_UNITS * system.rounding_level(solution) / size
        limited = bool(relative <= floor < 1.0)  # what is as large as b is no solution, whatever rounding does
        tolerance = floor if limited else tolerance
    estimates: dict[str, float] = {}
    error_tolerance = criteria.error_tolerance
    if relative <= tolerance and error_tolerance < math.inf:
        correction = residual.duplicate()
        apply_preconditioner(ksp, residual, correction)
        doubt, remaining = _doubt(system, ksp, divisors), _remaining(system, ksp, residual, correction)
        ratios = _ratios(system, system.by_field(correction), solution)
        estimates = {f: doubt * remaining[f] * e for f, e in ratios.items()}
        correction.destroy()
    residual.destroy()
    wrong = {f: e for f, e in estimates.items() if not e <= error_tolerance}
    notes = [note for note in (_scaling(system), stagnated, where) if note]
    if relative > tolerance or wrong:
        notes += explain_weakness(system.problem, scene)
    if wrong:
        found = ", ".join(f"{f} {e:.1e}" for f, e in wrong.items())
        notes.append(
            f"the residual is small, but not the estimated error: {found}; at most {error_tolerance:.1e} is asked for"
        )
    return Result(
        iterations=iterations,
        converged=bool(relative <= tolerance) and not wrong,
        reason=reason,
        true_relative_residual=relative,
        rtol=criteria.rtol,
        tolerance=tolerance,
        limited_by_rounding=limited,
        residual_by_field={f: n / size for f, n in norms.items()},
        error_by_field=_errors(system, solution, scene.reference),
        setup_seconds=0.0,
        solve_seconds=0.0,
        solution=solution,
        estimated_error_by_field=estimates,
        error_tolerance=error_tolerance,
        notes=tuple(notes),
    )


def apply_preconditioner(ksp: PETSc.KSP, x: PETSc.Vec, y: PETSc.Vec) -> None:
    """Y = M^-1 x. Collective.

    Raises:
        SolveError: it failed.
    """
    try:
        ksp.getPC().apply(x, y)
    except (PETSc.Error, ImportError) as e:
        raise translate(e, "the preconditioner failed") from None


def _doubt(system: System, ksp: PETSc.KSP, divisors: Blocks) -> float:
    """By how much one application of the preconditioner may fall short of the error; at least 1. Collective.

    The inverse of the least singular value of J M^-1 that GMRES has seen, and of the weakest entry of J_44, which
    M divides by where it is no factorisation.
    """
    least = 1.0
    if ksp.getType() == PETSc.KSP.Type.GMRES and ksp.getIterationNumber():
        least = float(ksp.computeExtremeSingularValues()[1])
        least = least if least < USUAL else 1.0
    if ksp.getPC().getType() not in (PETSc.PC.Type.LU, PETSc.PC.Type.CHOLESKY):
        least = min(least, *(weak.ratio for weak in weakest_entries(system.layout, divisors)), 1.0)
    return 1.0 / max(min(least, 1.0), EPS)


def _remaining(system: System, ksp: PETSc.KSP, residual: PETSc.Vec, correction: PETSc.Vec) -> dict[str, float]:
    """The error of each field over one correction to it; 1 but for Richardson's iteration. Collective.

    Its corrections c_k shrink like q^k, so that the error is |c_0| / (1 - q). The next correction tells q:
    c_1 = M^-1 (r - J c_0).
    """
    if ksp.getType() != PETSc.KSP.Type.RICHARDSON:
        return dict.fromkeys(system.layout.fields, 1.0)
    rest, following = residual.duplicate(), residual.duplicate()
    system.J.mult(correction, rest)
    rest.aypx(-1.0, residual)
    apply_preconditioner(ksp, rest, following)
    shrunk = _ratios(system, system.by_field(following), system.by_field(correction))
    for vector in (rest, following):
        vector.destroy()
    return {f: 1.0 / max(1.0 - q, EPS) for f, q in shrunk.items()}


def _overflow(system: System, ksp: PETSc.KSP) -> str:
    """The fields in which b, M^-1 b or J M^-1 b is too large to have a norm; "" if there are none. Collective."""
    found = _without_norm(system, system.b)
    if found:
        return f"the norm of the right-hand side overflows in {found}: scale the equations"
    x, y = system.b.duplicate(), system.b.duplicate()
    apply_preconditioner(ksp, system.b, x)
    what, found = "what the preconditioner makes of the right-hand side", _without_norm(system, x)
    if not found:
        system.J.mult(x, y)
        what = "the product of the Jacobian with what the preconditioner makes of the right-hand side"
        found = _without_norm(system, y)
    x.destroy()
    y.destroy()
    return f"{what} is not finite in {found}: look for entries that are too large there" if found else ""


def _without_norm(system: System, x: PETSc.Vec) -> str:
    return ", ".join(f for f, norm in system.field_norms(system.by_field(x)).items() if not math.isfinite(norm))


def _scaling(system: System) -> str:
    if not system.is_scaled:
        return ""
    return "rows scaled by " + ", ".join(f"{f} {system.row_scale[f]:.1e}" for f in system.layout.fields)


def _ratios(system: System, part: FieldArrays, whole: FieldArrays) -> dict[str, float]:
    """|part| / |whole| per field; infinite where only the latter is zero. Collective."""
    a, b = system.field_norms(part), system.field_norms(whole)
    return {f: a[f] / b[f] if b[f] else math.inf if a[f] else 0.0 for f in system.layout.fields}


def _errors(system: System, solution: FieldArrays, reference: FieldArrays) -> dict[str, float]:
    if set(reference) != set(system.layout.fields):
        return {}
    error = system.field_norms({f: solution[f] - reference[f] for f in reference})
    size = system.field_norms(reference)
    return {f: error[f] / (size[f] or 1.0) for f in system.layout.fields}
