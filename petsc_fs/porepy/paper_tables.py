"""The four tables of the paper, run again: which runs they are made of, and making those.

Each run is a process of its own with a time limit. What it found is kept in a JSON file, a run that is
finished there is not made again, and of one that is cut off the Newton steps it got to are kept.
`petsc_fs.porepy.paper_page` makes the page from the file, and from that of `petsc_fs.porepy.parity`,
which has some of the runs already.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

from petsc_fs.errors import SolveError, UsageError
from petsc_fs.porepy import parity
from petsc_fs.porepy.cases import CASES, ModelParameters
from petsc_fs.porepy.parity import Measured, Progress, Results, Run

AMG = "contact_poromechanics.opts"
DIRECT = "contact_poromechanics_direct.opts"
P_HAT = "fixed_stress_richardson.opts"
SCHEMES: dict[str, tuple[str, dict[str, str]]] = {
    "richardson": (P_HAT, {}),
    "gmres": (P_HAT, {"ksp_type": "gmres"}),
}
"""What is run over K_n and F: options file and changes to it."""

MODELS = ("model1", "model2", "model3")
PERMEABILITIES: dict[str, tuple[Literal["", "cubic"], ...]] = {
    "model1": ("", "cubic"),
    "model2": ("", "cubic"),
    "model3": ("",),
}
"""Fracture permeabilities that are run: that of the published code, and the cubic law that the paper describes."""

BEYOND = {"model1": (10,), "model2": (10,), "model3": ()}
"""Refinements that the paper's tables do not have."""


def paper() -> dict[str, Any]:
    """The figures printed in the paper.

    Its Krylov counts are lengths of PETSc's residual history, one more than the number of iterations.
    None stands where the paper has no figure.
    """
    data: dict[str, Any] = json.loads(Path(__file__).with_name("paper_tables.json").read_text(encoding="utf-8"))
    return data


def over_parameters(scheme: str, stiffness: float, friction: float) -> str:
    """Name of a run of the table over K_n and F."""
    return f"{scheme}_Kn{stiffness:g}_F{friction:g}"


def over_refinements(model: str, refinement: float, solver: str = "amg", permeability: str = "") -> str:
    """Name of a run of the tables over refinements.

    Args:
        model: name.
        refinement: of the grid.
        solver: of the sub-problems, "amg" or "direct".
        permeability: of the fractures, "cubic"; empty for that of the published code.
    """
    parts = [f"{model}_g{refinement:g}", *(["direct"] if solver == "direct" else []), permeability]
    return "_".join(part for part in parts if part)


def refinements(model: str) -> list[float]:
    """Refinements of a model's table, those beyond the paper's included."""
    return sorted({*paper()[model]["refinement"], *BEYOND[model]})


def _runs() -> dict[str, Run]:
    table = paper()["richardson"]
    runs = {}
    for scheme, (file, changes) in SCHEMES.items():
        for friction in table["friction"]:
            for stiffness in table["stiffness"]:
                parameters = ModelParameters(normal_stiffness=stiffness, friction=friction, physics="restricted")
                name = over_parameters(scheme, stiffness, friction)
                runs[name] = Run("model1", parameters, file, parity.RICHARDSON_TOLERANCE, changes)
    for model in MODELS:
        for refinement in refinements(model):
            for solver, file in (("amg", AMG), ("direct", DIRECT)):
                for permeability in PERMEABILITIES[model]:
                    parameters = ModelParameters(refinement=refinement, fracture_permeability=permeability or None)
                    name = over_refinements(model, refinement, solver, permeability)
                    runs[name] = Run(model, parameters, file, lean=model == "model3" and refinement > 1)
    return runs | parity.RUNS


RUNS: dict[str, Run] = _runs()
"""Name of a run to the run; those of `petsc_fs.porepy.parity` are among them."""

SMALL = 20_000
"""Runs of fewer unknowns than this are made where none are named; the number is in `scripts/paper_tables` too."""


def small() -> list[str]:
    """The runs of few unknowns that the tables need beside those of `petsc_fs.porepy.parity`."""
    table = paper()
    names = [name for name in RUNS if name.split("_")[0] not in MODELS]
    for model in MODELS:
        for i, refinement in enumerate(table[model]["refinement"]):
            if table[model]["unknowns"][i] < SMALL:
                solvers = [solver for solver in ("amg", "direct") if table[model][solver][i] is not None]
                names += [
                    over_refinements(model, refinement, solver, permeability)
                    for permeability in PERMEABILITIES[model]
                    for solver in solvers
                ]
    return [name for name in names if name not in parity.RUNS]


def find_runs(patterns: Iterable[str]) -> list[str]:
    """Names of the runs that fit any of the patterns of the shell, in the order of the patterns.

    Raises:
        UsageError: a pattern fits none.
    """
    names: dict[str, None] = {}
    for pattern in patterns:
        found = [name for name in RUNS if fnmatchcase(name, pattern)]
        if not found:
            raise UsageError(f"no run is called {pattern!r}; runs are {', '.join(RUNS)}")
        names |= dict.fromkeys(found)
    return list(names)


@dataclass(frozen=True)
class Plan:
    """How runs are made.

    Attributes:
        published_code: directory of the published code, which is then run instead, and its systems
            solved again by petsc_fs; None: petsc_fs alone.
        time_steps: at most so many in each run; None: all.
        limit: seconds for each run.
        launcher: command before that of each run, such as ("mpiexec", "-n", "2").
        petsc: options of PETSc.
        again_by: options file by which petsc_fs solves the systems of the published code; None: that of the run.
    """

    published_code: Path | None = None
    time_steps: int | None = None
    limit: float = 3600.0
    launcher: tuple[str, ...] = ()
    petsc: tuple[str, ...] = ()
    again_by: str | None = None


def kind_of(plan: Plan) -> str:
    """Under which heading of the results the runs of a plan belong: what runs, by which file, with which launcher."""
    kind = "petsc_fs" if plan.published_code is None else "published_code"
    kind += f" by {plan.again_by}" if plan.again_by else ""
    return f"{kind}: {' '.join(plan.launcher)}" if plan.launcher else kind


def is_finished(measured: Measured | None, name: str, time_steps: int | None) -> bool:
    """Whether a run need not be made again to have so many time steps."""
    if measured is None or measured.unfinished:
        return False
    all_of_them = CASES[RUNS[name].model].time_steps
    return len(measured.history) >= min(time_steps or all_of_them, all_of_them)


def make_runs(names: Sequence[str], results: Path, plan: Plan, progress: Progress) -> list[str]:
    """Make the runs that are not finished, each in a process of its own, and add them to the results file.

    Args:
        names: in `RUNS`.
        results: JSON file as `petsc_fs.porepy.parity.write` makes it; need not exist.
        plan: how to make them.
        progress: called with a line of text per run.

    Returns:
        One line for each run that failed or was cut off.
    """
    missed = []
    for name in names:
        kind = kind_of(plan)
        before = parity.read(results).setdefault(kind, {}).get(name)
        if is_finished(before, name, plan.time_steps):
            progress(f"{name}: is there already")
            continue
        found, trouble = _make_run(name, plan)
        if trouble:
            missed.append(f"{name}: {trouble}")
            progress(missed[-1])
        if found is not None and not _has_more(before, found):
            now = parity.read(results)  # another process may have added to it meanwhile
            now.setdefault(kind, {})[name] = found
            parity.write(now, results)
    return missed


def _has_more(one: Measured | None, other: Measured) -> bool:
    """Whether the one has more Newton steps than the other."""
    return one is not None and sum(map(len, one.history)) > sum(map(len, other.history))


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and those that it started, first politely: a launcher takes its ranks along."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            os.killpg(process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(SECONDS_TO_END)


SECONDS_TO_END = 10.0

CHILD = "from petsc_fs.porepy.paper_tables import child; child()"
"""What the process of a run does; its argument says which run, in JSON."""


def _make_run(name: str, plan: Plan) -> tuple[Measured | None, str]:
    """What a run found in a process of its own, if anything, and what went wrong with it, if anything did."""
    with tempfile.TemporaryDirectory() as directory:
        target = Path(directory) / "found.json"
        task = {
            "name": name,
            "target": str(target),
            "published_code": str(plan.published_code.resolve()) if plan.published_code else None,
            "time_steps": plan.time_steps,
            "petsc": plan.petsc,
            "again_by": plan.again_by,
        }
        command = [*plan.launcher, sys.executable, "-c", CHILD, json.dumps(task)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        # A session of its own: where the time is up, mpiexec and its ranks end together.
        process = subprocess.Popen(command, env=environment, start_new_session=True)
        trouble = ""
        try:
            code = process.wait(plan.limit)
            trouble = f"failed with exit code {code}" if code else ""
        except subprocess.TimeoutExpired:
            trouble = f"cut off after {plan.limit:g} s"
        finally:
            _end(process)
        found = parity.read(target)["petsc_fs"].get(name)
    return found, trouble


def child() -> None:
    """Make the run that the command line describes in JSON, and write what there is after each linear solve."""
    task = json.loads(sys.argv[1])

    import petsc4py

    petsc4py.init(["paper_tables", *task["petsc"]])
    from petsc_fs import server
    from petsc_fs.errors import PetscFsError
    from petsc_fs.porepy import published_code, require_porepy
    from petsc_fs.porepy.export import write_to_stderr

    server.join()  # ranks other than 0 get no further
    name, target = task["name"], Path(task["target"])

    def keep(found: Measured) -> None:
        found_results: Results = {"petsc_fs": {name: found}}
        parity.write(found_results, target)

    try:
        require_porepy()
        if task["published_code"] is not None:
            found = published_code.measure(
                name,
                RUNS[name],
                Path(task["published_code"]),
                write_to_stderr,
                time_steps=task["time_steps"],
                keep=keep,
                by=task["again_by"],
            )
        else:
            found = parity.measure(name, RUNS[name], write_to_stderr, time_steps=task["time_steps"], keep=keep)
        if not found.history:
            raise SolveError(f"{name}: there was nothing to solve")
        keep(found)
    except PetscFsError as error:
        write_to_stderr(f"{name}: {error}")
        sys.exit(error.exit_code)
