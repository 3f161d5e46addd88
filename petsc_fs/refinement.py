"""Refinement: one solve, with corrections as the user's system asks for them, and a word on its error."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import SolveError
from petsc_fs.partition import rows_of
from petsc_fs.petsc_errors import reason_name, translate
from petsc_fs.system import EPS, System, norm

MOST_PASSES = 20
"""The Krylov method and its corrections."""
HESSENBERG = ("gmres", "fgmres", "lgmres")
"""Krylov methods that know singular values of what they have projected."""
GMRES_RESTART = 30
"""PETSc's default."""
PETSC_ATOL = 1e-50
"""PETSc's own absolute tolerance, which stands for none."""
HOPELESS = ("DIVERGED_DTOL", "DIVERGED_NANORINF", "DIVERGED_PC_FAILED", "DIVERGED_INDEFINITE_PC")
"""PETSc's reasons after which a correction will do no better."""
MARGIN = 0.1
"""Part of a tolerance that the Krylov method is given, whose norm is not the user's: bundled scenes take a correction
less often than not, and 3 % more iterations otherwise."""
STRICTER = 1e-2
"""Factor on the tolerance of a correction after one that has gained little."""
LEAST_RTOL = 1e-12
"""Tolerance of the Krylov method that its recursion can still keep."""
DETERMINED = 1e-3
"""Relative error of each field, estimated or measured, up to which a solution is taken as it is."""
ACCEPTED = 1e-2
"""The same where rounding allows no better one."""
IMBALANCE = 1e-6
"""That of a field from which a solution is in doubt, unless a third of the tolerance is more."""
NOISE = 2.0
"""Size of a perturbation beside the residual."""
FAR = 10.0
"""Factor by which a field misses its tolerance, from which the norm of the Krylov method has hidden something."""
MEASURE = 0.1
"""Relative tolerance where errors are measured."""
SOLVED = 0.5
"""Relative residual, computed anew, up to which that has worked."""
MOST_IMPROVEMENTS = 3
"""Corrections for the sake of the estimated error."""
LIMIT = 1e-14
"""Backward error that no correction lessens any more."""


class Spectrum:
    """The least singular value of A M^-1 that a GMRES has seen, where it starts again and where it ends.

    Attributes:
        least: this, or 1 if that is less; 1 for methods other than `HESSENBERG`.
    """

    least = 1.0

    def __init__(self, ksp: PETSc.KSP) -> None:
        """Watch a KSP whose options are set. Collective."""
        self._restart = PETSc.Options(ksp.getOptionsPrefix() or "").getInt("ksp_gmres_restart", GMRES_RESTART)
        if ksp.getType() in HESSENBERG:
            ksp.setComputeSingularValues(True)  # of what it projects anyway
            ksp.setMonitor(self._watch)
        ksp.setAttr("spectrum", self)

    def _watch(self, ksp: PETSc.KSP, iteration: int, _: float) -> None:
        if iteration % self._restart == self._restart - 1:
            self.look(ksp)

    def look(self, ksp: PETSc.KSP) -> None:
        """Take in what the KSP has seen since it started again. Local."""
        if ksp.getType() in HESSENBERG and ksp.getIterationNumber():
            self.least = min(self.least, max(float(ksp.computeExtremeSingularValues()[1]), EPS))


class Refinement:
    """One solve: a Krylov method on the equilibrated system, and corrections as the user's system asks for them.

    Attributes:
        x: the solution so far, of the system as it is in PETSc.
        check: how well it satisfies the user's system.
        missing: by what factor it misses the tolerances.
        goal: tolerance of the residual, relative to |b|.
        field_goal: backward error that each field may have.
        estimates: estimated relative error of each field.
        is_determined: whether the equations determine the solution to `DETERMINED`.
    """

    def __init__(self, system: System, ksp: PETSc.KSP, rtol: float, atol: float, rounding: Mapping[str, float]) -> None:
        self.system, self.ksp, self.rtol, self._rounding = system, ksp, rtol, rounding
        self.x, self.r, self.d = (system.b.duplicate() for _ in range(3))
        self.max_it = int(ksp.getTolerances()[3])
        self.passes: list[int] = []  # iterations of each
        self.reason = "CONVERGED_ATOL"
        self.history: list[NDArray[np.float64]] = []
        self.notes: tuple[str, ...] = ()
        self.estimates: dict[str, float] = {}
        self.is_determined = True
        self._spectrum: Spectrum = ksp.getAttr("spectrum")
        self._spectrum.least = 1.0
        self._missed = 0.0  # by what factor a pass that met its own tolerance has missed that of a field
        self.x.set(0.0)
        self.check = system.check(None, self.r)
        size = norm(self.check.rhs)
        self.goal = max(rtol, math.ldexp(atol, system.rhs_scale) / size) if size else 1.0
        self.field_goal = rtol
        self.missing = self.check.excess(self.goal, self.field_goal) if size else 0.0

    @property
    def iterations(self) -> int:
        """Of all passes together."""
        return sum(self.passes)

    def first(self) -> None:
        """The Krylov method by its options. Collective."""
        if self.missing > 1.0:
            self._pass(MARGIN * max(self.rtol, min(self.goal, 0.5)))
            self._take_step(better=False)

    def correct(self) -> None:
        """Corrections, as long as each of them halves what is missing. Collective.

        The Krylov method stops in the norm of the equilibrated system, by a recursion that rounding may lead astray, or
        in one of its own, as with the preconditioner on the left; so one that gains little has a stricter one after it.
        """
        if self.ksp.getType() == PETSc.KSP.Type.PREONLY or self.reason in HOPELESS:
            return
        strictness = 1.0
        while self.missing > 1.0 and len(self.passes) < MOST_PASSES and self.iterations < self.max_it:
            old = self.missing
            self._pass(max(strictness * min(MARGIN / self.missing, 0.5), LEAST_RTOL))
            self._take_step()
            if self.missing > 0.5 * old:
                if strictness < 1.0:
                    return
                strictness = STRICTER

    def explain(self) -> None:
        """A note on why a solution does not count, where there is none yet. Collective."""
        if self.missing <= 1.0 or self.notes:
            return
        if self.reason in HOPELESS and (where := broken_level(self.ksp.getPC())):
            self.notes += (where,)
        elif max(self.check.backward.values()) <= LIMIT:
            self.notes += (
                "the residual is as small as rounding allows, but not beside the right-hand side: the solution is so "
                "large that the system is next to singular",
            )
        else:
            found = [f for f, e in self.check.backward.items() if e > self.field_goal]
            self.notes += (
                f"the tolerance is missed by a factor of {self.missing:.1e}"
                + (f", in the equations of {', '.join(found)}" if found else ""),
            )

    def _take_step(self, *, better: bool = True) -> None:
        """Add what the last pass has found, unless that makes it worse. Collective."""
        old = self.missing
        self._spectrum.look(self.ksp)
        self.x.axpy(1.0, self.d)
        self._judge()
        if better and self.missing > max(old, 1.0):
            self.x.axpy(-1.0, self.d)
            self._judge()
        self._missed = max(self._missed, max(self.check.backward.values()) / self.field_goal)

    def estimate_error(self) -> None:
        """Estimate the error of each field; where that casts doubt, improve the solution, or measure it. Collective.

        One application of the preconditioner to the residual is an estimate, divided by the least singular value that
        GMRES has seen. Other methods see none, and leave doubt. So does a field whose equations do not add up:
        a residual that is small in each cell may be large beside what is left of their sum, which alone says how high
        a pressure is. To measure the error is to solve for a residual of this size with a part at random, whatever
        the preconditioner is worth: a solution that the equations do not determine changes beyond measure.
        """
        if self.missing > 1.0 or not self.passes:
            return
        seen = self.ksp.getType() in (*HESSENBERG, PETSc.KSP.Type.PREONLY)  # how good the preconditioner is
        doubtful = not seen or self._missed > FAR or not self.reason.startswith("CONVERGED")
        doubtful = doubtful or max(self.system.imbalance(self.x, self.r).values()) > max(IMBALANCE, self.rtol / 3)
        for _ in range(MOST_IMPROVEMENTS):
            self._precondition()
            steps, eta = self._relative(self.d), max(self.check.backward.values())
            self.estimates = {f: e / self._spectrum.least for f, e in steps.items()}
            if max(self.estimates.values()) <= DETERMINED and not doubtful:
                return
            step = max(steps.values())
            final = eta <= LIMIT or self.ksp.getType() == PETSc.KSP.Type.PREONLY
            if step <= DETERMINED or final:
                found, doubtful = self._measured(), True
                self.estimates = found or self.estimates
                if found is not None and max(found.values()) <= (ACCEPTED if final else DETERMINED):
                    return
                if final or found is None:
                    break
                step = max(found.values())
            self._pass(min(max(MARGIN * DETERMINED / step, 1e-4), MARGIN))
            self._take_step()
            if self.missing > 1.0 or self.iterations >= self.max_it:
                break
        self.is_determined = False
        wrong = {f: e for f, e in self.estimates.items() if not e <= DETERMINED}
        self.notes += (
            "ill-conditioned: the residual is small, but says little of the error, which is estimated at "
            + ", ".join(f"{e:.0e} ({f})" for f, e in wrong.items())
            + f" of the solution; at most {DETERMINED:g} counts as converged"
            if wrong
            else "the residual is small, but casts doubt on the solution, and its error could not be measured: the "
            "Krylov method failed on another right-hand side",
        )

    def sharpen(self, error: float) -> None:
        """One correction more where the root mean square of the error, by estimate, is larger. Collective.

        Args:
            error: wanted in the units of the user's system, if rounding allows it.
        """
        if self.missing > 1.0 or not (self.passes and self.is_determined):
            return
        self._precondition()
        found = float(np.ldexp(self.d.norm(), -self.system.rhs_scale)) / math.sqrt(self.d.getSize() or 1)
        if found > error and self.iterations < self.max_it:
            self._pass(max(error / found, LEAST_RTOL))
            self._take_step()

    def _precondition(self) -> None:
        """D = M^-1 r. Collective."""
        try:
            self.ksp.getPC().apply(self.r, self.d)
        except (PETSc.Error, ImportError) as e:
            self.ksp.incRef()  # with a scatter under way, nothing in it can be destroyed
            raise translate(e, "the preconditioner failed") from None
        self._leave_null_space()

    def _leave_null_space(self) -> None:
        """Take out of `d` what the matrix maps to zero, where that is known. Collective."""
        space = self.ksp.getOperators()[0].getNullSpace()
        if space:
            space.remove(self.d)

    def _measured(self) -> dict[str, float] | None:
        """Relative size of what a residual of this size may be worth; None if that cannot be solved for. Collective."""
        system = self.system
        random = {f: scattered(system, f) for f in system.layout.fields}
        there, sizes = system.norms(system.by_field(self.r), random)
        parts = [v * (NOISE * there[f] / (sizes[f] or 1.0)) for f, v in random.items()]
        kept, reason, found, rest = self.r.copy(), self.reason, self.d.duplicate(), self.r.duplicate()
        self.r.setArray(self.r.getArray() + np.concatenate(parts))
        found.set(0.0)
        size = self.r.norm()
        for _ in range(MOST_IMPROVEMENTS):
            self._pass(MEASURE, self.max_it)
            found.axpy(1.0, self.d)
            self.ksp.getOperators()[0].mult(self.d, rest)
            self.r.axpy(-1.0, rest)
            if self.r.norm() <= SOLVED * size or self.reason in HOPELESS:
                break
        solved = self.r.norm() <= SOLVED * size
        relative = self._relative(found)
        kept.copy(self.r)
        self.reason = reason
        for vector in (kept, found, rest):
            vector.destroy()
        return relative if solved else None

    def _relative(self, part: PETSc.Vec) -> dict[str, float]:
        """Size of each field of a vector beside that of the solution, or beside what would change any equation.

        What is known to be rounding is as small as `DETERMINED` of that.
        """
        sizes, found = self.system.norms(self.system.by_field(self.x), self.system.by_field(part))
        least = self.system.least_sizes(self.check, self.field_goal)
        with np.errstate(over="ignore"):
            for f, size in self._rounding.items():
                least[f] = max(least[f], float(np.ldexp(size / DETERMINED, self.system.rhs_scale)))
        return {f: n / (max(sizes[f], least[f]) or 1.0) for f, n in found.items()}

    def _pass(self, rtol: float, max_it: int = 0) -> None:
        """Run a Krylov method on the present residual; what it finds is in `d`. Collective."""
        ksp = self.ksp
        ksp.setTolerances(rtol=rtol, atol=0.0, max_it=max_it or max(self.max_it - self.iterations, 1))
        try:
            ksp.solve(self.r, self.d)
        except (PETSc.Error, ImportError) as e:
            ksp.incRef()  # as in `_precondition`
            raise translate(e, "solve failed") from None
        self._leave_null_space()
        self.passes.append(ksp.getIterationNumber())
        self.history.append(np.array(ksp.getConvergenceHistory()))
        self.reason = reason_name(ksp)

    def _judge(self) -> None:
        """See where x stands. Collective.

        Raises:
            SolveError: it is not finite.
        """
        self.check = self.system.check(self.x, self.r)
        self.missing = self.check.excess(self.goal, self.field_goal)
        if not math.isfinite(self.missing):
            where = broken_level(self.ksp.getPC())
            raise SolveError(
                f"the solution is not finite after {self.iterations} iterations ({self.reason})"
                + (f"; {where}" if where else "")
            )
        if self.missing > 1.0:
            self.check = self.system.check(self.x, self.r, exactly=True)
            self.missing = self.check.excess(self.goal, self.field_goal)

    def destroy(self) -> None:
        """Collective."""
        for vector in (self.x, self.r, self.d):
            vector.destroy()


def scattered(system: System, name: str) -> NDArray[np.float64]:
    """Numbers between -1 and 1 without order, for the rows of a field on this rank; of a row always the same. Local."""
    rows = rows_of(system.layout.own_cells(name), system.layout.block_size(name))
    return np.asarray(2.0 * np.modf(np.abs(np.sin((rows + 1.0) * 12.9898) * 43758.5453))[0] - 1.0)


def broken_level(pc: PETSc.PC) -> str:
    """The innermost level of a set-up tree that turns ones into numbers that are not finite; "" if there is none.

    Collective.
    """
    for part in reversed(list(nest.levels(pc))):
        x, y = part.getOperators()[1].createVecs()
        x.set(1.0)
        y.set(0.0)
        try:
            part.apply(x, y)
            what = "" if math.isfinite(y.norm()) else "turns ones into numbers that are not finite"
        except PETSc.Error as e:
            pc.incRef()  # as in `_precondition`
            what = f"fails (error {e.ierr})"
        for v in (x, y):
            v.destroy()
        if what:
            kind, prefix = part.getType(), f"-{part.getOptionsPrefix() or ''}"
            hint = f"; if it is MUMPS, raise {prefix}mat_mumps_icntl_14" if kind in ("lu", "cholesky") else ""
            return f"level {prefix} ({kind}) {what}{hint}"
    return ""
