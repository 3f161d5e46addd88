"""The page of `petsc-fs stress` in Markdown, and its picture: cases by files, coloured by outcome."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from petsc_fs.io.files import complete, write_text
from petsc_fs.tools.markdown import table
from petsc_fs.tools.plots import pyplot
from petsc_fs.tools.stress import (
    OUTCOMES,
    SAFETY,
    SCALED,
    SINGULAR_BACKWARD,
    SMALLEST,
    TOLERANCE,
    UNCONDITIONED,
    WORST,
    counts,
)
from petsc_fs.tools.stress_repairs import REPAIRED, REPAIRS, label

Found = Mapping[str, Any]
Finding = Mapping[str, Any]

COLOURS = {"right": "#0072B2", "refusal": "#F0E442", "wrong": "#D55E00", "hang": "#CC79A7", "crash": "#000000"}
"""Of Okabe and Ito's palette, which people with colour blindness can tell apart."""
MARKS = {"refusal": "–", "wrong": "×", "hang": "∞", "crash": "!"}
"""What stands in a field of the matrix, for whom colours are not enough."""
UNIT_BASES = ("base", "model1")
"""Scenes whose errors in several unit systems are set side by side."""
STEPS = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
"""Errors up to which answers are counted."""
MANY = 25
"""Answers beyond which only their number is given."""
RARE = 20
"""Files for fewer cases than this share a column."""


def write_page(found: Found, target: Path) -> list[Path]:
    """Write the page, and beside it the picture that it shows.

    Args:
        found: what `petsc_fs.tools.stress.report` gives.
        target: page; the picture is called like it.

    Returns:
        Both files.

    Raises:
        UsageError: matplotlib is missing, or a file cannot be written.
    """
    picture = target.with_suffix(".png")
    draw(found, picture)
    lines = [
        "# Extreme scenes",
        "",
        *paragraph(
            f"Written by `{found['command']}`. Every case is solved with the tolerances of the options files; what is "
            "handed on as converged is held against a reference solution computed with twice double precision. Some "
            "of the cases, `--suite quick`, run with the tests (`scripts/test stress`). Scenes come from PorePy models "
            "(`scripts/stress_scenes` makes them anew) or from transformations of others, as the last table says."
        ),
        "",
        *(f"- **{name}**: {words}" for name, words in OUTCOMES.items()),
        "",
        *_totals(found),
        "",
        f"![Outcome of each case with each options file]({picture.name})",
        "",
        "## By options file",
        "",
        *_by_file(found, held_out=False),
        *_held_out(found),
        *_strictness(found),
        *_units(found),
        *_repairs(found),
        *_cases(found),
    ]
    write_text(target, "\n".join(lines) + "\n")
    return [target, picture]


def paragraph(text: str) -> list[str]:
    """Lines of a paragraph."""
    return textwrap.wrap(text, 120, break_long_words=False, break_on_hyphens=False)


def _of(found: Found, *, held_out: bool) -> list[Finding]:
    """Findings of the cases that are held out, or of the others."""
    names = {case["name"] for case in found["cases"] if case.get("held_out", False) is held_out}
    return [f for f in found["findings"] if f["case"] in names]


def _totals(found: Found) -> list[str]:
    """Number of each outcome by ranks, for both kinds of cases."""
    rows = []
    for held_out, words in ((False, "catalogue"), (True, "held out")):
        mine = _of(found, held_out=held_out)
        cases = len({f["case"] for f in mine})
        for n, numbers in counts({"findings": mine}).items():
            rows.append([f"{words}, {cases}", n, *(numbers.get(o, 0) for o in OUTCOMES)])
    return table(["cases", "ranks", *OUTCOMES], rows)


def _by_file(found: Found, *, held_out: bool) -> list[str]:
    findings = _of(found, held_out=held_out)
    rows: list[list[object]] = []
    said = ""
    for file, n in sorted(dict.fromkeys((f["file"], f["ranks"]) for f in findings), key=lambda k: (order(k[0]), k[1])):
        mine = [f for f in findings if (f["file"], f["ranks"]) == (file, n)]
        numbers = Counter(f["outcome"] for f in mine)
        bad = ", ".join(f["case"] for f in mine if f["outcome"] != "right") or "–"
        alike = bool(rows) and rows[-1][0] == file and bad == said and bad != "–"
        rows.append([file, n, *(numbers[o] for o in OUTCOMES), "the same" if alike else bad])
        said = bad
    return table(["file", "ranks", *OUTCOMES, "does not solve"], rows)


def order(file: str) -> tuple[int, str]:
    """Solvers cut for a scene first, then the canonical file and its like, then the others."""
    return (0 if file in (SMALLEST, SCALED) else 1 if file.startswith("contact_poro") else 2, file)


def _held_out(found: Found) -> list[str]:
    if not _of(found, held_out=True):
        return []
    return [
        "",
        "## Held out",
        "",
        *paragraph(
            "The thresholds of the solver and the criterion above were chosen on the cases of the catalogue. These "
            "have been drawn at random, by number, after that, and none was left out: models with random parameters "
            "inside the ranges of [limits.md](limits.md), and scenes under random transformations. Their first run "
            "found seven wrong answers of contact_poromechanics_direct.opts, with errors up to 3e-4; since then solves "
            "go on where an estimated error is above 1e4 times the tolerance: from that they are no longer held out."
        ),
        "",
        *_by_file(found, held_out=True),
    ]


Limit = Callable[[float, float], float]


def _strictness(found: Found) -> list[str]:
    """How many answers would be wrong by other criteria."""
    rules: dict[str, Limit] = {
        f"{SAFETY:g} κ tol, at most {WORST:g}": lambda c, tol: min(WORST, SAFETY * tol * max(c, 1.0)),
        f"{SAFETY:g} κ {TOLERANCE:g}, whatever tol became by absolute tolerance or rounding": lambda c, _: min(
            WORST, SAFETY * TOLERANCE * max(c, 1.0)
        ),
        f"10 κ tol, at most {WORST:g}": lambda c, tol: min(WORST, 10 * tol * max(c, 1.0)),
        f"κ tol, at most {WORST:g}": lambda c, tol: min(WORST, tol * max(c, 1.0)),
        f"{SAFETY:g} κ tol, at most 1e-3": lambda c, tol: min(1e-3, SAFETY * tol * max(c, 1.0)),
        f"{SAFETY:g} κ tol, at most 1e-4": lambda c, tol: min(1e-4, SAFETY * tol * max(c, 1.0)),
        f"{SAFETY:g} κ tol, at most 1e-5": lambda c, tol: min(1e-5, SAFETY * tol * max(c, 1.0)),
    }
    cases = {case["name"]: case for case in found["cases"]}
    answers = [f for f in found["findings"] if f["outcome"] in ("right", "wrong")]
    regular = [f for f in answers if f["error_by_field"] and not cases[f["case"]]["singular"]]
    rows = []
    for words, limit in rules.items():
        fields = {id(f): _exceeding(f, cases[f["case"]]["conditions"], limit) for f in regular}
        wrong = [f for f in regular if fields[id(f)]]
        where = Counter(name for f in wrong for name in fields[id(f)])
        rows.append([words, len(wrong), ", ".join(f"{name} {n}" for name, n in where.most_common()), _who(wrong)])
    singular = [f for f in answers if cases[f["case"]]["singular"]]
    loose = [f for f in singular if not f["backward_error"]["componentwise"] <= SINGULAR_BACKWARD]
    rows.append([f"singular: componentwise backward error, at most {SINGULAR_BACKWARD:g}", len(loose), "", _who(loose)])
    worst = [max(f["error_by_field"].values()) for f in regular]
    capped = sum(any(1e6 < c < math.inf for c in case["conditions"].values()) for case in found["cases"])
    shares = {f"{s:.0e}": 100 * sum(e <= s for e in worst) / max(len(worst), 1) for s in STEPS}
    return [
        "",
        "## How strict the criterion is",
        "",
        *paragraph(
            "A residual of each field of at most tol (|J| |x| + |b|) in its rows bounds the field's error by √fields κ "
            "tol. The Krylov method sees to the residual of all fields together, so that a small field may miss this "
            f"bound, and κ is estimated from below: hence the factor of {SAFETY:g}. It was 10 at first, and raised "
            "when answers of the catalogue missed that, which is why other criteria are set beside it here. The "
            f"limit of {WORST:g} decides where κ is above 1e6, as it is in {capped} of {len(found['cases'])} cases; "
            f"{UNCONDITIONED:g} holds where κ is not known. Answers that would be wrong:"
        ),
        "",
        *table(["criterion", "wrong", "in fields", "which"], rows),
        "",
        f"Of {len(worst)} answers to systems that are not singular, the error of the worst field is at most",
        "",
        *table(list(shares), [[f"{share:.1f} %" for share in shares.values()]]),
    ]


def _exceeding(finding: Finding, conditions: Mapping[str, float], limit: Limit) -> list[str]:
    """Fields whose errors are beyond a limit."""
    tolerance = finding["tolerance"]
    return [
        f
        for f, error in finding["error_by_field"].items()
        if not error <= (limit(conditions[f], tolerance) if f in conditions else UNCONDITIONED)
    ]


def _who(findings: Sequence[Finding]) -> str:
    """Files with their cases, or with the number of them where they are many."""
    by_file: dict[str, list[str]] = {}
    for f in findings:
        by_file.setdefault(f["file"].removesuffix(".opts"), []).append(f["case"])
    unlike = {file: list(dict.fromkeys(cases)) for file, cases in by_file.items()}
    many = sum(map(len, unlike.values())) > MANY
    words = (f"{file}: {len(cases) if many else ', '.join(cases)}" for file, cases in unlike.items())
    return "; ".join(words) or "–"


def _units(found: Found) -> list[str]:
    """Errors field by field of the same scene in several unit systems."""
    hard = {case["name"]: case["hard"] for case in found["cases"]}
    fields = next((case["fields"] for case in found["cases"] if case["name"].startswith("units_")), ())
    rows = []
    for base in UNIT_BASES:
        for f in found["findings"]:
            if f["file"] == REPAIRED and f["case"].startswith("units_") and f["case"].endswith(f"_{base}"):
                errors = f["error_by_field"] or {}
                errors_in_words = [f"{errors[name]:.0e}" if name in errors else f["outcome"] for name in fields]
                rows.append(
                    [base, hard[f["case"]].removeprefix("units "), f["ranks"], f["iterations"], *errors_in_words]
                )
    if not rows:
        return []
    return [
        "",
        "## Units",
        "",
        f"The same scene in several unit systems, by {REPAIRED}: relative error of each field against the reference.",
        "",
        *table(["scene", "units", "ranks", "iterations", *fields], sorted(rows, key=lambda r: (r[0], r[2]))),
    ]


def _repairs(found: Found) -> list[str]:
    """What each repair changes."""
    findings = [*found.get("repairs", ()), *_retries(found)]
    if not findings:
        return []
    by_label: dict[str, dict[str, Finding]] = {}
    for f in findings:
        by_label.setdefault(f["file"].removeprefix(REPAIRED), {})[f["case"]] = f
    rows = []
    for repair in REPAIRS:
        before, after = by_label.get(label(repair.before)), by_label.get(label(repair.after))
        if before and after:
            options = f"`{label(repair.before or repair.after).strip()}` " + ("before" if repair.before else "after")
            rows.append([f"{repair.name}: {repair.why}", options, *_change(before, after)])
    if "" in by_label and RETRY in by_label:
        rows.append(
            [
                "second attempt: GMRES around a direct solver",
                f"`{RETRY}` after",
                *_change(by_label[""], by_label[RETRY]),
            ]
        )
    return [
        "",
        "## Repairs",
        "",
        *paragraph(
            f"{REPAIRED} on all its cases, without and with each of them: the options named turn it off (before) or on "
            "(after), the other side is the default. Numbers of right answers, refusals and wrong ones."
        ),
        "",
        *table(["repair", "options", "before", "after", "mended", "lost", "iterations"], rows),
        "",
        *paragraph(
            "Mended: right after and not before, with the rung of the fallback that did it; what was wrong before "
            "is in **bold**. Lost: right before and not after. Iterations: sum over the cases right before and after."
        ),
    ]


RETRY = "retry.opts"


def _retries(found: Found) -> list[Finding]:
    """What the second attempt finds, for the cases that repairs are tried on."""
    tried = {f["case"] for f in found.get("repairs", ())}
    ranks = {f["ranks"] for f in found.get("repairs", ())}
    return [f for f in found["findings"] if f["file"] == RETRY and f["case"] in tried and f["ranks"] in ranks]


def _change(before: Mapping[str, Finding], after: Mapping[str, Finding]) -> list[object]:
    """Outcomes before and after, the cases that differ, and iterations."""
    common = [case for case in before if case in after]
    numbers = [Counter(side[case]["outcome"] for case in common) for side in (before, after)]
    sides = [" / ".join(str(n[o]) for o in ("right", "refusal", "wrong")) for n in numbers]
    mended = [c for c in common if before[c]["outcome"] != "right" == after[c]["outcome"]]
    caught = [c for c in common if before[c]["outcome"] == "wrong" and after[c]["outcome"] == "refusal"]
    lost = [c for c in common if before[c]["outcome"] == "right" != after[c]["outcome"]]
    names = {c: f"**{c}**" if before[c]["outcome"] == "wrong" else c for c in [*mended, *caught]}
    words = [names[c] + (f" ({after[c]['fallback']})" if after[c].get("fallback") else "") for c in mended]
    words += [f"{names[c]} (refused)" for c in caught]
    both = [c for c in common if before[c]["outcome"] == after[c]["outcome"] == "right"]
    sums = [sum(side[c]["iterations"] or 0 for c in both) for side in (before, after)]
    return [*sides, ", ".join(words) or "–", ", ".join(lost) or "–", f"{sums[0]} → {sums[1]}"]


def _cases(found: Found) -> list[str]:
    """The catalogue, with what the default makes of it."""
    rows = []
    for case in found["cases"]:
        best = next((f for f in found["findings"] if (f["case"], f["file"]) == (case["name"], SMALLEST)), None)
        known = [c for c in case["conditions"].values() if math.isfinite(c)]
        condition = "singular" if case["singular"] else f"{max(known):.0e}" if known else "not known"
        errors = (best or {}).get("error_by_field")
        solved = best is not None and best["outcome"] == "right"
        iterations = best["iterations"] if best is not None and solved else (best or {}).get("outcome", "")
        error = f"{max(errors.values()):.0e}" if errors and solved else ""
        rows.append([case["name"], case["unknowns"], case["hard"], case["source"], condition, iterations, error])
    return [
        "",
        "## Cases",
        "",
        *table(["case", "unknowns", "what makes it hard", "from", "condition", "iterations", "worst error"], rows),
        "",
        f"Condition: of the worst field. Iterations and error: of {SMALLEST}, the default of `petsc-fs solve`.",
    ]


def draw(found: Found, target: Path) -> Path:
    """Draw the matrix: a row for each case under its group, a column for each options file and number of ranks."""
    plt = pyplot()
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    numbers = Counter((f["file"], f["ranks"]) for f in found["findings"])
    most = {file: max(n for (other, _), n in numbers.items() if other == file) for file, _ in numbers}
    rare = {file for file, n in most.items() if n < RARE < len(found["cases"])}
    column = {f["file"]: _shared(f["file"]) if f["file"] in rare else f["file"] for f in found["findings"]}
    files = sorted(set(column.values()), key=lambda file: (file.startswith(OTHERS), *order(file)))
    ranks = sorted({f["ranks"] for f in found["findings"]})
    columns = [(file, n) for file in files for n in ranks]
    rows: list[str] = []
    groups: list[int] = []
    for group in dict.fromkeys(case["group"] for case in found["cases"]):
        groups.append(len(rows))
        rows += [group, *(case["name"] for case in found["cases"] if case["group"] == group)]
    names = list(OUTCOMES)
    grid = [[float("nan")] * len(columns) for _ in rows]
    figure, axes = plt.subplots(figsize=(3.2 + 0.2 * len(columns), 2.6 + 0.145 * len(rows)), layout="constrained")
    for f in found["findings"]:
        i = rows.index(f["case"], groups[0] + 1)
        j = columns.index((column[f["file"]], f["ranks"]))
        grid[i][j] = names.index(f["outcome"])
        if f["outcome"] in MARKS:
            dark = f["outcome"] == "refusal"
            axes.text(
                j, i, MARKS[f["outcome"]], ha="center", va="center", fontsize=7, color="black" if dark else "white"
            )
    colours = ListedColormap([COLOURS[name] for name in names])
    axes.imshow(grid, cmap=colours, vmin=-0.5, vmax=len(names) - 0.5, aspect="auto", interpolation="none")
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    for k in groups:
        axes.get_yticklabels()[k].set_fontweight("bold")
    axes.set_xticks(range(len(columns)), [str(n) for _, n in columns], fontsize=7)
    axes.tick_params(length=0)
    axes.set_xlabel("ranks", fontsize=8)
    for k in range(1, len(columns)):
        wide = k % len(ranks) == 0
        axes.axvline(k - 0.5, color="white", linewidth=2.5 if wide else 0.5)
    for k in range(1, len(rows)):
        axes.axhline(k - 0.5, color="white", linewidth=0.6)
    top = axes.secondary_xaxis("top")
    middles = [len(ranks) * k + (len(ranks) - 1) / 2 for k in range(len(files))]
    top.set_xticks(middles, [file.removesuffix(".opts") for file in files], rotation=90, fontsize=8)
    top.tick_params(length=0)
    for side in (*axes.spines.values(), *top.spines.values()):
        side.set_visible(False)
    present = [name for name in names if any(f["outcome"] == name for f in found["findings"])]
    handles = [Patch(facecolor=COLOURS[name], label=f"{name} {MARKS.get(name, '')}".rstrip()) for name in present]
    handles.append(Patch(facecolor="white", edgecolor="grey", label="not for these fields"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), fontsize=8, frameon=False)
    with complete(target) as temporary:
        figure.savefig(temporary, dpi=130, format=target.suffix.removeprefix("."))
    plt.close(figure)
    return target


OTHERS = "(file for these fields"
"""Column of the files that fit few cases, such as flow.opts."""


def _shared(file: str) -> str:
    """Column of such a file: no two in one fit the same case."""
    return OTHERS + (", fast)" if file.endswith("_fast.opts") else ")")
