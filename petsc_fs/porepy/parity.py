"""Krylov iterations and contact states on the paper's models, beside those of the published code.

`run` takes one model to its end with `FieldSplitSolver`; `petsc_fs.porepy.published_code` runs the
published code itself and solves each of its systems a second time with petsc_fs. Both kinds of
results go into one JSON file, from which `report` writes the page.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.porepy.cases import CASES, ModelParameters
from petsc_fs.scene import CONTACT_STATES

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
    """

    model: str
    parameters: ModelParameters
    options_file: str = "contact_poromechanics.opts"
    tolerance: float = MODEL_TOLERANCE


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
        history: of the run itself.
        again: Krylov iterations of petsc_fs on the very same systems, where the published code ran.
        unconverged: number of solves of petsc_fs whose true residual missed the tolerance.
    """

    unknowns: int
    seconds: float
    versions: dict[str, str]
    history: History
    again: list[list[int]] = field(default_factory=list)
    unconverged: int = 0


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
    """Run a model to its end with `FieldSplitSolver`.

    Args:
        name: in `RUNS`.
        progress: called with a line of text per Newton step.

    Raises:
        PetscFsError: the run cannot be made or did not converge.
    """
    from petsc_fs.porepy.models import make_model
    from petsc_fs.porepy.models import run as run_model
    from petsc_fs.porepy.solver import FieldSplitSolver

    this = find_run(name)
    model = make_model(this.model, this.parameters, mixins=(FieldSplitSolver,))
    model.params["petsc_fs_options_file"] = this.options_file
    history: History = []

    def record(model: Any, _: Any) -> None:
        solve = model.linear_solves[-1]
        append(history, solve.time_step, [solve.iterations, *solve.contact_states.values()])
        if progress is not None:
            progress(line(name, history))

    started = time.perf_counter()
    run_model(model, on_newton_step=record)
    return Measured(
        unknowns=model.linear_solves[-1].unknowns,
        seconds=time.perf_counter() - started,
        versions=versions(),
        history=history,
        unconverged=sum(not solve.converged for solve in model.linear_solves),
    )


def append(history: History, time_step: int, row: Row) -> None:
    """Add the row of the next Newton step, in a time step counted from 1."""
    while len(history) < time_step:
        history.append([])
    history[time_step - 1].append(row)


def line(name: str, history: History) -> str:
    """One line of progress on the last row."""
    iterations, *states = history[-1][-1]
    return f"{name}: time step {len(history)}, Newton step {len(history[-1]) - 1}: {iterations} iterations, {_states(states)}"


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
    """Commit, or tag, of the git checkout that a directory is in; empty if it is in none."""
    command = ["git", "-C", str(directory), "describe", "--always", "--tags", "--exact-match", "--abbrev=8"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()
    except (OSError, subprocess.SubprocessError):
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
    save(path, "{\n" + ",\n".join(kinds) + "\n}\n")


def save(path: Path, text: str) -> None:
    """Write a text file that appears under its name only once it is complete.

    Raises:
        UsageError: it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as e:
        raise UsageError(f"{path}: cannot be written: {e.strerror}") from e
    finally:
        temporary.unlink(missing_ok=True)


def _to_json(measured: Measured) -> str:
    data = asdict(measured) | {"seconds": round(measured.seconds, 1)}
    parts = []
    for key, value in data.items():
        text = json.dumps(value)
        if key in ("history", "again") and value:
            steps = ",\n".join("    " + json.dumps(step, separators=(",", ":")) for step in value)
            text = f"[\n{steps}\n   ]"
        parts.append(f'   "{key}": {text}')
    return "{\n" + ",\n".join(parts) + "\n  }"


def mean_iterations(history: Sequence[Sequence[Row]]) -> float:
    """Mean number of Krylov iterations over all linear solves of a run."""
    return float(np.mean([row[0] for step in history for row in step]))


@dataclass(frozen=True)
class Agreement:
    """How far two histories go together.

    Attributes:
        newton_steps: that both have, counted from the start of each time step.
        equal_states: of those, with the same number of sticking, sliding and open cells.
        equal_iterations: of those, with the same number of Krylov iterations.
        time_steps: that both have.
        equal_ends: of those, whose last Newton step has the same contact states in both.
        first: time step from 1 and Newton step from 0 of the first difference in the states, or in
            the number of Newton steps; None if there is none.
        first_states: at that Newton step in the one and in the other; empty where the time step is over.
    """

    newton_steps: int
    equal_states: int
    equal_iterations: int
    time_steps: int
    equal_ends: int
    first: tuple[int, int] | None
    first_states: tuple[Row, Row]


def compare(ours: History, theirs: History) -> Agreement:
    """Compare two histories Newton step by Newton step."""
    pairs = [(a, b) for x, y in zip(ours, theirs, strict=False) for a, b in zip(x, y, strict=False)]
    first = None
    first_states: tuple[Row, Row] = ([], [])
    for t, (x, y) in enumerate(zip(ours, theirs, strict=False), start=1):
        at = next((n for n, (a, b) in enumerate(zip(x, y, strict=False)) if a[1:] != b[1:]), None)
        if at is None and len(x) != len(y):
            at = min(len(x), len(y))
        if at is not None:
            first = t, at
            first_states = (x[at][1:] if at < len(x) else [], y[at][1:] if at < len(y) else [])
            break
    return Agreement(
        newton_steps=len(pairs),
        equal_states=sum(a[1:] == b[1:] for a, b in pairs),
        equal_iterations=sum(a[0] == b[0] for a, b in pairs),
        time_steps=min(len(ours), len(theirs)),
        equal_ends=sum(x[-1][1:] == y[-1][1:] for x, y in zip(ours, theirs, strict=False) if x and y),
        first=first,
        first_states=first_states,
    )


def missed(results: Results) -> list[str]:
    """A line for each run of petsc_fs whose mean differs by more than is allowed."""
    _, reference = published()
    lines = []
    for name, measured in results["petsc_fs"].items():
        difference = mean_iterations(measured.history) - mean_iterations(reference[name])
        if abs(difference) > RUNS[name].tolerance:
            lines.append(f"{name}: mean Krylov iterations differ by {difference:+.2f}, allowed {RUNS[name].tolerance}")
    return lines


def report(results: Results) -> str:
    """The page on parity, in Markdown; all its numbers come from the results."""
    origin, reference = published()
    own = {name: results["petsc_fs"][name] for name in RUNS if name in results["petsc_fs"]}
    rerun = {name: results["published_code"][name] for name in RUNS if name in results["published_code"]}
    models = {name: measured for name, measured in own.items() if not name.startswith("richardson")}
    richardson = {name: measured for name, measured in own.items() if name not in models}
    parts = [
        "# Parity with the published code",
        "<!-- Written by scripts/parity from parity.json; do not edit. -->",
        f'"Published" is: {origin}. "petsc_fs" is `petsc_fs.porepy.FieldSplitSolver` on one rank in '
        "PorePy models of the same set-up, with Newton running on its iterative solutions. Krylov iterations are "
        "PETSc's iteration number, which is one less than the length of the residual history that the published "
        "code keeps; means are over all linear solves of a run.",
        "## Models 1 to 3\n\n`options/contact_poromechanics.opts`: GMRES to a relative residual of 1e-10, "
        "multigrid and ILU(0).",
        _model_table(models, reference),
        "## Fixed-stress Richardson\n\nModel 1 at refinement 1 with restricted physics, "
        "`options/fixed_stress_richardson.opts`. K_n is the normal stiffness of the fracture, F its friction "
        "coefficient.",
        _model_table(richardson, reference),
    ]
    if rerun:
        parts += ["## The same linear systems", _same_systems_text(rerun), _same_systems_table(rerun)]
    parts += ["## Newton step by Newton step", _steps_text(bool(rerun)), _steps_table(own, rerun, reference)]
    differences = list(_first_differences(own, rerun, reference))
    if differences:
        parts.append("First difference of each run from the published one:\n\n" + "\n".join(differences))
    parts += ["## How it was run", _how(own, rerun)]
    return "\n\n".join(parts) + "\n"


def _model_table(runs: Mapping[str, Measured], reference: Mapping[str, History]) -> str:
    rows = []
    for name, measured in runs.items():
        ours, theirs = measured.history, reference[name]
        difference = mean_iterations(ours) - mean_iterations(theirs)
        rows.append(
            [
                _title(name),
                f"{measured.unknowns:,}",
                _newton(ours),
                _newton(theirs),
                f"{mean_iterations(ours):.2f}",
                f"{mean_iterations(theirs):.2f}",
                f"{difference:+.2f}",
                "yes" if abs(difference) <= RUNS[name].tolerance else "NO",
            ]
        )
    allowed = {RUNS[name].tolerance for name in runs}
    within = f"within {allowed.pop():g}" if len(allowed) == 1 else "within"
    headings = ["run", "unknowns", "Newton steps", "published", "mean Krylov", "published", "difference", within]
    return _table(headings, rows)


def _title(name: str) -> str:
    parameters = RUNS[name].parameters
    if name.startswith("richardson"):
        return f"K_n = {parameters.normal_stiffness:g}, F = {parameters.friction:g}"
    return f"{RUNS[name].model}, refinement {parameters.refinement:g}"


def _newton(history: History) -> str:
    """Mean number of Newton steps a time step, and the number in each."""
    counts = [len(step) for step in history]
    return f"{np.mean(counts):.2f} ({' '.join(map(str, counts))})"


def _same_systems_text(rerun: Mapping[str, Measured]) -> str:
    solves = sum(len(step) for measured in rerun.values() for step in measured.again)
    differences = [d for measured in rerun.values() for d in _again_differences(measured)]
    equal = sum(d == 0 for d in differences)
    return (
        "The published code was run with its own PorePy, its own preconditioner and its own Newton iteration, and "
        "each of its linear systems was solved a second time by petsc_fs: the same matrix and right-hand side, so "
        f"nothing but the solver differs. Of {solves} systems {equal} took the same number of iterations, and "
        f"{sum(abs(d) <= 1 for d in differences)} differ by at most one; the largest difference is "
        f"{max(map(abs, differences))}."
    )


def _again_differences(measured: Measured) -> list[int]:
    """Iterations of petsc_fs minus those of the published code, system by system."""
    pairs = zip(measured.again, measured.history, strict=True)
    return [n - row[0] for again, step in pairs for n, row in zip(again, step, strict=True)]


def _same_systems_table(rerun: Mapping[str, Measured]) -> str:
    rows = []
    for name, measured in rerun.items():
        differences = _again_differences(measured)
        rows.append(
            [
                _title(name),
                str(len(differences)),
                f"{mean_iterations(measured.history):.2f}",
                f"{np.mean([n for step in measured.again for n in step]):.2f}",
                str(sum(d == 0 for d in differences)),
                str(max(map(abs, differences))),
            ]
        )
    headings = ["run", "systems", "published code", "petsc_fs", "equal counts", "largest difference"]
    return _table(headings, rows)


def _steps_text(rerun: bool) -> str:
    text = (
        "Two runs of the same model part company sooner or later: the matrices' condition numbers are about 1e17, so "
        "that solutions to 1e-10 in the residual differ in their leading digits in some unknowns, and a fracture "
        "cell near the edge of a contact state falls on either side. From there on the Newton iterates differ. The "
        "table counts Newton steps that both runs have (paired from the start of each time step) with equal numbers "
        "of sticking, sliding and open cells, and time steps whose last Newton step has equal ones."
    )
    if rerun:
        text += (
            " Its last columns compare the published code with itself: run for the published counts, and run again "
            "on the machine of this page. That is the agreement to be expected of a perfect copy."
        )
    return text


def _steps_table(own: Mapping[str, Measured], rerun: Mapping[str, Measured], reference: Mapping[str, History]) -> str:
    headings = ["run", "equal states", "equal ends"]
    if rerun:
        headings += [
            "with the rerun: equal states",
            "equal ends",
            "rerun with published: equal states",
            "equal ends",
        ]
    rows = []
    for name, measured in own.items():
        row = [_title(name), *_equal(compare(measured.history, reference[name]))]
        if name in rerun:
            row += _equal(compare(measured.history, rerun[name].history))
            row += _equal(compare(rerun[name].history, reference[name]))
        rows.append(row + [""] * (len(headings) - len(row)))
    return _table(headings, rows)


def _equal(agreement: Agreement) -> list[str]:
    return [
        f"{agreement.equal_states} of {agreement.newton_steps}",
        f"{agreement.equal_ends} of {agreement.time_steps}",
    ]


def _first_differences(
    own: Mapping[str, Measured], rerun: Mapping[str, Measured], reference: Mapping[str, History]
) -> Iterator[str]:
    for name, measured in own.items():
        found = compare(measured.history, reference[name])
        if found.first is None:
            yield f"- {_title(name)}: none, all contact states and Newton steps are equal."
            continue
        ours, theirs = (_states(s) if s else "none (converged)" for s in found.first_states)
        text = (
            f"- {_title(name)}: time step {found.first[0]}, Newton step {found.first[1]}: {ours}; published: {theirs}"
        )
        if name in rerun:
            t, n = found.first
            step = rerun[name].history[t - 1]
            text += f"; published code run again: {_states(step[n][1:]) if n < len(step) else 'none (converged)'}"
        yield text + "."


def _states(counts: Sequence[int]) -> str:
    return ", ".join(f"{n} {state}" for n, state in zip(counts, CONTACT_STATES, strict=True))


def _how(own: Mapping[str, Measured], rerun: Mapping[str, Measured]) -> str:
    lines = [
        "- `scripts/parity RUN...` makes the runs and adds their results to `docs/parity.json`; "
        "`scripts/parity --write docs/parity.md` writes this page from them.",
        "- `scripts/parity --published-code DIR RUN...` runs the published code in DIR with the PorePy that Python "
        "finds, and solves its systems again.",
        "- Set-up: " + "; ".join(f"{name}: {_loads(name)}" for name in ("model1", "model2", "model3")) + ".",
    ]
    for label, runs in (("petsc_fs", own), ("The published code", rerun)):
        for text in sorted({_versions_text(m.versions) for m in runs.values()}):
            lines.append(f"- {label} ran with {text}, on one rank.")
    for label, runs in (("petsc_fs", own), ("published code and petsc_fs after it", rerun)):
        for name, measured in runs.items():
            if measured.unconverged:
                lines.append(
                    f"- {_title(name)} ({label}): {measured.unconverged} solves of petsc_fs missed the tolerance."
                )
    if not any(m.unconverged for m in [*own.values(), *rerun.values()]):
        lines.append("- All solves of petsc_fs met their tolerance in the true residual.")
    return "\n".join(lines)


def _loads(name: str) -> str:
    case = CASES[name]
    steps = f"{case.time_steps} steps of {case.time_step:g} s"
    return f"{case.traction:g} Pa traction, {case.shear:g} Pa shear, {case.pressure_ratio:g} times the pressure in the east, {steps}"


def _versions_text(found: Mapping[str, str]) -> str:
    return ", ".join(f"{program} {version}" for program, version in found.items())


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    rule = ["---", *["--:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [headings, rule, *rows])
