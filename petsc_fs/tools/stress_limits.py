"""The page of limits: how far each options file is right along each parameter, from the matrix of `petsc-fs stress`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from petsc_fs.io.files import write_text
from petsc_fs.tools.markdown import table
from petsc_fs.tools.stress_cases import RECIPES
from petsc_fs.tools.stress_page import RARE, order, paragraph


@dataclass(frozen=True)
class Axis:
    """One parameter, and the cases that vary it.

    Attributes:
        name: of the parameter, with its unit.
        values: case to value, increasing.
    """

    name: str
    values: Mapping[str, str]


def _named(prefix: str) -> dict[str, str]:
    """Exported cases by what stands behind a prefix, as numbers in order."""
    found = {name: name.removeprefix(prefix) for name in RECIPES if name.startswith(prefix)}
    numbers = {name: value for name, value in found.items() if value[:1].isdigit()}
    return dict(sorted(numbers.items(), key=lambda item: float(item[1])))


AXES = (
    Axis("friction F", {**_named("friction_"), "base": "0.577"}),
    Axis("normal stiffness K_n, Pa/m", {**_named("kn_"), "base": "1.2e9"}),
    Axis("contact constant c, of the model's", {**_named("contact_constant_"), "base": "1"}),
    Axis("characteristic displacement, m", {**_named("characteristic_displacement_"), "base": "0.1"}),
    Axis("permeability of the rock, m², fractures 1 m²", {**_named("permeability_"), "time_step_1e6": "1e-14"}),
    Axis("normal permeability", _named("normal_permeability_")),
    Axis("decades of scattered permeability", {"lognormal": "6", "lognormal_12": "12"}),
    Axis("aperture, m", _named("aperture_")),
    Axis("Poisson's ratio", {**_named("poisson_"), "time_step_1e6": "0.25"}),
    Axis("Young's modulus, of the model's", {**_named("stiffness_"), "time_step_1e6": "1"}),
    Axis("Biot coefficient", {**_named("biot_"), "time_step_1e6": "0.47"}),
    Axis("time step, s", _named("time_step_")),
    Axis("contact conditions times", {"contact_rows_1e-8": "1e-8", "base": "1", "contact_rows_1e8": "1e8"}),
    Axis("mass balance times", {"mass_rows_1e-8": "1e-8", "base": "1", "mass_rows_1e8": "1e8"}),
    Axis("traction in units of", {"traction_1e8": "1e-8", "base": "1", "traction_1e-8": "1e8"}),
    Axis("right-hand side times", {"tiny_rhs": "1e-150", "small_rhs": "1e-12", "base": "1", "huge_rhs": "1e160"}),
)
"""Parameters of the catalogue that have a scale."""


def write_limits(found: Mapping[str, Any], target: Path) -> Path:
    """Write the page.

    Args:
        found: what `petsc_fs.tools.stress.report` gives.
        target: page.

    Raises:
        UsageError: it cannot be written.
    """
    numbers = Counter(f["file"] for f in found["findings"])
    ranks = sorted({f["ranks"] for f in found["findings"]})
    files = sorted((file for file, n in numbers.items() if n >= RARE * len(ranks)), key=order)
    outcomes: dict[tuple[str, str], list[str]] = {}
    for f in found["findings"]:
        outcomes.setdefault((f["file"], f["case"]), []).append(f["outcome"])
    right = {key: all(o == "right" for o in values) for key, values in outcomes.items()}
    wrong = sum(o not in ("right", "refusal") for values in outcomes.values() for o in values)
    lines = [
        "# Where each options file is to be trusted",
        "",
        *paragraph(
            f"Written by `{found['command']} --limits`, from the matrix of [stress.md](stress.md). A value counts "
            f"where the answer is right on {' and '.join(map(str, ranks))} rank{'s' if ranks[-1] > 1 else ''}. "
            "Outside these ranges the files say that they have not converged; answers of the matrix that were wrong, "
            f"or no answer at all: {wrong}. `retry.opts`, one factorisation of the whole system, is what to try next "
            "where it fits into memory."
        ),
        "",
        "## Parameters",
        "",
        "One is varied at a time. *all*: right at every value that was tried; –: at none.",
        "",
        *table(
            ["parameter", "tried", *(file.removesuffix(".opts") for file in files)],
            [[axis.name, _tried(axis), *(_range(axis, file, right) for file in files)] for axis in AXES],
        ),
        "",
        "## Everything else",
        "",
        "Cases that have no scale, by what they are about; named are those that a file refuses.",
        "",
        *table(["group", "cases", *(file.removesuffix(".opts") for file in files)], _groups(found, files, right)),
        *_held_out(found, files, right),
        "",
        *NOTES,
    ]
    write_text(target, "\n".join(lines) + "\n")
    return target


def _in_order(axis: Axis) -> list[tuple[str, str]]:
    return sorted(axis.values.items(), key=lambda item: float(item[1]))


def _tried(axis: Axis) -> str:
    return ", ".join(value for _, value in _in_order(axis))


def _range(axis: Axis, file: str, right: Mapping[tuple[str, str], bool]) -> str:
    """Where a file is right along a parameter: runs of values next to each other."""
    known = [(value, right[file, case]) for case, value in _in_order(axis) if (file, case) in right]
    if not known:
        return ""
    if all(ok for _, ok in known):
        return "all"
    runs: list[list[str]] = [[]]
    for value, ok in known:
        if ok:
            runs[-1].append(value)
        elif runs[-1]:
            runs.append([])
    words = [run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs if run]
    return ", ".join(words) or "–"


def _groups(
    found: Mapping[str, Any], files: Sequence[str], right: Mapping[tuple[str, str], bool]
) -> list[list[object]]:
    """The cases that are on no axis, by group."""
    on_axis = {case for axis in AXES for case in axis.values}
    groups: dict[str, list[str]] = {}
    for case in found["cases"]:
        if case["name"] not in on_axis and not case.get("held_out", False):
            groups.setdefault(case["group"], []).append(case["name"])
    rows: list[list[object]] = []
    for group, cases in groups.items():
        refused = [[c for c in cases if not right.get((file, c), True)] for file in files]
        rows.append([group, len(cases), *("all but " + ", ".join(names) if names else "all" for names in refused)])
    return rows


def _held_out(found: Mapping[str, Any], files: Sequence[str], right: Mapping[tuple[str, str], bool]) -> list[str]:
    """How many of the held-out cases each file solves."""
    names = [case["name"] for case in found["cases"] if case.get("held_out", False)]
    kinds = {
        "models, all parameters random at once": [n for n in names if "_model_" in n],
        "scenes under random transformations": [n for n in names if "_model_" not in n],
    }
    rows = []
    for words, cases in kinds.items():
        known = [[right[file, c] for c in cases if (file, c) in right] for file in files]
        rows.append([words, *(f"{sum(k)} of {len(k)}" for k in known)])
    if not names:
        return []
    return [
        "",
        "## Held out",
        "",
        "Cases drawn at random that nothing was chosen on: right answers.",
        "",
        *table(["cases", *(file.removesuffix(".opts") for file in files)], rows),
    ]


NOTES = (
    "## What counts as an answer",
    "",
    *paragraph(
        "The residual meets its tolerance, and the estimated relative error of every field is at most 1e7 times "
        "`-ksp_rtol`, and 1e-3 at best (`-petsc_fs_error_factor`). From a tolerance of 1e-7 on nothing is promised of "
        "single fields. The estimate sees nothing of a singular matrix whose equations agree with each other. Its "
        "thresholds, and what counts as a right answer in the matrix, were chosen on the cases of the catalogue; the "
        "held-out cases say what they are worth on others."
    ),
)
