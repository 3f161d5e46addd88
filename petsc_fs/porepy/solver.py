"""FieldSplitSolver: a mixin with which a PorePy model solves its linear systems by petsc_fs.

    class MyModel(FieldSplitSolver, pp.poromechanics.Poromechanics): ...

    model = MyModel({"petsc_fs_options_file": "contact_poromechanics.opts", ...})
    pp.run_time_dependent_model(model, {})
    print(sum(solve.iterations for solve in model.linear_solves))

PorePy itself is not imported here.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.fields import in_order
from petsc_fs.scene import Scene, contact_state_counts

if TYPE_CHECKING:
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.solver import Solver

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LinearSolve:
    """What one linear solve of a run did.

    Attributes:
        time_step: from 1.
        newton_index: from 0 in each time step.
        unknowns: size of the system.
        iterations: of the outer Krylov method.
        reason: PETSc's name of the reason why it stopped.
        converged: whether the true residual meets the tolerance; see `petsc_fs.solver.Result`.
        true_relative_residual: |b - J x| / |b|.
        contact_states: number of sticking, sliding and open fracture cells at the iterate that the
            system was assembled at; empty without contact.
        seconds: of the whole solve, including the copy to PETSc and back.
        setup_seconds: of building PETSc's matrices and setting the preconditioner up.
        solve_seconds: of the Krylov method.
    """

    time_step: int
    newton_index: int
    unknowns: int
    iterations: int
    reason: str
    converged: bool
    true_relative_residual: float
    contact_states: dict[str, int]
    seconds: float
    setup_seconds: float
    solve_seconds: float


class FieldSplitSolver:
    """Mixin that solves a model's linear systems on one rank by what an options file says.

    It goes before the model's other bases, and takes these from the model's parameters:

    - `petsc_fs_options_file`: path of the options file, or name of a shipped one; default is the
      shipped default for the fields of the model;
    - `petsc_fs_options_prefix`: put before all option names, default "".

    The options of the file are in PETSc's database only while a system is being solved, and what
    stands there already goes first: after `petsc4py.init(sys.argv)` the command line wins, and
    models with different files do not disturb each other.

    A solve that ends before its tolerance is met is used all the same, as in the paper; look at
    `linear_solves` for those.

    Attributes:
        linear_solves: one record per solve, in the order of solving.
    """

    params: dict[str, Any]
    linear_solves: list[LinearSolve]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.linear_solves = []
        self._adapter: Adapter | None = None
        self._solver: Solver | None = None

    def solve_linear_system(self) -> Floats:
        """The Newton update, in PorePy's order.

        Raises:
            LayoutError: the model has unknowns or equations that belong to no field.
            SceneError: the linear system has entries that are not finite.
            UsageError: the options file cannot be used, or has an option that nothing asked for.
            SolveError: PETSc failed, or the solution is not finite.
        """
        from petsc_fs.porepy.adapter import Adapter

        started = time.perf_counter()
        if self._adapter is None:
            self._adapter = Adapter(self)
        scene = self._adapter.scene()
        with inserted(self._options_file(scene), self._options_prefix):
            solver = self._updated_solver(scene)
            result = solver.solve()
            if not self.linear_solves:
                self._refuse_unused(scene)
        update = self._adapter.to_porepy(result.solution)
        states = scene.contact_state
        self.linear_solves.append(
            LinearSolve(
                time_step=scene.metadata.time_step_index,
                newton_index=scene.metadata.newton_index,
                unknowns=update.size,
                iterations=result.iterations,
                reason=result.reason,
                converged=result.converged,
                true_relative_residual=result.true_relative_residual,
                contact_states={} if states is None else contact_state_counts(states),
                seconds=time.perf_counter() - started,
                setup_seconds=result.setup_seconds,
                solve_seconds=result.solve_seconds,
            )
        )
        return update

    @property
    def _options_prefix(self) -> str:
        return str(self.params.get("petsc_fs_options_prefix", ""))

    def _options_file(self, scene: Scene) -> Path:
        name = self.params.get("petsc_fs_options_file")
        if name is None:
            return options.default_for(scene.fields)
        header = options.read_header(options.find_options_file(str(name)))
        if not header.fits(scene.fields):
            raise UsageError(
                f"{header.path.name} is for models with the fields {', '.join(header.fields)}; "
                f"this one has {', '.join(in_order(scene.fields))}"
            )
        return header.path

    def _updated_solver(self, scene: Scene) -> Solver:
        """The solver with the values of the scene; a new one where the grids have changed."""
        from petsc4py import PETSc

        from petsc_fs.solver import Solver

        if self._solver is not None and dict(scene.sizes) != {
            f: self._solver.layout.sizes(f)[1] for f in self._solver.layout.fields
        }:
            self._solver.destroy()
            self._solver = None
        if self._solver is None:
            self._solver = Solver(scene, PETSc.COMM_SELF.tompi4py(), prefix=self._options_prefix)
        else:
            self._solver.update(scene)
        return self._solver

    def _refuse_unused(self, scene: Scene) -> None:
        """Raise a UsageError if an option of the file did nothing."""
        prefix, file = self._options_prefix, self._options_file(scene)
        useless = {prefix + name for name in options.parse(file)} & set(options.unused())
        if not useless:
            return
        raise UsageError(options.explain(sorted(useless), file=file))


@contextmanager
def inserted(file: Path, prefix: str = "") -> Iterator[None]:
    """Have the options of a file in PETSc's database within a block; what is set there already stays.

    Local.

    Args:
        file: options file.
        prefix: put before each name.

    Raises:
        UsageError: the file cannot be read.
    """
    from petsc4py import PETSc

    database = PETSc.Options()
    already = database.getAll()
    new = {prefix + name: value for name, value in options.parse(file).items() if prefix + name not in already}
    for name, value in new.items():
        database.setValue(name, value)
    try:
        yield
    finally:
        for name in new:
            database.delValue(name)
