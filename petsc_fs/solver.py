"""Solver: a KSP with its preconditioner tree on a system, timed and judged by the true residual."""

from __future__ import annotations

import atexit
import gc
import itertools
import math
import sys
import time
import weakref
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import options as database
from petsc_fs.diagnostics import explain_weakness
from petsc_fs.dm import one_matrix
from petsc_fs.errors import PetscFsError, SceneError, SolveError, UsageError, together
from petsc_fs.fallback import Fallback, NotApplicableError
from petsc_fs.fields import MECHANICS
from petsc_fs.judgement import EPS, ERROR_FACTOR, Criteria, Result, apply_preconditioner, judge
from petsc_fs.layout import Layout
from petsc_fs.levels import levels
from petsc_fs.partition import chosen, partition
from petsc_fs.petsc_errors import brief, translate
from petsc_fs.regularization import lift
from petsc_fs.reuse import Reuse
from petsc_fs.scene import Scene
from petsc_fs.stagnation import Stagnation
from petsc_fs.system import FieldArrays, PatternChanged, System

__all__ = ["Result", "Solver", "collect_garbage", "needed_data", "set_up_leaves"]

MAT_TYPES = ("nest", "merged", "aij")
SCALINGS = ("auto", "always", "none")
DOUBTFUL = 1e4
"""Estimated relative error of a field, per unit of tolerance, from which a converged solve goes on."""
ONE_CYCLE = 30
"""Iterations without success after which scaling is tried."""
SPREAD = {"auto": 1e6, "always": 16.0}
"""Ratio of the magnitudes of fields' equations from which their rows are scaled."""


AnError = TypeVar("AnError", bound=PetscFsError)

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
        -petsc_fs_ordering auto|natural|morton: order of the cells of a rank, see there too.
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
        -petsc_fs_fallback LIST: stronger preconditioners that are tried in turn where a solve has not converged, or
            failed: names of `petsc_fs.fallback.RUNGS` with commas between them; default none. Each adds to those
            before it. Further solves with the same matrix stay on the rung that helped. The next matrix starts with
            the options as given again, unless two matrices in a row needed a rung: then on that.
        -petsc_fs_regularize EPS: blocks that the preconditioner divides by, and that are weaker than EPS of what is
            usual, are lifted to that, in the preconditioner only; see `petsc_fs.regularization`. Default 0: none.
        -petsc_fs_stagnation_window, _ratio: see `petsc_fs.stagnation.Stagnation`.

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
            layout: distribution of rows; default by -petsc_fs_partition and -petsc_fs_ordering where several ranks
                have the whole scene, else the scene's order in chunks.
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
        self._preconditioned: Any = None  # the matrix of the preconditioner, where it is not the Jacobian
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
        self.fallback = Fallback.from_options(prefix)
        self.stagnation = Stagnation.from_options(prefix)
        self.regularize = database.number("petsc_fs_regularize", 0.0, prefix)
        if not 0 <= self.regularize < 1:
            raise UsageError(f"-{prefix}petsc_fs_regularize {self.regularize:g}: expected a number from 0 to below 1")
        self._failure: PetscFsError | None = None  # of the set-up of the present preconditioner
        self._is_set_up = False
        self._solved = False  # whether the last solve converged
        self.system, self.ksp = self._build()
        self._set_operators()
        self.restarts = database.number("petsc_fs_restarts", 2, prefix)
        self.rtol = float(self.ksp.getTolerances()[0])
        self.true_rtol = database.number("petsc_fs_true_rtol", self.rtol, prefix)
        self.error_factor = database.number("petsc_fs_error_factor", ERROR_FACTOR, prefix)
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
        """By the options where several ranks have the whole scene each; else the scene's order, cut into chunks."""
        kind, ordering = chosen(self.prefix)
        whole = comm.allreduce(scene.rows is None, MPI.LAND)
        if whole and comm.size > 1:
            return partition(scene, comm, kind, ordering, self.prefix)
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
            with database.replaced(self.fallback.options):
                ksp.setFromOptions()
        except (PETSc.Error, ImportError) as e:
            ksp.destroy()
            raise UsageError(f"PETSc refuses an option: {brief(e)}") from e
        ksp.setConvergenceHistory(reset=True)
        self.fallback.adapt(ksp)
        if ksp.getType() == PETSc.KSP.Type.GMRES:
            ksp.setComputeSingularValues(True)  # of what it projects anyway; for the error estimate
        self.stagnation.watch(ksp)
        return ksp

    def _renew_preconditioner(self) -> None:
        """Have the KSP, with its tolerances and monitors, make its preconditioner anew by the options. Collective."""
        pc = PETSc.PC().create(self.layout.comm)
        pc.setOptionsPrefix(self.prefix)
        if len(self.system.members) > 1:
            pc.setDM(self.system.dm)
        self.ksp.setPC(pc)
        try:
            with database.replaced(self.fallback.options):
                pc.setFromOptions()
        except (PETSc.Error, ImportError) as e:
            raise translate(e, "set-up failed") from None
        if self.ksp.getType() == PETSc.KSP.Type.GMRES:
            self.ksp.setComputeSingularValues(True)

    def _set_operators(self) -> None:
        """Give the KSP the Jacobian, and the matrix its preconditioner is made of where that is another. Collective."""
        system, before = self.system, self._preconditioned
        self._divisors, self._lifted, self._failure = system.blocks, list[str](), None
        self._preconditioned = None
        if system.J.getType() == "nest" and self.fallback.monolithic:
            self._preconditioned = one_matrix(self.layout.fields, system.blocks, self.layout)
        elif system.J.getType() == "nest" and (least := max(self.regularize, self.fallback.lifted)):
            self._preconditioned, self._divisors, self._lifted = lift(system.problem, system.members, self.scene, least)
        if before is not None:
            self._renew_preconditioner()  # or parts of the old one would take the old matrix for theirs
            before.destroy()
        self.ksp.setOperators(system.J, self._preconditioned or system.J)

    def update(self, scene: Scene) -> None:
        """Take the values of another scene of the same fields and sizes.

        Collective. PETSc's objects are kept where the nonzero pattern allows it, else made anew.
        """
        started = time.perf_counter()
        scales = self.system.row_scale if self.system.is_scaled else None
        with together(self.layout.comm):
            self.scene = self._part(scene)
        renew = self.fallback.take_matrix(self.ksp, self._solved)
        try:
            self.system.update(self.scene, grow=True)
        except PatternChanged:
            self.ksp.destroy()
            self.system.destroy()
            self.system, self.ksp = self._build()
            self.rebuilds += 1
        else:
            if renew:
                self._renew_preconditioner()
                self.reuse.release()
        if scales is not None:
            self.system.scale_rows(scales)
        self.reuse.take_matrix(self.scene.contact_state, self.layout.comm, self._mechanics_scale())
        self.scene.blocks.clear()
        self._set_operators()  # or KSPSetUp leaves the set-up to the first product
        collect_garbage(self.layout.comm)
        self._built_seconds = time.perf_counter() - started

    def set_up(self) -> None:
        """Set the preconditioner up, where it is not. Collective.

        Where it fails and there is a fallback, nothing is raised: that is up to `solve`.

        Raises:
            SolveError: PETSc could not.
            PetscFsError: an operator or option of a level is impossible.
        """
        try:
            self._set_up()
        except (SolveError, SceneError) as e:
            if not self.fallback.remaining():
                raise
            self._failure = _bare(e)

    def _set_up(self) -> None:
        if self._failure is not None:
            raise self._failure
        started = time.perf_counter()
        self._is_set_up = False
        try:
            with database.replaced(self.fallback.options):
                self.ksp.setUp()
                set_up_leaves(self.ksp.getPC())
        except (PETSc.Error, ImportError) as e:
            raise translate(e, "set-up failed") from None
        self._is_set_up = True
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
        wanted = max(self.rtol, rtol or 0.0)
        given, self._solved = not self.fallback.taken, False
        result = self._attempt(wanted, raising=not self.fallback.remaining())
        if isinstance(result, Result) and given:
            self.reuse.note_solve(result.iterations, result.true_relative_residual)
        if not isinstance(result, Result) or (not result.converged and self.fallback.remaining()):
            result = self._fall_back(wanted, result)
        self._solved = result.converged
        result = replace(result, setup_seconds=self._built_seconds, notes=(*self._lifted, *result.notes))
        self._built_seconds = 0.0
        return result

    def _attempt(self, wanted: float, *, raising: bool) -> Result | SolveError | SceneError:
        """One solve by the options in force; its error, where that is not to be raised. Collective."""
        try:
            return replace(self._solve(wanted), fallback=self.fallback.name)
        except (SolveError, SceneError) as e:
            if raising:
                raise
            return _bare(e)

    def _fall_back(self, wanted: float, outcome: Result | SolveError | SceneError) -> Result:
        """Go up the ladder until a solve converges; else the one with the least residual. Collective.

        Raises:
            SolveError: all of them ended with an error; or SceneError, as the first one did.
        """
        first, best = outcome, outcome if isinstance(outcome, Result) else None
        lines = [f"fallback from {self.fallback.name or 'the options as given'}: {_describe(outcome)}"]
        iterations, seconds = (best.iterations, best.solve_seconds) if best is not None else (0, 0.0)
        weak = explain_weakness(self.system.problem, self.scene)
        self.fallback.see(self.ksp.getPC() if self._is_set_up else None, self.layout.fields, bool(weak))
        for rung in self.fallback.remaining():
            before = self.fallback.options, self.fallback.lifted
            try:
                where = self.fallback.climb(rung, self.ksp)
            except NotApplicableError as e:
                lines.append(f"fallback {rung}: {e}, skipped")
                continue
            if (self.fallback.options, self.fallback.lifted) != before:
                self._renew_preconditioner()
                self.reuse.release()
                self._set_operators()
            outcome = self._attempt(wanted, raising=False)
            lines.append(f"fallback {rung}{where}: {_describe(outcome)}")
            if isinstance(outcome, Result):
                iterations, seconds = iterations + outcome.iterations, seconds + outcome.solve_seconds
                better = best is None or outcome.true_relative_residual < best.true_relative_residual
                best = outcome if outcome.converged or better else best
                if outcome.converged:
                    break
        if best is None:
            assert not isinstance(first, Result)
            raise type(first)("; ".join([str(first), *lines[1:]]))
        return replace(best, iterations=iterations, solve_seconds=seconds, notes=(*lines, *best.notes))

    def _solve(self, wanted: float) -> Result:
        """Solve by the options in force, with restarts and scaling. Collective.

        Raises:
            SolveError: PETSc failed on the way, or the solution is not finite.
        """
        self._set_up()
        atol = self.ksp.getTolerances()[1]
        self.ksp.setTolerances(rtol=wanted)
        try:
            result = self._run_first(wanted)
            for _ in range(self.restarts):
                if result.converged and not self._is_doubtful(result, wanted):
                    break
                if not (result.iterations or result.estimated_error_by_field):
                    break
                if not self._prepare_restart(result, wanted):
                    break
                better = self._run(result.iterations, result.solve_seconds, wanted)
                if result.converged and not better.converged:
                    result = replace(result, iterations=better.iterations, solve_seconds=better.solve_seconds)
                    break
                if better.estimated_error_by_field or not result.estimated_error_by_field:
                    result = better
        finally:
            self.ksp.setInitialGuessNonzero(False)
            self.ksp.setTolerances(rtol=wanted, atol=atol)
        return result

    def _is_doubtful(self, result: Result, wanted: float) -> bool:
        """Whether a field hides in the norm of the residual, so that a restart is worth its iterations."""
        worst = max(result.estimated_error_by_field.values(), default=0.0)
        return math.isfinite(result.error_tolerance) and worst > DOUBTFUL * wanted

    def _prepare_restart(self, result: Result, wanted: float) -> bool:
        """Scale rows, tighten the tolerance or start from what is there; whether another run may help. Collective."""
        if not result.reason.startswith("CONVERGED"):
            given_up = result.reason == "DIVERGED_MAX_IT" and result.iterations < ONE_CYCLE
            if given_up or not self._scale_by_preconditioner(SPREAD["auto"]):
                return False
            self.ksp.setInitialGuessNonzero(False)
            return True
        known = bool(result.estimated_error_by_field)
        scaled = self._scale_rows(result.solution, SPREAD["always" if known else "auto"])
        if known and not scaled:
            worst = max(result.estimated_error_by_field.values())
            aim = min(result.error_tolerance, DOUBTFUL * wanted)
            tighter = max(0.1 * wanted * min(1.0, aim / worst), EPS)
            self.ksp.setTolerances(rtol=tighter, atol=0.0)
        elif not scaled and self.system.is_scaled:
            # small in the norm of the scaled rows alone
            missing = 0.1 * result.tolerance / result.true_relative_residual
            atol = self.ksp.getTolerances()[1]
            self.ksp.setTolerances(rtol=max(wanted * missing, EPS), atol=atol * missing)
        self.ksp.setInitialGuessNonzero(known or not scaled)
        return True

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
        self._set_operators()
        self._set_up()
        self.ksp.setInitialGuessNonzero(better)
        result = self._run(iterations, seconds, wanted)
        self.ksp.setInitialGuessNonzero(False)
        return result

    def _scale_by_preconditioner(self, spread: float) -> bool:
        """Scale rows by the solution that the preconditioner alone gives; see `_scale_rows`. Collective."""
        apply_preconditioner(self.ksp, self.system.b, self.x)
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
        self._set_operators()
        self.reuse.take_scaled(self._mechanics_scale())
        self._set_up()
        return True

    def _mechanics_scale(self) -> float:
        """What the rows of mechanics have been multiplied by."""
        return next((self.system.row_scale[f] for f in self.layout.fields if f in MECHANICS), 1.0)

    def _run(self, iterations: int, seconds: float, wanted: float) -> Result:
        """Solve once, from the current solution if the KSP is told so; iterations and seconds are added up."""
        self.stagnation.restart(self.ksp)
        started = time.perf_counter()
        try:
            self.ksp.solve(self.system.b, self.x)
        except (PETSc.Error, ImportError) as e:
            raise translate(e, "solve failed") from None
        seconds += time.perf_counter() - started
        loosened = wanted / self.rtol if self.rtol else 1.0
        criteria = Criteria(wanted, self.true_rtol * loosened, self.error_factor)
        result = judge(self.system, self.ksp, self.x, criteria, self.scene, self._divisors, str(self.stagnation))
        return replace(result, iterations=iterations + result.iterations, solve_seconds=seconds)

    def history(self) -> NDArray[np.float64]:
        """Residual norms of the last solve, as the Krylov method saw them; the first is the initial one."""
        return np.asarray(self.ksp.getConvergenceHistory())

    def destroy(self) -> None:
        """Free PETSc's objects. Collective; may be called twice."""
        if self.ksp is not None:
            self.ksp.destroy()
            if self._preconditioned is not None:
                self._preconditioned.destroy()
            self.system.destroy()
            self.ksp = None
            self.reuse.release()
            collect_garbage(self.layout.comm)


def collect_garbage(comm: MPI.Intracomm) -> None:
    """Free what Python has let go of: petsc4py keeps it until all ranks come together. Collective."""
    PETSc.garbage_cleanup(comm)


def set_up_leaves(pc: PETSc.PC) -> None:
    """Set up what PCFIELDSPLIT leaves to the first application, so that set-up time holds all of it. Collective."""
    for level in levels(pc):
        level.setUp()
        level.setUpOnBlocks()


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


def _bare(error: AnError) -> AnError:
    """An error that is kept, without the frames it came through: on some ranks only they would keep PETSc's objects."""
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)


def _describe(outcome: Result | PetscFsError) -> str:
    """How a solve ended, in a few words."""
    if not isinstance(outcome, Result):
        return str(outcome)
    worst = max(outcome.estimated_error_by_field.values(), default=None)
    return f"{outcome.iterations} iterations, {outcome.reason}, true residual {outcome.true_relative_residual:.1e}" + (
        f", estimated error {worst:.1e}" if worst is not None else ""
    )
