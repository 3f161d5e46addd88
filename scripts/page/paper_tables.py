"""The tables of the paper, beside what is printed and the published code, and what differs from the paper's words.

Runs of models are kept in docs/paper_tables.json with a digest of their options and of the models' numbers: only those
that are missing there, or whose digest is another, are made again. All of them take some three hours. Large ones, up
to an hour each, are made if they have an entry there, which may be null.
"""

import hashlib
import itertools
import json
import math
import re
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from statistics import median
from typing import Any
from unittest import mock

import numpy as np

from page import ROOT, Place
from petsc_fs import options
from petsc_fs.errors import SolveError
from petsc_fs.io import hdf5
from petsc_fs.io.bundled import find_scene
from petsc_fs.io.files import write_text
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.cases import CASES, ModelParameters
from petsc_fs.scene import CONTACT_STATES
from petsc_fs.tools.pages import markdown
from petsc_fs.tools.plots import plot_blocks, plot_contact_states

INPUTS = (
    "options/contact_poromechanics.opts",
    "options/contact_poromechanics_direct.opts",
    "options/contact_poromechanics_left.opts",
    "options/fixed_stress_richardson.opts",
    "scripts/paper_counts.json",
    "petsc_fs/porepy/cases.py",
    "petsc_fs/porepy/models.py",
    "petsc_fs/tools/contraction.py",
    "petsc_fs/tools/plots.py",
)
COUNTS = json.loads((ROOT / "scripts/paper_counts.json").read_text(encoding="utf-8"))
PAPER: dict[str, Any] = COUNTS["paper"]
PUBLISHED: dict[str, Any] = COUNTS["published_code"]["runs"]
RTOL, ATOL, PRECONDITIONED_ATOL = 1e-10, 1e-15, 1e-10
"""As published; the last is that of Richardson's method, in its own norm."""

PAGE = """\
# The paper's tables

The tables of {source}, run again by `petsc_fs.porepy.FieldSplitSolver` in PorePy {porepy} models of the same set-up, on
one rank. "Paper" is what is printed. "Published code" are {origin}.

Krylov counts are means over all linear solves of a run, as the paper counts them: the residual norms that PETSc
records, one more than the number of iterations. Newton steps are means over time steps. A dash stands where there is no
run, an asterisk where there are only the first time steps of one. Every solve stops as the published code does, by
residuals that are neither scaled nor corrected; by its own rules, petsc_fs would not have called {missed} solves
converged. Runs were made with the package as of {commits}.

{words}

## Table 1: fixed-stress Richardson over K_n and F

Model 1 at refinement 1 with restricted physics. P̂ is the paper's operator of two blocks with direct solves, P that of
three Schur complements, with direct solves too and with the transformation Q_r, in Richardson's method as well: of P
the paper says that counts were similar, and prints none. It has no GMRES either, which here has P̂ from the left and
stops at the same preconditioned residual. The published code has K_n = 1.2e19 Pa/m where the paper prints 1.2e20; its
run stands in that column.

{table_1}

### A fracture near the boundary

The paper says that a fracture near the boundary takes more iterations, which its theorem has in the constant D. Here
model 1 has its fracture elsewhere, K_n = 1.2e9 Pa/m and F = 0.577; the pressure is high in the east (x = 1 km), and the
south (y = 0) is held. "4 G D" is the upper bound that `petsc-fs inspect --contraction` gives, the median of the run
with GMRES, and "open cells" the most that are open in it.

{places}

### Mismatch of Coulomb's law and slip of sticking cells

The paper examined both and found no correlation with the number of iterations. Spearman's rank correlation with the
iterations of P̂ by Richardson's method in the runs of Table 1, each quantity at its largest over the fracture cells, and
in brackets the number of solves:

{correlations}

## Table 2: one fracture in 2D, refined

Published runs have a fracture permeability of 1 m², the paper describes the cubic law, aperture² / 12: here are both,
with direct sub-solves and with multigrid and ILU(0).

{model1}

## Table 3: four fractures in 2D, refined

{model2}

![Fracture cells by contact state, and iterations, over the Newton steps of a run](model2_contact_states.png)

The run by the cubic law at refinement 2: fracture cells by contact state over the Newton steps, shaded and white for
time steps in turns, the iterations of each solve, and where the cells are.

![Block structure of a Jacobian and of what each level leaves](model2_blocks.png)

A Jacobian of the model by 1 m² (the bundled `model2.h5`), and above it what each level of the preconditioner leaves.

## Table 4: four fractures in 3D, refined

{model3}

## The transformation from the left

The paper saw no notable difference between Q_r and a transformation Q_l from the left. Krylov counts with multigrid
(`_cubic`: by the cubic law) by `contact_poromechanics.opts` and `contact_poromechanics_left.opts`:

{left}

## Solve by solve

Runs follow the published ones until rounding decides on the contact state of a cell. Newton steps are over the time
steps that both have.

{parity}
"""

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Run:
    """A run of one of the models.

    Attributes:
        model: its name.
        parameters: what differs from its own.
        file: options file, without its ending.
        changes: options that go before those of the file.
        fracture: the only one, instead of the model's.
        steps: at most so many time steps.
    """

    model: str
    parameters: Mapping[str, Any]
    file: str
    changes: Mapping[str, str] = field(default_factory=dict)
    fracture: tuple[float, ...] = ()
    steps: int = 6  # all

    def digest(self) -> str:
        """Of the options, comments apart, and of the numbers of the model."""
        words = sorted(options.parse(ROOT / f"options/{self.file}.opts").items())
        return hashlib.sha256(repr((words, CASES[self.model], self)).encode()).hexdigest()[:12]


RICHARDSON = {"ksp_type": "richardson", "ksp_pc_side": "left", "ksp_norm_type": "preconditioned", "ksp_max_it": "1000"}
TABLE_1: dict[str, tuple[str, str, dict[str, str]]] = {
    "richardson": ("P̂", "fixed_stress_richardson", {}),
    "practical": ("P", "contact_poromechanics_direct", RICHARDSON | {"petsc_fs_allow_unused": "ksp_gmres_*"}),
    "gmres": ("P̂, GMRES", "fixed_stress_richardson", {"ksp_type": "gmres"}),
}
"""What it is called, options file and changes to it."""
PLACES = ("y0.05", "y0.3", "y0.5", "y0.7", "y0.95", "x0.05", "x0.3", "x0.5", "x0.7", "x0.95")
"""Of the fracture of model 1: level at this part of the domain's height, or upright at this part of its width."""
LAWS = {
    "model1": (both := {"": "1 m²", "_cubic": "cubic law"}),
    "model2": both,
    "model3": {"": "permeability of the rock"},
}
"""Permeability of the fractures by the end of a run's name."""
COLUMNS = {"newton": ("Newton", "", 0), "direct": ("GMRES dir.", "_direct", 1), "amg": ("GMRES AMG", "", 1)}
"""Heading, the part of the run's name that says which sub-solvers, and which of its `means`."""
FILES = {"_direct": "contact_poromechanics_direct", "": "contact_poromechanics", "_left": "contact_poromechanics_left"}
ROWS = 4
"""Of each of these tables, of which the first ones are run."""
LARGE, SMALL = 1e5, 2e4
"""Unknowns from which only the first time step is run, and up to which the left transformation is."""
STEPS = CASES["model1"].time_steps
"""Of all models of the paper."""
PICTURED = "model2_g2_cubic"
VIOLATIONS = {
    "coulomb_mismatch_over_trial": "mismatch of Coulomb's law, over the trial traction",
    "sticking_slip_over_bound": "slip of sticking cells, over the friction bound",
}
"""Of the theorem's assumptions, in words; see `petsc_fs.tools.contraction`."""


def _runs() -> Iterator[tuple[str, Run]]:
    """Name of a run, and the run."""
    table = PAPER["richardson"]
    for kind, (_, file, changes) in TABLE_1.items():
        for friction, stiffness in itertools.product(table["friction"], table["stiffness"]):
            parameters = {"normal_stiffness": stiffness, "friction": friction, "physics": "restricted"}
            yield f"{kind}_Kn{stiffness:g}_F{friction:g}", Run("model1", parameters, file, changes)
        for place in PLACES:
            at = float(place[1:])
            fracture = (at, 0.2, at, 0.8) if place[0] == "x" else (0.2, at, 0.8, at)
            yield f"{kind}_{place}", Run("model1", {"physics": "restricted"}, file, changes, fracture)
    for model, i in itertools.product(LAWS, range(ROWS)):
        refinement, size, direct = (PAPER[model][column][i] for column in ("refinement", "unknowns", "direct"))
        solvers = ["_direct"] * (direct is not None) + ["", *["_left"] * (size < SMALL)]
        for law, solver in itertools.product(LAWS[model], solvers):
            parameters = {"refinement": refinement} | ({"fracture_permeability": "cubic"} if law else {})
            steps = 1 if size > LARGE else STEPS
            yield f"{model}_g{refinement:g}{solver}{law}", Run(model, parameters, FILES[solver], steps=steps)


RUNS = dict(_runs())


def solver_commit() -> str:
    """The last commit that changed the package or the options files."""
    log = ["git", "-C", str(ROOT), "log", "-1", "--format=%h", "--", "petsc_fs", "options"]
    return subprocess.run(log, capture_output=True, text=True, check=False).stdout.strip() or "unknown"


def make_run(name: str, say: Callable[[str], object] = print) -> dict[str, Any]:
    """Run a model.

    The Krylov method stops as the published code does: in the norm of the rows as they are, without the corrections
    that the verdict may ask for. With full physics every update is used, as in the paper, whatever it is worth.

    Returns:
        `history` has, for each time step, a row per linear solve: iterations, numbers of sticking, sliding and open
        cells; with restricted physics also the largest mismatch of Coulomb's law over the trial traction, the largest
        slip of sticking cells over the friction bound, the upper bound of 4 G D, and the verdict on the theorem's
        condition. `failed` says what ended the run early; `missed` counts solves that petsc_fs itself would not call
        converged.
    """
    from petsc_fs.porepy import FieldSplitSolver, make_model, run, scene_from_model
    from petsc_fs.porepy.models import StopRun
    from petsc_fs.refinement import MARGIN, Refinement
    from petsc_fs.tools import contraction

    class AnyUpdate(FieldSplitSolver):
        """Goes on with whatever a solve has found."""

        def _judge(self, result: Any, policy: str) -> tuple[str, str]:
            return "accepted", ""

    this = RUNS[name]
    parameters = ModelParameters(**this.parameters)
    solver = AnyUpdate if parameters.physics == "full" else FieldSplitSolver
    model = make_model(this.model, parameters, mixins=(solver,))
    model.params["petsc_fs_options_file"] = f"{this.file}.opts"
    if this.fracture:
        model.case = replace(model.case, fractures=(this.fracture,))
    record: dict[str, Any] = {"digest": this.digest(), "commit": solver_commit(), "failed": "", "history": []}
    published = {"ksp_rtol": RTOL / MARGIN}  # of which the Krylov method is given the part MARGIN
    published |= {} if parameters.physics == "restricted" else {"ksp_atol": ATOL / MARGIN}

    def look(model: Any, _: Any) -> None:
        last = model.linear_solves[-1]
        if last.time_step > this.steps:
            model.linear_solves.pop()
            raise StopRun
        row = [last.passes[0], *(last.contact_states[state] for state in CONTACT_STATES)]
        if parameters.physics == "restricted":
            found = contraction.evaluate(scene_from_model(model))
            values = [found.summary(found.violations[what]).get("max") for what in VIOLATIONS]
            values.append(found.stiffness[1] if found.stiffness else None)
            row += [*(None if value is None else float(f"{value:.3g}") for value in values), found.verdict]
        if name == PICTURED:
            scene = scene_from_model(model)
            record["cells"] = [scene.cell_centers["contact"].round().tolist(), scene.contact_state.tolist()]
        record["history"] += [[] for _ in range(last.time_step - len(record["history"]))]
        record["history"][-1].append(row)
        say(f"{name}, time step {last.time_step}, Newton step {last.newton_index}: {row}")

    def one_pass(self: Refinement, rtol: float, max_it: int = 0, own: Any = Refinement._pass) -> None:
        """The first one has an absolute tolerance in the norm of the preconditioner, if that is what it sees."""
        if not self.passes and self.ksp.getNormType() == self.ksp.NormType.PRECONDITIONED:
            self._precondition()
            rtol = max(rtol, math.ldexp(PRECONDITIONED_ATOL, self.system.rhs_scale) / self.d.norm())
        own(self, rtol, max_it)

    unscaled = mock.patch("petsc_fs.system.row_exponents", lambda sizes: dict.fromkeys({r for r, _ in sizes}, 0))
    given = {option: repr(value) for option, value in published.items()} | dict(this.changes)
    with options.inserted(given), unscaled, mock.patch.object(Refinement, "_pass", one_pass):
        try:
            run(model, on_newton_step=look)
        except SolveError as e:
            record["failed"] = re.sub(r": NOT CONVERGED.*(DIVERGED_\w+).*", r", \1", str(e))
    missed = sum(not solve.converged for solve in model.linear_solves)
    return record | {"unknowns": model.linear_solves[0].unknowns, "missed": missed}


def solves(record: Record) -> list[Sequence[Any]]:
    """Rows of all linear solves."""
    return [row for step in record["history"] for row in step]


def means(record: Record) -> tuple[float, float]:
    """Newton steps a time step, and Krylov counts a solve as the paper has them: one more than iterations."""
    rows = solves(record)
    return len(rows) / len(record["history"]), 1 + sum(row[0] for row in rows) / len(rows)


def differences(ours: Record, theirs: Record) -> list[int]:
    """Of iterations, in the solves that start from as many sticking, sliding and open cells."""
    steps = zip(ours["history"], theirs["history"], strict=False)
    pairs = (pair for step in steps for pair in zip(*step, strict=False))
    return [abs(a[0] - b[0]) for a, b in pairs if a[1:4] == b[1:4]]


def published(name: str) -> Record | None:
    """What the published code did; it has K_n = 1.2e19 where the paper prints 1.2e20."""
    history = PUBLISHED.get(name.replace("1.2e+20", "1.2e+19"))
    return history and {"history": history, "failed": ""}


def shown(record: Record | None, which: int = 1) -> str:
    """A mean of `means` as a cell; an asterisk marks a run of the first time steps only."""
    if record is None:
        return "-"
    if record["failed"]:
        return "fails"
    return f"{means(record)[which]:.1f}" + "\\*" * (len(record["history"]) < STEPS)


def decimal(number: float | None) -> str:
    """A number that is printed in the paper, as a cell."""
    return "-" if number is None else f"{number:.1f}"


Records = Mapping[str, Record]


def table_1(records: Records) -> list[str]:
    """Stiffness and friction."""
    printed, rows = PAPER["richardson"], []
    for i, friction in enumerate(printed["friction"]):
        names = [f"Kn{stiffness:g}_F{friction:g}" for stiffness in printed["stiffness"]]
        rows.append([f"F = {friction:g}", "paper, P̂", *map(decimal, printed["krylov"][i])])
        rows.append(["", "published code, P̂", *(shown(published(f"richardson_{name}")) for name in names)])
        for kind, (words, *_) in TABLE_1.items():
            rows.append(["", f"petsc_fs, {words}", *(shown(records[f"{kind}_{name}"]) for name in names)])
    return markdown(["", "", *(f"K_n = {stiffness:g}" for stiffness in printed["stiffness"])], rows, numbers=True)


def places(records: Records) -> list[str]:
    """The fracture elsewhere, and what the first solves took."""
    rows, first, failed = [], [], []
    for place in PLACES:
        found = [records[f"{kind}_{place}"] for kind in TABLE_1]
        last = solves(found[-1])
        first.append(solves(found[0])[0][0] + 1)
        where = f"{'upright' if place[0] == 'x' else 'level'}, {place[0]} = {place[1:]} km"
        failed += [f"{where}, {record['failed']}" for record in found if record["failed"]]
        rows.append([where, *map(shown, found), max(row[3] for row in last), f"{median(row[6] for row in last):.1e}"])
    headings = ["fracture", *(words for words, *_ in TABLE_1.values()), "open cells", "4 G D (Pa/m)"]
    near = [records[f"richardson_{place}"] for place in PLACES if not 0.1 < float(place[1:]) < 0.9]
    middle = means(records["richardson_y0.5"])[1]
    more = sum(bool(record["failed"]) or means(record)[1] > middle for record in near)
    words = (
        f"Places within 0.1 km of a side where P̂ takes more than at y = 0.5 km, or fails: {more} of {len(near)}. In "
    )
    words += f"the first solve of each run all cells stick; its count is {' or '.join(map(str, sorted(set(first))))}."
    words += f" Failures: {'; '.join(dict.fromkeys(failed))}." * bool(failed)
    return [*markdown(headings, rows, numbers=True), "", words]


def correlations(records: Records) -> list[str]:
    """What goes with iterations in the runs of Table 1."""
    from scipy.stats import spearmanr

    rows = [row for name, record in records.items() if name.startswith("richardson_K") for row in solves(record)]
    cells = []
    for k, words in ((3, "open cells"), *enumerate(VIOLATIONS.values(), 4)):
        cells.append([words])
        for chosen in (rows, [row for row in rows if not row[3]], [row for row in rows if row[3]]):
            both = [(row[0], row[k]) for row in chosen if row[k] is not None]
            varied = len({value for _, value in both}) > 1
            cells[-1].append(f"{spearmanr(*zip(*both, strict=True))[0]:+.2f} ({len(both)})" if varied else "-")
    split = ([row[0] for row in rows if bool(row[3]) == some] for some in (True, False))
    words = "Solves with an open cell have a Krylov count of {:.1f} in the mean, those without one of {:.1f}. "
    holds = sum(row[7] == "holds" for row in rows)
    words += f"The theorem's condition, which is sufficient, holds in {holds} of these {len(rows)} solves."
    table = markdown(["", "all solves", "no cell open", "some cell open"], cells, numbers=True)
    return [*table, "", words.format(*(1 + sum(n) / len(n) for n in split))]


def table_of(model: str, records: Records) -> list[str]:
    """Refinements of a model, and below how far full runs are from the paper, and what the others are."""
    table, rows, notes = PAPER[model], [], []
    columns = {c: words for c, words in COLUMNS.items() if any(table[c])}
    heads = [heading for heading, *_ in columns.values()]
    sources = {"published code": ("", published)}
    sources |= {f"petsc_fs, {words}": (law, records.get) for law, words in LAWS[model].items()}
    off: dict[str, dict[str, float]] = {words: {} for words in sources}
    for i, refinement in enumerate(table["refinement"]):
        printed = (decimal(table[c][i]) for c in columns)
        rows.append([f"{refinement:g}", "paper", f"{table['unknowns'][i]:,}", *printed])
        for words, (law, source) in sources.items():
            found = {c: source(f"{model}_g{refinement:g}{solver}{law}") for c, (_, solver, _) in columns.items()}
            if any(found.values()):
                size = next((f"{r['unknowns']:,}" for r in found.values() if r and "unknowns" in r), "")
                rows.append(["", words, size, *(shown(r, columns[c][2]) for c, r in found.items())])
            for c, record in found.items():
                if record and len(record["history"]) < STEPS:
                    steps = f"time step {len(record['history'])}, {len(solves(record))} solves"
                    notes.append(f"{words}, refinement {refinement:g}: up to {steps}")
                elif record and not record["failed"] and table[c][i]:
                    off[words][c] = max(off[words].get(c, 0), abs(means(record)[columns[c][2]] - table[c][i]))
    lines = [*markdown(["refinement", "", "unknowns", *heads], rows, numbers=True), ""]
    lines += [f"\\* Not all time steps: {'; '.join(dict.fromkeys(notes))}.", ""] * bool(notes)
    rows = [[words, *(decimal(off[words].get(c)) for c in columns)] for words in sources]
    lines += ["Largest difference from the paper, of full runs:", "", *markdown(["", *heads], rows, numbers=True)]
    del off["published code"]
    nearest = {c: min(off, key=lambda words: off[words][c]) for c in columns if c != "newton"}
    if len(set(nearest.values())) > 1:
        each = ", ".join(f"{columns[c][0]} by {words.removeprefix('petsc_fs, ')}" for c, words in nearest.items())
        lines += ["", f"No one setting is nearest to the paper in both: {each}."]
    return lines


def left(records: Records) -> list[str]:
    """The transformation from the left beside that from the right."""
    rows, ratios = [], []
    for name in (name for name in records if "_left" in name):
        right = name.replace("_left", "")
        counts = [means(records[n])[1] for n in (right, name)]
        ratios.append(counts[1] / counts[0])
        rows.append([right, *map(decimal, counts)])
    words = f"Q_l has {min(ratios):.2f} to {max(ratios):.2f} times the count of Q_r."
    return [*markdown(["run", "Q_r", "Q_l"], rows, numbers=True), "", words]


def parity(records: Records) -> tuple[str, list[str]]:
    """Solve by solve beside the published code: in words, and each run."""
    rows, everything, total = [], [], 0
    for name, record in records.items():
        theirs = published(name)
        if theirs is not None:
            ours = {"history": record["history"][: len(theirs["history"])]}
            alike = differences(ours, theirs)
            everything += alike
            total += len(solves(ours))
            newton = [decimal(means(r)[0]) for r in (theirs, ours)]
            rows.append([name, *newton, f"{len(alike)} of {len(solves(ours))}", max(alike, default="-")])
    words = (
        f"{len(everything)} of {total} solves start from as many sticking, sliding and open cells as in the published "
    )
    words += (
        f"run: {sum(n <= 1 for n in everything)} of these take as many iterations as there or one more or less, and "
    )
    words += f"the largest difference is {max(everything)}."
    headings = ["run", "Newton, published", "petsc_fs", "alike", "largest difference"]
    return words, markdown(headings, rows, numbers=True)


def make(place: Place) -> str:
    """The page, after the runs that are missing."""
    require_porepy()
    store = place.docs / "paper_tables.json"
    records: dict[str, Any] = json.loads(store.read_text(encoding="utf-8")) if store.exists() else {}
    for name, this in sorted(RUNS.items(), key=lambda item: -item[1].steps):  # large ones last
        wanted = this.steps == STEPS or name in records
        if wanted and (records.get(name) or {}).get("digest") != this.digest():
            records[name] = make_run(name, place.say)
            lines = (f"{json.dumps(n)}: {json.dumps(records[n], separators=(',', ':'))}" for n in RUNS if n in records)
            write_text(store, "{\n" + ",\n".join(lines) + "\n}\n")
    records = {name: records[name] for name in RUNS if name in records}
    scene = hdf5.read(find_scene("model2.h5"))
    plot_blocks(scene, place.docs / "model2_blocks.png")
    history, (centers, states) = records[PICTURED]["history"], records[PICTURED]["cells"]
    steps = [
        {
            "time_step": k + 1,
            "time": CASES["model2"].time_step * (k + 1),
            "iterations": row[0],
            "contact_states": dict(zip(CONTACT_STATES, row[1:4], strict=True)),
        }
        for k, step in enumerate(history)
        for row in step
    ]
    cells = np.array(centers), np.array(states)
    plot_contact_states(steps, place.docs / "model2_contact_states.png", title="model 2, refinement 2", cells=cells)
    missed = sum(record["missed"] for record in records.values())
    in_words, solve_by_solve = parity(records)
    parts = {
        "table_1": table_1(records),
        "places": places(records),
        "correlations": correlations(records),
        **{model: table_of(model, records) for model in LAWS},
        "left": left(records),
        "parity": solve_by_solve,
    }
    words = {
        "source": PAPER["source"],
        "origin": COUNTS["published_code"]["origin"],
        "porepy": version("porepy"),
        "commits": ", ".join(sorted({record["commit"] for record in records.values()})),
        "missed": f"{missed} of {sum(len(solves(record)) for record in records.values())}",
        "words": in_words,
    }
    return PAGE.format(**words, **{name: "\n".join(lines) for name, lines in parts.items()})
