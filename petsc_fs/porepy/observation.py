"""What a running model does: time per phase, one record per linear solve, and how to stop it.

PorePy is not imported here.
"""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import UsageError

Floats = NDArray[np.float64]
Record = dict[str, Any]

PHASES = ("meshing", "discretisation", "assembly", "transfer", "setup", "solve", "output")
"""Where the seconds of a run go, and a key of `Observer.seconds` each. What is left is PorePy's own: residuals,
line search and bookkeeping."""


class Observer:
    """Keeps the time of a run and one record per linear solve.

    Records are written one JSON object a line, each as soon as its Newton step is judged, so that a run that is
    interrupted keeps what it has.

    Attributes:
        records: what is in the file; see `petsc_fs.porepy.solver.LinearSolve` for most of their entries.
        seconds: per phase.
        time_steps: number of time steps that converged.
        cuts: number of time steps that were tried again with a shorter step.
    """

    def __init__(
        self,
        path: Path,
        *,
        time_steps: int | None = None,
        on_record: Callable[[Record], None] | None = None,
        on_time_step: Callable[[int], None] | None = None,
        on_solve: Callable[[Any, Callable[[], Floats]], Floats] | None = None,
    ) -> None:
        """Begin the file.

        Args:
            path: of the file with the records.
            time_steps: the run ends after so many; None for all.
            on_record: called with each record.
            on_time_step: called with the number of each time step that converged.
            on_solve: called with the model and what solves its linear system, instead of the latter.

        Raises:
            UsageError: the file cannot be written.
        """
        self.records: list[Record] = []
        self.seconds = dict.fromkeys(PHASES, 0.0)
        self.time_steps = 0
        self.cuts = 0
        self._limit = time_steps
        self._on_record = on_record
        self._on_time_step = on_time_step
        self._on_solve = on_solve
        self._started = time.perf_counter()
        self._phase: str | None = None
        self._counted = dict(self.seconds)
        self._pending: Record | None = None
        try:
            self._file = path.open("w", encoding="utf-8")
        except OSError as e:
            raise UsageError(f"{path}: cannot be written: {e.strerror}") from e

    @property
    def total_seconds(self) -> float:
        """Since the beginning."""
        return time.perf_counter() - self._started

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the time of a block; a block within a block counts for the outer one."""
        if self._phase is not None:
            yield
            return
        self._phase = name
        started = time.perf_counter()
        try:
            yield
        finally:
            self._phase = None
            self.seconds[name] += time.perf_counter() - started

    def solve(self, model: Any, solve: Callable[[], Floats]) -> Floats:
        """Have a model solve its linear system, and begin the record."""
        update = solve() if self._on_solve is None else self._on_solve(model, solve)
        last = model.linear_solves[-1]
        record = {name: _finite(v) if isinstance(v, float) else v for name, v in asdict(last).items()}
        for name in ("transfer", "setup", "solve"):
            self.seconds[name] += getattr(last, f"{name}_seconds")
        for name in ("discretisation", "assembly"):
            record[f"{name}_seconds"] = self.seconds[name] - self._counted[name]
        self._counted = dict(self.seconds)
        record["time"] = float(model.time_manager.time)
        record["time_step_length"] = float(model.time_manager.dt)
        self._pending = record
        return update

    def judge(self, model: Any, converged: bool) -> None:
        """Complete the record of a Newton step with what PorePy's convergence check has found."""
        if self._pending is None:
            return
        statistics = model.nonlinear_solver_statistics
        for name, values in (
            ("newton_increment", statistics.nonlinear_increment_norms),
            ("newton_residual", statistics.residual_norms),
        ):
            self._pending[name] = _finite(values[-1]) if values else None
        self._pending["newton_converged"] = bool(converged)
        self.flush()

    def flush(self) -> None:
        """Write a record that waits for its Newton step to be judged."""
        record, self._pending = self._pending, None
        if record is None:
            return
        self.records.append(record)
        self._file.write(json.dumps(record, allow_nan=False) + "\n")
        self._file.flush()
        if self._on_record is not None:
            self._on_record(record)

    def end_time_step(self, model: Any) -> bool:
        """Count a time step that converged; whether the run has to end with it."""
        self.time_steps += 1
        if self._on_time_step is not None:
            self._on_time_step(self.time_steps)
        return self._limit is not None and self.time_steps >= self._limit

    def close(self) -> None:
        """Write what waits, and close the file. May be called twice."""
        if not self._file.closed:
            self.flush()
            self._file.close()


class Observed:
    """Mixin that tells an `Observer` what a model does; it goes before all other bases.

    Attributes:
        observer: set it before the model is prepared.
        stop: raised to end the run after the last time step asked for.
    """

    observer: Observer
    stop: type[Exception]

    def set_geometry(self) -> None:
        """Mesh."""
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        with self.observer.phase("meshing"):
            super().set_geometry()  # type: ignore[misc]
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():  # gmsh leaves some that end the process at once
                signal.signal(number, handler if handler is not None else signal.SIG_DFL)

    def set_discretization_parameters(self) -> None:
        """Evaluate what the discretisation depends on."""
        with self.observer.phase("discretisation"):
            super().set_discretization_parameters()  # type: ignore[misc]

    def discretize(self) -> None:
        """Discretise all terms."""
        with self.observer.phase("discretisation"):
            super().discretize()  # type: ignore[misc]

    def rediscretize(self) -> None:
        """Discretise the nonlinear terms."""
        with self.observer.phase("discretisation"):
            super().rediscretize()  # type: ignore[misc]

    def assemble_linear_system(self) -> None:
        """Assemble Jacobian and residual."""
        with self.observer.phase("assembly"):
            super().assemble_linear_system()  # type: ignore[misc]

    def solve_linear_system(self) -> Floats:
        """Solve, by the next class that does."""
        return self.observer.solve(self, super().solve_linear_system)  # type: ignore[misc]

    def check_convergence(self, *args: Any, **kwargs: Any) -> tuple[bool, bool]:
        """Look at the Newton step."""
        converged, diverged = super().check_convergence(*args, **kwargs)  # type: ignore[misc]
        self.observer.judge(self, converged)
        return converged, diverged

    def save_data_time_step(self) -> None:
        """Write what PorePy writes after a time step."""
        with self.observer.phase("output"):
            super().save_data_time_step()  # type: ignore[misc]

    def after_nonlinear_convergence(self) -> None:
        """End a time step, and perhaps the run."""
        super().after_nonlinear_convergence()  # type: ignore[misc]
        if self.observer.end_time_step(self):
            raise self.stop

    def after_nonlinear_failure(self) -> None:
        """Try again with a shorter time step, where the model does that."""
        super().after_nonlinear_failure()  # type: ignore[misc]
        self.observer.cuts += 1


def _finite(value: Any) -> float | None:
    """A number as JSON has it: None for NaN and infinity."""
    number = float(value)
    return number if math.isfinite(number) else None
