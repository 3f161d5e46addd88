"""Krylov iterations and contact states on the paper's models, beside those of the published code.

`run` takes one model to its end with `FieldSplitSolver`; `petsc_fs.porepy.published_code` runs the
published code itself and solves each of its systems a second time with petsc_fs. Both kinds of
results go into one JSON file, from which `petsc_fs.porepy.parity_page` makes a page to read.
"""

from __future__ import annotations

import json
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.files import write_text
from petsc_fs.options import inserted
from petsc_fs.porepy.cases import ModelParameters
from petsc_fs.scene import CONTACT_STATES

if TYPE_CHECKING:
    from petsc_fs.porepy.solver import LinearSolve

Progress = Callable[[str], None]
Row = list[int]
"""Krylov iterations, then the number of sticking, sliding and open cells."""

History = list[list[Row]]
"""One row per Newton step, for each time step."""

MODEL_TOLERANCE = 1.0
RICHARDSON_TOLERANCE = 0.5
"""Allowed difference of the mean number of Krylov iterations."""


@dataclass(frozen=True)
class Run:
    """One run of the paper.

    Attributes:
        model: a name in `petsc_fs.porepy.cases.CASES`.
        parameters: of the model.
        options_file: name of the shipped options file.
        tolerance: allowed difference of the mean number of Krylov iterations.
        changes: PETSc options, without dashes, that go before those of the file.
        lean: whether petsc_fs runs with `LeanModel`, which large 3D grids need.
    """

    model: str
    parameters: ModelParameters
    options_file: str = "contact_poromechanics.opts"
    tolerance: float = MODEL_TOLERANCE
    changes: Mapping[str, str] = field(default_factory=dict)
    lean: bool = False


AS_PUBLISHED = {"petsc_fs_scaling": "none", "petsc_fs_error_factor": "0"}
"""PETSc options of all runs. The published code neither scales rows nor estimates errors; both change iterations."""

NORMAL_STIFFNESS = (0.0, 1.2e9, 1.2e19)
FRICTION = (0.1, 0.577, 0.8)

RUNS: dict[str, Run] = {
    f"{model}_g{refinement:g}": Run(model, ModelParameters(refinement=refinement))
    for model, refinements in (("model1", (1, 2, 5)), ("model2", (1, 2, 5)), ("model3", (1,)))
    for refinement in refinements
} | {
    f"richardson_Kn{stiffness:g}_F{friction:g}": Run(
        "model1",
        ModelParameters(normal_stiffness=stiffness, friction=friction, physics="restricted"),
        "fixed_stress_richardson.opts",
        RICHARDSON_TOLERANCE,
    )
    for stiffness in NORMAL_STIFFNESS
    for friction in FRICTION
}
"""Name of a run, as in `published_counts.json`, to the run."""


@dataclass
class Measured:
    """What came out of one run.

    Attributes:
        unknowns: size of the systems.
        seconds: wall time.
        versions: of the programs that took part.
        history: of the run itself; it may end after any time step.
        again: Krylov iterations of petsc_fs on the very same systems, where the published code ran.
        unconverged: number of solves of petsc_fs whose true residual missed the tolerance.
        unfinished: whether the run was stopped within the last time step of the history.
        timings: seconds of each linear solve, see `TIMINGS`.
    """

    unknowns: int
    seconds: float
    versions: dict[str, str]
    history: History
    again: list[list[int]] = field(default_factory=list)
    unconverged: int = 0
    unfinished: bool = False
    timings: list[list[float]] = field(default_factory=list)


TIMINGS = (
    "transfer", "set-up", "solve", "published set-up", "published solve", "processor", "published processor",
)  # fmt: skip
"""Columns of `Measured.timings`, in seconds; those after the first three where the published code ran.

Transfer is what is left of the whole call in the simulation: taking the Jacobian apart by fields, and
bringing it to PETSc and the solution back. The first five are seconds of the clock, the last two of the
processor of rank 0 for the whole of each solve: where others use the machine at the same time, these
are what can be compared, on one rank. Ranks that wait for each other use up processor time too.
"""

Keep = Callable[[Measured], None]
Results = dict[str, dict[str, Measured]]
"""By "petsc_fs" (own run) or "published_code" (the published code's), and by name of the run."""


def published() -> tuple[str, dict[str, History]]:
    """Where the published counts come from, and the counts by name of the run."""
    data = json.loads(Path(__file__).with_name("published_counts.json").read_text(encoding="utf-8"))
    return data["origin"], data["runs"]


def find_run(name: str) -> Run:
    """A run by name.

    Raises:
        UsageError: there is none.
    """
    if name not in RUNS:
        raise UsageError(f"unknown run {name!r}; runs are {', '.join(RUNS)}")
    return RUNS[name]


def run(name: str, progress: Progress | None = None) -> Measured:
    """Run a model to its end with `FieldSplitSolver`, see `measure`; `name` is in `RUNS`."""
    return measure(name, find_run(name), progress)


def measure(
    name: str,
    this: Run,
    progress: Progress | None = None,
    *,
    time_steps: int | None = None,
    keep: Keep | None = None,
) -> Measured:
    """Run a model with `FieldSplitSolver`.

    Args:
        name: of the run, for `progress`.
        this: what to run.
        progress: called with a line of text per Newton step.
        time_steps: at most so many; None: all of the model.
        keep: called after each linear solve with what there is so far, marked as unfinished.

    Raises:
        PetscFsError: the run cannot be made or did not converge.
    """
    from petsc_fs.porepy.lean_model import LeanModel
    from petsc_fs.porepy.models import StopRun, make_model
    from petsc_fs.porepy.models import run as run_model
    from petsc_fs.porepy.solver import FieldSplitSolver

    mixins = (FieldSplitSolver, LeanModel) if this.lean else (FieldSplitSolver,)
    model = make_model(this.model, this.parameters, mixins=mixins)
    model.params["petsc_fs_options_file"] = this.options_file
    found = Measured(0, 0.0, versions(), [], unfinished=True)
    started = time.perf_counter()

    def record(model: Any, _: Any) -> None:
        solve = model.linear_solves[-1]
        if time_steps is not None and solve.time_step > time_steps:
            raise StopRun
        add_solve(found, solve)
        append(found.history, solve.time_step, [solve.iterations, *solve.contact_states.values()])
        found.seconds = time.perf_counter() - started
        if progress is not None:
            progress(line(name, found.history))
        if keep is not None:
            keep(found)

    with inserted({**AS_PUBLISHED, **this.changes}):
        run_model(model, on_newton_step=record)
    found.unfinished = False
    return found


def add_solve(found: Measured, solve: LinearSolve) -> None:
    """Add what a linear solve of petsc_fs did, except its iterations."""
    found.unknowns = solve.unknowns
    found.unconverged += not solve.converged
    transfer = solve.seconds - solve.setup_seconds - solve.solve_seconds
    found.timings.append([transfer, solve.setup_seconds, solve.solve_seconds])


def append(history: History, time_step: int, row: Row) -> None:
    """Add the row of the next Newton step, in a time step counted from 1."""
    while len(history) < time_step:
        history.append([])
    history[time_step - 1].append(row)


def line(name: str, history: History) -> str:
    """One line of progress on the last row."""
    iterations, *states = history[-1][-1]
    at = f"time step {len(history)}, Newton step {len(history[-1]) - 1}"
    return f"{name}: {at}: {iterations} iterations, {states_text(states)}"


def states_text(counts: Sequence[int]) -> str:
    """Numbers of cells in each contact state in words."""
    return ", ".join(f"{n} {state}" for n, state in zip(counts, CONTACT_STATES, strict=True))


def versions() -> dict[str, str]:
    """Versions of everything that has a say in the counts; of a git checkout of PorePy, the commit."""
    import porepy
    from petsc4py import PETSc

    import petsc_fs

    return {
        "petsc_fs": petsc_fs.__version__,
        "PorePy": commit(Path(porepy.__file__).parent) or str(porepy.__version__),
        "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
        "numpy": np.__version__,
        "Python": platform.python_version(),
    }


def commit(directory: Path) -> str:
    """Tag or abbreviated commit of the git checkout that a directory is in; empty if it is in none."""
    git = ["git", "-C", str(directory)]
    for command in (["describe", "--tags", "--exact-match"], ["rev-parse", "--short=8", "HEAD"]):
        try:
            found = subprocess.run([*git, *command], capture_output=True, text=True, check=True, timeout=60)
        except (OSError, subprocess.SubprocessError):
            continue
        return found.stdout.strip()
    return ""


def read(path: Path) -> Results:
    """Results of earlier runs; none if there is no such file.

    Raises:
        UsageError: the file is something else.
    """
    results: Results = {"petsc_fs": {}, "published_code": {}}
    if not path.exists():
        return results
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        for kind, runs in data.items():
            results[kind] = {name: Measured(**measured) for name, measured in runs.items()}
    except (OSError, ValueError, TypeError, AttributeError) as e:
        raise UsageError(f"{path}: not a file of parity results: {e}") from e
    return results


def write(results: Results, path: Path) -> None:
    """Write results, one time step a line; the file appears once it is complete.

    Raises:
        UsageError: it cannot be written.
    """
    kinds = []
    for kind, runs in results.items():
        entries = [f'  "{name}": {_to_json(measured)}' for name, measured in runs.items()]
        kinds.append(f' "{kind}": {{\n' + ",\n".join(entries) + "\n }")
    write_text(path, "{\n" + ",\n".join(kinds) + "\n}\n")


def _to_json(measured: Measured) -> str:
    data = asdict(measured) | {
        "seconds": round(measured.seconds, 1),
        "timings": [[round(s, 4) for s in solve] for solve in measured.timings],
    }
    parts = []
    for key, value in data.items():
        if key in ("unfinished", "timings") and not value:
            continue
        text = json.dumps(value)
        if key in ("history", "again", "timings") and value:
            steps = ",\n".join("    " + json.dumps(step, separators=(",", ":")) for step in value)
            text = f"[\n{steps}\n   ]"
        parts.append(f'   "{key}": {text}')
    return "{\n" + ",\n".join(parts) + "\n  }"


def mean_iterations(history: Sequence[Sequence[Row]]) -> float:
    """Mean number of Krylov iterations over all linear solves of a run."""
    return float(np.mean([row[0] for step in history for row in step]))


@dataclass(frozen=True)
class Agreement:
    """How far two histories go together, with pairs of numbers: how many are equal, and of how many.

    Attributes:
        starts: time steps whose first Newton step has the same contact states in both.
        later: the other Newton steps that both have, with the same contact states.
        ends: time steps whose last Newton step has the same contact states in both.
        first: time step from 1 and Newton step from 0 of the first difference in the states, or in
            the number of Newton steps; None if there is none.
        first_states: at that Newton step in the one and in the other; empty where the time step is over.
    """

    starts: tuple[int, int]
    later: tuple[int, int]
    ends: tuple[int, int]
    first: tuple[int, int] | None
    first_states: tuple[Row, Row]


def compare(ours: History, theirs: History) -> Agreement:
    """Compare the contact states of two histories Newton step by Newton step."""
    steps = list(zip(ours, theirs, strict=False))
    equal = [[a[1:] == b[1:] for a, b in zip(x, y, strict=False)] for x, y in steps]
    first = None
    first_states: tuple[Row, Row] = ([], [])
    for t, ((x, y), same) in enumerate(zip(steps, equal, strict=True)):
        at = same.index(False) if False in same else len(same)
        if at < max(len(x), len(y)):
            first = t + 1, at
            first_states = (x[at][1:] if at < len(x) else [], y[at][1:] if at < len(y) else [])
            break
    return Agreement(
        starts=_count(same[:1] for same in equal),
        later=_count(same[1:] for same in equal),
        ends=_count([x[-1][1:] == y[-1][1:]] for x, y in steps),
        first=first,
        first_states=first_states,
    )


def _count(parts: Iterable[list[bool]]) -> tuple[int, int]:
    flat = [same for part in parts for same in part]
    return sum(flat), len(flat)


def missed(results: Results) -> list[str]:
    """A line for each run of petsc_fs whose mean differs by more than is allowed."""
    _, reference = published()
    lines = []
    for name, measured in results["petsc_fs"].items():
        difference = mean_iterations(measured.history) - mean_iterations(reference[name])
        if abs(difference) > RUNS[name].tolerance:
            lines.append(f"{name}: mean Krylov iterations differ by {difference:+.2f}, allowed {RUNS[name].tolerance}")
    return lines
