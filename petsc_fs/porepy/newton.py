"""What inexact Newton saves on the paper's models: Krylov iterations against Newton steps.

Each model runs to its end on one rank with all linear systems solved to -ksp_rtol, with Eisenstat-Walker forcing, and,
to see what any change of the solver does to the states, with all systems solved further. The results go into one JSON
file, and from there into a page.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SolveError, UsageError
from petsc_fs.files import write_text
from petsc_fs.forcing import EisenstatWalkerParameters

RUNS = (("model1", 1.0), ("model1", 2.0), ("model2", 1.0), ("model2", 2.0), ("model3", 0.25))
"""Models and refinements of the page."""

OPTIONS_FILE = "contact_poromechanics.opts"
"""By which linear systems are solved."""

FORCING = {
    "fixed": {},
    "eisenstat_walker": {"petsc_fs_forcing": "eisenstat_walker"},
    "eisenstat_walker, 0.1": {
        "petsc_fs_forcing": "eisenstat_walker",
        "petsc_fs_ew_rtol0": "0.1",
        "petsc_fs_ew_rtolmax": "0.1",
    },
    "fixed, 1e-12": {"ksp_rtol": "1e-12"},
}
"""Name of a kind of forcing, to its options; all others are compared with the first."""


@dataclass(frozen=True)
class Measured:
    """One run.

    Attributes:
        model: name.
        refinement: of its grid.
        forcing: a name in `FORCING`.
        unknowns: size of the systems.
        newton_steps: in each time step.
        iterations: of the Krylov method, in each linear solve.
        forcing_terms: relative tolerance of each linear solve.
        residuals: nonlinear residual at the end of each time step.
        linear_seconds: set-up and solve of all linear solves.
        failure: why the run ended early; empty if it did not.
        difference: of the states at the ends of the time steps from those with fixed forcing: the largest over time
            steps and fields of |x - y| / |y|; 0 for fixed forcing itself.
        difference_field: the field in which it is largest.
    """

    model: str
    refinement: float
    forcing: str
    unknowns: int
    newton_steps: list[int]
    iterations: list[int]
    forcing_terms: list[float]
    residuals: list[float]
    linear_seconds: float
    failure: str = ""
    difference: float = 0.0
    difference_field: str = ""


def measure(name: str, refinement: float, progress: Callable[[str], None] | None = None) -> list[Measured]:
    """Run a model with each kind of forcing.

    Args:
        name: of the model.
        refinement: of its grid.
        progress: called with a line of text per time step.

    Raises:
        PetscFsError: the model cannot be run.
    """
    found: list[Measured] = []
    reference: list[dict[str, NDArray[np.float64]]] = []
    for forcing in FORCING:
        measured, ends = _run(name, refinement, forcing, progress or (lambda line: None))
        reference = reference or ends
        differences = [
            (float(np.linalg.norm(x[f] - y[f]) / np.linalg.norm(y[f])), f)
            for y, x in zip(reference, ends, strict=False)
            for f in y
            if np.linalg.norm(y[f])
        ]
        largest, where = max(differences, default=(0.0, ""))
        found.append(replace(measured, difference=largest, difference_field=where if largest else ""))
    return found


def _run(
    name: str, refinement: float, forcing: str, progress: Callable[[str], None]
) -> tuple[Measured, list[dict[str, NDArray[np.float64]]]]:
    from petsc4py import PETSc

    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.porepy.models import make_model
    from petsc_fs.porepy.models import run as run_model
    from petsc_fs.porepy.solver import FieldSplitSolver

    ends: list[NDArray[np.float64]] = []
    newton_steps: list[int] = []
    residuals: list[float] = []

    class Watch:
        """Keeps the state at the end of each time step."""

        def after_nonlinear_convergence(self, *args: Any) -> None:
            super().after_nonlinear_convergence(*args)  # type: ignore[misc]
            model: Any = self
            ends.append(model.equation_system.get_variable_values(time_step_index=0))
            newton_steps.append(sum(s.time_step == model.time_manager.time_index for s in model.linear_solves))
            residuals.append(float(model.nonlinear_solver_statistics.residual_norms[-1]))
            iterations = sum(s.iterations for s in model.linear_solves)
            progress(f"{name} {refinement:g} {forcing}: {len(ends)} time steps, {iterations} iterations so far")

    model = make_model(name, refinement=refinement, mixins=(Watch, FieldSplitSolver))
    model.params["petsc_fs_options_file"] = OPTIONS_FILE
    for option, value in FORCING[forcing].items():
        PETSc.Options().setValue(option, value)
    failure = ""
    try:
        run_model(model)
    except SolveError as e:
        failure = str(e)
    finally:
        for option in FORCING[forcing]:
            PETSc.Options().delValue(option)
    solves = model.linear_solves
    measured = Measured(
        model=name,
        refinement=refinement,
        forcing=forcing,
        unknowns=solves[-1].unknowns,
        newton_steps=newton_steps,
        iterations=[s.iterations for s in solves],
        forcing_terms=[s.forcing for s in solves],
        residuals=residuals,
        linear_seconds=sum(s.setup_seconds + s.solve_seconds for s in solves),
        failure=failure,
    )
    adapter = Adapter(model)
    return measured, [adapter.from_porepy(end) for end in ends]


def read(path: Path) -> list[Measured]:
    """Results of earlier runs; none if there is no such file.

    Raises:
        UsageError: the file is something else.
    """
    if not path.exists():
        return []
    try:
        return [Measured(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError) as e:
        raise UsageError(f"{path}: not a file of results on Newton: {e}") from e


def write(results: Iterable[Measured], path: Path) -> None:
    """Write results, one run a line."""
    write_text(path, "[\n" + ",\n".join(json.dumps(asdict(measured)) for measured in results) + "\n]\n")


def replaced(results: Iterable[Measured], new: Iterable[Measured]) -> list[Measured]:
    """Results in order, with new ones in place of those of the same runs."""
    by_run = {(m.model, m.refinement, m.forcing): m for m in [*results, *new]}
    return [by_run[key] for key in sorted(by_run, key=lambda key: (key[0], key[1], list(FORCING).index(key[2])))]


def update(runs: Sequence[str], folder: Path, progress: Callable[[str], None]) -> None:
    """Make runs anew, keep the results of the others, and write newton.json and newton.md.

    Args:
        runs: such as "model1:2", for a model and its refinement; or "all".
        folder: of the files.
        progress: called with a line of text per time step.

    Raises:
        UsageError: a run is not of this form.
        PetscFsError: a model cannot be run.
    """
    import petsc4py

    petsc4py.init(["newton"])
    chosen = RUNS if list(runs) == ["all"] else [_parse(run) for run in runs]
    results = folder / "newton.json"
    for name, refinement in chosen:
        write(replaced(read(results), measure(name, refinement, progress)), results)
    write_text(folder / "newton.md", page(read(results)))


def _parse(run: str) -> tuple[str, float]:
    name, _, refinement = run.partition(":")
    try:
        return name, float(refinement)
    except ValueError as e:
        raise UsageError(f"{run}: expected MODEL:REFINEMENT, such as model1:2") from e


PAGE = """\
# Inexact Newton

Written by `scripts/newton`. Each model runs to its end on one rank, with `contact_poromechanics.opts`, the published
configuration, for linear solver, and with the Newton settings of the paper: line search
on residual and contact constraints, nonlinear tolerance 1e-7 in PorePy's residual norm. In one run all linear systems
are solved to 1e-10 (`fixed`), in the other as far as `-petsc_fs_forcing eisenstat_walker` says with its defaults:
rtol0 {p.rtol0:g}, rtolmax {p.rtolmax:g}, gamma {p.gamma:g}, alpha {p.alpha:.3f}, and the guard at the end (see
`petsc_fs.forcing`). `eisenstat_walker, 0.1` has the usual textbook values rtol0 = rtolmax = 0.1.

*Largest residual* is that at the end of a time step, as Newton judges it. *Difference* is the largest over time steps
and fields between the states and those of `fixed`, |x - y| / |y|, and the field where it is. `fixed, 1e-12`, in which
all systems are solved a hundred times further, is there to compare with: where it differs from `fixed` as well, the
nonlinear tolerance does not determine the states, because a time step that begins with a residual near 1e-7 ends after
one Newton step wherever that has led. Seconds are those of set-up and Krylov method together, relative to `fixed`: each
Newton step pays for a set-up, so saved iterations weigh less than their number says. They mean something only where
nothing else ran on the machine.

| model | refinement | unknowns | forcing | Newton steps | Krylov iterations | saved | seconds | largest residual | difference |
|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501


def page(results: Iterable[Measured]) -> str:
    """The results as Markdown."""
    lines = []
    fixed: dict[tuple[str, float], Measured] = {}
    for m in results:
        key = m.model, m.refinement
        base = fixed.setdefault(key, m)
        iterations, base_iterations = sum(m.iterations), sum(base.iterations)
        saved = "" if m is base else f"{1 - iterations / base_iterations:.0%}"
        steps = f"{sum(m.newton_steps)}" + (f", then {m.failure}" if m.failure else "")
        difference = "" if m is base else f"{m.difference:.1e} ({m.difference_field})"
        lines.append(
            f"| {m.model} | {m.refinement:g} | {m.unknowns:,} | {m.forcing} | {steps} | {iterations:,} | {saved} "
            f"| {m.linear_seconds / base.linear_seconds:.2f} | {max(m.residuals, default=0.0):.1e} | {difference} |"
        )
    return PAGE.format(p=EisenstatWalkerParameters()) + "\n".join(lines) + "\n"
