"""Compare options files: error against seconds, on any scenes, with any tolerances and numbers of ranks.

Each combination of scene, options file and number of ranks is measured in processes of its own, all of them once
before any is measured again and each time in another order, so that noise falls on all alike. The reference solution
of each scene is computed first, in a process of its own, see `petsc_fs.tools.reference`.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io.files import write_text
from petsc_fs.tools.measure import Job, Record, environment, measure

if TYPE_CHECKING:
    from mpi4py import MPI

RTOLS = "1e-2..1e-12"
TARGETS = tuple(10.0**-k for k in range(1, 13))
"""Accuracies for which the summary names the fastest file."""

ENDED = ("converged", "stagnated")
"""Kinds of records whose solution is one to be judged by its error."""

CLOCKS = {"wall": "wall clock", "cpu": "processor time"}
"""What seconds can be, and what axes call them. Processor time, the busiest rank's, is steadier where other programs
run, but hides what waits for others."""

PARDISO = "mkl_pardiso"


@dataclass(frozen=True)
class Entry:
    """One thing to compare: an options file, perhaps with further options.

    Attributes:
        label: what pictures call it.
        path: of the file.
        options: without the dash, which win over the file.
        fields: that a scene must have; empty if any will do.
        not_for: models it is known to fail on.
        purpose: first line of the file.
        text: the file, verbatim.
    """

    label: str
    path: str
    options: dict[str, str | None]
    fields: tuple[str, ...]
    not_for: tuple[str, ...]
    purpose: str
    text: str

    @classmethod
    def of(cls, path: Path, more: Mapping[str, str | None] | None = None, suffix: str = "") -> Entry:
        """Read the header of a file.

        Raises:
            UsageError: PETSc would not understand the file.
        """
        options.parse(path)
        header = options.read_header(path)
        return cls(
            label=path.stem + suffix,
            path=str(path),
            options=dict(more or {}),
            fields=header.fields,
            not_for=header.not_for,
            purpose=header.purpose,
            text=path.read_text(encoding="utf-8"),
        )

    def applies(self, case: Case) -> bool:
        """Whether the file is for a scene, by its header."""
        known = {case.label, *re.findall(r"\w+", case.model)[:1]}
        return (not self.fields or set(self.fields) == set(case.sizes)) and not known & set(self.not_for)


@dataclass(frozen=True)
class Case:
    """A scene to compare on.

    Attributes:
        label: what pictures call it: the name of the file.
        path: of the file.
        dimension: of the rock matrix.
        sizes: unknowns of each field.
        model: where the scene comes from.
        reference: what is known of the accuracy of the reference, see `petsc_fs.tools.reference.Reference.about`.
    """

    label: str
    path: str
    dimension: int
    sizes: dict[str, int]
    model: str
    reference: dict[str, Any] = field(default_factory=dict)

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return sum(self.sizes.values())


@dataclass(frozen=True)
class Comparison:
    """All that was measured, and what with.

    Attributes:
        cases: scenes.
        entries: options files.
        ranks: numbers of ranks.
        rtols: tolerances, from the loosest.
        repeat: rounds.
        records: see `petsc_fs.tools.measure`, with `scene` and `file` as labels, and `ranks` and `round`.
        given_up: combinations that were not measured again after they had reached the time limit.
        about: machine, versions and date.
        clock: what seconds are, one of `CLOCKS`.
    """

    cases: tuple[Case, ...]
    entries: tuple[Entry, ...]
    ranks: tuple[int, ...]
    rtols: tuple[float, ...]
    repeat: int
    records: list[Record]
    given_up: list[dict[str, Any]]
    about: dict[str, Any]
    clock: str = "wall"

    @property
    def command(self) -> str:
        """The command line that measures the same, but for folders."""
        files = dict.fromkeys(Path(entry.path).name for entry in self.entries)
        words = ["petsc-fs compare", *(Path(case.path).name for case in self.cases), "--options", *files]
        words += ["--rtol", rtol_words(self.rtols), "--ranks", *map(str, self.ranks)]
        words += ["--repeat", str(self.repeat), "--clock", self.clock]
        common = [set(entry.options.items()) for entry in self.entries]
        more = sorted(set.intersection(*common)) if common else []
        return " ".join([*words, *(f"-{name} {value or ''}".rstrip() for name, value in more)])

    def to_json(self) -> str:
        """Everything, for `from_json`."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Comparison:
        """Read what `to_json` wrote."""
        data = json.loads(text)
        for case in data["cases"]:
            case["reference"] = dict(case["reference"])
        return cls(
            cases=tuple(Case(**case) for case in data.pop("cases")),
            entries=tuple(
                Entry(**(e | {"fields": tuple(e["fields"]), "not_for": tuple(e["not_for"])}))
                for e in data.pop("entries")
            ),
            ranks=tuple(data.pop("ranks")),
            rtols=tuple(data.pop("rtols")),
            **data,
        )


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


@dataclass(frozen=True)
class Point:
    """What one file did with one tolerance on one scene and number of ranks, over all rounds.

    Attributes:
        scene, file, ranks, rtol: what was measured.
        ended: whether every round came to a solution.
        converged: whether every round met the tolerance.
        iterations: median.
        error: forward error, median.
        residual: true residual, median.
        read, setup, solve: seconds.
        total: seconds of set-up and solve.
        direct: whether the file is a factorisation of the whole matrix.
    """

    scene: str
    file: str
    ranks: int
    rtol: float
    ended: bool
    converged: bool
    iterations: float
    error: float
    residual: float
    read: Spread
    setup: Spread
    solve: Spread
    total: Spread
    direct: bool


def seconds_of(record: Record, clock: str) -> dict[str, float]:
    """Seconds of each phase, "read", "setup" and "solve"."""
    if clock == "cpu":
        return dict(record["cpu_by_phase"])
    return {phase: record[f"{phase}_seconds"] for phase in ("read", "setup", "solve")}


def points(records: Sequence[Record], clock: str = "wall") -> list[Point]:
    """Medians and quartiles over rounds of all that came to a solution in any of them."""
    groups: dict[tuple[str, str, int, float], list[Record]] = {}
    for record in records:
        if record["rtol"] is not None:
            key = (record["scene"], record["file"], record["ranks"], record["rtol"])
            groups.setdefault(key, []).append(record)
    found = []
    for (scene, file, ranks, rtol), runs in groups.items():
        good = [r for r in runs if r["kind"] in ENDED and r["forward_error"] is not None]
        if not good:
            continue
        seconds = [seconds_of(r, clock) for r in good]
        found.append(
            Point(
                scene=scene,
                file=file,
                ranks=ranks,
                rtol=rtol,
                ended=len(good) == len(runs),
                converged=all(r["kind"] == "converged" for r in runs),
                iterations=float(np.median([r["iterations"] for r in good])),
                error=float(np.median([r["forward_error"] for r in good])),
                residual=float(np.median([r["true_residual"] for r in good])),
                **{phase: Spread.of([s[phase] for s in seconds]) for phase in ("read", "setup", "solve")},
                total=Spread.of([s["setup"] + s["solve"] for s in seconds]),
                direct=bool(good[0]["direct"]),
            )
        )
    return found


@dataclass(frozen=True)
class Fastest:
    """The fastest file for an accuracy.

    Attributes:
        file: its label.
        seconds: median of its fastest point whose error is not above the accuracy.
        ties: other files whose quartiles overlap with its own, from the fastest.
    """

    file: str
    seconds: float
    ties: tuple[str, ...]


def fastest(found: Sequence[Point], accuracy: float, seconds: Callable[[Point], Spread]) -> Fastest | None:
    """The fastest file whose forward error is at most `accuracy`, or None if no file gets there.

    Args:
        found: points of one scene and number of ranks; those that did not end in every round do not count.
        accuracy: forward error.
        seconds: what counts, for example `lambda p: p.total`.
    """
    best: dict[str, Spread] = {}
    for point in found:
        if point.ended and point.error <= accuracy:
            spread = seconds(point)
            if point.file not in best or spread.median < best[point.file].median:
                best[point.file] = spread
    order = sorted(best.items(), key=lambda item: item[1].median)
    if not order:
        return None
    (file, first), *others = order
    return Fastest(file, first.median, tuple(label for label, spread in others if spread.low <= first.high))


SECONDS: dict[str, Callable[[Point], Spread]] = {
    "set-up and solve": lambda point: point.total,
    "solve alone": lambda point: point.solve,
}
"""The two ways to count: for a system that is solved once, and for one that is set up already."""


@dataclass(frozen=True)
class Verdict:
    """Which files are fastest for a range of accuracies, on one scene and number of ranks.

    Attributes:
        scene, ranks: where.
        accuracies: largest and smallest forward error.
        winners: for each of `SECONDS` the fastest file at each accuracy, the same file throughout; None if none
            is so accurate.
    """

    scene: str
    ranks: int
    accuracies: tuple[float, float]
    winners: dict[str, list[Fastest] | None]

    @property
    def label(self) -> str:
        """For example "1e-02 … 1e-04"."""
        return " … ".join(f"{a:.0e}" for a in dict.fromkeys(self.accuracies))


def verdicts(found: Comparison) -> list[Verdict]:
    """Which file is fastest for which accuracy; accuracies of the same winners and ties are one verdict."""
    everything = points(found.records, found.clock)
    rows: list[Verdict] = []
    for case in found.cases:
        for ranks in found.ranks:
            mine = [p for p in everything if (p.scene, p.ranks) == (case.label, ranks)]
            last: Any = None
            for accuracy in decades(mine):
                best = {what: fastest(mine, accuracy, seconds) for what, seconds in SECONDS.items()}
                key = [b and (b.file, b.ties) for b in best.values()]
                if key == last:
                    row = rows.pop()
                    winners = {w: None if b is None else [*(row.winners[w] or []), b] for w, b in best.items()}
                    rows.append(Verdict(case.label, ranks, (row.accuracies[0], accuracy), winners))
                else:
                    first = {w: None if b is None else [b] for w, b in best.items()}
                    rows.append(Verdict(case.label, ranks, (accuracy, accuracy), first))
                last = key
    return rows


def seconds_words(winners: Sequence[Fastest]) -> str:
    """For example "0.12 s", or "0.12–0.2 s" from the loosest accuracy to the strictest."""
    numbers = dict.fromkeys(f"{w.seconds:.2g}" for w in (winners[0], winners[-1]))
    return "–".join(numbers) + " s"


def decades(found: Sequence[Point]) -> list[float]:
    """Accuracies worth a row: those between the largest and the smallest error of any point."""
    errors = [p.error for p in found if p.ended and p.error > 0]
    if not errors:
        return []
    return [t for t in TARGETS if t >= min(errors) and t <= 10 * max(errors)]


def rtols_of(text: str) -> tuple[float, ...]:
    """Tolerances from "1e-2..1e-12" (every decade), "1e-2..1e-12:2" (every second), or "1e-3,1e-6".

    Raises:
        UsageError: it cannot be read, or a tolerance is not between 0 and 1.
    """
    match = re.fullmatch(r"([^.,:]+(?:\.\d+)?(?:e-?\d+)?)\.\.([^:,]+?)(?::(\d+))?", text)
    try:
        if match is not None:
            first, last = float(match[1]), float(match[2])
            step = int(match[3] or 1)
            count = round(abs(np.log10(first / last)) / step)
            found = [float(f"{max(first, last) * 10.0 ** (-step * k):.6g}") for k in range(count + 1)]
        else:
            found = [float(word) for word in text.split(",")]
    except (ValueError, ZeroDivisionError) as e:
        raise UsageError(f"--rtol {text}: expected for example 1e-2..1e-12, 1e-2..1e-12:2 or 1e-3,1e-6") from e
    if not found or not all(0 < r < 1 for r in found):
        raise UsageError(f"--rtol {text}: tolerances must lie between 0 and 1")
    return tuple(sorted(set(found), reverse=True))


def rtol_words(rtols: Sequence[float]) -> str:
    """The shortest text that `rtols_of` turns into these tolerances."""
    for step in ("", ":2", ":3"):
        text = f"{rtols[0]:.0e}..{rtols[-1]:.0e}{step}"
        if rtols_of(text) == tuple(rtols):
            return text
    return ",".join(f"{r:g}" for r in rtols)


def find_cases(names: Sequence[str]) -> list[Case]:
    """Scenes by path or name of a bundled one.

    Raises:
        SceneError: one is missing or no scene.
        UsageError: two have the same name.
    """
    from petsc_fs.io import hdf5
    from petsc_fs.io.bundled import find_scene

    cases = []
    for path in dict.fromkeys(find_scene(name) for name in names):
        dimension, sizes = hdf5.read_sizes(path)
        with hdf5.open_file(path) as file:
            model = str(file.attrs["model"])
        cases.append(Case(path.stem, str(path), dimension, {f: n for f, n in sizes.items() if n}, model))
    labels = [case.label for case in cases]
    for label in labels:
        if labels.count(label) > 1:
            raise UsageError(f"two scenes are called {label}: rename one, as pictures tell them apart by name")
    return cases


def find_entries(names: Sequence[str] | None, cases: Sequence[Case], more: Mapping[str, str | None]) -> list[Entry]:
    """Options files by path or name of a shipped one; by default all shipped ones that are for any of the scenes.

    Where there is a direct solver among them and PETSc has MKL Pardiso, the same with it.

    Raises:
        UsageError: a file is missing or wrong, or two have the same name, or one is for none of the scenes.
    """
    from petsc4py import PETSc

    paths = [options.find_options_file(n) for n in names] if names else [file.path for file in options.shipped()]
    entries = [Entry.of(path, more) for path in dict.fromkeys(paths)]
    entries = [e for e in entries if names or any(e.applies(case) for case in cases)]
    if PETSc.Sys.hasExternalPackage(PARDISO):
        for entry in list(entries):
            if options.parse(Path(entry.path)).get("pc_factor_mat_solver_type") == "mumps":
                pardiso = {**more, "pc_factor_mat_solver_type": PARDISO, options.ALLOW_UNUSED: "mat_mumps_*"}
                entries.append(Entry.of(Path(entry.path), pardiso, " (Pardiso)"))
    labels = [entry.label for entry in entries]
    for entry in entries:
        if labels.count(entry.label) > 1:
            raise UsageError(f"two options files are called {entry.label}: rename one")
        if not any(entry.applies(case) for case in cases):
            raise UsageError(f"{entry.path} is for none of the scenes, by its header")
    return entries


def compute_reference(case: Case, target: Path) -> dict[str, Any]:
    """Make sure that the reference of a scene is there; what is known of it.

    A reference in the file is kept if it is one of the same scene. A factorisation that crashes is followed by the
    iterative method.

    Raises:
        SolveError: there is none.
    """
    from petsc_fs.tools import reference

    if target.exists():
        found = reference.read(target)
        if found.scene_digest == reference.digest(case.path):
            return found.about()
    said = ""
    for method in ("auto", "iterative"):
        command = [sys.executable, "-m", "petsc_fs.tools.reference", case.path, str(target), "--method", method]
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
        if done.returncode == 0:
            return reference.read(target).about()
        said = " ".join(done.stderr.split()[-60:]) or f"exit code {done.returncode}"
    raise SolveError(f"{case.label}: {said}")


def run(
    cases: Sequence[Case],
    entries: Sequence[Entry],
    *,
    ranks: Sequence[int],
    rtols: Sequence[float],
    repeat: int,
    references: Mapping[str, Path],
    time_limit: float = 300.0,
    mpiexec: str | None = None,
    progress: Callable[[dict[str, Any], list[Record]], None] = lambda *_: None,
) -> tuple[list[Record], list[dict[str, Any]], bool]:
    """Measure all combinations, in alternation.

    Args:
        cases: scenes.
        entries: options files; each is measured on the scenes that it is for.
        ranks: numbers of ranks.
        rtols: tolerances.
        repeat: number of rounds.
        references: label of a scene to its reference.
        time_limit: seconds for each step of a process, see `petsc_fs.tools.measure.Job`.
        mpiexec: program that starts ranks.
        progress: called after each process with what was measured and its records.

    Returns:
        Records; the combinations that were given up after a hang; whether all was measured, or Ctrl-C came first.
    """
    records: list[Record] = []
    given_up: list[dict[str, Any]] = []
    try:
        for number, case, n, entry in schedule(cases, entries, ranks, repeat):
            what = {"scene": case.label, "file": entry.label, "ranks": n}
            found: list[Record] = []
            if what not in given_up:
                job = Job(
                    scenes=[case.path],
                    options_file=entry.path,
                    options=entry.options,
                    ranks=n,
                    rtols=rtols,
                    warm_up=True,
                    errors=True,
                    references={case.path: references[case.label]},
                    history=number == 0,
                    time_limit=time_limit,
                )
                found = [r | what | {"round": number} for r in measure(job, mpiexec=mpiexec)]
            if any(r["kind"] == "hang" for r in found):
                given_up.append(what)
            records += found
            progress(what, found)
    except KeyboardInterrupt:
        if not records:
            raise
        return records, given_up, False
    return records, given_up, True


def schedule(
    cases: Sequence[Case], entries: Sequence[Entry], ranks: Sequence[int], repeat: int
) -> Iterator[tuple[int, Case, int, Entry]]:
    """Rounds of all combinations that fit; files take turns at going first."""
    for number in range(repeat):
        for case in cases:
            for n in ranks:
                fitting = [entry for entry in entries if entry.applies(case)]
                shift = number % max(len(fitting), 1)
                for entry in fitting[shift:] + fitting[:shift]:
                    yield number, case, n, entry


def describe_machine() -> dict[str, str]:
    """Processor, cores, memory and system that measurements were made on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = re.findall(r"^model name\s*: (.*)$", cpuinfo.read_text(encoding="utf-8"), flags=re.MULTILINE)
        model = names[0] if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": f"{model}, {cores} core{'s' if cores > 1 else ''}",
        "memory": f"{memory:.0f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "threads per rank": environment()["OMP_NUM_THREADS"],
    }


def to_csv(records: Sequence[Record]) -> str:
    """One line for each record; fields and ranks in columns of their own."""
    rows = []
    for record in records:
        row = {k: v for k, v in record.items() if not isinstance(v, dict | list) and k != "repetition"}
        for name in ("residual_by_field", "error_by_field", "backward_error"):
            for key, value in (record[name] or {}).items():
                row[f"{name.removesuffix('_by_field')}_{key}"] = value
        for name in ("peak_rss", "base_rss"):
            row[f"{name}_max"] = max(record[name]) if record[name] else None
        rows.append(row)
    first = ["scene", "ranks", "file", "round", "rtol", "kind", "iterations"]
    columns = first + sorted({key for row in rows for key in row} - set(first))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


EPILOG = """\
Scenes come first. Each combination of scene, options file and number of ranks runs in processes of its own; one that
crashes, hangs or diverges is shown as such. Ctrl-C ends measuring; what was measured is drawn. --out gets
compare.html, which needs no other file and no network, compare.json and compare.csv with all numbers, and the pictures
as PNG and SVG. Reference solutions are kept in --out and used again. Single-dash options are PETSc's and go to every
run (-n RANKS is the exception).

  petsc-fs compare model1.h5 model2.h5 --repeat 3 --out comparison
  petsc-fs compare mine.h5 --options direct.opts mine.opts --rtol 1e-2..1e-10:2 -n 1 2 --out comparison
  petsc-fs compare --again comparison/compare.json --out comparison     # pictures and page only

exit codes: 0 everything was measured, whatever the outcomes; 1 no reference solution; 2 wrong call; 3 no such scene"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs compare`."""
    parser.epilog = EPILOG
    parser.add_argument("scenes", metavar="SCENE", nargs="*", help="file, or name of a bundled scene")
    parser.add_argument(
        "--options", nargs="+", metavar="FILE", help="options files; default all shipped ones that fit a scene"
    )
    parser.add_argument(
        "--rtol",
        default=RTOLS,
        metavar="A..B",
        help="tolerances, every decade; or a list with commas; default %(default)s",
    )
    parser.add_argument("--ranks", type=int, nargs="+", default=None, metavar="N", help="numbers of ranks; default 1")
    parser.add_argument("--repeat", type=int, default=5, metavar="N", help="rounds, default %(default)s")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write, made if missing")
    parser.add_argument(
        "--time-limit",
        type=float,
        default=300.0,
        metavar="S",
        help="seconds for a set-up or solve, default %(default)g",
    )
    parser.add_argument(
        "--clock", choices=CLOCKS, help="what seconds are; cpu: processor time, for a machine where others compute"
    )
    parser.add_argument("--mpiexec", metavar="PROGRAM", help="that starts ranks; default MPIEXEC or the one on PATH")
    parser.add_argument("--again", type=Path, metavar="FILE.json", help="draw from an earlier comparison instead")


def split_petsc(petsc: Sequence[str]) -> tuple[list[int], dict[str, str | None]]:
    """Numbers of ranks from `-n`, and PETSc's options by name.

    Raises:
        UsageError: -n has no number.
    """
    groups: list[list[str]] = []
    for word in petsc:
        if re.match(r"-[A-Za-z_]", word):
            groups.append([word[1:]])
        else:
            groups[-1].append(word)
    ranks: list[int] = []
    found: dict[str, str | None] = {}
    for name, *values in groups:
        if name in ("n", "np"):
            if not values or not all(v.isdecimal() for v in values):
                raise UsageError(f"-{name}: expected numbers of ranks")
            ranks = [int(v) for v in values]
        else:
            found[name] = " ".join(values) or None
    return ranks, found


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs compare`."""
    if comm.size > 1:
        raise UsageError("compare starts mpiexec itself: call it without, and give it -n RANKS")
    out: Path = args.out
    from petsc_fs.tools import compare_plots
    from petsc_fs.tools.plots import pyplot

    pyplot()  # or an error, before anything is measured
    if args.again is not None:
        try:
            found = Comparison.from_json(args.again.read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError, KeyError) as e:
            raise UsageError(f"--again {args.again}: not a comparison: {e}") from e
        _make_folder(out)
    else:
        found = _measure_all(args, petsc)
    from petsc_fs.tools.compare_page import page, terminal_summary

    if args.clock is not None:
        found = replace(found, clock=args.clock)

    pictures = compare_plots.draw(found, out)
    write_text(out / "compare.csv", to_csv(found.records))
    write_text(out / "compare.json", found.to_json())
    write_text(out / "compare.html", page(found, pictures))
    print(terminal_summary(found))
    print(f"written: {out / 'compare.html'}, with compare.csv, compare.json and {len(pictures)} pictures beside it")
    return 0


def _make_folder(folder: Path) -> None:
    """Make the folder of --out, once nothing in the call is found wrong any more."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise UsageError(f"--out {folder}: cannot be made: {e.strerror}") from e


@contextmanager
def _interruptible() -> Iterator[None]:
    """Let SIGTERM, which batch systems send when time is up, do what Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _measure_all(args: argparse.Namespace, petsc: list[str]) -> Comparison:
    """Measure what the command line asks for, with live progress."""
    from petsc_fs.io.bundled import versions
    from petsc_fs.tools.compare_page import Progress

    more_ranks, more = split_petsc(petsc)
    ranks = tuple(dict.fromkeys(args.ranks or more_ranks or [1]))
    rtols = rtols_of(args.rtol)
    if not args.scenes:
        raise UsageError("name at least one scene; they come before --options")
    if min(ranks) < 1 or args.repeat < 1 or args.time_limit <= 0:
        raise UsageError("--ranks, --repeat and --time-limit must be positive")
    cases = find_cases(args.scenes)
    entries = find_entries(args.options, cases, more)
    _make_folder(args.out)
    total = sum(1 for _ in schedule(cases, entries, ranks, args.repeat))
    started = time.time()
    with Progress(total) as progress, _interruptible():
        references = {}
        for k, case in enumerate(cases):
            references[case.label] = args.out / f"reference_{case.label}.npz"
            progress.say(f"reference solution of {case.label}")
            cases[k] = replace(case, reference=compute_reference(case, references[case.label]))
        records, given_up, complete = run(
            cases,
            entries,
            ranks=ranks,
            rtols=rtols,
            repeat=args.repeat,
            references=references,
            time_limit=args.time_limit,
            mpiexec=args.mpiexec,
            progress=progress.update,
        )
    about = {
        "date": time.strftime("%Y-%m-%d %H:%M", time.localtime(started)),
        "seconds": time.time() - started,
        "complete": complete,
        "load": os.getloadavg()[2],
        "time_limit": args.time_limit,
        "machine": describe_machine(),
        "versions": versions(),
    }
    return Comparison(tuple(cases), tuple(entries), ranks, rtols, args.repeat, records, given_up, about)
