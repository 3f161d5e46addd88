"""Compare options files: error against seconds, or seconds against those of a base file, on any scenes and ranks.

See `METHOD` for how, and `petsc_fs.tools.reference` for the reference solution of each scene, which comes first.
"""

from __future__ import annotations

import argparse
import base64
import csv
import io
import itertools
import json
import os
import re
import signal
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from pathlib import Path
from statistics import geometric_mean, median
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.io.files import write_text
from petsc_fs.tools import measure
from petsc_fs.tools.measure import CLOCKS, Job, Record, Variant, grown, positive, say, seconds_of
from petsc_fs.tools.pages import hypertext, whole

if TYPE_CHECKING:
    from mpi4py import MPI

RTOLS = "1e-2..1e-12"
TARGETS = tuple(10.0**-k for k in range(1, 13))
"""Accuracies for which the summary names the fastest file."""
ENDED = ("converged", "stagnated")
"""Kinds of records whose solution is one to be judged by its error."""
SECONDS = {"total": "set-up and solve", "solve": "solve alone"}
"""The two ways to count: for a system that is solved once, and for one that is set up already."""


@dataclass(frozen=True)
class Case:
    """A scene or sequence to compare on."""

    label: str  # the name of the file
    path: str
    dimension: int
    sizes: dict[str, int]  # unknowns of each field, in the first step of a sequence
    model: str  # where it comes from
    steps: int = 0  # of a sequence
    reference: dict[str, Any] = field(default_factory=dict)  # see `petsc_fs.tools.reference.Reference.about`

    @classmethod
    def of(cls, path: Path) -> Case:
        """Read the head of a file.

        Raises:
            SceneError: it is no scene.
        """
        from petsc_fs.io import hdf5, sequence

        if sequence.is_sequence(path):
            contents = sequence.read_contents(path)
            first, model, steps = contents.steps[0], contents.model, len(contents.steps)
            return cls(path.stem, str(path), first.dimension, first.sizes, model, steps)
        dimension, sizes = hdf5.read_sizes(path)
        with hdf5.open_file(path) as file:
            model = str(file.attrs["model"])
        return cls(path.stem, str(path), dimension, {f: n for f, n in sizes.items() if n}, model)

    @property
    def names(self) -> tuple[str, ...]:
        """By which headers of options files know it."""
        return (self.label, *re.findall(r"\w+", self.model)[:1])


@dataclass(frozen=True)
class Comparison:
    """All that was measured, and what with."""

    cases: tuple[Case, ...]
    variants: tuple[Variant, ...]
    ranks: tuple[int, ...]
    rtols: tuple[float, ...]  # from the loosest; empty for those of the files
    repeat: int  # rounds
    records: list[Record]  # see `petsc_fs.tools.measure`
    about: dict[str, Any]  # command, machine and date
    clock: str = "wall"  # what seconds are, one of `petsc_fs.tools.measure.CLOCKS`
    base: str = ""  # label of the variant that others are compared to; "" for none

    def to_json(self) -> str:
        """Everything, for `from_json`."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Comparison:
        """Read what `to_json` wrote."""
        data = json.loads(text)
        cases = tuple(Case(**case) for case in data["cases"])
        variants = tuple(Variant(**v) for v in data["variants"])
        exact = {name: tuple(data[name]) for name in ("ranks", "rtols")}
        return cls(**(data | exact | {"cases": cases, "variants": variants}))


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Of at least one value."""
        low, median, high = np.percentile(values, [25, 50, 75])
        return cls(float(median), float(low), float(high))

    def __str__(self) -> str:
        return f"{self.median:.3g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True)
class Point:
    """What one file did with one tolerance on one scene and number of ranks, over all rounds: medians."""

    scene: str
    file: str
    ranks: int
    rtol: float | None
    ended: bool  # whether every round came to a solution
    converged: bool  # whether every round met the tolerance
    iterations: float
    error: float  # forward error; NaN where there is no reference
    residual: float  # true residual
    seconds: dict[str, Spread]  # of "setup", "solve", and "total" of both
    ratios: dict[str, Spread]  # of "setup", "solve" and "total" to those of the base file in the same round
    memory: float  # bytes that all ranks' memory grew by


def points(found: Comparison) -> list[Point]:
    """Medians and quartiles over rounds of all that came to a solution in any of them."""
    labels = {case.path: case.label for case in found.cases}
    groups: dict[tuple[Any, ...], dict[int, Record]] = {}
    for r in found.records:
        groups.setdefault((r["scene"], r["ranks"], r["rtol"], r["variant"]), {})[r["round"]] = r
    ended = {key: {k: r for k, r in runs.items() if r["kind"] in ENDED} for key, runs in groups.items()}
    rows = []
    for (scene, ranks, rtol, file), runs in groups.items():
        good = ended[scene, ranks, rtol, file]
        if not good:
            continue
        base = ended.get((scene, ranks, rtol, found.base), {})
        mine = {k: seconds_of(r, found.clock) for k, r in good.items()}
        theirs = {k: seconds_of(base[k], found.clock) for k in mine if k in base}
        ratios = {what: [mine[k][what] / s[what] for k, s in theirs.items()] for what in ("setup", *SECONDS)}
        errors = [r["forward_error"] for r in good.values() if r["forward_error"] is not None]
        point = Point(
            *(labels[scene], file, ranks, rtol),
            ended=len(good) == len(runs),
            converged=all(r["kind"] == "converged" for r in runs.values()),
            iterations=median(r["iterations"] for r in good.values()),
            error=median(errors) if errors else float("nan"),
            residual=median(r["true_residual"] for r in good.values()),
            seconds={what: Spread.of([s[what] for s in mine.values()]) for what in ("setup", *SECONDS)},
            ratios={what: Spread.of(values) for what, values in ratios.items() if values},
            memory=median(map(grown, good.values())),
        )
        rows.append(point)
    return rows


@dataclass(frozen=True)
class Fastest:
    """The fastest file for an accuracy, and other files whose quartiles overlap with its own, from the fastest."""

    file: str
    seconds: float  # median of its fastest point whose error is not above the accuracy
    ties: tuple[str, ...]

    def __str__(self) -> str:
        ties = f" (≈ {', '.join(self.ties)})" if self.ties else ""
        return f"{self.file} {self.seconds:.2g} s{ties}"


def fastest(found: Iterable[Point], accuracy: float, what: str) -> Fastest | None:
    """The fastest file whose forward error is at most `accuracy`, or None if no file gets there.

    Of points of one scene and number of ranks; those that did not end in every round do not count, and of `SECONDS`
    does `what`.
    """
    good = [(p.seconds[what], p.file) for p in found if p.ended and p.error <= accuracy]
    good.sort(key=lambda pair: pair[0].median)
    best = {file: spread for spread, file in reversed(good)}  # of each file the first one
    if not best:
        return None
    first, file = good[0]
    ties = dict.fromkeys(label for _, label in good if label != file and best[label].low <= first.high)
    return Fastest(file, first.median, tuple(ties))


def summary(found: Comparison, everything: Sequence[Point]) -> list[list[object]]:
    """Scene, ranks, accuracies and the fastest file by each of `SECONDS`; a row for accuracies of the same winners."""
    rows: list[list[object]] = []
    for case, ranks in itertools.product(found.cases, found.ranks):
        mine = [p for p in everything if (p.scene, p.ranks) == (case.label, ranks)]
        errors = [p.error for p in mine if p.ended and p.error > 0]
        decades = [t for t in TARGETS if errors and min(errors) <= t <= 10 * max(errors)]
        winners = [(t, [fastest(mine, t, what) for what in SECONDS]) for t in decades]
        for _, group in itertools.groupby(winners, key=lambda w: [b and (b.file, b.ties) for b in w[1]]):
            same = list(group)
            span = " … ".join(f"{t:.0e}" for t in dict.fromkeys((same[0][0], same[-1][0])))
            rows.append([case.label, ranks, span, *(str(b or "none") for b in same[-1][1])])
    return rows


SUMMARY = ("scene", "ranks", "error ≤", *SECONDS.values())
MEDIANS = "file;ranks;tolerance;iterations;true residual;forward error;set-up (s);solve (s);outcome".split(";")
RATIOS = "scene;ranks;file;Krylov;set-up, s;solve, s;set-up ratio;solve ratio;ratio;MiB".split(";")
FAILURES = "scene;file;ranks;outcome;runs;said".split(";")


def ratio_rows(found: Comparison, everything: Sequence[Point]) -> list[list[object]]:
    """Seconds of each file and their ratios to the base file's, and geometric means over scenes at the end."""
    rows: list[list[object]] = []
    means: dict[tuple[int, str], list[float]] = {}
    for p in everything:
        ratios = ["–"] * 3
        if p.ratios:
            means.setdefault((p.ranks, p.file), []).append(p.ratios["total"].median)
            ratios = [f"{p.ratios[w].median:.2f}" for w in ("setup", "solve")] + [str(p.ratios["total"])]
        scene = p.scene if p.rtol is None else f"{p.scene} to {p.rtol:.0e}"
        file = p.file if p.converged else f"{p.file} (not converged)"
        seconds = [f"{p.seconds[w].median:.3g}" for w in ("setup", "solve")]
        rows.append([scene, p.ranks, file, f"{p.iterations:g}", *seconds, *ratios, f"{p.memory / 2**20:.3g}"])
    for (ranks, file), values in sorted(means.items()):
        if file != found.base:
            mean = f"{geometric_mean(values):.2f}, worst {max(values):.2f}"
            rows.append(["geometric mean", ranks, file, *[""] * 5, mean, ""])
    return rows


def failures(found: Comparison) -> list[list[object]]:
    """Scene, file, ranks, outcome, number of runs, and what was said, of all that did not converge."""
    groups: dict[tuple[str, str, int, str], list[Record]] = {}
    for r in found.records:
        if r["kind"] != "converged":
            groups.setdefault((Path(r["scene"]).stem, r["variant"], r["ranks"], r["kind"]), []).append(r)
    return [[*key, len(runs), (runs[0]["message"] or runs[0]["reason"] or "")[:300]] for key, runs in groups.items()]


def rtols_of(text: str) -> tuple[float, ...]:
    """Tolerances from "1e-2..1e-12" (every decade), "1e-2..1e-12:2" (every second), or "1e-3,1e-6"; or a UsageError."""
    match = re.fullmatch(r"([^.,:]+(?:\.\d+)?(?:e-?\d+)?)\.\.([^:,]+?)(?::(\d+))?", text)
    try:
        if match is not None:
            first, last = float(match[1]), float(match[2])
            step = int(match[3] or 1)
            count = round(abs(np.log10(first / last)) / step)
            found = [float(f"{max(first, last) * 10.0 ** (-step * k):.6g}") for k in range(count + 1)]
        else:
            found = [float(word) for word in text.split(",")]
    except (ValueError, ZeroDivisionError, OverflowError) as e:
        raise UsageError(f"--rtol {text}: expected for example 1e-2..1e-12, 1e-2..1e-12:2 or 1e-3,1e-6") from e
    if not found or not all(0 < r < 1 for r in found):
        raise UsageError(f"--rtol {text}: tolerances must lie between 0 and 1")
    return tuple(sorted(set(found), reverse=True))


def to_csv(found: Comparison) -> str:
    """One line for each record; phases, fields and ranks in columns of their own."""
    rows = []
    for record in found.records:
        row: Record = {}
        for name, value in record.items():
            if isinstance(value, dict):
                row |= {f"{name.removesuffix('_by_field')}_{key}": v for key, v in value.items()}
            else:
                row |= {f"{name}_max": max(value)} if isinstance(value, list) else {name: value}
        rows.append(row | {"scene": Path(record["scene"]).stem})
    first = ["scene", "ranks", "variant", "round", "rtol", "kind", "iterations"]
    text = io.StringIO()
    writer = csv.DictWriter(text, first + sorted({k for row in rows for k in row} - set(first)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --- the page

METHOD = """\
Each combination of scene, file and number of ranks ran in a process of its own in each round; all combinations came to
their turn before any did again, in another order each time. A first set-up and solve in each process is not counted.
One set-up served all tolerances, which replace those of the file. Numbers are medians and, in brackets, quartiles over
rounds; ratios are of the same round. Forward error: difference from the reference, each field in its own norm (mean
square weighted with cell volumes, each dimension of cells alike; fluxes by their density), relative to the reference;
all fields together as their root mean square. True residual: |b − Jx| / |b| of the user's system. MiB: what all
ranks' memory grew by in set-up and solve. A file is fastest whose forward error is at most that of the row, at whatever
tolerance that takes; ≈ names files whose quartiles overlap with the fastest one's: between them this measurement does
not decide."""


def page(found: Comparison, everything: Sequence[Point], pictures: Mapping[str, Path]) -> str:
    """The page: summary, pictures by label of the scene, and how it was measured; it refers to no other file."""
    lines: list[str] = []
    if not found.about["complete"]:
        lines.append("<p><b>Measuring was interrupted:</b> later rounds or combinations are missing.</p>")
    if found.base:
        rows = ratio_rows(found, everything)
        lines += [f"<h2>Against {escape(found.base)}</h2>", hypertext("Ratios of seconds", RATIOS, rows)]
    if best := summary(found, everything):
        lines += ["<h2>Which file is fastest for which accuracy</h2>", hypertext("Fastest files", SUMMARY, best)]
    for case in found.cases:
        lines += _about_case(case, [p for p in everything if p.scene == case.label], pictures.get(case.label))
    failed = failures(found)
    lines.append("<h2>What did not converge</h2>")
    lines.append(hypertext("Failures", FAILURES, failed) if failed else "<p>Every solve met its tolerance.</p>")
    facts = [[k, f"{v:.3g}" if isinstance(v, float) else v] for k, v in found.about.items()]
    facts.append(["seconds are", f"{CLOCKS[found.clock]} of the slowest rank"])
    how = hypertext("Machine, versions and call", ("what", "value"), facts)
    lines += ["<h2>How this was measured</h2>", f"<p>{METHOD}</p>", how]
    for variant in found.variants:
        more = "".join(f"-{k} {v or ''}\n" for k, v in variant.options.items())
        head = f"<code>{escape(variant.label)}</code>: {escape(variant.purpose)}"
        lines.append(f"<details><summary>{head}</summary><pre tabindex=0>{escape(more + variant.text)}</pre></details>")
    return whole(f"Comparison: {', '.join(case.label for case in found.cases)}", lines)


def _about_case(case: Case, mine: Sequence[Point], picture: Path | None) -> Iterator[str]:
    """The part of the page on one scene."""
    sizes = ", ".join(f"{name} {size:,}" for name, size in case.sizes.items())
    steps = f"{case.steps} steps; " if case.steps else ""
    about = f"{case.model}, {case.dimension}D; {steps}{sum(case.sizes.values()):,} unknowns: {sizes}."
    yield from (f"<h2>{escape(case.label)}</h2>", f"<p>{escape(about)}</p>")
    if picture is not None:
        data = base64.b64encode(picture.read_bytes()).decode("ascii")
        alt = f"Error against seconds on {escape(case.label)}, a curve for each options file; its numbers are below"
        yield f'<img alt="{alt}" src="data:image/svg+xml;base64,{data}">'
    if case.reference:
        words = f"{case.reference['method']}; last correction {case.reference['corrections'][-1]:.0e}, "
        words += f"componentwise backward error {case.reference['backward_error']['componentwise']:.0e}"
        yield f"<p>Reference: {escape(words)}.</p>"
    rows = [
        (
            *(p.file, p.ranks, "its own" if p.rtol is None else f"{p.rtol:.0e}", f"{p.iterations:g}"),
            *(f"{p.residual:.1e}", f"{p.error:.1e}", p.seconds["setup"], p.seconds["solve"]),
            "" if p.converged else "missed the tolerance" if p.ended else "failed in some rounds",
        )
        for p in mine
    ]
    yield f"<details><summary>All medians</summary>{hypertext(f'Medians on {case.label}', MEDIANS, rows)}</details>"


def draw(found: Comparison, everything: Sequence[Point], out: Path) -> dict[str, Path]:
    """Draw error against seconds for each scene with a reference, on the least number of ranks, as SVG and PNG."""
    from petsc_fs.tools.plots import plot_work_precision

    pictures = {}
    ranks = min(found.ranks)
    for case in found.cases:
        mine = [p for p in everything if p.scene == case.label and p.ranks == ranks and p.error == p.error]
        curves: dict[str, dict[str, list[tuple[float, float]]]] = {heading: {} for heading in SECONDS.values()}
        for (what, heading), p in itertools.product(SECONDS.items(), mine):
            curves[heading].setdefault(p.file, []).append((p.seconds[what].median, p.error))
        where = f"{case.label} on {ranks} rank{'s' if ranks > 1 else ''}"
        for suffix in ("png", "svg") if mine else ():
            target = out / f"work_precision_{case.label}.{suffix}"
            pictures[case.label] = plot_work_precision(curves, target, where, CLOCKS[found.clock])
    return pictures


# --- the command line

EPILOG = """\
Scenes come first. Each combination of scene, options file and number of ranks runs in processes of its own; one that
crashes, hangs or diverges is shown as such. Ctrl-C ends measuring; what was measured is written. --out gets
compare.html, which needs no other file and no network, compare.json and compare.csv with all numbers, and pictures.
Reference solutions are kept in --out and used again; --again draws what was measured anew.
An options file may be followed by further options, in quotes.
Single-dash options are PETSc's and go to every run (-n RANKS is the exception).

  petsc-fs compare model1.h5 model2.h5 --repeat 3 --out comparison
  petsc-fs compare mine.h5 --options direct.opts "mine.opts -ksp_max_it 50" \\
      --rtol 1e-2..1e-10:2 --ranks 1 2 --out comparison
  petsc-fs compare mine.h5 run.h5 --options mine.opts --repeat 5 \\
      --base contact_poromechanics.opts
  petsc-fs compare --again comparison/compare.json --out comparison

exit codes: 0 everything was measured, whatever the outcomes; 1 no reference solution; 2 wrong call; 3 no such scene"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs compare`."""
    add = parser.add_argument
    parser.epilog = EPILOG
    add("scenes", metavar="SCENE", nargs="*", help="scene or sequence: a file, or the name of a bundled one")
    add("--options", nargs="+", metavar="FILE", help="options files; default all shipped ones that fit a scene")
    add("--base", metavar="FILE", help="options file whose seconds the others' are set against, in the same round")
    add("--rtol", metavar="A..B", help=f"tolerances, every decade, or a list with commas; default {RTOLS}, and with "
        "--base those of the files, without errors")  # fmt: skip
    add("--ranks", type=positive(int), nargs="+", metavar="N", help="numbers of ranks; default 1")
    add("--repeat", type=positive(int), default=5, metavar="N", help="rounds, default %(default)s")
    add("--out", type=Path, metavar="DIR", help="folder to write, made if missing; with --base it may be left away")
    add("--time-limit", type=positive(float), default=300.0, metavar="S", help="seconds for a set-up or solve, default "
        "%(default)g")  # fmt: skip
    add("--clock", choices=CLOCKS, help="what seconds are; cpu: processor time, for a machine where others compute")
    add("--mpiexec", metavar="PROGRAM", help="that starts ranks; default MPIEXEC or the one on PATH")
    add("--again", type=Path, metavar="FILE.json", help="draw from an earlier comparison instead")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs compare`."""
    if comm.size > 1:
        raise UsageError("compare starts mpiexec itself: call it without, and give it -n RANKS")
    if args.out is None and (args.again or not args.base):
        raise UsageError("--out: name the folder to write")
    if args.out is not None:
        from petsc_fs.tools.plots import pyplot

        pyplot()  # or an error, before anything is measured
    if args.again is not None:
        try:
            found = Comparison.from_json(args.again.read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError, KeyError) as e:
            raise UsageError(f"--again {args.again}: not a comparison: {e}") from e
        measure.make_folder(args.out)
    else:
        found = _measure(args, petsc)
    if args.clock is not None:
        found = replace(found, clock=args.clock)
    everything = points(found)
    if found.base:
        _print(RATIOS, ratio_rows(found, everything))
    if best := summary(found, everything):
        _print(SUMMARY, best)
    if args.out is not None:
        pictures = draw(found, everything, args.out)
        write_text(args.out / "compare.csv", to_csv(found))
        write_text(args.out / "compare.json", found.to_json())
        write_text(args.out / "compare.html", page(found, everything, pictures))
        print(f"written: {args.out / 'compare.html'}, compare.csv, compare.json and pictures")
    return 0


def _measure(args: argparse.Namespace, petsc: list[str]) -> Comparison:
    """Measure what the command line asks for, with a line for each process that did not converge."""
    from petsc_fs.io.bundled import find_scene
    from petsc_fs.tools import reference

    more_ranks, more = measure.split_ranks(petsc)
    ranks = tuple(dict.fromkeys(args.ranks or more_ranks or [1]))
    rtols = () if args.base and not args.rtol else rtols_of(args.rtol or RTOLS)
    if not args.scenes:
        raise UsageError("name at least one scene; they come before --options")
    cases = [Case.of(path) for path in dict.fromkeys(find_scene(name) for name in args.scenes)]
    variants = _variants(args.options, args.base, cases, more)
    measure.refuse_twice("scenes", [case.label for case in cases])
    if args.out is not None:
        measure.make_folder(args.out)  # once nothing in the call is found wrong any more
    started, complete, records, references = time.time(), True, list[Record](), dict[str, str]()
    by_path = {case.path: case for case in cases}

    def fits(system: str, variant: Variant) -> bool:
        return variant.fits(tuple(by_path[system].sizes), by_path[system].names)

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # batch systems send it when time is up
    try:
        for k, case in enumerate(cases if rtols and args.out is not None else ()):
            if not case.steps:
                say(f"reference solution of {case.label}")
                references[case.path] = os.fspath(args.out / f"reference_{case.label}.npz")
                cases[k] = replace(case, reference=reference.made(case.path, Path(references[case.path])).about())
        how: dict[str, Any] = {"time_limit": args.time_limit, "mpiexec": args.mpiexec, "warm_up": True, "errors": True}
        job = Job(rtols=rtols, references=references, **how)
        for found in measure.measure_all(list(by_path), variants, job, ranks=ranks, repeat=args.repeat, fits=fits):
            records += found
            for r in (r for r in found if r["kind"] != "converged"):
                where = f"{by_path[r['scene']].label}, {r['variant']}, {r['ranks']} rank(s)"
                say(f"{where}: {r['kind']} {r['message'] or r['reason']}")
    except KeyboardInterrupt:
        if not records:
            raise
        complete = False
    finally:
        signal.signal(signal.SIGTERM, before)
    date = time.strftime("%Y-%m-%d %H:%M", time.localtime(started))
    about = {"command": " ".join(["petsc-fs", *sys.argv[1:]]), "date": date, "minutes": (time.time() - started) / 60}
    about |= {"complete": complete, "load average at the end": os.getloadavg()[2], **measure.describe_machine()}
    clock, base = args.clock or "wall", variants[0].label if args.base else ""
    return Comparison(tuple(cases), tuple(variants), ranks, rtols, args.repeat, records, about, clock, base)


def _variants(
    names: Sequence[str] | None, base: str | None, cases: Sequence[Case], more: Mapping[str, str | None]
) -> list[Variant]:
    """Options files by path or name of a shipped one, the base first; those named must be for one of the scenes."""
    words = names or [str(file.path) for file in options.shipped()]
    found = {v.label: v for v in (Variant.of(w, more) for w in ([base, *words] if base else words))}
    for label, v in list(found.items()):
        if not any(v.fits(tuple(c.sizes), c.names) for c in cases):
            if names:
                raise UsageError(f"{v.path} is for none of the scenes, by its header")
            del found[label]
    return list(found.values())


def _print(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """A table for a terminal of 80 columns; headings, and cells where it is needed, are broken between words.

    The parts of a long name, as contact_poromechanics_fast, are words.
    """
    cells = [
        [re.sub(r"\w{16,}", lambda name: name[0].replace("_", "_ "), str(c)) for c in row] for row in (headings, *rows)
    ]
    columns = list(zip(*cells, strict=True))
    words = [max(map(len, " ".join(column).split())) for column in columns]
    widths = [max(word, *map(len, column[1:])) for word, column in zip(words, columns, strict=True)]
    gap = "  " if sum(widths) + 2 * len(widths) <= 82 else " "
    while sum(widths) + len(widths) > 81 and widths != words:
        widths[max(range(len(widths)), key=lambda k: (widths[k] > words[k], widths[k]))] -= 1
    for row in cells:
        parts = (textwrap.wrap(cell, width) for cell, width in zip(row, widths, strict=True))
        for line in itertools.zip_longest(*parts, fillvalue=""):
            padded = (part.replace("_ ", "_").ljust(width) for part, width in zip(line, widths, strict=True))
            print(gap.join(padded).rstrip())
