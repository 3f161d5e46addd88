# mypy: disable-error-code="import-untyped"
"""The convergence condition beside the iterations it is about, on the runs of the paper's table over K_n and F.

Each run of `petsc_fs.porepy.parity` with the fixed-stress Richardson iteration is made once more; at every linear
system `petsc_fs.contraction` evaluates the condition, and the iteration counts its steps.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs import contraction
from petsc_fs.errors import UsageError
from petsc_fs.files import write_text
from petsc_fs.porepy.parity import RUNS, versions

Progress = Callable[[str], None]

INTRODUCTION = """\
`petsc-fs inspect --contraction SCENE` evaluates the condition under which the paper proves that the sequential
fixed-stress scheme contracts: 4 G D ≥ coupling + normal + mismatch + friction
([petsc_fs/contraction.py](../petsc_fs/contraction.py) has the formulas). Here it is evaluated at every linear system
of the nine runs over fracture stiffness and friction (model 1 at refinement 1, restricted physics), which Richardson's
method solves to 1e-10 with `fixed_stress_richardson.opts`. Made with {versions}.
"""

TIE = 1e-6
"""Means that differ by less are equal."""

NAMES = tuple(name for name in RUNS if name.startswith("richardson"))


@dataclass(frozen=True)
class System:
    """One linear system.

    Attributes:
        iterations: of Richardson's method.
        open_cells: number of open fracture cells.
        theorem: terms of the condition in Pa/m; None where infinite.
        stiffness: bounds of 4 G D in Pa/m.
        verdict: see `petsc_fs.contraction.Contraction`.
        slip: greatest slip of a sticking cell, over the friction bound.
        mismatch: greatest size of Coulomb's mismatch, over the trial traction.
    """

    iterations: int
    open_cells: int
    theorem: dict[str, float | None]
    stiffness: tuple[float, float]
    verdict: str
    slip: float
    mismatch: float


Study = dict[str, list[System]]
"""Name of a run to its systems, in the order of solving."""


def measure(name: str) -> list[System]:
    """Make one run, and evaluate the condition at each of its systems.

    Raises:
        PetscFsError: the run cannot be made or did not converge.
    """
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.porepy.models import make_model
    from petsc_fs.porepy.models import run as run_model
    from petsc_fs.porepy.solver import FieldSplitSolver

    this = RUNS[name]
    model = make_model(this.model, this.parameters, mixins=(FieldSplitSolver,))
    model.params["petsc_fs_options_file"] = this.options_file
    systems: list[System] = []

    def record(model: Any, _: Any) -> None:
        found = contraction.evaluate(Adapter(model).scene())
        assert found.stiffness is not None
        solve = model.linear_solves[-1]
        systems.append(
            System(
                iterations=solve.iterations,
                open_cells=solve.contact_states["open"],
                theorem={k: v if math.isfinite(v) else None for k, v in found.theorem.items()},
                stiffness=found.stiffness,
                verdict=found.verdict,
                slip=_greatest(found.slip_over_bound),
                mismatch=_greatest(np.abs(found.mismatch_over_trial)),
            )
        )

    run_model(model, on_newton_step=record)
    return systems


def term(system: System, name: str) -> float:
    """A term of the condition in Pa/m, infinity included."""
    value = system.theorem[name]
    return math.inf if value is None else value


def rank_correlation(x: Sequence[float], y: Sequence[float]) -> float:
    """Spearman's coefficient; NaN where one of the two does not vary."""
    from scipy.stats import rankdata

    a, b = rankdata(x), rankdata(y)
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) and np.ptp(b) else math.nan


def page(study: Study, made_with: dict[str, str]) -> str:
    """The page, in Markdown."""
    systems = [system for run in study.values() for system in run]
    fails = sum(system.verdict == "fails" for system in systems)
    ratio = [sum(term(s, n) for n in s.theorem) / s.stiffness[1] for s in systems]
    with_open, without = ([s.iterations for s in systems if (s.open_cells > 0) == yes] for yes in (True, False))
    head = [
        "K_n (Pa/m)",
        "F",
        "systems",
        "mean iterations",
        *(f"{n} (Pa/m)" for n in contraction.FORMULAS),
        "with open",
    ]
    lines = [
        "# The convergence condition against measured iterations\n",
        "<!-- Written by scripts/contraction; do not edit. -->\n",
        INTRODUCTION.format(versions=", ".join(f"{k} {v}" for k, v in made_with.items())),
        f"The condition fails at {fails} of {len(systems)} systems: the sum of the terms is {min(ratio):.0e} times the "
        f"upper bound of 4 G D or more, {np.median(ratio):.0e} times in the median. Richardson's method converged all "
        "the same: the condition is sufficient, but far from necessary. Terms below are medians over a run.\n",
        f"| {' | '.join(head)} |",
        "| " + " | ".join(["--:"] * len(head)) + " |",
    ]
    for name, run in study.items():
        p = RUNS[name].parameters
        row = [f"{p.normal_stiffness:g}", f"{p.friction:g}", str(len(run)), f"{_mean(run):.2f}"]
        row += [f"{np.median([term(s, n) for s in run]):.1e}" for n in contraction.FORMULAS]
        row.append(str(sum(s.open_cells > 0 for s in run)))
        lines.append(f"| {' | '.join(row)} |")
    lines += [
        "",
        '"With open" is the number of systems with an open fracture cell.\n',
        "## Is it the order that the theory says?\n",
        "Runs by their contact terms (normal + friction), the least first, which should take the fewest iterations. "
        "Where K_n = 0 is fixed all are infinite, and nothing is said:\n",
        "| fixed | by the terms | mean iterations of these | in this order |",
        "| --- | --- | --- | --- |",
    ]
    lines += _orders(study)
    lines += [
        "",
        "## What goes with iterations\n",
        f"Over all {len(systems)} systems, Spearman's rank correlation of the number of iterations with\n",
        "| quantity | correlation |",
        "| --- | --: |",
    ]
    quantities = {f"{n} term": [term(s, n) for s in systems] for n in contraction.FORMULAS} | {
        "slip of sticking cells, over the friction bound": [s.slip for s in systems],
        "mismatch of Coulomb's law, over the trial traction": [abs(s.mismatch) for s in systems],
        "number of open cells": [float(s.open_cells) for s in systems],
    }
    counts = [float(s.iterations) for s in systems]
    lines += [f"| {what} | {rank_correlation(values, counts):+.2f} |" for what, values in quantities.items()]
    if with_open and without:
        lines += [
            "",
            f"Systems with an open cell take {np.mean(with_open):.1f} iterations in the mean, {min(with_open)} to "
            f"{max(with_open)}; those without take {np.mean(without):.1f}, {min(without)} to {max(without)}. The "
            "condition has no contact term for open cells: tractions do no work there.",
        ]
    return "\n".join(lines) + "\n"


def _orders(study: Study) -> list[str]:
    """For each K_n with F varying, and each F with K_n varying: the order by the contact terms, and as measured."""
    rows = []
    for fixed, varied in (("normal_stiffness", "friction"), ("friction", "normal_stiffness")):
        label = {"normal_stiffness": "K_n", "friction": "F"}
        for value in dict.fromkeys(getattr(RUNS[n].parameters, fixed) for n in study):
            names = [n for n in study if getattr(RUNS[n].parameters, fixed) == value]
            keys = {n: f"{label[varied]} = {getattr(RUNS[n].parameters, varied):g}" for n in names}
            said = {n: float(np.median([term(s, "normal") + term(s, "friction") for s in study[n]])) for n in names}
            if len(names) < 2 or all(math.isinf(v) for v in said.values()):
                continue
            theory = sorted(names, key=lambda n: said[n])
            means = [_mean(study[n]) for n in theory]
            row = [
                f"{label[fixed]} = {value:g}",
                ", ".join(keys[n] for n in theory),
                ", ".join(f"{mean:.2f}" for mean in means),
                "yes" if all(a <= b + TIE for a, b in pairwise(means)) else "no",
            ]
            rows.append(f"| {' | '.join(row)} |")
    return rows


def _mean(run: Sequence[System]) -> float:
    return float(np.mean([s.iterations for s in run]))


def _greatest(values: Any) -> float:
    found = contraction.summary(np.asarray(values))
    return 0.0 if found is None else found[2]


def main(argv: Sequence[str] | None = None) -> int:
    """Make the nine runs, and write contraction.json and contraction.md."""
    parser = argparse.ArgumentParser(prog="contraction", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), metavar="DIR", help="default docs")
    args = parser.parse_args(argv)
    if not args.out.is_dir():
        raise UsageError(f"{args.out}: no such folder")
    import petsc4py

    petsc4py.init(["contraction"])
    study: Study = {}
    for name in NAMES:
        study[name] = measure(name)
        sys.stderr.write(f"{name}: {len(study[name])} systems, {_mean(study[name]):.2f} iterations in the mean\n")
    made_with = versions()
    runs = ",\n".join(
        f'  "{name}": [\n' + ",\n".join("   " + json.dumps(asdict(s)) for s in run) + "\n  ]"
        for name, run in study.items()
    )
    text = f'{{\n "versions": {json.dumps(made_with)},\n "runs": {{\n{runs}\n }}\n}}\n'
    write_text(args.out / "contraction.json", text)
    write_text(args.out / "contraction.md", page(study, made_with))
    return 0
