"""Forcing terms of inexact Newton methods: how well each linear system needs to be solved."""

from __future__ import annotations

from dataclasses import dataclass, fields

from petsc_fs.errors import UsageError

FINISH = 0.5
"""Part of the nonlinear tolerance that the last linear residual is allowed to have."""

ALMOST = 10.0
"""A linear residual expected within this factor of the nonlinear tolerance is brought below it at once."""


@dataclass(frozen=True)
class EisenstatWalkerParameters:
    """Parameters with the names and, but for `rtol0` and `rtolmax`, the defaults of PETSc's `-snes_ksp_ew_...`.

    Each is an attribute and an option of its name.

    Options:
        -petsc_fs_ew_rtol0 <0.0001>: first term of each time step.
        -petsc_fs_ew_rtolmax <0.0001>: the largest term. Textbooks have 0.1 and more, which takes more Newton steps
            here: contact states follow the direction of the update, and each step costs an assembly and a set-up.
        -petsc_fs_ew_gamma <1>: factor.
        -petsc_fs_ew_alpha <1.61803>: exponent.
        -petsc_fs_ew_threshold <0.1>: how large the safeguard has to be to act.
    """

    rtol0: float = 1e-4
    rtolmax: float = 1e-4
    gamma: float = 1.0
    alpha: float = (1 + 5**0.5) / 2
    threshold: float = 0.1

    def __post_init__(self) -> None:
        for f in fields(self):
            if not getattr(self, f.name) > 0:
                raise UsageError(f"Eisenstat-Walker forcing: {f.name} must be positive, found {getattr(self, f.name)}")
        if not (self.rtol0 < 1 and self.rtolmax < 1 and self.gamma <= 1 and 1 < self.alpha <= 2):
            raise UsageError("Eisenstat-Walker forcing needs rtol0 < 1, rtolmax < 1, gamma <= 1 and 1 < alpha <= 2")


class EisenstatWalker:
    """Choice 2 of Eisenstat and Walker, "Choosing the forcing terms in an inexact Newton method", SISC 17 (1996).

    With the nonlinear residual norms r_k, the linear system of Newton step k is solved to the relative residual

        eta_k = gamma (r_k / r_{k-1})^alpha,

    - not below gamma eta_{k-1}^alpha where that is above a threshold, so that terms do not fall at once after a
      chance success (their safeguard), and not above `rtolmax`;
    - at the end, not below 1/2 t / r_k with the nonlinear tolerance t: more would be solved for nothing (Kelley,
      "Iterative Methods for Linear and Nonlinear Equations", SIAM 1995, eq. 6.20);
    - and just that where eta_k r_k is below 10 t: a few more iterations now save a Newton step.
    """

    def __init__(self, parameters: EisenstatWalkerParameters) -> None:
        self.parameters = parameters
        self._last: tuple[float, float] | None = None

    def restart(self) -> None:
        """Forget the residuals before, as at the start of a time step."""
        self._last = None

    def term(self, residual: float, tolerance: float | None = None) -> float:
        """The next forcing term.

        Args:
            residual: nonlinear residual norm of the iterate that the system was assembled at.
            tolerance: that Newton holds the same norm against; None if it does not, or is not known.
        """
        p = self.parameters
        eta = p.rtol0
        if self._last is not None:
            last_eta, last_residual = self._last
            eta = p.gamma * (residual / last_residual) ** p.alpha if last_residual > 0 else p.rtolmax
            kept = p.gamma * last_eta**p.alpha
            if kept > p.threshold:
                eta = max(eta, kept)
        eta = min(eta, p.rtolmax)
        if tolerance is not None and residual > 0:
            finish = FINISH * tolerance / residual
            if eta * residual < ALMOST * tolerance:
                eta = finish
            eta = min(eta, p.rtolmax)
        self._last = eta, residual
        return eta
