"""FieldSplitSolver: a mixin with which a PorePy model solves its linear systems by petsc_fs, on all ranks.

    class MyModel(FieldSplitSolver, pp.poromechanics.Poromechanics): ...

    model = MyModel({...})
    pp.run_time_dependent_model(model, {})
    print(sum(solve.iterations for solve in model.linear_solves))

Started with `mpiexec -n 4 python script.py`, rank 0 runs PorePy and the script, and the other ranks help to solve.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs import options, server
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.porepy.forcing import EisenstatWalker, EisenstatWalkerParameters
from petsc_fs.scene import Scene, contact_state_counts

if TYPE_CHECKING:
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.solver import Result

Floats = NDArray[np.float64]

logger = logging.getLogger("petsc_fs")

ON_FAILURE = ("accept", "retry", "raise")
"""Values of -petsc_fs_on_failure; the first is the default."""

FORCING = ("fixed", "eisenstat_walker")
"""Values of -petsc_fs_forcing; the first is the default."""

RETRY_FILE = "retry.opts"
"""-petsc_fs_retry where -petsc_fs_on_failure is retry."""

INCREMENT_TOLERANCE = 1e-10
"""PorePy's default of `nl_convergence_tol`, the root mean square of the increment that ends Newton's method; what a
model has says `check_convergence`, after the first solve."""

UNNOTICED = 0.1
"""Part of it that the error of the first update in a time step may have: it is the next increment if all is linear, and
would be taken for a sign that another step is needed."""

FIRST = "first solve: "
"""How the note of a solve that was tried again begins."""


@dataclass(frozen=True)
class LinearSolve:
    """What one linear solve of a run did.

    Attributes:
        time_step: from 1.
        newton_index: from 0 in each time step.
        unknowns: size of the system.
        ranks: number of ranks that solved it.
        iterations: of the outer Krylov method.
        passes: iterations of each of its runs, see `petsc_fs.result.Result`.
        reason: PETSc's name of the reason why it stopped.
        converged: whether the true residual meets the tolerance; see `petsc_fs.solver.Result`.
        true_relative_residual: |b - J x| / |b|.
        forcing: relative tolerance that was asked for: -ksp_rtol, or the forcing term of inexact Newton.
        nonlinear_residual: norm of the residual, as Newton measures it, at the iterate that the system was
            assembled at.
        action: "" if the solve converged at first; "retried" if it did by the options file of -petsc_fs_retry; else
            what -petsc_fs_on_failure did: "accepted" (the update was used as it is) or "raised" (the run ended).
        failure: what went wrong, at first where the solve was tried again, in words; "" if nothing.
        contact_states: number of sticking, sliding and open fracture cells at the iterate that the
            system was assembled at; empty without contact.
        rebuilds: how often, in this run so far, PETSc's objects were made anew because the sparsity had
            changed, or the grids.
        seconds: of the whole solve: the sum of the next three and a little.
        transfer_seconds: of cutting PorePy's matrix into fields and getting the update back into PorePy's order.
        setup_seconds: of building PETSc's matrices, which brings values to ranks, and setting the preconditioner up.
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
    transfer_seconds: float = 0.0
    ranks: int = 1
    forcing: float = float("nan")
    nonlinear_residual: float = float("nan")
    action: str = ""
    failure: str = ""
    rebuilds: int = 0
    passes: tuple[int, ...] = ()


class FieldSplitSolver:
    """Mixin that solves a model's linear systems on all ranks by what an options file says.

    It goes before the model's other bases. On several ranks, rank 0 alone gets past the construction of the first
    such model: the others work for it until its process ends, and end with it (see `petsc_fs.server`). What a script
    does after that, it does once. On one rank nothing is sent anywhere.

    From the model's parameters it takes:

    - `petsc_fs_options_file`: path of the options file, or name of a shipped one; default is the one for the
      fields of the model;
    - `petsc_fs_options_prefix`: put before all option names, default "";
    - `nl_convergence_tol`, as PorePy's Newton method has it, until that tells: the first update of a time step gets a
      correction more where its error would not pass for convergence.

    The options of the file are in PETSc's database only while a system is being solved, and what
    stands there already goes first: after `petsc4py.init(sys.argv)` the command line wins, and
    models with different files do not disturb each other. An option that does nothing in the first solve ends the
    run; -petsc_fs_allow_unused names those that may (see `petsc_fs.options`).

    Options beside those of `petsc_fs.solver.Solver`:
        -petsc_fs_on_failure <accept> (accept, retry, raise): what happens to a solve that misses its tolerance, with
            a warning to the logger "petsc_fs". accept uses the update all the same, as the paper did, as long as the
            linear residual is less than that of no update at all. It is the default: what Newton's method needs is a
            smaller residual, whether it got there it sees for itself, and a second solve by stronger means may not
            fit into memory. retry is -petsc_fs_retry retry.opts, and raises if that fails too.
        -petsc_fs_forcing <fixed> (fixed, eisenstat_walker): solve to -ksp_rtol, or each system only as far as Newton
            makes use of it, but never further than to -ksp_rtol; see `petsc_fs.porepy.forcing.EisenstatWalker`.
            Residuals are measured as Newton does, by the model's `compute_residual_norm`. Its parameters are those of
            `petsc_fs.porepy.forcing.EisenstatWalkerParameters`.
        -petsc_fs_keep_affine <True>: parts of equations that are affine in the unknowns are evaluated again only when
            what they are made of has changed; see `petsc_fs.porepy.equations`. This and the next one are asked for
            before an options file is: they belong on the command line.
        -petsc_fs_share <True>: large grids are discretised by all ranks.
        -petsc_fs_least_rows <3000>: unknowns that a rank should have; smaller systems are solved on fewer ranks.

    Attributes:
        linear_solves: one record per solve, in the order of solving.

    Raises:
        UsageError: of the class statement, where a base with a linear solver of PorePy's goes before this one.
    """

    params: dict[str, Any]
    linear_system: tuple[Any, Floats]
    linear_solves: list[LinearSolve]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for base in cls.__mro__[: cls.__mro__.index(FieldSplitSolver)]:
            if base.__module__.partition(".")[0] == "porepy" and "solve_linear_system" in vars(base):
                raise UsageError(
                    f"{cls.__name__}: FieldSplitSolver comes after {base.__name__}, whose linear solver would be used; "
                    f"put it first: class {cls.__name__}(FieldSplitSolver, ...)"
                )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._client = server.join()
        super().__init__(*args, **kwargs)
        self.linear_solves = []
        self._adapter: Adapter | None = None
        self._solver: server.ServedSolver | None = None
        self._file: Path | None = None
        self._values: dict[str, str | None] = {}
        self._forcing: EisenstatWalker | None = None
        self._newton_tolerance: float | None = None
        self._increment_tolerance = float(self.params.get("nl_convergence_tol", INCREMENT_TOLERANCE))
        self._reference_residual: Floats | None = None

    def set_geometry(self) -> None:
        """PorePy's own; gmsh leaves handlers of signals that end the process at once, which are taken back."""
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        super().set_geometry()  # type: ignore[misc]
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def set_equation_system_manager(self) -> None:
        """PorePy's own, with an equation system that does less in each Newton step, and has help from waiting ranks."""
        from petsc4py import PETSc

        from petsc_fs.porepy.equations import EquationSystem

        if not hasattr(self, "equation_system"):
            database = PETSc.Options(self._options_prefix)
            keep, share = database.getBool("petsc_fs_keep_affine", True), database.getBool("petsc_fs_share", True)
            client = self._client if share else None
            self.equation_system = EquationSystem(self.mdg, keep=keep, client=client)  # type: ignore[attr-defined]
        super().set_equation_system_manager()  # type: ignore[misc]

    def discretize(self) -> None:
        """PorePy's own, once it is clear that unknowns and equations of the model pair up."""
        self._prepare_adapter()
        super().discretize()  # type: ignore[misc]

    def solve_linear_system(self) -> Floats:
        """The Newton update, in PorePy's order.

        Raises:
            LayoutError: unknowns and equations of the model do not pair up.
            SceneError: the linear system has entries that are not finite.
            UsageError: the options file cannot be used, or has an option that nothing asked for.
            SolveError: PETSc failed, the solution is not finite, or -petsc_fs_on_failure ends the run.
        """
        started = time.perf_counter()
        scene = self._prepare_adapter().scene()
        cut_seconds = time.perf_counter() - started
        with self._options(scene):
            policy = self._option("petsc_fs_on_failure", ON_FAILURE)
            residual = self._nonlinear_residual(scene)
            forcing = self._forcing_term(residual)
            solver = self._updated_solver(scene)
            first = scene.metadata.newton_index == 0 and forcing is None
            error = UNNOTICED * self._increment_tolerance if first else math.inf
            result = solver.solve(forcing, error=error, rounding=self._rounding())
            if not self.linear_solves:
                self._refuse_unused()
        action, failure = self._judge(result, policy)
        back = time.perf_counter()
        update = self._prepare_adapter().to_porepy(result.solution)
        states = scene.contact_state
        self.linear_solves.append(
            LinearSolve(
                time_step=scene.metadata.time_step_index,
                newton_index=scene.metadata.newton_index,
                unknowns=update.size,
                ranks=solver.layout.comm.size,
                iterations=result.iterations,
                passes=result.passes,
                reason=result.reason,
                converged=result.converged,
                true_relative_residual=result.true_relative_residual,
                forcing=result.rtol,
                nonlinear_residual=residual,
                action=action,
                failure=failure,
                contact_states={} if states is None else contact_state_counts(states),
                rebuilds=solver.rebuilds,
                seconds=time.perf_counter() - started,
                transfer_seconds=cut_seconds + solver.transfer_seconds + time.perf_counter() - back,
                setup_seconds=result.setup_seconds,
                solve_seconds=result.solve_seconds,
            )
        )
        if failure:
            where = f"time step {scene.metadata.time_step_index}, Newton step {scene.metadata.newton_index}"
            if action == "raised":
                raise SolveError(f"{where}: {failure}")
            so = "; the update is used all the same" if action == "accepted" else ""
            logger.warning("%s: %s%s", where, failure, so)
        return update

    def check_convergence(self, *args: Any, **kwargs: Any) -> Any:
        """PorePy's own, which tells on the way what the nonlinear tolerance is."""
        given = kwargs.get("nl_params", args[-1] if args else None)
        if isinstance(given, dict):
            self._increment_tolerance = float(given.get("nl_convergence_tol", math.inf))
            tolerance = float(given.get("nl_convergence_tol_res", math.inf))
            self._newton_tolerance = tolerance if math.isfinite(tolerance) else None
        return super().check_convergence(*args, **kwargs)  # type: ignore[misc]

    # Options

    @property
    def _options_prefix(self) -> str:
        return str(self.params.get("petsc_fs_options_prefix", ""))

    @contextmanager
    def _options(self, scene: Scene) -> Iterator[None]:
        """Have the options of the file in the database within a block; without one the solver has its default."""
        name = self.params.get("petsc_fs_options_file")
        if name is not None and self._file is None:
            self._file = options.fitting_file(str(name), scene.fields)
            self._values = options.parse(self._file)
        prefix = self._options_prefix
        with options.inserted(self._values, prefix):
            retries = self._option("petsc_fs_on_failure", ON_FAILURE) == "retry"
            with options.inserted({"petsc_fs_retry": RETRY_FILE} if retries else {}, prefix):
                yield

    def _refuse_unused(self) -> None:
        """Raise a UsageError if an option did nothing; those of PETSC_OPTIONS may be meant for other programs."""
        from petsc4py import PETSc

        prefix = self._options_prefix
        later = PETSc.Options(prefix).getString("petsc_fs_retry", "none") != "none"
        useless = [n for n in options.refused(options.unused()) if not (later and n.startswith(f"{prefix}retry_"))]
        elsewhere = {name for name in useless if f"-{name}" in os.environ.get("PETSC_OPTIONS", "").split()}
        if elsewhere:
            logger.warning("of PETSC_OPTIONS nothing has asked for -%s", ", -".join(sorted(elsewhere)))
        if others := sorted(set(useless) - elsewhere):
            typed = {word[1:] for word in sys.argv if word.startswith("-")}
            raise UsageError(options.explain(others, typed, self._file))

    def _option(self, name: str, choices: tuple[str, ...]) -> str:
        from petsc4py import PETSc

        value = str(PETSc.Options(self._options_prefix).getString(name, choices[0]))
        if value not in choices:
            raise UsageError(f"-{self._options_prefix}{name} {value}: expected {' or '.join(choices)}")
        return value

    # Newton

    def _nonlinear_residual(self, scene: Scene) -> float:
        """Norm of the residual as Newton judges it; the right-hand side is the residual with the other sign."""
        _, rhs = self.linear_system
        if scene.metadata.newton_index == 0 or self._reference_residual is None:
            self._reference_residual = np.array(rhs)
            if self._forcing is not None:
                self._forcing.restart()
        norm = getattr(self, "compute_residual_norm", None)
        if norm is None:
            return float(np.linalg.norm(rhs) / math.sqrt(rhs.size or 1))
        return float(norm(rhs, self._reference_residual))

    def _forcing_term(self, residual: float) -> float | None:
        """Relative tolerance of the next solve; None for -ksp_rtol."""
        if self._option("petsc_fs_forcing", FORCING) == "fixed":
            return None
        if self._forcing is None:
            prefix = f"{self._options_prefix}petsc_fs_ew_"
            defaults: dict[str, float] = asdict(EisenstatWalkerParameters())
            given = {name: options.number(name, default, prefix) for name, default in defaults.items()}
            self._forcing = EisenstatWalker(EisenstatWalkerParameters(**given))
        return self._forcing.term(residual, self._newton_tolerance)

    # Solving

    def _prepare_adapter(self) -> Adapter:
        """What maps between the model and its scenes, once the model has its equations."""
        from petsc_fs.porepy.adapter import Adapter

        if self._adapter is None:
            self._adapter = Adapter(self)
        return self._adapter

    def _updated_solver(self, scene: Scene) -> server.ServedSolver:
        """The solver with the values of the scene; it is made with the first one."""
        if self._solver is None:
            if self._client is None:  # on one rank; PETSc starts no earlier than with the first system
                self._client = server.start()
            assert self._client is not None
            self._solver = server.ServedSolver(self._client, scene, prefix=self._options_prefix)
        else:
            self._solver.update(scene)
        return self._solver

    def _rounding(self) -> dict[str, float]:
        """Norm of each field that a change needs to be one of the state."""
        state = self.equation_system.get_variable_values(iterate_index=0)
        parts = self._prepare_adapter().from_porepy(state).items()
        return {field: float(np.finfo(float).eps * np.linalg.norm(values)) for field, values in parts}

    def _judge(self, result: Result, policy: str) -> tuple[str, str]:
        """Action and failure of a record, see `LinearSolve`."""
        again = next((note for note in result.notes if note.startswith(FIRST)), "")
        first = again.removeprefix(FIRST)
        if result.converged:
            return "retried" if again else "", first
        failure = f"{result.verdict} after {result.iterations} iterations ({result.reason})"
        failure = "; ".join([failure, *result.notes])
        if policy != "accept":
            return "raised", failure
        if not result.true_relative_residual < 1:
            return "raised", f"{failure}; the update is no better than none"
        return "accepted", failure
