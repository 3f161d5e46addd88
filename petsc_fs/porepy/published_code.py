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

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.porepy.parity import Measured, Progress, Run, append, commit, find_run, line, versions
from petsc_fs.scene import contact_state_counts

PREFIX = "petsc_fs_again_"
"""Of the options of the second solve: the published code clears all options before each of its own."""

GMRES, RICHARDSON = 2, 1
STIFFNESS_TYPE = {0.0: 0, 1.2e9: 2, 1.2e19: 5}
FRICTION_TYPE = {0.1: 0, 0.577: 1, 0.8: 2}


def run(name: str, directory: Path, progress: Progress | None = None) -> Measured:
    """Run the published code on one of its models and solve each system a second time.

    Args:
        name: in `petsc_fs.porepy.parity.RUNS`.
        directory: of the published code.
        progress: called with a line of text per Newton step.

    Raises:
        UsageError: the published code is not there, or does not find what it needs.
        PetscFsError: see `petsc_fs.porepy.solver.FieldSplitSolver`.
    """
    this = find_run(name)
    script = _script(this, directory)
    found = Measured(0, 0.0, versions() | {"published code": commit(directory)}, [])

    class Both(script.Setup):  # type: ignore[name-defined]
        """A published model that solves twice."""

        def solve_linear_system(self) -> NDArray[np.float64]:
            update: NDArray[np.float64] = super().solve_linear_system()
            # It keeps the length of PETSc's residual history, which begins with the initial residual.
            theirs = self._linear_solve_stats.krylov_iters - 1
            time_step, states, again, converged = _solve_again(self, this.options_file)
            append(found.history, time_step, [theirs, *states.values()])
            while len(found.again) < time_step:
                found.again.append([])
            found.again[-1].append(again)
            found.unconverged += not converged
            found.unknowns = update.size
            if progress is not None:
                progress(f"{line(name, found.history)}; petsc_fs {again} iterations")
            return update

    started = time.perf_counter()
    with (
        tempfile.TemporaryDirectory() as scratch,
        open(os.devnull, "w") as nowhere,
        contextlib.chdir(scratch),
        contextlib.redirect_stdout(nowhere),
        mock.patch.object(script, "Setup", Both),
    ):
        script.run_model(_setup(this))
    found.seconds = time.perf_counter() - started
    return found


def _script(this: Run, directory: Path) -> Any:
    """The published run script of a model, as a module."""
    if not (directory / "hm_solver.py").is_file():
        raise UsageError(f"{directory}: not the published code; it has no hm_solver.py")
    path = str(directory.resolve())
    if path not in sys.path:
        sys.path.insert(0, path)
    try:
        return import_module(f"experiments.mandel_runscript_{this.model.removeprefix('model')}")
    except (ImportError, AttributeError) as e:
        raise UsageError(f"{directory}: the published code cannot be imported with this PorePy: {e}") from e


def _setup(this: Run) -> dict[str, Any]:
    """A run in the words of the published code."""
    parameters = this.parameters
    restricted = parameters.physics == "restricted"
    refinement = parameters.refinement
    setup: dict[str, Any] = {
        "physics": 0 if restricted else 1,
        "geometry": 0,
        "barton_bandis_stiffness_type": STIFFNESS_TYPE[parameters.normal_stiffness],
        "friction_type": FRICTION_TYPE[parameters.friction],
        "grid_refinement": int(refinement) if refinement == int(refinement) else refinement,
        "solver": RICHARDSON if restricted else GMRES,
        "save_matrix": False,
        "high_boundary_pressure_ratio": 10 if restricted else 13,
    }
    return setup | ({"permeability": 0} if this.model == "model3" else {})


def _solve_again(model: Any, options_file: str) -> tuple[int, dict[str, int], int, bool]:
    """Solve the linear system of a published model: time step, contact states, iterations, converged."""
    from petsc4py import PETSc

    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.porepy.solver import inserted
    from petsc_fs.solver import Solver

    permuted = model.linear_system
    back = np.argsort(model.contact_permutation)
    model.linear_system = permuted[0].tocsr()[back], permuted[1][back]
    try:
        scene = Adapter(model).scene()
    finally:
        model.linear_system = permuted
    PETSc.Options().setValue(f"{PREFIX}petsc_fs_restarts", 0)  # as the published code
    with inserted(options.find_options_file(options_file), PREFIX):
        solver = Solver(scene, PETSc.COMM_SELF.tompi4py(), prefix=PREFIX)
        result = solver.solve()
        solver.destroy()
    states = {} if scene.contact_state is None else contact_state_counts(scene.contact_state)
    return scene.metadata.time_step_index, states, result.iterations, result.converged
