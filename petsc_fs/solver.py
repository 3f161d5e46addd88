"""Solver: a KSP by PETSc's options on one system after another, judged by the system as it was given."""

from __future__ import annotations

import gc
import math
import time
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs import options as database
from petsc_fs.errors import SceneError, SolveError, UsageError
from petsc_fs.partition import Layout, chosen, partition
from petsc_fs.petsc_errors import brief, check_build, translate
from petsc_fs.refinement import PETSC_ATOL, Refinement, Spectrum
from petsc_fs.result import Result
from petsc_fs.scene import Scene
from petsc_fs.singular import attach, describe, null_vectors
from petsc_fs.system import FieldArrays, System, norm

__all__ = ["Result", "Solver"]


class Solver:
    """Solves a scene by what the options database says, and further scenes of the same fields and sizes.

    Where the database chooses no preconditioner (`-pc_type`), the default options file for the scene's fields does.

    Options beside those of `petsc_fs.partition.chosen`:
        -petsc_fs_retry <none> (an options file, none): a second solve by this file, where the first has not converged.
        -retry_*: what -petsc_fs_retry's file has, with this prefix.

    Attributes:
        built_seconds: spent since the last solve on building PETSc's matrices and setting the preconditioner up.
        rtol: relative tolerance, -ksp_rtol.
        layout: distribution of the rows.
        system: the present system.
        ksp: the Krylov method. What it sees is the equilibrated system.
        left_out: what the default solver leaves out because the scene has no need of it, a line each.
    """

    def __init__(
        self,
        scene: Scene | None,
        comm: MPI.Intracomm | None = None,
        *,
        layout: Layout | None = None,
        prefix: str = "",
        release: bool = False,
        root_only: bool = False,
    ) -> None:
        """Build the system; nothing is factored yet.

        Collective.

        Args:
            scene: all rows on every rank, or each rank's share of them in the scene's numbering (see
                `petsc_fs.io.reader`), or with `root_only` all rows on rank 0 and None elsewhere.
            comm: communicator, default MPI_COMM_WORLD.
            layout: distribution of rows; default by -petsc_fs_partition and -petsc_fs_ordering.
            prefix: of all options of this solver, including its own.
            release: empty `scene.blocks` while PETSc's matrices are made, for callers that have no other use
                for them: matrix and scene are then not both in memory.
            root_only: see `scene`.

        Raises:
            SceneError: the scene does not fit together.
            UsageError: an option has an impossible value, or PETSc is built for complex numbers.
        """
        check_build()
        mpi = comm or MPI.COMM_WORLD
        started = time.perf_counter()
        _destroy_dropped(mpi)
        number = _number(mpi)
        self.prefix = prefix
        self._root_only = root_only
        whole = layout or partition(scene, mpi, *chosen(prefix), prefix)
        self.layout = whole.only(f for f in whole.fields if whole.sizes(f)[1])
        if not self.layout.fields:
            raise SceneError("the scene has no unknowns")
        self._scene = self._part(scene)
        if release and scene is not None:
            scene.blocks.clear()
        self._chosen = self._choose(mpi)
        self.left_out = self._chosen.left_out
        self._retry: _Retry | None = None
        with self._options():
            self.system = System(self.layout, root_only=root_only, near_null_space=needs_near_null_space(prefix))
            self.system.take(self._scene, release=release)
            self._forget_blocks()
            self.ksp = self._make_ksp(prefix)
        tolerances = self.ksp.getTolerances()
        self.rtol, self._atol = float(tolerances[0]), float(tolerances[1])
        self._finalizer = weakref.finalize(self, _dropped.__setitem__, number, _Parts(self))
        self._finalizer.atexit = False  # where nothing collective may depend on what is alive on a rank
        self._rounding: dict[str, float] = {}
        self.built_seconds = time.perf_counter() - started

    def __repr__(self) -> str:
        default = self._chosen.file.name if self._chosen.file else "the smallest solver"
        return f"<Solver by {default if self._chosen.values else 'options of the database'} for {self.layout!r}>"

    @property
    def rebuilds(self) -> int:
        """How often matrices of blocks were made anew because their pattern had changed."""
        return self.system.renewals

    def _part(self, scene: Scene | None) -> Scene | None:
        return None if scene is None else scene.only(self.layout.fields)

    def _choose(self, comm: MPI.Intracomm) -> database.Choice:
        """The default options for the scene, where the database has none. Collective."""
        if PETSc.Options(self.prefix).hasName("pc_type"):
            return database.Choice()
        facts = None
        if self._scene is not None:
            alone = PETSc.COMM_SELF.tompi4py()
            facts = database.Facts.of(self._scene, alone if self._root_only else comm)
        return database.choose(comm.bcast(facts) if self._root_only or facts is None else facts)

    @contextmanager
    def _options(self) -> Iterator[None]:
        """Have the default options in the database where there are none, and Python's garbage collection off.

        Collection inside petsc4py's error handler swallows the pending exception of a Python PC and crashes.
        """
        collecting = gc.isenabled()
        gc.disable()
        try:
            with database.inserted(self._chosen.values, self.prefix):
                yield
        finally:
            if collecting:
                gc.enable()

    @property
    def _matrix(self) -> PETSc.Mat:
        """What the KSP works on: the nest, or the only block."""
        fields = self.layout.fields
        return self.system.J if len(fields) > 1 else self.system.blocks[fields[0], fields[0]]

    def _make_ksp(self, prefix: str) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.layout.comm)
        ksp.setOptionsPrefix(prefix)
        ksp.setOperators(self._matrix, self._matrix)
        nest.give_fields(ksp)
        try:
            ksp.setFromOptions()
        except (PETSc.Error, ImportError) as e:
            ksp.destroy()
            raise UsageError(f"PETSc refuses an option: {brief(e)}") from e
        ksp.setConvergenceHistory(reset=True)
        Spectrum(ksp)
        return ksp

    def update(self, scene: Scene | None) -> None:
        """Take another scene of the same fields and sizes, given as the first one was; PCs are kept and updated.

        Collective.

        Raises:
            SceneError: the scene does not fit together, or into the layout.
        """
        started = time.perf_counter()
        _destroy_dropped(self.layout.comm)
        self._scene = self._part(scene)
        with self._options():
            self.system.take(self._scene)
            self._forget_blocks()
            self.ksp.setOperators(self._matrix, self._matrix)
        self._drop_retry()
        PETSc.garbage_cleanup(self.layout.comm)
        self.built_seconds = time.perf_counter() - started

    def _forget_blocks(self) -> None:
        """Matrices are in PETSc now; of the scene only what explains and checks the solution is kept."""
        if self._scene is not None:
            self._scene = replace(self._scene, blocks={})

    def set_up(self) -> None:
        """Set the preconditioner up, where it is not. Collective.

        Raises:
            SolveError: PETSc could not.
            PetscFsError: an operator or option of a level is impossible.
        """
        started = time.perf_counter()
        with self._options():
            try:
                _set_up(self.ksp)
            except SceneError as e:
                if e.cell is not None and e.cell[0] in self.layout.fields:
                    name, number = e.cell
                    raise SceneError(
                        f"{e}".replace(f"cell {number}", f"cell {self.layout.scene_cell(name, number)}", 1)
                    ) from None
                raise
        self.built_seconds += time.perf_counter() - started

    def solve(
        self,
        rtol: float | None = None,
        rhs: Mapping[str, NDArray[np.float64]] | None = None,
        *,
        error: float = math.inf,
        rounding: Mapping[str, float] | None = None,
    ) -> Result:
        """Solve for the right-hand side of the scene, from a zero initial guess. Collective.

        The Krylov method runs to its tolerance; where its solution does not count as converged (see `Result`), it runs
        again for a correction, as long as each pass halves what is missing, within -ksp_max_it. A Krylov method that
        stops early is no error.

        Args:
            rtol: relative tolerance of this solve, if a looser one than -ksp_rtol is enough.
            rhs: another right-hand side for the same matrix, given as that of the scene was; kept for further solves.
            error: root mean square over all unknowns that the error of the solution should have at most; where the
                tolerances leave more of it, by estimate, there is another correction. That decides nothing.
            rounding: norm of each field up to which an error is none, as when the solution is added to something that
                is so much larger; of fields that are missing, 0.

        Raises:
            SolveError: PETSc failed on the way, or the solution is not finite.
        """
        wanted, self._rounding = max(self.rtol, rtol or 0.0), dict(rounding or {})
        if rhs is not None:
            self.system.set_rhs(rhs)
        file = PETSc.Options(self.prefix).getString("petsc_fs_retry", "none")
        first: Result | SolveError | SceneError
        try:
            first = self._first(wanted, error)
        except (SolveError, SceneError) as e:
            if file == "none":
                raise
            e.__cause__ = e.__context__ = None  # whose frames would keep PETSc's objects, on some ranks only
            first = e.with_traceback(None)
        if isinstance(first, Result) and (first.converged or file == "none"):
            result = first
        else:
            with self._options():
                result = self._solve_again(file, wanted, first)
        result = replace(result, setup_seconds=self.built_seconds)
        self.built_seconds = 0.0
        return result

    def _first(self, wanted: float, error: float) -> Result:
        """By the options of this solver. Collective."""
        self.set_up()
        with self._options():
            result = self._run(self.ksp, wanted, error)
            return result if result.converged else self._look_for_null_vectors(result, wanted)

    def _run(self, ksp: PETSc.KSP, wanted: float, error: float = math.inf) -> Result:
        """The Krylov method and its corrections, and what comes of them. Collective."""
        started = time.perf_counter()
        system = self.system
        run = Refinement(system, ksp, wanted, self._atol if self._atol > PETSC_ATOL else 0.0, self._rounding)
        try:
            run.first()
            run.correct()
            run.estimate_error()
            if error < math.inf:
                run.sharpen(error)
            run.explain()
            self._history = np.concatenate(run.history) if run.history else np.zeros(0)
            with np.errstate(over="ignore"):
                solution = {f: np.ldexp(v, -system.rhs_scale) for f, v in system.by_field(run.x).items()}
            if not self.layout.comm.allreduce(all(np.isfinite(v).all() for v in solution.values()), MPI.LAND):
                raise SolveError("the solution is too large for numbers of double precision: use other units")
        finally:
            run.destroy()
            ksp.setTolerances(rtol=self.rtol, atol=self._atol, max_it=run.max_it)
        check, size = run.check, norm(run.check.rhs)
        return Result(
            iterations=run.iterations,
            converged=run.missing <= 1.0 and run.is_determined,
            reason=run.reason,
            rtol=wanted,
            tolerance=run.goal,
            field_tolerance=run.field_goal,
            true_relative_residual=check.relative,
            residual_by_field={f: n / (size or 1.0) for f, n in check.residual.items()},
            backward_error_by_field=check.backward,
            estimated_error_by_field=run.estimates,
            error_by_field=self._errors(solution),
            passes=tuple(run.passes),
            setup_seconds=0.0,
            solve_seconds=time.perf_counter() - started,
            solution=solution,
            notes=run.notes,
        )

    def _look_for_null_vectors(self, result: Result, wanted: float) -> Result:
        """Where a solve has failed as the system is singular, say so, and solve without its null space. Collective."""
        vectors = null_vectors(self.system)
        if not vectors:
            return result
        note = describe(self.system, vectors)
        attach(self.system, self._matrix, vectors)
        again = self._run(self.ksp, wanted)
        return replace(
            again,
            iterations=result.iterations + again.iterations,
            passes=result.passes + again.passes,
            solve_seconds=result.solve_seconds + again.solve_seconds,
            notes=(note + (". Solved for the solution without it" if again.converged else ""), *again.notes),
        )

    def _errors(self, solution: FieldArrays) -> dict[str, float]:
        """Relative error of each field, where the scene has a reference. Collective."""
        comm, fields = self.layout.comm, self.layout.fields
        reference = self._scene.reference if self._scene is not None else {}
        known = set(reference) == set(fields)
        if not comm.bcast(known) if self._root_only else not known:
            return {}
        exact = {f: self.system.to_layout(f, reference.get(f)) for f in fields}
        error, size = self.system.norms({f: solution[f] - exact[f] for f in fields}, exact)
        return {f: error[f] / (size[f] or 1.0) for f in fields}

    # The second solve

    def _solve_again(self, name: str, wanted: float, first: Result | SolveError | SceneError) -> Result:
        """By another options file, on the same system. Collective."""
        started = time.perf_counter()
        if self._retry is None:
            self._retry = _Retry(self, name)
        _set_up(self._retry.ksp)
        self.built_seconds += time.perf_counter() - started
        second = self._run(self._retry.ksp, wanted)
        if not isinstance(first, Result):
            return replace(second, notes=(f"first solve: {first}; again by {name}", *second.notes))
        note = f"first solve: {first.verdict} after {first.iterations} iterations ({first.reason}); again by {name}"
        return replace(
            second,
            iterations=first.iterations + second.iterations,
            passes=first.passes + second.passes,
            solve_seconds=first.solve_seconds + second.solve_seconds,
            notes=(note, *second.notes),
        )

    def _drop_retry(self) -> None:
        if self._retry is not None:
            self._retry.destroy()
            self._retry = None

    def history(self) -> NDArray[np.float64]:
        """Residual norms of the last solve, as the Krylov method saw them, pass after pass."""
        return self._history

    def destroy(self) -> None:
        """Free PETSc's objects. Collective; may be called twice."""
        self._drop_retry()
        found = self._finalizer.detach()
        if found is not None:
            _, _, (_, parts), _ = found
            with suppress(PETSc.Error):  # of what an error has left in the middle of an operation
                parts.destroy()
                PETSc.garbage_cleanup(self.layout.comm)


class _Parts:
    """What a solver leaves to be destroyed, apart from it."""

    def __init__(self, solver: Solver) -> None:
        self.ksp, self.system, self.comm = solver.ksp, solver.system, solver.layout.comm

    def destroy(self) -> None:
        """Collective."""
        self.ksp.destroy()
        self.system.destroy()


_numbers: dict[int, int] = {}
"""How many solvers a communicator has had, which all of its ranks count alike; by handle."""
_dropped: dict[tuple[int, int], _Parts] = {}
"""Of solvers that were let go without `destroy`, by communicator and number; freed when its ranks meet."""


_anchors: dict[int, PETSc.IS] = {}
"""An object for each communicator, which PETSc duplicates for the first object, collectively, and frees with the last,
which ranks may have at different times after an error."""


def _number(comm: MPI.Intracomm) -> tuple[int, int]:
    handle = comm.py2f()
    if handle not in _anchors:
        _anchors[handle] = PETSc.IS().createStride(0, comm=comm)
    _numbers[handle] = _numbers.get(handle, 0) + 1
    return handle, _numbers[handle]


def _destroy_dropped(comm: MPI.Intracomm) -> None:
    """Free what all ranks have let go of. Collective."""
    mine = {number for handle, number in _dropped if handle == comm.py2f()}
    if not comm.allreduce(len(mine), MPI.MIN):
        return
    for number in sorted(set.intersection(*comm.allgather(mine))):
        _dropped.pop((comm.py2f(), number)).destroy()
    PETSc.garbage_cleanup(comm)


class _Retry:
    """KSP and options of the second solve."""

    def __init__(self, solver: Solver, name: str) -> None:
        self.prefix = f"{solver.prefix}retry_"
        file = database.fitting_file(name, solver.layout.fields)
        self._inserted = database.insert_all(database.parse(file), self.prefix)
        self.ksp = solver._make_ksp(self.prefix)

    def destroy(self) -> None:
        """Collective."""
        self.ksp.destroy()
        database.delete_all(self._inserted)


def _set_up(ksp: PETSc.KSP) -> None:
    """Set a KSP up, with what PCFIELDSPLIT leaves to the first application. Collective."""
    try:
        ksp.setUp()
        for level in nest.levels(ksp.getPC()):
            level.setUp()
            level.setUpOnBlocks()
    except (PETSc.Error, ImportError) as e:
        raise translate(e, "set-up failed") from None


def needs_near_null_space(prefix: str) -> bool:
    """Whether the solver in the options database makes use of rigid-body modes. Local."""
    chosen = {k: str(v) for k, v in PETSc.Options().getAll().items() if k.startswith(prefix)}
    types = {v for k, v in chosen.items() if k.endswith("pc_type")}
    foreign = any(k.endswith("pc_python_type") and not v.startswith("petsc_fs.pc.") for k, v in chosen.items())
    nodal = any(k.endswith(("boomeramg_nodal_coarsen", "boomeramg_vec_interp_variant")) for k in chosen)
    return nodal or foreign or bool(types & {"gamg", "ml", "bddc", "hmg"})
