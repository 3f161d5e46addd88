"""Progress of a run on stderr: a bar where that is a terminal, else one line per Newton step."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any, Protocol, Self

from petsc_fs.porepy.observation import Record


class Display(Protocol):
    """What shows the progress of a run; a context manager around the run."""

    def __enter__(self) -> Self:
        """Begin to show."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Show no more."""

    def begin(self, time_steps: int) -> None:
        """Say how many time steps there will be."""

    def show(self, record: Record) -> None:
        """Show a Newton step."""

    def advance(self, time_step: int) -> None:
        """Show that a time step has converged."""


def display_for(name: str) -> Display:
    """A bar if stderr is a terminal, else lines."""
    return Bar(name) if sys.stderr.isatty() else Lines()


class Lines:
    """One line per Newton step."""

    def __init__(self) -> None:
        self.time_steps = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        pass

    def begin(self, time_steps: int) -> None:
        """See `Display`."""
        self.time_steps = time_steps

    def show(self, record: Record) -> None:
        """See `Display`."""
        step = f"time step {record['time_step']} of {self.time_steps}, Newton step {record['newton_index']}"
        sys.stderr.write(f"{step}: {newton_text(record)}\n")
        sys.stderr.flush()

    def advance(self, time_step: int) -> None:
        """See `Display`."""


class Bar:
    """A bar over the time steps, and below it the latest Newton step."""

    def __init__(self, name: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("time steps"),
            TimeElapsedColumn(),
            TextColumn("\n{task.fields[newton]}"),
            console=Console(stderr=True),
        )
        self._task: Any = self._progress.add_task(name, total=None, newton="meshing and discretisation")
        self._steps = self._iterations = 0

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    def begin(self, time_steps: int) -> None:
        """See `Display`."""
        self._progress.update(self._task, total=time_steps)

    def show(self, record: Record) -> None:
        """See `Display`."""
        self._steps += 1
        self._iterations += record["iterations"]
        so_far = f"so far {self._steps} Newton steps, {self._iterations} Krylov iterations"
        text = f"Newton step {record['newton_index']}: {newton_text(record)}\n{so_far}"
        self._progress.update(self._task, newton=text)

    def advance(self, time_step: int) -> None:
        """See `Display`."""
        self._progress.update(self._task, completed=time_step)


def newton_text(record: Record) -> str:
    """What a record says of its Newton step."""
    residual = record.get("newton_residual")
    states = ", ".join(f"{n} {state}" for state, n in record["contact_states"].items())
    parts = [
        f"{record['iterations']} Krylov iterations" + ("" if record["converged"] else " (NOT CONVERGED)"),
        f"residual {residual:.1e}" if residual is not None else "",
        states,
    ]
    return "; ".join(part for part in parts if part)
