"""The page of the paper's tables: Markdown from the results that `paper_tables` and `parity` keep."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.porepy.cases import CASES
from petsc_fs.porepy.paper_tables import (
    AMG,
    MODELS,
    PERMEABILITIES,
    RUNS,
    over_parameters,
    over_refinements,
    paper,
    refinements,
)
from petsc_fs.porepy.parity import AS_PUBLISHED, TIMINGS, Measured, Results, mean_iterations
from petsc_fs.porepy.parity_page import table, versions_text

Runs = Mapping[str, Measured]
Floats = NDArray[np.float64]

PUBLISHED_STIFFNESS = {1.2e20: 1.2e19}
"""Greatest K_n of the published code, where the paper's table has another."""

CUBIC = """\
"petsc_fs" has the fracture permeability that the published code has when it runs with its PorePy, 1 m^2; "petsc_fs,
cubic law" has the one that the paper describes, aperture^2 / 12.
"""

SEVERAL = """\
No one setting gives all that is printed here: the counts with direct sub-solvers are those of 1 m^2, the ones with
multigrid are near those of the cubic law, and the published code as it stands runs the former.
"""

TITLES = {
    "model1": "Table 2: one fracture in 2D, refined",
    "model2": "Table 3: four fractures in 2D, refined",
    "model3": "Table 4: four fractures in 3D, refined",
}

LABELS = {"direct": "dir.", "amg": "AMG"}

FULL = min(case.time_steps for case in CASES.values())

LARGE = 6_000
"""Seconds are given for runs of more unknowns than this; smaller systems measure calls, not solvers."""

Comparison = tuple[str, float, dict[str, Measured | None]]
"""A setting in words, the paper's figure, and the run of each source."""

NOTES = {
    "model1": CUBIC,
    "model2": CUBIC + SEVERAL,
}

COUNTS = """\
Three sources stand side by side: "paper" is what is printed, "published code" is the authors' program
(github.com/Yuriyzabegaev/FTHM-Solver at d9b687b, with the PorePy it names) run on this machine, "petsc_fs" is
`petsc_fs.porepy.FieldSplitSolver` in PorePy models of the same set-up, on this machine too.

Krylov counts are means over all linear solves of a run, and counted as the paper does it: the number of residual
norms that PETSc records, one more than the number of iterations. Newton steps are means over the time steps that a
run finished. An asterisk marks a run of only the first time steps, where the mean over all of them may be another;
below each table these runs are listed.
"""

OVER_PARAMETERS = """\
Restricted physics, model 1 at refinement 1, {unknowns} unknowns. Richardson iteration with the two-block operator
P-hat and direct solves. The published code has K_n = 1.2e19 Pa/m where the paper prints 1.2e20; its run stands in that
column, and petsc_fs ran with what is printed.
"""

GMRES = """\
The same with GMRES in place of Richardson iteration: the same P-hat from the left, and the same tolerance on the
preconditioned residual. The paper has no such table.
"""

SECONDS = """\
In one run, each linear system of the published code's simulation is solved by both, one after the other, and the one
that goes first changes from system to system. "Published code" is all of its `solve_linear_system`, on one rank;
"petsc_fs" is all of `FieldSplitSolver.solve_linear_system`, with the same sub-solvers or by the file that is named. It
keeps its solver between Newton steps as in any simulation with it: taking the Jacobian apart by fields and bringing it
to PETSc (transfer), building the matrices and setting the preconditioner up, the Krylov method, and the way back. Where
the seconds of the clock are more than those of the processor, other programs ran on the machine's two cores at the same
time. Ratios are published code to petsc_fs.
"""


def report(results: Results, parity_results: Results) -> str:
    """The page, in Markdown; all its numbers come from the results and from the paper."""
    own = _merged(results, parity_results, "petsc_fs")
    theirs = _merged(results, parity_results, "published_code")
    parts = [
        "# The paper's tables",
        "<!-- Written by scripts/paper_tables from paper_tables.json and parity.json; do not edit. -->",
        f"The tables of {paper()['source']}, run again.",
        COUNTS.strip(),
        *_over_parameters(own, theirs),
        *(part for model in MODELS for part in _over_refinements(model, own, theirs)),
    ]
    timed = [
        (kind, name, measured)
        for kind, runs in results.items()
        if kind.startswith("published_code")
        for name, measured in runs.items()
        if measured.unknowns > LARGE and RUNS[name].options_file == AMG and measured.timings[:1]
        if len(measured.timings[0]) == len(TIMINGS)
    ]
    if timed:
        timed.sort(key=lambda item: list(RUNS).index(item[1]))
        parts += ["## Seconds in linear solves", SECONDS.strip(), _seconds(timed)]
        parts += ["Iterations, and where the seconds of the clock went:", _split(timed)]
    parts += ["## How it was run", "\n".join(_how(own, theirs))]
    return "\n\n".join(parts) + "\n"


def _merged(results: Results, parity_results: Results, kind: str) -> dict[str, Measured]:
    """Runs of both files; of one that is in both, the one with more linear solves."""
    merged: dict[str, Measured] = {}
    for runs in (parity_results.get(kind, {}), results.get(kind, {})):
        for name, measured in runs.items():
            if name not in merged or _solves(measured) > _solves(merged[name]):
                merged[name] = measured
    return merged


def _solves(measured: Measured) -> int:
    return sum(map(len, measured.history))


def _time_steps(name: str) -> int:
    return CASES[RUNS[name].model].time_steps


def _is_short(name: str, measured: Measured) -> bool:
    """Whether a run did not get to the end of its simulated time."""
    return measured.unfinished or len(measured.history) < _time_steps(name)


def krylov(measured: Measured) -> float:
    """Mean number of residual norms of a linear solve, which is how the paper counts."""
    return mean_iterations(measured.history) + 1


def newton(measured: Measured) -> float:
    """Mean number of Newton steps of the finished time steps; not a number if there are none."""
    steps = measured.history[:-1] if measured.unfinished else measured.history
    return float(np.mean([len(step) for step in steps])) if steps else float("nan")


def _cell(runs: Runs, name: str, what: Any) -> str:
    """A mean of a run, with an asterisk where it is over part of the run only."""
    if name not in runs:
        return "-"
    value = what(runs[name])
    if np.isnan(value):
        return "-"
    return f"{value:.1f}" + ("\\*" if _is_short(name, runs[name]) else "")


def _printed(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _over_parameters(own: Runs, theirs: Runs) -> Iterator[str]:
    """Parts of the page on the table over K_n and F."""
    printed = paper()["richardson"]
    stiffnesses, frictions = printed["stiffness"], printed["friction"]
    headings = ["Krylov", "", *(f"K_n = {stiffness:.3g}" for stiffness in stiffnesses)]
    rows, newton_rows, gmres_rows = [], [], []
    pairs: list[Comparison] = []
    for i, friction in enumerate(frictions):
        names = [over_parameters("richardson", stiffness, friction) for stiffness in stiffnesses]
        published = [over_parameters("richardson", PUBLISHED_STIFFNESS.get(s, s), friction) for s in stiffnesses]
        gmres = [over_parameters("gmres", stiffness, friction) for stiffness in stiffnesses]
        label = f"F = {friction:g}"
        rows += [
            [label, "paper", *map(_printed, printed["krylov"][i])],
            ["", "published code", *(_cell(theirs, name, krylov) for name in published)],
            ["", "petsc_fs", *(_cell(own, name, krylov) for name in names)],
        ]
        newton_rows += [
            [label, "published code", *(_cell(theirs, name, newton) for name in published)],
            ["", "petsc_fs", *(_cell(own, name, newton) for name in names)],
        ]
        gmres_rows += [
            [label, "Krylov", *(_cell(own, name, krylov) for name in gmres)],
            ["", "Newton", *(_cell(own, name, newton) for name in gmres)],
        ]
        pairs += [
            (
                f"K_n = {stiffnesses[j]:.3g}, {label}",
                printed["krylov"][i][j],
                {"published code": theirs.get(published[j]), "petsc_fs": own.get(name)},
            )
            for j, name in enumerate(names)
        ]
    unknowns = next((own[name].unknowns for name in own if name.startswith("richardson")), 0)
    yield "## Table 1: fixed-stress Richardson over K_n and F"
    yield OVER_PARAMETERS.format(unknowns=f"{unknowns:,}").strip()
    yield table(headings, rows)
    yield _differences(pairs)
    yield "Newton steps a time step in these runs, which the paper does not print:"
    yield table(["Newton", *headings[1:]], newton_rows)
    yield GMRES.strip()
    yield table(["GMRES", *headings[1:]], gmres_rows)


def _over_refinements(model: str, own: Runs, theirs: Runs) -> Iterator[str]:
    """Parts of the page on a model's table over refinements."""
    printed = paper()[model]
    solvers = [s for s in ("direct", "amg") if any(value is not None for value in printed[s])]
    sources = [("published code", theirs, ""), ("petsc_fs", own, "")]
    if "cubic" in PERMEABILITIES[model]:
        sources.append(("petsc_fs, cubic law", own, "cubic"))
    headings = ["refinement", "unknowns, paper", "unknowns, here"]
    for what in ("Newton", *(f"GMRES {LABELS[solver]}" for solver in solvers)):
        headings += [f"{what}: paper", *(source for source, _, _ in sources)]
    rows, short = [], []
    pairs: list[Comparison] = []
    for refinement in refinements(model):
        at = printed["refinement"].index(refinement) if refinement in printed["refinement"] else None
        found = [
            (source, name, runs[name])
            for solver in reversed(solvers)
            for source, runs, permeability in sources
            if (name := over_refinements(model, refinement, solver, permeability)) in runs
        ]
        if not found and at is None:
            continue
        short += [f"- {source}, {name}: {_extent(name, run)}." for source, name, run in found if _is_short(name, run)]
        row = [
            f"{refinement:g}",
            "-" if at is None else f"{printed['unknowns'][at]:,}",
            f"{found[0][2].unknowns:,}" if found else "not run",
            "-" if at is None else _printed(printed["newton"][at]),
            *(_cell(runs, over_refinements(model, refinement, "amg", p), newton) for _, runs, p in sources),
        ]
        for solver in solvers:
            figure = None if at is None else printed[solver][at]
            names = [over_refinements(model, refinement, solver, permeability) for _, _, permeability in sources]
            row += [_printed(figure), *(_cell(runs, n, krylov) for n, (_, runs, _) in zip(names, sources, strict=True))]
            if figure is not None:
                label = f"refinement {refinement:g}, {LABELS[solver]}"
                runs_found = {s: runs.get(n) for n, (s, runs, _) in zip(names, sources, strict=True)}
                pairs.append((label, figure, runs_found))
        rows.append(row)
    yield f"## {TITLES[model]}"
    if model in NOTES:
        yield NOTES[model].strip()
    yield table(headings, rows)
    if short:
        yield "\n".join(["\\* Only the first time steps:", "", *short])
    yield _differences(pairs)


def _extent(name: str, measured: Measured) -> str:
    """How far a run got, in words."""
    done, of = len(measured.history) - measured.unfinished, _time_steps(name)
    parts = []
    if done:
        parts.append(f"time step 1 of {of}" if done == 1 else f"time steps 1 to {done} of {of}")
    if measured.unfinished:
        steps = len(measured.history[-1])
        parts.append(f"{steps} Newton step{'' if steps == 1 else 's'} of time step {done + 1}")
    return f"{' and '.join(parts)}; {_solves(measured)} linear solves"


def _differences(pairs: Iterable[Comparison]) -> str:
    """The largest differences between the mean Krylov counts of a table's full runs, in words."""
    against: dict[str, list[tuple[float, str]]] = {}
    for label, figure, runs in pairs:
        full = {s: krylov(m) for s, m in runs.items() if m is not None and not m.unfinished and len(m.history) >= FULL}
        for source, mean in full.items():
            against.setdefault(f"{source} and the paper", []).append((mean - figure, label))
            if source != "published code" and "published code" in full:
                difference = mean - full["published code"]
                against.setdefault(f"{source} and the published code", []).append((difference, label))
    lines = []
    for what, found in against.items():
        difference, label = max(found, key=lambda item: abs(item[0]))
        lines.append(f"- {what}: {difference:+.1f} ({label}), of {len(found)} full runs that both have")
    return "\n".join(["Largest difference of mean Krylov counts, first minus second:", "", *lines]) if lines else ""


def _seconds(timed: Sequence[tuple[str, str, Measured]]) -> str:
    """Seconds of both solves, and how they compare."""
    rows = []
    for kind, name, measured in timed:
        timings = np.array(measured.timings)
        clock = timings[:, 3:5].sum(axis=1), timings[:, :3].sum(axis=1)
        processor = timings[:, 6], timings[:, 5]
        rows.append([_name(kind, name), "clock", *_compared(*clock)])
        rows.append(["", "processor of rank 0", *_compared(*processor)])
    headings = [
        "run", "seconds of", "total, published code", "petsc_fs", "ratio", "median of a solve, published code",
        "petsc_fs", "median ratio",
    ]  # fmt: skip
    return table(headings, rows)


def _compared(theirs: Floats, ours: Floats) -> list[str]:
    return [
        f"{theirs.sum():.1f}",
        f"{ours.sum():.1f}",
        f"{theirs.sum() / ours.sum():.2f}",
        f"{np.median(theirs):.2f}",
        f"{np.median(ours):.2f}",
        f"{np.median(theirs / ours):.2f}",
    ]


def _split(timed: Sequence[tuple[str, str, Measured]]) -> str:
    """What was solved, and where the seconds of the clock went."""
    rows = []
    for kind, name, measured in timed:
        again = [n for step in measured.again for n in step]
        rows.append(
            [
                _name(kind, name),
                f"{measured.unknowns:,}",
                _extent(name, measured),
                f"{mean_iterations(measured.history):.1f}",
                f"{np.mean(again):.1f}",
                *(f"{total:.1f}" for total in np.array(measured.timings)[:, :5].sum(axis=0)),
            ]
        )
    headings = [
        "run", "unknowns", "covers", "iterations, published code", "petsc_fs", "transfer, petsc_fs", "set-up", "solve",
        "set-up, published code", "everything else",
    ]  # fmt: skip
    return table(headings, rows)


def _name(kind: str, name: str) -> str:
    what, _, launcher = kind.partition(": ")
    file = what.partition(" by ")[2]
    parts = [name, f"`{launcher}`" if launcher else "one rank", *([f"`{file}`"] if file else [])]
    return ", ".join(parts)


def _how(own: Runs, theirs: Runs) -> Iterator[str]:
    yield (
        "- `scripts/paper_tables [--time-steps N] [--limit SECONDS] RUN...` makes runs and adds them to "
        "`docs/paper_tables.json`, each in a process of its own. A run that is finished there is not made again; of "
        "one that `--limit` cuts off, what there was stays. "
        "`scripts/paper_tables --write docs/paper_tables.md` writes this page."
    )
    yield (
        "- `--published-code DIR` runs the published code in DIR instead, with the PorePy that Python finds, solves "
        'its systems again by petsc_fs and times both; with `--launcher "scripts/mpiexec -n 2"` petsc_fs does so on '
        "two ranks, and with `--again-by FILE` by another options file."
    )
    yield "- Runs that [parity.md](parity.md) has too are taken from there."
    judged = " ".join(f"-{name} {value}" for name, value in AS_PUBLISHED.items())
    yield f"- Solutions were judged by their residual and no rows scaled, as in the published code: `{judged}`."
    for label, runs in (("petsc_fs", own), ("The published code", theirs)):
        for text in sorted({versions_text(m.versions) for m in runs.values()}):
            yield f"- {label} ran with {text}."
    for label, runs in (("In the runs of petsc_fs", own), ("In the second solves of published systems", theirs)):
        total = sum(map(_solves, runs.values()))
        missed = sum(m.unconverged for m in runs.values())
        if total:
            yield f"- {label}, {total - missed} of {total} solves met the tolerance in the true residual."
