"""FieldSplitSolver: a mixin with which a PorePy model solves its linear systems by petsc_fs, on all ranks.

    class MyModel(FieldSplitSolver, pp.poromechanics.Poromechanics): ...

    model = MyModel({...})
    pp.run_time_dependent_model(model, {})
    print(sum(solve.iterations for solve in model.linear_solves))

Started with `mpiexec -n 4 python script.py`, rank 0 runs PorePy and the script, and the other ranks help to solve.
PorePy itself is not imported here.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs import options, server
from petsc_fs.errors import SceneError, SolveError, UsageError
from petsc_fs.fields import in_order
from petsc_fs.memory import return_freed
from petsc_fs.options import Choice, Facts
from petsc_fs.porepy.forcing import EisenstatWalker, EisenstatWalkerParameters
from petsc_fs.scene import Scene, contact_state_counts

if TYPE_CHECKING:
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.server import ServedSolver
    from petsc_fs.solver import Result

Floats = NDArray[np.float64]

logger = logging.getLogger("petsc_fs")

ON_FAILURE = ("accept", "retry", "raise")
"""Values of -petsc_fs_on_failure; the first is the default."""

FORCING = ("fixed", "eisenstat_walker")
"""Values of -petsc_fs_forcing; the first is the default."""

RETRY = "retry_"
"""Prefix of the options of the second solve."""

RETRY_FILE = "retry.opts"
"""Options file of the second solve, if -petsc_fs_retry_file names no other."""


@dataclass(frozen=True)
class LinearSolve:
    """What one linear solve of a run did.

    Attributes:
        time_step: from 1.
        newton_index: from 0 in each time step.
        unknowns: size of the system.
        ranks: number of ranks that solved it.
        iterations: of the outer Krylov method.
        reason: PETSc's name of the reason why it stopped.
        converged: whether the true residual meets the tolerance; see `petsc_fs.solver.Result`.
        true_relative_residual: |b - J x| / |b|.
        forcing: relative tolerance that was asked for: -ksp_rtol, or the forcing term of inexact Newton.
        nonlinear_residual: norm of the residual, as Newton measures it, at the iterate that the system was
            assembled at.
        action: "" if the solve converged at first; else what -petsc_fs_on_failure did: "accepted" (the update
            was used as it is), "retried" (the numbers here are those of the second solve, the seconds of both)
            or "raised" (the run ended).
        failure: what went wrong at first, in words; "" if nothing.
        contact_states: number of sticking, sliding and open fracture cells at the iterate that the
            system was assembled at; empty without contact.
        rebuilds: how often, in this run so far, PETSc's objects were made anew because the sparsity had
            changed, or the grids.
        seconds: of the whole solve: the sum of the next three and a little.
        transfer_seconds: of cutting PorePy's matrix into fields, sending values to the ranks and getting the
            update back into PorePy's order.
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
    transfer_seconds: float = 0.0
    ranks: int = 1
    forcing: float = float("nan")
    nonlinear_residual: float = float("nan")
    action: str = ""
    failure: str = ""
    rebuilds: int = 0


@dataclass
class _Outcome:
    """A solve and what became of it."""

    result: Result | None
    action: str = ""
    failure: str = ""
    setup_seconds: float = 0.0
    solve_seconds: float = 0.0
    transfer_seconds: float = 0.0
    error: SolveError | None = field(default=None, repr=False)


class FieldSplitSolver:
    """Mixin that solves a model's linear systems on all ranks by what an options file says.

    It goes before the model's other bases. On several ranks, rank 0 alone gets past the construction of the first
    such model: the others work for it until its process ends, and end with it (see `petsc_fs.server`). What a script
    does after that, it does once. On one rank nothing is sent anywhere.

    From the model's parameters it takes:

    - `petsc_fs_options_file`: path of the options file, or name of a shipped one; default is the smallest
      solver for the fields and couplings of the model, cut from contact_poromechanics_fast.opts;
    - `petsc_fs_options_prefix`: put before all option names, default "".

    The options of the file are in PETSc's database only while a system is being solved, and what
    stands there already goes first: after `petsc4py.init(sys.argv)` the command line wins, and
    models with different files do not disturb each other. An option that does nothing in the first solve ends the
    run; -petsc_fs_allow_unused names those that may (see `petsc_fs.options`).

    Options beside those of `petsc_fs.solver.Solver`:
        -petsc_fs_on_failure accept|retry|raise: what happens to a solve that misses its tolerance, with a warning
            to the logger "petsc_fs". accept uses the update all the same, as the paper did, as long as the linear
            residual is less than that of no update at all. It is the default: what Newton's method needs is a
            smaller residual, whether it got there it sees for itself, and a second solve by stronger means may not
            fit into memory. retry solves again by another options file, and raises if that fails too.
        -petsc_fs_retry_file FILE: for retry, default retry.opts; its options get the prefix retry_.
        -petsc_fs_forcing fixed|eisenstat_walker: solve to -ksp_rtol, or each system only as far as Newton makes use
            of it, but never further than to -ksp_rtol; see `petsc_fs.porepy.forcing.EisenstatWalker`. Residuals are
            measured as Newton does, by the model's `compute_residual_norm`.
        -petsc_fs_ew_rtol0, _rtolmax, _gamma, _alpha, _threshold: see `petsc_fs.porepy.forcing.EisenstatWalkerParameters`.

    Attributes:
        linear_solves: one record per solve, in the order of solving.
    """

    params: dict[str, Any]
    linear_system: tuple[Any, Floats]
    linear_solves: list[LinearSolve]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._client = server.join()
        return_freed()  # or the process grows with each Newton step: PorePy frees what malloc then keeps
        super().__init__(*args, **kwargs)
        self.linear_solves = []
        self._adapter: Adapter | None = None
        self._solver: ServedSolver | None = None
        self._chosen: Choice | None = None
        self._facts: Facts | None = None
        self._forcing: EisenstatWalker | None = None
        self._newton_tolerance: float | None = None
        self._reference_residual: Floats | None = None
        self._earlier_rebuilds = 0

    def solve_linear_system(self) -> Floats:
        """The Newton update, in PorePy's order.

        Raises:
            LayoutError: the model has unknowns or equations that belong to no field.
            SceneError: the linear system has entries that are not finite.
            UsageError: the options file cannot be used, or has an option that nothing asked for.
            SolveError: PETSc failed, the solution is not finite, or -petsc_fs_on_failure ends the run.
        """
        from petsc_fs.porepy.adapter import Adapter

        started = time.perf_counter()
        if self._adapter is None:
            self._adapter = Adapter(self)
        scene = self._adapter.scene()
        cut_seconds = time.perf_counter() - started
        chosen = self._choose(scene)
        with options.inserted(chosen.values, self._options_prefix):
            residual = self._nonlinear_residual(scene)
            outcome = self._solve_by_policy(scene, self._forcing_term(residual))
            if not self.linear_solves:
                self._refuse_unused(chosen)
        assert outcome.result is not None and self._client is not None
        back = time.perf_counter()
        update = self._adapter.to_porepy(outcome.result.solution)
        states = scene.contact_state
        self.linear_solves.append(
            LinearSolve(
                time_step=scene.metadata.time_step_index,
                newton_index=scene.metadata.newton_index,
                unknowns=update.size,
                ranks=self._client.comm.size,
                iterations=outcome.result.iterations,
                reason=outcome.result.reason,
                converged=outcome.result.converged,
                true_relative_residual=outcome.result.true_relative_residual,
                forcing=outcome.result.rtol,
                nonlinear_residual=residual,
                action=outcome.action,
                failure=outcome.failure,
                contact_states={} if states is None else contact_state_counts(states),
                rebuilds=self._rebuilds,
                seconds=time.perf_counter() - started,
                transfer_seconds=cut_seconds + outcome.transfer_seconds + time.perf_counter() - back,
                setup_seconds=outcome.setup_seconds,
                solve_seconds=outcome.solve_seconds,
            )
        )
        if outcome.error is not None:
            raise outcome.error
        return update

    def check_convergence(self, *args: Any, **kwargs: Any) -> Any:
        """PorePy's own, which tells on the way what the nonlinear tolerance is."""
        given = kwargs.get("nl_params", args[-1] if args else None)
        if isinstance(given, dict):
            tolerance = float(given.get("nl_convergence_tol_res", math.inf))
            self._newton_tolerance = tolerance if math.isfinite(tolerance) else None
        return super().check_convergence(*args, **kwargs)  # type: ignore[misc]

    # Options

    @property
    def _options_prefix(self) -> str:
        return str(self.params.get("petsc_fs_options_prefix", ""))

    def _choose(self, scene: Scene) -> Choice:
        """The options of the file, or of the smallest tree for what the model has shown so far."""
        name = self.params.get("petsc_fs_options_file")
        if name is not None:
            if self._chosen is None:
                file = _fitting_file(str(name), scene)
                self._chosen = Choice(options.parse(file), file, ())
            return self._chosen
        from petsc4py import PETSc

        facts = Facts.of(scene, PETSc.COMM_SELF.tompi4py())
        if self._facts is not None:
            facts = facts.or_either(self._facts)
        if self._chosen is None or facts != self._facts:
            self._forget_solver()
            self._chosen, self._facts = options.choose(facts), facts
        return self._chosen

    def _refuse_unused(self, chosen: Choice) -> None:
        """Raise a UsageError if an option did nothing."""
        retries = self._option("petsc_fs_on_failure", ON_FAILURE) == "retry"
        later = f"{self._options_prefix}{RETRY}"
        useless = [n for n in options.refused(options.unused()) if not (retries and n.startswith(later))]
        if not useless:
            return
        typed = {word[1:] for word in sys.argv if word.startswith("-")}
        raise UsageError(options.explain(sorted(useless), typed, chosen.file, chosen.left_out))

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

    def _solve_by_policy(self, scene: Scene, rtol: float | None) -> _Outcome:
        """Solve, and do what -petsc_fs_on_failure says where the tolerance is missed."""
        policy = self._option("petsc_fs_on_failure", ON_FAILURE)
        outcome = self._attempt(scene, rtol, retry=policy == "retry")
        where = f"time step {scene.metadata.time_step_index}, Newton step {scene.metadata.newton_index}"
        if not outcome.failure:
            notes = () if outcome.result is None else outcome.result.notes
            rungs = [note for note in notes if note.startswith("fallback ")]
            if rungs:
                logger.warning("%s: %s", where, "; ".join(rungs))
            return outcome
        if policy == "retry":
            logger.warning("%s: %s; solving again by stronger means", where, outcome.failure)
            return self._second_attempt(scene, rtol, outcome, where)
        assert outcome.result is not None
        if policy == "raise" or not outcome.result.true_relative_residual < 1:
            outcome.action = "raised"
            useless = "" if policy == "raise" else "; the update is no better than none"
            outcome.error = SolveError(f"{where}: {outcome.failure}{useless}")
        else:
            outcome.action = "accepted"
            logger.warning("%s: %s; the update is used all the same", where, outcome.failure)
        return outcome

    def _attempt(self, scene: Scene, rtol: float | None, *, retry: bool) -> _Outcome:
        """Solve by the options of the model; an error is a failure like any other if there is a second attempt."""
        try:
            solver = self._updated_solver(scene)
            return _outcome(solver, solver.solve(rtol))
        except (SolveError, SceneError) as e:
            self._forget_solver()
            if not retry:
                raise
            return _Outcome(None, failure=str(e))

    def _second_attempt(self, scene: Scene, rtol: float | None, first: _Outcome, where: str) -> _Outcome:
        from petsc4py import PETSc

        prefix = f"{self._options_prefix}{RETRY}"
        name = PETSc.Options(self._options_prefix).getString("petsc_fs_retry_file", RETRY_FILE)
        file = _fitting_file(name, scene)
        with options.inserted(file, prefix):
            solver = self._create_solver(scene, prefix)
            try:
                second = _outcome(solver, solver.solve(rtol))
            finally:
                solver.destroy()
        if second.failure:
            second.action = "raised"
            second.error = SolveError(f"{where}: {first.failure}; again by {file.name}: {second.failure}")
        else:
            second.action = "retried"
        second.failure = first.failure
        for name in ("setup_seconds", "solve_seconds", "transfer_seconds"):
            setattr(second, name, getattr(first, name) + getattr(second, name))
        return second

    def _updated_solver(self, scene: Scene) -> ServedSolver:
        """The solver with the values of the scene."""
        if self._solver is None:
            self._solver = self._create_solver(scene, self._options_prefix)
        else:
            self._solver.update(scene)
        return self._solver

    def _create_solver(self, scene: Scene, prefix: str) -> ServedSolver:
        if self._client is None:  # on one rank; PETSc starts no earlier than with the first system
            self._client = server.start()
        assert self._client is not None
        return server.ServedSolver(self._client, scene, prefix=prefix)

    def _forget_solver(self) -> None:
        if self._solver is not None:
            self._earlier_rebuilds = self._rebuilds + 1
            self._solver.destroy()
            self._solver = None

    @property
    def _rebuilds(self) -> int:
        return self._earlier_rebuilds + (self._solver.rebuilds if self._solver is not None else 0)


def _outcome(solver: ServedSolver, result: Result) -> _Outcome:
    """What came of a solve, in words if it missed its tolerance."""
    failure = ""
    if not result.converged:
        failure = (
            f"{result.reason} after {result.iterations} iterations, true residual "
            f"{result.true_relative_residual:.2e}, tolerance {result.tolerance:.2e}"
            + "".join(f"; {note}" for note in result.notes)
        )
    return _Outcome(result, "", failure, result.setup_seconds, result.solve_seconds, solver.transfer_seconds)


def _fitting_file(name: str, scene: Scene) -> Path:
    """An options file that is for the fields of a scene.

    Raises:
        UsageError: there is no such file, or it is for other fields.
    """
    header = options.read_header(options.find_options_file(name))
    if not header.fits(scene.fields):
        raise UsageError(
            f"{header.path.name} is for models with the fields {', '.join(header.fields)}; "
            f"this one has {', '.join(in_order(scene.fields))}"
        )
    return header.path
