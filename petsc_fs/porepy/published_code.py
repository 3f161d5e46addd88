# mypy: disallow-subclassing-any=False
"""The published code, run on its own models, with each of its linear systems solved by petsc_fs too.

It is github.com/Yuriyzabegaev/FTHM-Solver at d9b687b, in some directory; the PorePy that it needs,
commit 9befd80f, is the one that Python has to find.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import UsageError
from petsc_fs.options import inserted
from petsc_fs.porepy.parity import (
    AS_PUBLISHED,
    Keep,
    Measured,
    Progress,
    Run,
    add_solve,
    append,
    commit,
    find_run,
    line,
    versions,
)
from petsc_fs.porepy.solver import FieldSplitSolver

PREFIX = "petsc_fs_again_"
"""Of the options of the second solve: the published code clears all options before each of its own."""

STIFFNESS_TYPE = {0.0: 0, 1.2e5: 1, 1.2e9: 2, 1.2e13: 3, 1.2e17: 4, 1.2e19: 5}
FRICTION_TYPE = {0.1: 0, 0.577: 1, 0.8: 2}
SOLVER = {"fixed_stress_richardson.opts": 1, "contact_poromechanics.opts": 2, "contact_poromechanics_direct.opts": 21}
"""Its numbers for a stiffness, a friction coefficient, and the solver of an options file."""


class _LastStep(Exception):
    """Ends a run after the last time step that was asked for."""


def run(name: str, directory: Path, progress: Progress | None = None) -> Measured:
    """Run the published code on one of its models, see `measure`; `name` is in `petsc_fs.porepy.parity.RUNS`."""
    return measure(name, find_run(name), directory, progress)


def measure(
    name: str,
    this: Run,
    directory: Path,
    progress: Progress | None = None,
    *,
    time_steps: int | None = None,
    keep: Keep | None = None,
    by: str | None = None,
) -> Measured:
    """Run the published code on one of its models and solve each system a second time, by `FieldSplitSolver`.

    Both solves are timed. Which one comes first changes from system to system. The published solve is
    all of its `solve_linear_system`, the other all of that of `FieldSplitSolver`, which keeps its
    solver from one Newton step to the next as it does in a simulation of its own, and solves on all
    ranks where there are several; the published code runs on rank 0 while the others sleep.

    Args:
        name: of the run, for `progress`.
        this: what to run.
        directory: of the published code.
        progress: called with a line of text per Newton step.
        time_steps: at most so many; None: all of the model.
        keep: called after each linear system with what there is so far, marked as unfinished.
        by: options file of the second solve; None: that of the run, which does what the published code does.

    Raises:
        UsageError: the published code is not there, does not find what it needs, or has no such run.
        PetscFsError: see `petsc_fs.porepy.solver.FieldSplitSolver`.
    """
    script, setup = _script(this, directory), _setup(this)
    published: Any = script.Setup
    found = Measured(0, 0.0, versions() | {"published code": commit(directory)}, [], unfinished=True)
    started = time.perf_counter()

    class Both(FieldSplitSolver, published):
        """A published model that solves twice."""

        linear_system: Any

        def __init__(self, params: dict[str, Any]) -> None:
            file = by or this.options_file
            super().__init__(params | {"petsc_fs_options_file": file, "petsc_fs_options_prefix": PREFIX})

        def solve_linear_system(self) -> NDArray[np.float64]:
            time_step = int(self.time_manager.time_index)
            if time_steps is not None and time_step > time_steps:
                raise _LastStep
            if len(found.timings) % 2:
                self._solve_again()
                update = self._solve_as_published()
            else:
                update = self._solve_as_published()
                self._solve_again()
            solve = self.linear_solves[-1]
            add_solve(found, solve)
            found.timings[-1] += [*self._published_seconds, self._processor, self._published_processor]
            # It keeps the length of PETSc's residual history, which begins with the initial residual.
            theirs = self._linear_solve_stats.krylov_iters - 1
            append(found.history, time_step, [theirs, *solve.contact_states.values()])
            while len(found.again) < time_step:
                found.again.append([])
            found.again[-1].append(solve.iterations)
            found.seconds = time.perf_counter() - started
            if progress is not None:
                progress(f"{line(name, found.history)}; petsc_fs {solve.iterations} iterations")
            if keep is not None:
                keep(found)
            return update

        def _solve_as_published(self) -> NDArray[np.float64]:
            from petsc4py import PETSc

            # Its objects belong to this rank alone, though it does not say so.
            PETSc.Sys.setDefaultComm(PETSc.COMM_SELF)
            started, processor = time.perf_counter(), time.process_time()
            try:
                update: NDArray[np.float64] = published.solve_linear_system(self)
            finally:
                total = time.perf_counter() - started
                self._published_processor = time.process_time() - processor
                PETSc.Sys.setDefaultComm(PETSc.COMM_WORLD)
            self._published_seconds = [self._set_up_seconds, total - self._set_up_seconds]
            return update

        def _solve_again(self) -> None:
            permuted = self.linear_system
            back = np.argsort(self.contact_permutation)
            self.linear_system = permuted[0].tocsr()[back], permuted[1][back]
            # The published code does not restart either.
            changes = {"petsc_fs_restarts": "0", **AS_PUBLISHED, **this.changes}
            processor = time.process_time()
            try:
                with inserted({PREFIX + key: value for key, value in changes.items()}):
                    FieldSplitSolver.solve_linear_system(self)
            finally:
                self._processor = time.process_time() - processor
                self.linear_system = permuted

        def make_solver_scheme(self) -> Any:
            """The scheme of the published code, whose set-up is timed."""
            scheme = super().make_solver_scheme()
            make = scheme.make_solver

            def timed(matrix: Any) -> Any:
                started = time.perf_counter()
                solver = make(matrix)
                self._set_up_seconds = time.perf_counter() - started
                return solver

            scheme.make_solver = timed
            return scheme

    with (
        tempfile.TemporaryDirectory() as scratch,
        open(os.devnull, "w") as nowhere,
        contextlib.chdir(scratch),
        contextlib.redirect_stdout(nowhere),
        mock.patch.object(script, "Setup", Both),
        contextlib.suppress(_LastStep),
    ):
        script.run_model(setup)
    found.unfinished = False
    return found


def _script(this: Run, directory: Path) -> Any:
    """The published run script of a model, as a module."""
    if not (directory / "hm_solver.py").is_file():
        raise UsageError(f"{directory}: not the published code; it has no hm_solver.py")
    path = str(directory.resolve())
    if path not in sys.path:
        sys.path.insert(0, path)
    import petsc4py

    try:
        # Initialising PETSc once more would have it tidied up twice at exit, first while other ranks still sleep.
        with mock.patch.object(petsc4py, "init"):
            return import_module(f"experiments.mandel_runscript_{this.model.removeprefix('model')}")
    except (ImportError, AttributeError) as e:
        raise UsageError(f"{directory}: the published code cannot be imported with this PorePy: {e}") from e


def _setup(this: Run) -> dict[str, Any]:
    """A run in the words of the published code.

    Raises:
        UsageError: it has no such run.
    """
    parameters = this.parameters
    if parameters.normal_stiffness not in STIFFNESS_TYPE or parameters.friction not in FRICTION_TYPE:
        raise UsageError(
            f"the published code has no K_n = {parameters.normal_stiffness:g} with F = {parameters.friction:g}"
        )
    if parameters.fracture_permeability is not None:
        raise UsageError(f"the published code has no choice of fracture permeability ({parameters.changes()})")
    if this.options_file not in SOLVER or this.changes:
        raise UsageError(f"the published code has no solver like {this.options_file} {dict(this.changes) or ''}")
    restricted = parameters.physics == "restricted"
    refinement = parameters.refinement
    setup: dict[str, Any] = {
        "physics": 0 if restricted else 1,
        "geometry": 0,
        "barton_bandis_stiffness_type": STIFFNESS_TYPE[parameters.normal_stiffness],
        "friction_type": FRICTION_TYPE[parameters.friction],
        "grid_refinement": int(refinement) if refinement == int(refinement) else refinement,
        "solver": SOLVER[this.options_file],
        "save_matrix": False,
        "high_boundary_pressure_ratio": 10 if restricted else 13,
    }
    return setup | ({"permeability": 0} if this.model == "model3" else {})
