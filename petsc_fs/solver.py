"""Solver: a KSP with its preconditioner tree on a system, timed and judged by the true residual."""

from __future__ import annotations

import atexit
import gc
import itertools
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

from petsc_fs.errors import PetscFsError, SolveError, UsageError, together
from petsc_fs.layout import Layout
from petsc_fs.partition import chosen_kind, partition
from petsc_fs.scene import Scene
from petsc_fs.system import FieldArrays, PatternChanged, System

REFUSALS = (62, 63, 86)
"""PETSc's codes for a wrong argument, one out of range and an unknown type: what bad options give."""

MAT_TYPES = ("nest", "merged", "aij")
ROUNDING_UNITS = 10
"""A residual this many times the rounding level of the system cannot be told from zero."""


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
        self.system = System(self.scene, self.layout, **self._storage)
        self.ksp = self._create_ksp()
        self.restarts = options.getInt("petsc_fs_restarts", 2)
        self.rtol = float(self.ksp.getTolerances()[0])
        self.true_rtol = options.getReal("petsc_fs_true_rtol", self.rtol)
        self.rebuilds = 0
        self.x = self.system.J.createVecRight()
        self._built_seconds = time.perf_counter() - started

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

    def _create_ksp(self) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.layout.comm)
        ksp.setOptionsPrefix(self.prefix)
        ksp.setOperators(self.system.J, self.system.J)
        if len(self.system.members) > 1:
            ksp.setDM(self.system.dm)
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
        return ksp

    def update(self, scene: Scene) -> None:
        """Take the values of another scene of the same fields and sizes.

        Collective. PETSc's objects are kept where the nonzero pattern allows it, else made anew.
        """
        started = time.perf_counter()
        with together(self.layout.comm):
            self.scene = self._part(scene)
        try:
            self.system.update(self.scene)
        except PatternChanged:
            self.ksp.destroy()
            self.system = System(self.scene, self.layout, **self._storage)
            self.ksp = self._create_ksp()
            self.rebuilds += 1
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
        self.ksp.setTolerances(rtol=max(self.rtol, rtol or 0.0))
        result = self._run(0, 0.0)
        for _ in range(self.restarts):
            if result.converged or not result.reason.startswith("CONVERGED") or not result.iterations:
                break
            self.ksp.setInitialGuessNonzero(True)
            result = self._run(result.iterations, result.solve_seconds)
        self.ksp.setInitialGuessNonzero(False)
        self._built_seconds = 0.0
        return result

    def _run(self, iterations: int, seconds: float) -> Result:
        """Solve once, from the current solution if the KSP is told so; iterations and seconds are added up."""
        started = time.perf_counter()
        try:
            self.ksp.solve(self.system.b, self.x)
        except (PETSc.Error, ImportError) as e:
            raise _ours(e, "solve failed") from None
        return self._judge(iterations + self.ksp.getIterationNumber(), seconds + time.perf_counter() - started)

    def _judge(self, iterations: int, solve_seconds: float) -> Result:
        system, reason = self.system, reason_name(self.ksp)
        residual = system.b.duplicate()
        system.J.mult(self.x, residual)
        residual.aypx(-1.0, system.b)
        norms = system.field_norms(system.by_field(residual))
        size = system.b.norm() or 1.0
        relative = residual.norm() / size
        residual.destroy()
        if not np.isfinite(relative):
            hint = "; a factorisation broke down: see -ksp_view, and for MUMPS raise -mat_mumps_icntl_14 on its level"
            raise SolveError(
                f"the solution is not finite after {iterations} iterations ({reason})"
                + (hint if "PC" in reason else "")
            )
        rtol, atol, *_ = self.ksp.getTolerances()
        tolerance = max(self.true_rtol * (rtol / self.rtol if self.rtol else 1.0), atol / size)
        solution = system.by_field(self.x)
        limited = False
        if relative > tolerance:
            floor = ROUNDING_UNITS * system.rounding_level(solution) / size
            limited = bool(relative <= floor)
            tolerance = floor if limited else tolerance
        return Result(
            iterations=iterations,
            converged=bool(relative <= tolerance),
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
        )

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
            self.ksp = None
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
    own = ("petsc_fs.pc.ContactTransform", "petsc_fs.pc.FixedStress")
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
