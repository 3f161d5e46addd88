"""The page of `petsc-fs stress` in Markdown, and its picture: cases by files, coloured by outcome."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from petsc_fs.files import complete, write_text
from petsc_fs.plot import pyplot
from petsc_fs.stress import OUTCOMES, SMALLEST

COLOURS = {"right": "#0072B2", "refusal": "#F0E442", "wrong": "#D55E00", "hang": "#CC79A7", "crash": "#000000"}
"""Of Okabe and Ito's palette, which people with colour blindness can tell apart."""


def write_page(found: dict[str, Any], target: Path) -> list[Path]:
    """Write the page, and beside it the picture that it shows.

    Args:
        found: what `petsc_fs.stress.report` gives.
        target: page; the picture is called like it.

    Returns:
        Both files.

    Raises:
        UsageError: matplotlib is missing, or a file cannot be written.
    """
    picture = target.with_suffix(".png")
    draw(found, picture)
    files = list(dict.fromkeys(f["file"] for f in found["findings"]))
    ranks = sorted({f["ranks"] for f in found["findings"]})
    lines = [
        "# Extreme scenes",
        "",
        f"Written by `{found['command']}`. Every case is solved with the tolerances of the options files; what is",
        "handed on as converged is held against a reference solution computed with twice double precision.",
        "",
        *(f"- **{name}**: {words}" for name, words in OUTCOMES.items()),
        "",
        "| ranks | " + " | ".join(OUTCOMES) + " |",
        "| --- " * (len(OUTCOMES) + 1) + "|",
        *(
            f"| {n} | " + " | ".join(str(counts.get(o, 0)) for o in OUTCOMES) + " |"
            for n, counts in found["counts"].items()
        ),
        "",
        f"![Outcome of each case with each options file]({picture.name})",
        "",
        "## By options file",
        "",
        "| file | ranks | " + " | ".join(OUTCOMES) + " | does not solve |",
        "| --- " * (len(OUTCOMES) + 3) + "|",
    ]
    for file in files:
        for n in ranks:
            mine = [f for f in found["findings"] if (f["file"], f["ranks"]) == (file, n)]
            counts = Counter(f["outcome"] for f in mine)
            bad = ", ".join(f["case"] for f in mine if f["outcome"] != "right")
            lines.append(f"| {file} | {n} | " + " | ".join(str(counts[o]) for o in OUTCOMES) + f" | {bad or '–'} |")
    lines += ["", "## Cases", "", "| case | what makes it hard | from | condition | iterations | worst error |"]
    lines.append("| --- " * 6 + "|")
    for case in found["cases"]:
        best = next((f for f in found["findings"] if (f["case"], f["file"]) == (case["name"], SMALLEST)), None)
        condition = f"{max(case['conditions'].values()):.0e}" if case["conditions"] else "singular"
        errors = (best or {}).get("error_by_field")
        solved = best is not None and best["outcome"] == "right"
        iterations = best["iterations"] if best is not None and solved else (best or {}).get("outcome", "")
        error = f"{max(errors.values()):.0e}" if errors and solved else ""
        lines.append(f"| {case['name']} | {case['hard']} | {case['source']} | {condition} | {iterations} | {error} |")
    lines += [
        "",
        f"Condition: of the worst field. Iterations and error: of {SMALLEST}, the default of `petsc-fs solve`.",
    ]
    write_text(target, "\n".join(lines) + "\n")
    return [target, picture]


def draw(found: dict[str, Any], target: Path) -> Path:
    """Draw the matrix: a row for each case, a column for each options file and number of ranks."""
    plt = pyplot()
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    cases = [case["name"] for case in found["cases"]]
    columns = list(dict.fromkeys((f["file"], f["ranks"]) for f in found["findings"]))
    names = list(OUTCOMES)
    grid = [[float("nan")] * len(columns) for _ in cases]
    for f in found["findings"]:
        grid[cases.index(f["case"])][columns.index((f["file"], f["ranks"]))] = names.index(f["outcome"])
    figure, axes = plt.subplots(figsize=(2.5 + 0.45 * len(columns), 1.5 + 0.16 * len(cases)), layout="constrained")
    colours = ListedColormap([COLOURS[name] for name in names])
    axes.imshow(grid, cmap=colours, vmin=-0.5, vmax=len(names) - 0.5, aspect="auto", interpolation="none")
    axes.set_yticks(range(len(cases)), cases, fontsize=6)
    labels = [f"{file.removesuffix('.opts')}, {n}" for file, n in columns]
    axes.set_xticks(range(len(columns)), labels, rotation=90, fontsize=7)
    handles = [Patch(color=COLOURS[name], label=name) for name in names]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(names), fontsize=8)
    with complete(target) as temporary:
        figure.savefig(temporary, dpi=130, format=target.suffix.removeprefix("."))
    plt.close(figure)
    return target
