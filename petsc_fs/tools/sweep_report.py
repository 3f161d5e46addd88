"""What a sweep found, for people: the best file, a report with its picture, and tables for programs."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from petsc_fs.io.files import complete, write_text
from petsc_fs.tools import measure
from petsc_fs.tools.markdown import table
from petsc_fs.tools.plots import pyplot
from petsc_fs.tools.space import ABSENT
from petsc_fs.tools.sweep import OBJECTIVES, OUTCOMES, STARTUP_TRIALS

Results = Mapping[str, Any]

AXES = {
    "time": "time / time of the base file",
    "memory": "memory / memory of the base file",
    "error": "error / error of the base file",
}
EVALUATORS = {
    "PED-ANOVA": "PED-ANOVA: in what the best tenth of the solved trials differs from the whole space; it favours "
    "numbers, which the best can agree on more closely than on one of a few choices.",
    "fANOVA": "fANOVA: which part of the variance over all solved trials a parameter explains by itself; parameters "
    "that exist only where others have certain values are left out.",
}
"""What the importance by each evaluator means."""
COLOURS = ("#0072b2", "#d55e00", "#999999")
"""Blue, vermilion and grey of Okabe and Ito's palette, which colour-blind people tell apart."""


def write(results: Results, folder: Path, page: Path | None = None) -> list[Path]:
    """Write best.opts, trials.csv, sweep.json, front.png and report.md into the folder of a sweep.

    Args:
        results: of `petsc_fs.tools.sweep.Sweep.run`.
        folder: of the sweep.
        page: where the report goes as well, with its picture beside it.

    Returns:
        The files written.
    """
    written = []
    lint = ""
    if results["final"] is not None:
        best = folder / "best.opts"
        with complete(best) as temporary:
            shutil.copyfile(folder / "trials" / f"{results['final']['best']:04}.opts", temporary)
        lint = _lint(best)
        written.append(best)
    write_text(folder / "trials.csv", table_of_trials(results))
    write_text(folder / "sweep.json", json.dumps(dict(results), indent=2) + "\n")
    written += [folder / "trials.csv", folder / "sweep.json"]
    for target in filter(None, (folder / "report.md", page)):
        picture = target.with_name("front.png") if target is not page else target.with_suffix(".png")
        drawn = any(t["outcome"] == "solved" for t in results["trials"])
        if drawn:
            plot(results, picture)
            written.append(picture)
        write_text(target, "\n".join(report(results, picture.name if drawn else None, lint)) + "\n")
        written.append(target)
    return written


def _lint(file: Path) -> str:
    """What `petsc-fs lint` says of a file; "" if nothing."""
    command = [sys.executable, "-m", "petsc_fs", "lint", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, env=measure.environment(), check=False)
    return "" if done.returncode == 0 else done.stderr.strip()


def table_of_trials(results: Results) -> str:
    """One line per trial, as CSV: outcome, objectives, measurements of each scene, parameters."""
    names = sorted({name for t in results["trials"] for name in t["values"]})
    measured = ("seconds", "base_seconds", "setup_seconds", "iterations", "memory", "residual", "error")
    heads = ["trial", "outcome", "message", "same_as"]
    heads += [f"{o}_{how}" for o in OBJECTIVES for how in ("mean", "worst")]
    heads += [f"{scene}:{m}" for scene in results["scenes"] for m in measured]
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow([*heads, *names])
    for t in results["trials"]:
        row = [t["number"], t["outcome"], t["message"], t["same_as"]]
        row += [t["totals"].get(o, {}).get(how) for o in OBJECTIVES for how in ("mean", "worst")]
        row += [t["scenes"].get(scene, {}).get(m) for scene in results["scenes"] for m in measured]
        out.writerow([*row, *(t["values"].get(name) for name in names)])
    return text.getvalue()


def screen_text(results: Results) -> str:
    """A few lines for the terminal."""
    lines = [f"{len(results['trials'])} trials: {_counts(results)}"]
    final = results["final"]
    if final is not None:
        lines += [
            f"best: trial {final['best']}; time in multiples of the base file's, medians of {results['confirm']}:"
        ]
        found = final["finalists"][str(final["best"])]
        lines += [f"  {scene}: {_time(s)}" for scene, s in found.items()]
        lines += [f"  {scene} (held out): {_time(s)}" for scene, s in final["hold_out"].items()]
    return "\n".join(lines)


def _time(found: Mapping[str, Any]) -> str:
    return f"{found['ratios']['time']:.2f}" if found["outcome"] == "solved" else found["outcome"]


def _counts(results: Results) -> str:
    return ", ".join(f"{n} {kind}" for kind, n in sorted(results["outcomes"].items(), key=lambda item: -item[1]))


def report(results: Results, picture: str | None, lint: str) -> list[str]:
    """The report's lines, in Markdown."""
    clock = "wall-clock time" if results["clock"] == "wall" else "processor time"
    lines = [
        f"# Sweep: {results['description']}",
        "",
        "Written by",
        "",
        *" \\\n".join(textwrap.wrap(results["command"], 114, initial_indent="    ", subsequent_indent="      ")).split(
            "\n"
        ),
        "",
        f"- space `{results['space']}`, base file `{results['base']}`",
        f"- each trial solved {', '.join(results['scenes'])} on {_ranks(results['ranks'])} to a relative tolerance of "
        f"{results['tolerance']:g}, {results['repetitions']} time{'s' if results['repetitions'] > 1 else ''}",
        f"- sampler {results['sampler']}, to make small: {', '.join(results['objectives'])}; the {_mean(results)} over "
        "scenes of the ratio to the base file, measured between the trials",
        f"- time is {clock} of set-up and solve; memory what the process grew by after reading the scene; "
        + ("the error is that of the solution" if results["errors_known"] else "the error is the true residual"),
        "",
    ]
    if results["final"] is not None:
        lines += [*_best(results, lint), ""]
    lines += [*_outcomes(results), ""]
    if picture is not None:
        lines += [*_front(results, picture), ""]
    lines += [*_importance(results), ""]
    versions = ", ".join(f"{name} {number}" for name, number in results["versions"].items())
    return [*lines, f"Versions: {versions}."]


def _ranks(ranks: int) -> str:
    return f"{ranks} rank{'s' if ranks > 1 else ''}"


def _mean(results: Results) -> str:
    return "worst" if results["aggregate"] == "worst" else "geometric mean"


def _best(results: Results, lint: str) -> Iterator[str]:
    """What the best file changes, and how it does on the scenes of the sweep and on those held out."""
    final = results["final"]
    yield f"## The best file: trial {final['best']}"
    yield ""
    if results["changes"]:
        rows = [[f"`-{n}`", _value(old), _value(new)] for n, (old, new) in results["changes"].items()]
        yield from table(["option", results["base"], "best.opts"], rows, compact=True)
    else:
        yield "It is the base file: no trial was better."
    yield ""
    if results["at_edge"]:
        yield f"At the end of their range, which may be too narrow: {', '.join(f'`{n}`' for n in results['at_edge'])}."
        yield ""
    yield f"`petsc-fs lint best.opts` complains: {lint}" if lint else "`petsc-fs lint best.opts` has no complaint."
    yield ""
    yield (
        f"Measured again, the base file and the best {len(final['finalists'])} in turns, {results['confirm']} times; "
        "medians, and the least and the greatest ratio in brackets:"
    )
    yield ""
    yield from _comparison(final["finalists"][str(final["best"])])
    if final["hold_out"]:
        yield ""
        yield "On scenes that the search never saw:"
        yield ""
        yield from _comparison(final["hold_out"])
        worse = [scene for scene, s in final["hold_out"].items() if s["outcome"] != "solved" or s["ratios"]["time"] > 1]
        if worse:
            yield ""
            yield (
                f"On {', '.join(worse)} the base file is the better one: best.opts is for scenes like those that it "
                "was tuned for."
            )
    others = [n for n in final["finalists"] if n != str(final["best"])]
    if others:
        yield ""
        yield "The other finalists: " + "; ".join(
            f"trial {n}: {', '.join(_time(s) for s in final['finalists'][n].values())}" for n in others
        )


def _value(value: str | None) -> str:
    return "not set" if value is None else f"`{value}`"


def _comparison(found: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Base file against a file, by scene."""
    heads = ["scene", "seconds, base", "best", "ratio", "iterations, base", "best", "MB, base", "best"]
    heads += ["true residual", "error, base", "best"]
    rows = []
    for scene, s in found.items():
        base = s["base"]
        if s["outcome"] != "solved":
            rows.append([scene, f"{base['seconds']:.3g}", f"{s['outcome']}: {s['message']}", *[""] * 8])
            continue
        low, high = s["spread"]
        rows.append(
            [
                scene,
                f"{base['seconds']:.3g}",
                f"{s['seconds']:.3g}",
                f"**{s['ratios']['time']:.2f}** ({low:.2f}–{high:.2f})",
                f"{base['iterations']:.0f}",
                f"{s['iterations']:.0f}",
                f"{base['memory'] / 1e6:.0f}",
                f"{s['memory'] / 1e6:.0f}",
                f"{s['residual']:.1e}",
                _error(base["error"]),
                _error(s["error"]),
            ]
        )
    yield from table(heads, rows, compact=True)
    ratios = [s["ratios"]["time"] for s in found.values() if s["outcome"] == "solved"]
    if len(ratios) > 1:
        from petsc_fs.tools.sweep import aggregate

        yield ""
        yield f"Time ratio over these scenes: geometric mean {aggregate(ratios, 'mean'):.2f}, worst {max(ratios):.2f}."


def _error(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _outcomes(results: Results) -> Iterator[str]:
    yield f"## How the {len(results['trials'])} trials ended"
    yield ""
    rows = []
    for kind, count in sorted(results["outcomes"].items(), key=lambda item: -item[1]):
        message = next((t["message"] for t in results["trials"] if t["outcome"] == kind), "")
        rows.append([kind, str(count), OUTCOMES[kind], _escaped(message)])
    yield from table(["outcome", "trials", "meaning", "for example"], rows, compact=True)
    repeated = sum(t["same_as"] is not None for t in results["trials"])
    if repeated:
        yield ""
        yield f"Of these, {repeated} drew the same options as an earlier trial, and took its result unmeasured."


def _escaped(text: str) -> str:
    text = " ".join(text.split()).replace("|", "\\|")
    return text if len(text) <= 160 else f"{text[:157]}..."


def _front(results: Results, picture: str) -> Iterator[str]:
    names = results["front_objectives"]
    yield "## Pareto front"
    yield ""
    yield f"Trials of which none is better in all of {', '.join(names)}, as multiples of the base file."
    yield ""
    yield f"![Trials by {names[0]} and {names[1]}, with the front, and importance of parameters]({picture})"
    yield ""
    trials = {t["number"]: t for t in results["trials"]}
    varied = sorted({name for n in results["front"] for name in trials[n]["values"]})
    shown = [n for n in varied if len({str(trials[k]["values"].get(n)) for k in results["front"]}) > 1]
    heads = ["trial", *(f"{o}, {how}" for o in OBJECTIVES for how in _hows(results)), "what differs on the front"]
    rows = []
    for number in results["front"]:
        t = trials[number]
        totals = [f"{t['totals'][o][how]:.2f}" for o in OBJECTIVES for how in _hows(results)]
        values = [f"{name} {_short(t['values'][name])}" for name in shown if name in t["values"]]
        rows.append([str(number), *totals, ", ".join(values)])
    yield from table(heads, rows, compact=True)


def _hows(results: Results) -> tuple[str, ...]:
    return ("mean", "worst") if len(results["scenes"]) > 1 else ("mean",)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value).replace(ABSENT, "default")


def _importance(results: Results) -> Iterator[str]:
    yield "## Importance of the parameters"
    yield ""
    if not results["importance"]:
        yield f"Fewer than {2 * STARTUP_TRIALS} trials were solved, too few to tell."
        return
    yield "By optuna's evaluators; each column adds up to 1."
    yield ""
    for name in results["importance"]:
        yield f"- {EVALUATORS[name]}"
    yield ""
    columns = [(name, o) for name, by in results["importance"].items() for o in by]
    first = results["importance"][columns[0][0]][columns[0][1]]
    rows = [
        [f"`{p}`", *(f"{results['importance'][name][o].get(p, 0.0):.2f}" for name, o in columns)]
        for p in sorted(first, key=lambda p: -first[p])
    ]
    yield from table(["parameter", *(f"{o} ({name})" for name, o in columns)], rows, compact=True)


def plot(results: Results, target: Path) -> None:
    """Draw all solved trials by the first two objectives of the front, with the front; beside it the importance.

    Raises:
        UsageError: matplotlib is missing or cannot write the file.
    """
    plt = pyplot()
    how = results["aggregate"]
    x_name, y_name = results["front_objectives"][:2]
    solved = [t for t in results["trials"] if t["outcome"] == "solved" and t["same_as"] is None]
    evaluator = next(reversed(results["importance"]), "")
    importance: dict[str, float] = results["importance"].get(evaluator, {}).get(x_name, {})
    figure, axes = plt.subplots(1, 2 if importance else 1, figsize=(11 if importance else 6, 4.6), layout="constrained")
    scatter = axes[0] if importance else axes
    on_front = set(results["front"])
    for chosen, colour, mark, text in (
        (False, COLOURS[2], "o", "solved"),
        (True, COLOURS[0], "o", "Pareto front"),
    ):
        points = [t["totals"] for t in solved if (t["number"] in on_front) == chosen]
        x, y = [p[x_name][how] for p in points], [p[y_name][how] for p in points]
        scatter.plot(
            x, y, mark, ms=6 if chosen else 4, color=colour, label=f"{text} ({len(points)})", zorder=2 + chosen
        )
    if results["final"] is not None:
        best = next(t for t in solved if t["number"] == results["final"]["best"])["totals"]
        scatter.plot(
            best[x_name][how], best[y_name][how], "*", ms=15, mfc="none", color=COLOURS[1], label="best.opts", zorder=4
        )
    scatter.plot(1, 1, "s", ms=8, mfc="none", mew=1.8, color="black", label=results["base"], zorder=5)
    for axis, scale in (("x", scatter.set_xscale), ("y", scatter.set_yscale)):
        name = x_name if axis == "x" else y_name
        values = [t["totals"][name][how] for t in solved]
        if max(values) > 10 * min(values):
            scale("log")
    failed = len(results["trials"]) - sum(t["outcome"] == "solved" for t in results["trials"])
    scatter.set_xlabel(AXES[x_name])
    scatter.set_ylabel(AXES[y_name])
    scatter.set_title(f"{len(results['trials'])} trials, of which {failed} were not solved", fontsize=10)
    scatter.grid(alpha=0.3)
    scatter.legend(fontsize=8)
    if importance:
        names = sorted(importance, key=lambda p: importance[p])[-15:]
        axes[1].barh(names, [importance[p] for p in names], color=COLOURS[0])
        axes[1].set_xlabel(f"importance for {x_name} ({evaluator})")
        axes[1].tick_params(axis="y", labelsize=7)
        axes[1].set_title("which parameters matter", fontsize=10)
    try:
        with complete(target) as temporary:
            figure.savefig(temporary, dpi=120, format=target.suffix[1:])
    finally:
        plt.close(figure)
