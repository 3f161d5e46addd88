"""Solver: a KSP with its preconditioner tree on a system, timed and judged by the true residual."""

from __future__ import annotations

import atexit
import gc
import itertools
import math
import re
import sys
import time
import weakref
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.diagnostics import broken_level, weakest_entries
from petsc_fs.errors import PetscFsError, SolveError, UsageError, together
from petsc_fs.fields import MECHANICS
from petsc_fs.layout import Layout
from petsc_fs.partition import chosen_kind, partition
from petsc_fs.reuse import Reuse
from petsc_fs.scene import Scene
from petsc_fs.system import FieldArrays, PatternChanged, System

REFUSALS = (62, 63, 86)
"""PETSc's codes for a wrong argument, one out of range and an unknown type: what bad options give."""

MAT_TYPES = ("nest", "merged", "aij")
ROUNDING_UNITS = 10
"""A residual this many times the rounding level of the system cannot be told from zero."""

ERROR_FACTOR = 1e7
"""Estimated relative error of a field, per unit of tolerance, beyond which a solution does not count as one.

Solutions of well-behaved scenes stay below 1e4.
"""
ENOUGH = 1e-3
"""Estimated relative error that is never too large: rounding in the residual alone may amount to it."""
EPS = float(np.finfo(np.float64).eps)
SCALINGS = ("auto", "always", "none")
USUAL = 1e-5
"""Least singular values of J M^-1 above this occur where only the units of fields differ; they cast no doubt."""
ONE_CYCLE = 30
"""Iterations without success after which scaling is tried."""
SPREAD = {"auto": 1e6, "always": 16.0}
"""Ratio of the magnitudes of fields' equations from which their rows are scaled."""


@dataclass
class Result:
    """What a solve did.

    Attributes:
        iterations: of the outer Krylov method, restarts by -petsc_fs_restarts included.
        converged: whether the true residual of the untransformed system meets the tolerance.
        reason: PETSc's name of the reason why the Krylov method stopped.
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
    notes: tuple[str, ...] = ()

    def report(self) -> dict[str, Any]:
        """All of it but the solution, for JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "solution"}


_numbers = itertools.count()
_live: weakref.WeakSet[Solver] = weakref.WeakSet()


@atexit.register
def _destroy_live() -> None:
    """Free what Python PCs hold while Python still runs: PetscFinalize comes after it."""
    for solver in sorted(_live, key=lambda s: s._number):
        solver.destroy()
    for name in ("last_exc", "last_value", "last_traceback", "last_type"):  # of an error nobody caught
        if hasattr(sys, name):
            delattr(sys, name)
    gc.collect()
    PETSc.garbage_cleanup()


class Solver:
    """Solves a scene by what the options database says, and further scenes of the same structure.

    Options:
        -petsc_fs_mat_type nest|merged|aij: storage of the Jacobian; aij copies the blocks into one matrix,
            merged only those of mechanics, where ContactTransform does not.
        -petsc_fs_partition auto|rcb|ptscotch|contiguous: which rank gets which cells, see `petsc_fs.partition`.
        -petsc_fs_restarts n: how often the Krylov method may start again from its own solution where the
            true residual misses the tolerance that its recursive estimate has met; default 2.
        -petsc_fs_true_rtol r: relative true residual that counts as converged; default -ksp_rtol.
        -petsc_fs_error_factor c: estimated relative error of each field that counts as converged, per unit of
            -ksp_rtol; default 1e7. 0 judges by the residual alone.
        -petsc_fs_scaling auto|always|none: scaling of the rows, field by field, by what their terms amount to, so
            that the residual norm hides no field, whatever the units. auto: where the Krylov method fails, or a
            field's estimated error is too large though the residual is small; one of the restarts. always: first of
            all, by what one application of the preconditioner says. Either way the preconditioner is set up once
            more, and the scales are kept for further scenes.

    Attributes:
        rtol: relative tolerance of the Krylov method, from the options.
        rebuilds: how often matrices and preconditioner were made anew because the pattern had changed.
    """

    def __init__(
        self,
        scene: Scene,
        comm: MPI.Intracomm | None = None,
        *,
        layout: Layout | None = None,
        prefix: str = "",
        release: bool = False,
    ) -> None:
        """Build the system; nothing is factored yet.

        Collective.

        Args:
            scene: all rows on every rank, or the rows of this rank as `layout` has them.
            comm: communicator, default MPI_COMM_WORLD.
            layout: distribution of rows; default by -petsc_fs_partition where the scene is whole, else contiguous.
            prefix: of all options of this solver, including its own.
            release: empty `scene.blocks` while PETSc's matrices are made, for callers that have no other use
                for them: matrix and scene are then not both in memory.

        Raises:
            SceneError: the scene does not fit together.
            UsageError: an option has an impossible value.
        """
        mpi = comm or MPI.COMM_WORLD
        started = time.perf_counter()
        self.prefix = prefix
        self.ksp: Any = None
        self._number = next(_numbers)
        _live.add(self)
        whole = layout or self._layout_of(scene, mpi)
        self.layout = whole.only(f for f in whole.fields if whole.sizes(f)[1])
        options = PETSc.Options(prefix)
        mat_type = options.getString("petsc_fs_mat_type", "nest")
        if mat_type not in MAT_TYPES:
            raise UsageError(f"-{prefix}petsc_fs_mat_type {mat_type}: expected {' or '.join(MAT_TYPES)}")
        with together(mpi):
            self.scene = self._part(scene)
        if release:
            scene.blocks.clear()
        self._storage = {"mat_type": mat_type, "release": True, **needed_data(prefix)}
        self.reuse = Reuse.from_options(prefix)
        self.system, self.ksp = self._build()
        self.restarts = options.getInt("petsc_fs_restarts", 2)
        self.rtol = float(self.ksp.getTolerances()[0])
        self.true_rtol = options.getReal("petsc_fs_true_rtol", self.rtol)
        self.error_factor = options.getReal("petsc_fs_error_factor", ERROR_FACTOR)
        self.scaling = options.getString("petsc_fs_scaling", SCALINGS[0])
        if self.scaling not in SCALINGS:
            raise UsageError(f"-{prefix}petsc_fs_scaling {self.scaling}: expected {' or '.join(SCALINGS)}")
        self._looked = False  # whether the magnitudes of the fields have been looked at
        self.rebuilds = 0
        self.x = self.system.J.createVecRight()
        self._built_seconds = time.perf_counter() - started

    def _build(self) -> tuple[System, Any]:
        """System and KSP, with what is kept from one matrix to the next. Collective."""
        system = System(self.scene, self.layout, **self._storage)
        system.problem.reuse = self.reuse
        return system, self._create_ksp(system)

    def _part(self, scene: Scene) -> Scene:
        """The rows of this rank, of the fields that have any unknowns."""
        part = scene.only(self.layout.fields)
        return part if part.rows is not None else part.restrict(self.layout)

    def _layout_of(self, scene: Scene, comm: MPI.Intracomm) -> Layout:
        """By -petsc_fs_partition, where every rank has the whole scene; parts are taken for contiguous ones."""
        kind = chosen_kind(self.prefix)
        whole = comm.allreduce(scene.rows is None, MPI.LAND)
        if whole and comm.size > 1:
            return partition(scene, comm, kind, self.prefix)
        return Layout.contiguous(comm, scene.dimension, scene.sizes)

    def _create_ksp(self, system: System) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.layout.comm)
        ksp.setOptionsPrefix(self.prefix)
        ksp.setOperators(system.J, system.J)
        if len(system.members) > 1:
            ksp.setDM(system.dm)
            if PETSc.Sys.getVersion() < (3, 25):
                ksp.setDMActive(False)
            else:
                ksp.setDMActive(PETSc.KSP.DMActive.ALL, False)
        try:
            ksp.setFromOptions()
        except (PETSc.Error, ImportError) as e:
            ksp.destroy()
            raise UsageError(f"PETSc refuses an option: {brief(e)}") from e
        ksp.setConvergenceHistory(reset=True)
        if ksp.getType() == PETSc.KSP.Type.GMRES:
            ksp.setComputeSingularValues(True)  # of what it projects anyway; for the error estimate
        return ksp

    def update(self, scene: Scene) -> None:
        """Take the values of another scene of the same fields and sizes.

        Collective. PETSc's objects are kept where the nonzero pattern allows it, else made anew.
        """
        started = time.perf_counter()
        scales = self.system.row_scale
        with together(self.layout.comm):
            self.scene = self._part(scene)
        try:
            self.system.update(self.scene, grow=True)
        except PatternChanged:
            self.ksp.destroy()
            self.system.destroy()
            self.system, self.ksp = self._build()
            self.rebuilds += 1
        if any(scale != 1.0 for scale in scales.values()):
            self.system.scale_rows(scales)
        self.reuse.take_matrix(self.scene.contact_state, self.layout.comm, self._mechanics_scale())
        self.scene.blocks.clear()
        self.ksp.setOperators(self.system.J, self.system.J)  # or KSPSetUp leaves the set-up to the first product
        collect_garbage(self.layout.comm)
        self._built_seconds = time.perf_counter() - started

    def set_up(self) -> None:
        """Set the preconditioner up, where it is not. Collective.

        Raises:
            SolveError: PETSc could not.
            PetscFsError: an operator or option of a level is impossible.
        """
        started = time.perf_counter()
        try:
            self.ksp.setUp()
            set_up_leaves(self.ksp.getPC())
        except (PETSc.Error, ImportError) as e:
            raise _ours(e, "set-up failed") from None
        self._built_seconds += time.perf_counter() - started
        if self.scaling == "always" and not self._looked:
            self._looked = True
            self._scale_by_preconditioner(SPREAD["always"])

    def solve(self, rtol: float | None = None) -> Result:
        """Solve for the right-hand side of the scene, from a zero initial guess. Collective.

        A Krylov method that stops early is no error: see `Result.converged` and `Result.reason`.

        Args:
            rtol: relative tolerance of this solve, if a looser one than -ksp_rtol is enough; the true residual is
                held against -petsc_fs_true_rtol made looser by as much.

        Raises:
            SolveError: PETSc failed on the way, or the solution is not finite.
        """
        self.set_up()
        wanted, atol = max(self.rtol, rtol or 0.0), self.ksp.getTolerances()[1]
        self.ksp.setTolerances(rtol=wanted)
        result = self._run_first(wanted)
        for _ in range(self.restarts):
            if result.converged or not (result.iterations or result.estimated_error_by_field):
                break
            if not result.reason.startswith("CONVERGED"):
                given_up = result.reason == "DIVERGED_MAX_IT" and result.iterations < ONE_CYCLE
                if given_up or not self._scale_by_preconditioner(SPREAD["auto"]):
                    break
                self.ksp.setInitialGuessNonzero(False)
            else:
                known = bool(result.estimated_error_by_field)
                scaled = self._scale_rows(result.solution, SPREAD["always" if known else "auto"])
                if known and not scaled:
                    worst = max(result.estimated_error_by_field.values())
                    tighter = max(0.1 * wanted * min(1.0, result.error_tolerance / worst), EPS)
                    self.ksp.setTolerances(rtol=tighter, atol=0.0)
                self.ksp.setInitialGuessNonzero(known or not scaled)
            better = self._run(result.iterations, result.solve_seconds, wanted)
            if better.estimated_error_by_field or not result.estimated_error_by_field:
                result = better
        self.ksp.setInitialGuessNonzero(False)
        self.ksp.setTolerances(rtol=wanted, atol=atol)
        self.reuse.note_solve(result.iterations, result.true_relative_residual)
        self._built_seconds = 0.0
        return result

    def _run_first(self, wanted: float) -> Result:
        """Solve from zero; where what was kept for an older matrix is not good enough, build the latest and go on."""
        limit, max_it = self.reuse.iteration_limit(wanted), self.ksp.getTolerances()[3]
        if limit is None:
            return self._run(0, 0.0, wanted)
        iterations, seconds, better = 0, 0.0, False
        self.ksp.setTolerances(max_it=min(limit, max_it))
        try:
            result = self._run(0, 0.0, wanted)
            if result.reason.startswith("CONVERGED"):
                return result
            iterations, seconds = result.iterations, result.solve_seconds
            better = result.true_relative_residual < 1
        except SolveError:
            pass  # not finite, on all ranks: the latest may do better
        finally:
            self.ksp.setTolerances(max_it=max_it)
        self.reuse.give_up()
        self.system.J.stateIncrease()  # or PETSc takes the preconditioner for the latest
        self.ksp.setOperators(self.system.J, self.system.J)
        self.set_up()
        self.ksp.setInitialGuessNonzero(better)
        result = self._run(iterations, seconds, wanted)
        self.ksp.setInitialGuessNonzero(False)
        return result

    def _scale_by_preconditioner(self, spread: float) -> bool:
        """Scale rows by the solution that the preconditioner alone gives; see `_scale_rows`. Collective."""
        self._apply_preconditioner(self.system.b, self.x)
        solution = self.system.by_field(self.x)
        self.x.set(0.0)
        finite = all(bool(np.isfinite(v).all()) for v in solution.values())
        return all(self.layout.comm.allgather(finite)) and self._scale_rows(solution, spread)

    def _scale_rows(self, solution: FieldArrays, spread: float) -> bool:
        """Scale the rows of each field by what their terms amount to, where that differs by so much. Collective.

        Returns whether it did.
        By powers of two, so that nothing is rounded; the fields of mechanics, which multigrid treats together, alike.
        The norm of the right-hand side stays nearly as it is, for absolute tolerances.
        """
        if self.scaling == "none":
            return False
        sizes = self.system.magnitudes(solution)
        if not all(math.isfinite(n) for n in sizes.values()):
            return False
        mechanics = math.hypot(*(sizes[f] for f in sizes if f in MECHANICS))
        sizes = {f: mechanics if f in MECHANICS else n for f, n in sizes.items()}
        known = [n for n in sizes.values() if n > 0]
        if not known or max(known) <= spread * min(known):
            return False
        norms = self.system.field_norms(self.system.by_field(self.system.b))
        before = math.hypot(*norms.values())
        after = math.hypot(*(norms[f] / n for f, n in sizes.items() if n > 0))
        common = before / after if before and after else 1.0
        if not (math.isfinite(common) and common > 0):
            return False
        self.system.scale_rows({f: 2.0 ** round(math.log2(common / n)) if n > 0 else 1.0 for f, n in sizes.items()})
        self.ksp.setOperators(self.system.J, self.system.J)
        self.reuse.take_scaled(self._mechanics_scale())
        self.set_up()
        return True

    def _mechanics_scale(self) -> float:
        """What the rows of mechanics have been multiplied by."""
        return next((self.system.row_scale[f] for f in self.layout.fields if f in MECHANICS), 1.0)

    def _apply_preconditioner(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        try:
            self.ksp.getPC().apply(x, y)
        except (PETSc.Error, ImportError) as e:
            raise _ours(e, "the preconditioner failed") from None

    def _run(self, iterations: int, seconds: float, wanted: float) -> Result:
        """Solve once, from the current solution if the KSP is told so; iterations and seconds are added up."""
        started = time.perf_counter()
        try:
            self.ksp.solve(self.system.b, self.x)
        except (PETSc.Error, ImportError) as e:
            raise _ours(e, "solve failed") from None
        seconds += time.perf_counter() - started
        return self._judge(iterations + self.ksp.getIterationNumber(), seconds, wanted)

    def _judge(self, iterations: int, solve_seconds: float, rtol: float) -> Result:
        system, reason = self.system, reason_name(self.ksp)
        residual = system.b.duplicate()
        system.J.mult(self.x, residual)
        residual.aypx(-1.0, system.b)
        norms = system.field_norms(system.by_field(residual))
        size = system.b.norm() or 1.0
        relative = residual.norm() / size
        if not np.isfinite(relative):
            residual.destroy()
            where = broken_level(self.ksp.getPC(), system.b)
            hint = ", for MUMPS raise -mat_mumps_icntl_14 there" if where else ""
            raise SolveError(
                f"the solution is not finite after {iterations} iterations ({reason})"
                + (f"; {where}: see -ksp_view{hint}" if where else "")
            )
        atol = self.ksp.getTolerances()[1]
        loosened = rtol / self.rtol if self.rtol else 1.0
        tolerance = max(self.true_rtol * loosened, atol / size)
        solution = system.by_field(self.x)
        limited = False
        if relative > tolerance:
            floor = ROUNDING_UNITS * system.rounding_level(solution) / size
            limited = bool(relative <= floor)
            tolerance = floor if limited else tolerance
        estimates: dict[str, float] = {}
        error_tolerance = math.inf
        if self.error_factor:
            error_tolerance = max(self.error_factor * rtol, ENOUGH)
        if error_tolerance >= 1.0:
            error_tolerance = math.inf  # so loose a tolerance promises nothing of the fields
        if relative <= tolerance and error_tolerance < math.inf:
            correction = residual.duplicate()
            self._apply_preconditioner(residual, correction)
            doubt = self._doubt()
            estimates = {f: doubt * e for f, e in self._ratios(system.by_field(correction), solution).items()}
            correction.destroy()
        residual.destroy()
        notes = self._notes_on_scaling()
        if relative > tolerance or max(estimates.values(), default=0.0) > error_tolerance:
            notes += [str(weak) for weak in weakest_entries(system)]
        wrong = {f: e for f, e in estimates.items() if not e <= error_tolerance}
        if wrong:
            found = ", ".join(f"{f} {e:.1e}" for f, e in wrong.items())
            notes.append(
                f"the residual is small, but not the estimated error: {found}; "
                f"at most {error_tolerance:.1e} is asked for"
            )
        return Result(
            iterations=iterations,
            converged=bool(relative <= tolerance) and not wrong,
            reason=reason,
            true_relative_residual=relative,
            rtol=rtol,
            tolerance=tolerance,
            limited_by_rounding=limited,
            residual_by_field={f: n / size for f, n in norms.items()},
            error_by_field=self._errors(solution),
            setup_seconds=self._built_seconds,
            solve_seconds=solve_seconds,
            solution=solution,
            estimated_error_by_field=estimates,
            error_tolerance=error_tolerance,
            notes=tuple(notes),
        )

    def _doubt(self) -> float:
        """By how much one application of the preconditioner may fall short of the error; at least 1. Collective.

        The inverse of the least singular value of J M^-1 that GMRES has seen, and of the weakest entry of J_44, which
        M divides by where it is no factorisation.
        """
        least = 1.0
        if self.ksp.getType() == PETSc.KSP.Type.GMRES and self.ksp.getIterationNumber():
            least = float(self.ksp.computeExtremeSingularValues()[1])
            least = least if least < USUAL else 1.0
        if self.ksp.getPC().getType() not in (PETSc.PC.Type.LU, PETSc.PC.Type.CHOLESKY):
            least = min(least, *(weak.ratio for weak in weakest_entries(self.system)), 1.0)
        return 1.0 / max(min(least, 1.0), EPS)

    def _notes_on_scaling(self) -> list[str]:
        scales = self.system.row_scale
        if all(scale == 1.0 for scale in scales.values()):
            return []
        return ["rows scaled by " + ", ".join(f"{f} {scales[f]:.1e}" for f in self.layout.fields)]

    def _ratios(self, part: FieldArrays, whole: FieldArrays) -> dict[str, float]:
        """|part| / |whole| per field; infinite where only the latter is zero. Collective."""
        a, b = self.system.field_norms(part), self.system.field_norms(whole)
        return {f: a[f] / b[f] if b[f] else math.inf if a[f] else 0.0 for f in self.layout.fields}

    def _errors(self, solution: FieldArrays) -> dict[str, float]:
        reference = self.scene.reference
        if set(reference) != set(self.layout.fields):
            return {}
        error = self.system.field_norms({f: solution[f] - reference[f] for f in reference})
        size = self.system.field_norms(reference)
        return {f: error[f] / (size[f] or 1.0) for f in self.layout.fields}

    def history(self) -> NDArray[np.float64]:
        """Residual norms of the last solve, as the Krylov method saw them; the first is the initial one."""
        return np.asarray(self.ksp.getConvergenceHistory())

    def destroy(self) -> None:
        """Free PETSc's objects. Collective; may be called twice."""
        if self.ksp is not None:
            self.ksp.destroy()
            self.system.destroy()
            self.ksp = None
            self.reuse.release()
            collect_garbage(self.layout.comm)


def collect_garbage(comm: MPI.Intracomm) -> None:
    """Free what Python has let go of: petsc4py keeps it until all ranks come together. Collective."""
    PETSc.garbage_cleanup(comm)


def set_up_leaves(pc: PETSc.PC) -> None:
    """Set up what PCFIELDSPLIT leaves to the first application, so that set-up time holds all of it. Collective."""
    if pc.getType() == PETSc.PC.Type.FIELDSPLIT:
        for ksp in pc.getFieldSplitSubKSP():
            ksp.setUp()
            set_up_leaves(ksp.getPC())
    elif pc.getType() == PETSc.PC.Type.PYTHON:
        inner = getattr(pc.getPythonContext(), "inner", None)
        if inner is not None:
            set_up_leaves(inner)
    else:
        pc.setUpOnBlocks()


def needed_data(prefix: str) -> dict[str, bool]:
    """Which data beside the matrix the solver in the options database makes use of, for `System`. Local."""
    chosen = {k: str(v) for k, v in PETSc.Options().getAll().items() if k.startswith(prefix)}
    types = {v for k, v in chosen.items() if k.endswith("pc_type")}
    own = ("petsc_fs.pc.ContactTransform", "petsc_fs.pc.FixedStress", "petsc_fs.pc.ComponentSweep")
    foreign = any(k.endswith("pc_python_type") and v not in own for k, v in chosen.items())
    nodal = any(k.endswith(("boomeramg_nodal_coarsen", "boomeramg_vec_interp_variant")) for k in chosen)
    return {
        "near_null_space": nodal or foreign or bool(types & {"gamg", "ml", "bddc", "hmg"}),
        "fixed_stress": foreign or own[1] in chosen.values(),
    }


def _ours(error: Exception, what: str) -> PetscFsError:
    """The error of this package that stands for one of PETSc's.

    An exception in a Python PC comes through PETSc as it is, or, in newer petsc4py, as the cause of its error.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, PetscFsError):
            return cause
        if isinstance(cause, ImportError) or (isinstance(cause, PETSc.Error) and cause.ierr in REFUSALS):
            return UsageError(f"PETSc refuses an option: {brief(cause)}")
        if isinstance(cause, Exception) and not isinstance(cause, PETSc.Error):
            return SolveError(f"{what}: {type(cause).__name__}: {cause}")
        cause = cause.__cause__ or cause.__context__
    return SolveError(f"{what}: {brief(error)}")


def reason_name(ksp: PETSc.KSP) -> str:
    """Name of the reason why a KSP stopped, for example CONVERGED_RTOL."""
    number = ksp.getConvergedReason()
    names = {v: k for k, v in vars(PETSc.KSP.ConvergedReason).items() if isinstance(v, int)}
    return str(names.get(number, number))


def brief(error: Exception) -> str:
    """One line of an error; of one of PETSc's, its code's text and the innermost message."""
    if not isinstance(error, PETSc.Error):
        return str(error)
    lines = [re.sub(r"^\[\d+\]\s*", "", line).strip() for line in str(error).splitlines()]
    messages = [line for line in lines if line and not re.match(r"\w+\(\) (line|at)", line)]
    return "; ".join(messages) or f"error code {error.ierr}"
