"""What people read of a comparison: live progress, the summary on the terminal, and one page in HTML."""

from __future__ import annotations

import base64
import html
import io
from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from petsc_fs.tools.compare import (
    CLOCKS,
    SECONDS,
    Case,
    Comparison,
    Fastest,
    Point,
    Spread,
    points,
    seconds_words,
    verdicts,
)
from petsc_fs.tools.compare_plots import Picture, looks, rank_words
from petsc_fs.tools.measure import KINDS, Record

WIDTH = 110


class Progress:
    """A bar on standard error, and a line for each outcome that is not convergence."""

    def __init__(self, total: int) -> None:
        """Of this many processes."""
        self._console = Console(stderr=True)
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=self._console,
        )
        self._task = self._bar.add_task("starting", total=total)

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def say(self, what: str) -> None:
        """Say what is being done."""
        self._bar.update(self._task, description=what)

    def update(self, what: dict[str, Any], records: list[Record]) -> None:
        """One process has ended."""
        label = f"{what['scene']} · {what['file']} · {rank_words(what['ranks'])}"
        kinds = Counter(r["kind"] for r in records if r["kind"] != "converged")
        for kind, number in kinds.items():
            message = next(r["message"] for r in records if r["kind"] == kind)
            times = f" ({number} tolerances)" if number > 1 else ""
            self._console.print(f"{label}: {kind}{times} {message}".rstrip(), highlight=False, markup=False)
        self._bar.update(self._task, advance=1, description=label)


def terminal_summary(found: Comparison) -> str:
    """Which file is fastest for which accuracy, as a table for the terminal."""
    table = Table(title="fastest options file that reaches a forward error, and its seconds")
    for heading in ("scene", "ranks", "error ≤", *SECONDS):
        table.add_column(heading, justify="right" if heading in ("ranks", "error ≤") else "left")
    last = None
    for verdict in verdicts(found):
        if last is not None and (verdict.scene, verdict.ranks) != last:
            table.add_section()
        last = verdict.scene, verdict.ranks
        cells = []
        for winners in verdict.winners.values():
            ties = f" (≈ {', '.join(winners[0].ties)})" if winners and winners[0].ties else ""
            cells.append(f"{winners[0].file} {seconds_words(winners)}{ties}" if winners else "none")
        table.add_row(verdict.scene, str(verdict.ranks), verdict.label, *cells)
    console = Console(file=io.StringIO(), width=WIDTH, color_system=None)
    console.print(table)
    return str(console.file.getvalue()).rstrip()  # type: ignore[attr-defined]


STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 68rem;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.9rem; margin-bottom: .2rem; } h2 { margin-top: 2.6rem; border-bottom: 2px solid #0072B2; }
h3 { margin: 1.6rem 0 .4rem; }
p.lead { color: #444; margin-top: 0; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-variant-numeric: tabular-nums; font-size: .92rem; }
td b, .label { white-space: nowrap; }
th, td { text-align: left; padding: .25rem .7rem; border-bottom: 1px solid #ddd; vertical-align: top; }
thead th { border-bottom: 2px solid #888; } td.n, th.n { text-align: right; white-space: nowrap; }
.dot { display: inline-block; width: .75em; height: .75em; border-radius: 50%; margin-right: .4em; }
.small { color: #555; font-size: .86em; } .none { color: #777; }
figure { margin: 1rem 0 1.6rem; } figure img { max-width: 100%; height: auto; }
figcaption { color: #444; font-size: .9rem; max-width: 60rem; }
details { margin: .5rem 0; } summary { cursor: pointer; }
pre { background: #f5f5f5; padding: .7rem; overflow-x: auto; font-size: .82rem; }
.scroll { overflow-x: auto; }
@media print { body { max-width: none; margin: 0; font-size: 10pt; } figure, tr { break-inside: avoid; }
               h2, h3 { break-after: avoid; } table { font-size: 7.5pt; } th, td { padding: .15rem .3rem; }
               .scroll { overflow: visible; } pre { white-space: pre-wrap; font-size: 7pt; }
               h2 { break-before: page; } h2.first { break-before: auto; } }
"""


def page(found: Comparison, pictures: Sequence[Picture]) -> str:
    """The page: summary, pictures, and how it was measured; it refers to no other file."""
    everything = points(found.records, found.clock)
    versions = found.about["versions"]
    lines = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{_text(_title(found))}</title><style>{STYLE}</style></head><body>",
        f"<h1>{_text(_title(found))}</h1>",
        f'<p class="lead">{len(found.entries)} options files on {len(found.cases)} '
        f"scene{'s' if len(found.cases) > 1 else ''}, {' and '.join(rank_words(n) for n in found.ranks)}, "
        f"{len(found.rtols)} tolerances, {found.repeat} round{'s' if found.repeat > 1 else ''}; "
        f"PETSc {_text(versions['petsc'])}, "
        f"{_text(found.about['machine']['processor'])}; {_text(found.about['date'])}</p>",
    ]
    if not found.about.get("complete", True):
        lines.append("<p><strong>Measuring was interrupted:</strong> later rounds or combinations are missing.</p>")
    lines += _summary(found)
    for case in found.cases:
        lines += _scene(found, case, everything, [p for p in pictures if p.scene == case.label])
    lines += _outcomes(found)
    lines += _method(found)
    return "\n".join([*lines, "</body></html>"]) + "\n"


def _title(found: Comparison) -> str:
    names = ", ".join(case.label for case in found.cases)
    return f"Error against run time: {names}"


def _text(value: object) -> str:
    return html.escape(str(value))


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table; cells are HTML, columns whose number is in `numbers` are aligned to the right."""
    kinds = [' class="n"' if k in numbers else "" for k in range(len(headings))]
    head = "".join(f"<th{kind}>{h}</th>" for kind, h in zip(kinds, headings, strict=True))
    body = "".join(
        f"<tr>{''.join(f'<td{kind}>{cell}</td>' for kind, cell in zip(kinds, row, strict=True))}</tr>\n" for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>'


def _summary(found: Comparison) -> list[str]:
    """Which file is fastest for which accuracy."""
    colours = {label: look.colour for label, look in looks(found.entries).items()}
    sizes = {case.label: f"{case.unknowns:,} unknowns, {case.dimension}D" for case in found.cases}
    rows = []
    last: tuple[str, int] | None = None
    for verdict in verdicts(found):
        here = (verdict.scene, verdict.ranks)
        new = last is None or last[0] != verdict.scene
        scene = f"<b>{_text(verdict.scene)}</b><br><span class='small'>{sizes[verdict.scene]}</span>" if new else ""
        ranks = str(verdict.ranks) if here != last else ""
        rows.append(
            [
                scene,
                ranks,
                f'<span class="label">{verdict.label}</span>',
                *(_winner(w, colours) for w in verdict.winners.values()),
            ]
        )
        last = here
    return [
        '<h2 class="first">Which file is fastest for which accuracy</h2>',
        "<p>The fastest file whose <em>forward error</em>, all fields together, is at most that of the row, at "
        f"whatever tolerance that takes; median seconds ({CLOCKS[found.clock]}), from the loosest error of the row to "
        "the strictest. ≈ names files whose "
        "quartiles overlap with the fastest one's: between them this measurement does not decide.</p>",
        _table(["scene", "ranks", "error ≤", *SECONDS], rows, numbers=(1,)),
    ]


def _winner(winners: Sequence[Fastest] | None, colours: dict[str, str]) -> str:
    """Cell of the summary."""
    if not winners:
        return '<span class="none">none</span>'
    first = winners[0]
    ties = f"<br><span class='small'>≈ {_text(', '.join(first.ties))}</span>" if first.ties else ""
    dot = f'<span class="dot" style="background:{colours[first.file]}"></span>'
    return f"{dot}{_text(first.file)} <b>{seconds_words(winners)}</b>{ties}"


def _spread(spread: Spread) -> str:
    return f"{spread.median:.3g} <span class='small'>[{spread.low:.3g}, {spread.high:.3g}]</span>"


def _scene(found: Comparison, case: Case, everything: Sequence[Point], pictures: Sequence[Picture]) -> list[str]:
    """Pictures and numbers of one scene."""
    fields = ", ".join(f"{name} {size:,}" for name, size in case.sizes.items())
    lines = [
        f"<h2>{_text(case.label)}</h2>",
        f"<p>{_text(case.model or 'a scene')}, {case.dimension}D, {case.unknowns:,} unknowns: {_text(fields)}.</p>",
    ]
    for picture in pictures:
        data = base64.b64encode(picture.svg.read_bytes()).decode("ascii")
        lines.append(
            f'<figure><h3>{_text(picture.title)}</h3><img alt="{_text(picture.title)}" '
            f'src="data:image/svg+xml;base64,{data}"><figcaption>{_text(picture.caption)}</figcaption></figure>'
        )
    rows = [
        [
            _text(p.file),
            str(p.ranks),
            f"{p.rtol:.0e}",
            f"{p.iterations:g}",
            f"{p.residual:.1e}",
            f"{p.error:.1e}",
            _spread(p.setup),
            _spread(p.solve),
            "" if p.converged else "missed the tolerance" if p.ended else "failed in some rounds",
        ]
        for p in everything
        if p.scene == case.label
    ]
    headings = [
        "file",
        "ranks",
        "tolerance",
        "iterations",
        "true residual",
        "forward error",
        "set-up, s",
        "solve, s",
        "",
    ]
    table = _table(headings, rows, numbers=range(1, 8))
    return [*lines, f"<details><summary>All medians of {_text(case.label)} in numbers</summary>{table}</details>"]


def _outcomes(found: Comparison) -> list[str]:
    """What did not converge."""
    groups: dict[tuple[str, str, int, str], list[Record]] = {}
    for r in found.records:
        if r["kind"] != "converged":
            groups.setdefault((r["scene"], r["file"], r["ranks"], r["kind"]), []).append(r)
    lines = ["<h2>What did not converge</h2>"]
    if not groups:
        return [*lines, "<p>Every solve met its tolerance.</p>"]
    rows = []
    for (scene, file, ranks, kind), runs in groups.items():
        tolerances = sorted({r["rtol"] for r in runs if r["rtol"] is not None}, reverse=True)
        span = (
            f"{tolerances[0]:.0e}" + (f" … {tolerances[-1]:.0e}" if len(tolerances) > 1 else "") if tolerances else ""
        )
        said = runs[0]["message"] or runs[0]["reason"] or ""
        rows.append([_text(scene), _text(file), str(ranks), _text(kind), str(len(runs)), span, _text(said[:300])])
    lines.append(_table(["scene", "file", "ranks", "outcome", "runs", "tolerances", "said"], rows, numbers=(2, 4)))
    kinds = {kind for *_, kind in groups}
    lines.append("<ul>" + "".join(f"<li><b>{k}</b>: {_text(KINDS[k])}</li>" for k in KINDS if k in kinds) + "</ul>")
    if found.given_up:
        words = "; ".join(f"{w['scene']}, {w['file']}, {rank_words(w['ranks'])}" for w in found.given_up)
        limit = f"{found.about['time_limit']:g} s"
        lines.append(f"<p>Not measured again after the time limit of {limit} had passed: {_text(words)}.</p>")
    return lines


def _method(found: Comparison) -> list[str]:
    """How it was measured."""
    about = found.about
    facts = {**about["machine"], "versions": ", ".join(f"{k} {v}" for k, v in about["versions"].items())}
    facts |= {"command": found.command, "date": about["date"], "took": f"{about['seconds'] / 60:.1f} min"}
    facts["load average at the end"] = f"{about['load']:.1f} (other programs disturb where this exceeds the ranks)"
    references = [
        [
            _text(case.label),
            _text(case.reference["method"]),
            f"{case.reference['refinements']}",
            f"{case.reference['corrections'][-1]:.0e}",
            f"{case.reference['backward_error']['componentwise']:.0e}",
            ", ".join(f"{name} {value:.0e}" for name, value in case.reference["residual_by_field"].items()),
        ]
        for case in found.cases
        if case.reference
    ]
    lines = [
        "<h2>How this was measured</h2>",
        f"<p>Each combination of scene, file and number of ranks ran in a process of its own in each of {found.repeat} "
        "rounds; all combinations came to their turn before any did again, in another order each time. A first set-up "
        "and solve in each process is not counted, so that no time goes to loading libraries. Then one set-up served "
        f"all tolerances, which replace those of the file. Seconds are {CLOCKS[found.clock]} of the slowest rank; "
        "errors were computed afterwards, those by iteration in a solve of their own, whose times do not count.</p>",
        "<p><b>Forward error</b>: difference from the reference, each field in its own norm (mean square weighted with "
        "cell volumes, each dimension of cells alike; fluxes by their density), relative to the reference; all fields "
        "together as their root mean square. <b>True residual</b>: |b − Jx| / |b| of the untransformed system, in the "
        "Euclidean norm of all unknowns, which is what the tolerance is held against.</p>",
        "<h3>Reference solutions</h3>",
        "<p>The last correction, relative to the solution in the worst field, bounds what is wrong with a reference "
        "before it is rounded to double precision. Its residuals are relative to all fields' |b|.</p>",
        _table(
            ["scene", "method", "refinements", "last correction", "componentwise backward error", "true residual"],
            references,
            numbers=(2, 3, 4),
        ),
        "<h3>Machine and versions</h3>",
        _table(["", ""], [[_text(k), _text(v)] for k, v in facts.items()]),
        "<h3>Options files</h3>",
    ]
    for entry in found.entries:
        more = "".join(f"-{k} {v or ''}\n" for k, v in entry.options.items())
        extra = f"<p>with, before the file's own:</p><pre>{_text(more)}</pre>" if more else ""
        lines.append(
            f"<details><summary><code>{_text(entry.label)}</code>: {_text(entry.purpose)}</summary>"
            f"{extra}<pre>{_text(entry.text)}</pre></details>"
        )
    return lines
