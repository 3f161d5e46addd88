"""Benchmark of options files on scenes and sequences, each as a ratio to one file that takes turns with the others.

For every input and number of ranks one process reads it once; then all files solve it in turns, each time in another
order, after a warm-up that is not counted. So noise falls on all alike, and ratios say more than seconds.
`petsc_fs.bench_probe` is that process. Its events are records: dictionaries with

    kind               "solved", "warm-up", "failed" (with a `message`), "machine" or "input"
    file, round        which options file, and which turn, from 0
    iterations         of the Krylov method; of all steps of a sequence together
    solves             1, or the number of steps
    converged          whether the true residual met the tolerance, in all steps
    true_residual      |b - J x| / |b|, the largest
    wall, cpu          {"setup": ..., "solve": ...}: seconds by the clock, and of the processor, the busiest rank's
    peak_bytes         list, per rank: what memory grew by at most, above what was held before the solve
    hierarchies        on warm-ups: see `petsc_fs.bench_probe.read_hierarchies`
    restart            on warm-ups: of GMRES
    python_share       on warm-ups: part of the time spent outside of compiled functions of PETSc, MPI and HDF5
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs import options
from petsc_fs.bench_probe import entry
from petsc_fs.compare import describe_machine
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.fields import MECHANICS
from petsc_fs.measure import environment, launcher

Record = dict[str, Any]
CLOCKS = ("wall", "cpu")

DEFAULT_BASE = "contact_poromechanics.opts -petsc_fs_ordering natural"
"""Options file that others are compared to: the published configuration, with cells in the order of the scene."""

TWICE = {6, 8, 16}
"""hypre's smoothers that go through the matrix twice: symmetric Gauss-Seidel, the same with l1 scaling, and Chebyshev
polynomials of second order."""

ENTRY = 12
"""Bytes of an entry of a sparse matrix: value and column number."""

ROW = 28
"""Bytes of a row in a product: its start, reading and writing a vector and reading another."""

NUMBER = 8


@dataclass(frozen=True)
class Settings:
    """What is the same for all that is measured.

    Attributes:
        files: options files, the first of which is what the others are compared to; each may be followed by further
            options: "FILE -option value ...".
        repeat: turns that count.
        clock: what seconds are: "wall" or "cpu".
        limit: seconds that one process may take.
        options: further PETSc options without the dash, which win over the files.
    """

    files: tuple[str, ...]
    repeat: int = 3
    clock: str = "wall"
    limit: float = 3600.0
    options: Mapping[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """One file on one input and number of ranks: medians over its turns, and ratios to the first file.

    Attributes:
        input: name of the scene or sequence.
        dimension: of the rock.
        unknowns: of the system; of a sequence, of its first step.
        solves: linear systems solved.
        ranks: number of them.
        file: name of the options file, see `label`.
        outcome: "" or what went wrong.
        converged: whether all solves met their tolerance.
        iterations: of all solves.
        setup, solve, total: seconds.
        setup_ratio, solve_ratio, ratio: of these, to those of the first file in the same turn; medians.
        lowest, highest: of the turns' ratios of the total.
        peak: bytes that all ranks' memory grew by.
        complexity: entries of all levels over those of the block of mechanics.
        mass_complexity: the same of the block of mass.
        traffic: bytes touched per iteration, estimated; see `traffic`.
        bandwidth: bytes per second that this makes.
        stream: bytes per second of STREAM's triad, on as many ranks.
        python_share: see the head of this module.
    """

    input: str
    dimension: int
    unknowns: int
    solves: int
    ranks: int
    file: str
    outcome: str = ""
    converged: bool = False
    iterations: int = 0
    setup: float = float("nan")
    solve: float = float("nan")
    total: float = float("nan")
    setup_ratio: float = float("nan")
    solve_ratio: float = float("nan")
    ratio: float = float("nan")
    lowest: float = float("nan")
    highest: float = float("nan")
    peak: int = 0
    complexity: float = float("nan")
    mass_complexity: float = float("nan")
    traffic: float = float("nan")
    bandwidth: float = float("nan")
    stream: float = float("nan")
    python_share: float = float("nan")


@dataclass(frozen=True)
class Benchmark:
    """All that was measured, and what with.

    Attributes:
        rows: by input, ranks and file.
        settings: see there.
        about: machine, versions and date.
    """

    rows: tuple[Row, ...]
    settings: Settings
    about: dict[str, Any]

    def to_json(self) -> str:
        """Everything, for `from_json`."""
        return json.dumps(asdict(self), indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Benchmark:
        """Read what `to_json` wrote."""
        data = json.loads(text)
        settings = data["settings"] | {"files": tuple(data["settings"]["files"])}
        return cls(tuple(Row(**row) for row in data["rows"]), Settings(**settings), data["about"])


def run(inputs: Sequence[Path], ranks: Sequence[int], settings: Settings, progress: Callable[[str], None]) -> Benchmark:
    """Measure all files on all inputs and numbers of ranks.

    Args:
        inputs: scenes and sequences.
        ranks: numbers of ranks.
        settings: what to measure.
        progress: called with a line for each row.

    Raises:
        UsageError: an options file is missing.
        SolveError: the first file gave no result anywhere.
    """
    names = [label(file) for file in settings.files]
    for file in settings.files:
        options.find_options_file(entry(file)[0])
    if len(set(names)) != len(names):
        raise UsageError(f"the options files have to have different names: {', '.join(names)}")
    rows: list[Row] = []
    for path in inputs:
        for n in ranks:
            found = rows_of(path.stem, n, measure(path, n, settings), settings)
            for row in found:
                progress(describe(row))
            rows += found
    if not any(row.total == row.total for row in rows):
        raise SolveError(f"nothing was solved; the first reason: {rows[0].outcome}" if rows else "nothing to measure")
    return Benchmark(tuple(rows), settings, describe_machine())


def measure(path: Path, ranks: int, settings: Settings) -> list[Record]:
    """Records of one input, from a process of its own; what ends that process early is the last of them."""
    with tempfile.TemporaryDirectory() as folder:
        job, events = Path(folder) / "job.json", Path(folder) / "events"
        wanted = {"input": str(path), "files": list(settings.files), "repeat": settings.repeat}
        job.write_text(json.dumps(wanted | {"options": dict(settings.options)}), encoding="utf-8")
        command = [*launcher(ranks), sys.executable, "-m", "petsc_fs.bench_probe", str(job), str(events)]
        process = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
            start_new_session=True,  # so that the ranks end with mpiexec
        )
        try:
            said = process.communicate(timeout=settings.limit)[1]
            ended = f"exit code {process.returncode}"
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            said, ended = "", f"ended after {settings.limit:g} s"
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        records = []
        if events.exists():
            records = [json.loads(line) for line in events.read_text(encoding="utf-8").splitlines()]
    if not records or records[-1]["kind"] != "done":
        lines = [line.strip() for line in said.splitlines() if "Error" in line]
        last = records[-1] if records else {}
        records.append({"kind": "failed", "file": last.get("file"), "message": lines[-1] if lines else ended})
    return records


def rows_of(name: str, ranks: int, records: Sequence[Record], settings: Settings) -> list[Row]:
    """A row for each file, from the records of one input.

    Args:
        name: of the input.
        ranks: number of them.
        records: from `measure`.
        settings: what was measured.
    """
    nothing: Record = {"dimension": 0, "sizes": {}, "steps": 0}
    about = next((r for r in records if r["kind"] == "input"), nothing)
    stream = next((r["bandwidth"] for r in records if r["kind"] == "machine"), float("nan"))
    turns = {(r["file"], r["round"]): r for r in records if r["kind"] == "solved"}
    base = settings.files[0]
    rows = []
    for file in settings.files:
        same = (name, about["dimension"], sum(about["sizes"].values()), max(about["steps"], 1), ranks)
        failed = next((r for r in records if r["kind"] == "failed" and r.get("file") in (file, None)), None)
        mine = [r for (f, _), r in turns.items() if f == file]
        if failed is not None or not mine:
            message = failed["message"] if failed is not None else "not reached"
            rows.append(Row(*same, label(file), outcome=message))
            continue
        pairs = [
            (r[settings.clock], turns[base, r["round"]][settings.clock]) for r in mine if (base, r["round"]) in turns
        ]
        ratios = [_sum(a) / _sum(b) for a, b in pairs]
        warm_up = next(r for r in records if r["kind"] == "warm-up" and r["file"] == file)
        solve = _median([r[settings.clock]["solve"] for r in mine])
        iterations = int(_median([r["iterations"] for r in mine]))
        complexities = operator_complexities(warm_up["hierarchies"], about["sizes"])
        touched = float("nan")
        if about["steps"] == 0:
            touched = traffic(about, warm_up["hierarchies"], iterations, warm_up["restart"])
        rows.append(
            Row(
                *same,
                label(file),
                converged=all(r["converged"] for r in mine),
                iterations=iterations,
                setup=_median([r[settings.clock]["setup"] for r in mine]),
                solve=solve,
                total=_median([_sum(r[settings.clock]) for r in mine]),
                setup_ratio=_median([a["setup"] / b["setup"] for a, b in pairs]),
                solve_ratio=_median([a["solve"] / b["solve"] for a, b in pairs]),
                ratio=_median(ratios),
                lowest=min(ratios, default=float("nan")),
                highest=max(ratios, default=float("nan")),
                peak=int(_median([sum(r["peak_bytes"]) for r in mine])),
                complexity=complexities.get("mechanics", float("nan")),
                mass_complexity=complexities.get("mass", float("nan")),
                traffic=touched,
                bandwidth=touched * iterations / solve,
                stream=stream,
                python_share=warm_up["python_share"],
            )
        )
    return rows


def label(file: str) -> str:
    """What tables call an options file, with the last part of the names of further options."""
    name, more = entry(file)
    parts = [
        f"{'mass ' if '_mass_' in k else ''}{re.split('boomeramg_|component_|petsc_fs_', k)[-1]} {v or ''}".strip()
        for k, v in more.items()
    ]
    return ", ".join([Path(name).name.removesuffix(".opts"), *parts])


def _sum(seconds: Mapping[str, float]) -> float:
    return seconds["setup"] + seconds["solve"]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def operator_complexities(hierarchies: Sequence[Record], sizes: Mapping[str, int]) -> dict[str, float]:
    """Entries of all levels over those of the finest, of the multigrids of mechanics and of mass.

    Several hierarchies of one block, as where its components have one each, count together. The last one with as many
    rows as there are pressures is that of mass: without fractures components of displacement have as many.
    """
    finest: dict[str, int] = {}
    entries: dict[str, int] = {}
    known = [hierarchy for hierarchy in hierarchies if hierarchy["levels"]]
    mass = max((k for k, h in enumerate(known) if h["levels"][0][0] == sizes.get("mass")), default=None)
    for k, hierarchy in enumerate(known):
        block = "mass" if k == mass else "mechanics"
        finest[block] = finest.get(block, 0) + hierarchy["levels"][0][1]
        entries[block] = entries.get(block, 0) + sum(n for _, n in hierarchy["levels"])
    return {block: entries[block] / finest[block] for block in finest}


def traffic(about: Record, hierarchies: Sequence[Record], iterations: int, restart: int) -> float:
    """Bytes that one iteration moves between memory and processor, if no cache holds a matrix: an estimate.

    Counted are the product with J; the products with off-diagonal blocks of the upper triangular factors, each once;
    for each level of each multigrid its operator in each smoothing step, in the residual, and its interpolation twice;
    the small blocks of contact and interface flow twice; and what GMRES reads to make a vector orthogonal to those
    before it. An entry of a matrix has 12 bytes, a row 28 of vectors.

    Args:
        about: `sizes` and `entries` of the scene.
        hierarchies: see `petsc_fs.bench_probe.read_hierarchies`.
        iterations: of the Krylov method.
        restart: of GMRES.
    """
    entries = {tuple(k.split()): n for k, n in about["entries"].items()}
    unknowns = sum(about["sizes"].values())
    level_of = {"contact": 0, **dict.fromkeys(MECHANICS, 1), "intf_flow": 2, "mass": 3}
    moved = ENTRY * sum(entries.values()) + ROW * unknowns
    moved += ENTRY * sum(n for (r, c), n in entries.items() if level_of[r] < level_of[c])
    moved += 2 * ENTRY * sum(entries.get((f, f), 0) for f in ("contact", "intf_flow"))
    for hierarchy in hierarchies:
        levels = hierarchy["levels"]
        passes = 1 + sum(
            n * (2 if kind in TWICE else 1)
            for n, kind in zip(hierarchy["sweeps"], hierarchy["relaxation"], strict=True)
        )
        moved += passes * sum(ENTRY * n + ROW * rows for rows, n in levels)
        if levels and hierarchy["memory"]:
            interpolation = hierarchy["memory"] * levels[0][1] - sum(n for _, n in levels)
            moved += 2 * ENTRY * max(interpolation, 0)
    basis = np.mean([k % restart + 1 for k in range(max(iterations, 1))])
    return float(moved + 2 * basis * NUMBER * unknowns)


def describe(row: Row) -> str:
    """A row in one line."""
    where = f"{row.input}, {row.ranks} rank{'s' if row.ranks > 1 else ''}, {row.file}"
    if row.outcome:
        return f"{where}: {row.outcome}"
    return f"{where}: {row.iterations} iterations, {row.setup:.3g} + {row.solve:.3g} s, ratio {row.ratio:.2f}"
