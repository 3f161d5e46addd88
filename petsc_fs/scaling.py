"""Strong scaling: one scene on more and more ranks, each run in a process of its own, counted and timed.

Seconds and memory come from the report of `petsc-fs solve`, messages and reductions from PETSc's log
(`-log_view :FILE:ascii_csv`), which lists every event on every rank. What hypre sends within its multigrid
cycles goes past PETSc's log; `petsc_fs.scaling_model` has a formula for it.
"""

from __future__ import annotations

import csv
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any

from petsc_fs.errors import UsageError
from petsc_fs.files import complete

Progress = Callable[[str], None]

Event = dict[str, list[float]]
"""One event of PETSc's log: name of a column to its value on each rank."""

COLUMNS = ("Count", "Time", "Num Messages", "Message Length", "Num Reductions", "FLOP")

LEVEL = re.compile(r"^\s*\d+\s+(\d+)\s+(\d+)\s+[\d.]+\s+\d+\s+\d+\s+[\d.]+(?:\s+\S+){2}\s*$")
"""A line of hypre's table of operators: level, rows, entries, density, entries per row, row sums."""


@dataclass(frozen=True)
class Case:
    """What is run.

    Attributes:
        scene: path, or name of a bundled scene.
        options_file: path or name; empty for the smallest solver of the scene.
        ranks: number of them.
        partition: value of -petsc_fs_partition; empty for its default.
    """

    scene: str
    options_file: str
    ranks: int
    partition: str = ""

    def __str__(self) -> str:
        """In one line."""
        parts = [Path(self.scene).name, Path(self.options_file).stem, self.partition]
        return " ".join(p for p in parts if p) + f", {self.ranks} rank{'s' if self.ranks > 1 else ''}"


@dataclass(frozen=True)
class Run:
    """What one run of a case did; one row of the table.

    Attributes:
        scene: name of the file.
        options_file: see `Case`.
        partition: see `Case`.
        ranks: see `Case`.
        repetition: from 0.
        outcome: "ok", or in one line why there are no numbers.
        dimension: of the rock.
        unknowns: of the system.
        small_unknowns: of the fields that live on fractures and their walls.
        iterations: of the Krylov method.
        converged: whether the true residual meets the tolerance.
        read_seconds: reading the scene.
        setup_seconds: building PETSc's matrices and the preconditioner.
        solve_seconds: the Krylov method.
        peak_bytes: sum over ranks of the greatest resident memory.
        own_bytes: the same, less what interpreter and libraries take.
        rank_bytes: greatest resident memory of a rank.
        messages: sent in the solve by all ranks, as PETSc's log counts them.
        message_bytes: their length.
        reductions: in the solve, on each rank.
        krylov_reductions: of these, for dot products and norms.
        exchanges: in the solve, scatters of vectors that all ranks take part in.
        krylov_seconds: in the solve, making vectors orthogonal.
        preconditioner_seconds: in the solve, the whole preconditioner.
        mechanics_seconds: of this, the solves with the first field of each level: contact and
            interface flow, which are cheap, and mechanics.
        processor_share: of the whole run, processor seconds over seconds times ranks; less than one where
            the machine had other work, or too few cores.
    """

    scene: str
    options_file: str
    partition: str
    ranks: int
    repetition: int
    outcome: str = "ok"
    dimension: int = 0
    unknowns: int = 0
    small_unknowns: int = 0
    iterations: int = 0
    converged: bool = False
    read_seconds: float = 0.0
    setup_seconds: float = 0.0
    solve_seconds: float = 0.0
    peak_bytes: int = 0
    own_bytes: int = 0
    rank_bytes: int = 0
    messages: int = 0
    message_bytes: int = 0
    reductions: int = 0
    krylov_reductions: int = 0
    exchanges: int = 0
    krylov_seconds: float = 0.0
    preconditioner_seconds: float = 0.0
    mechanics_seconds: float = 0.0
    processor_share: float = 0.0

    @property
    def bytes_per_unknown(self) -> float:
        """Memory of matrix and solver over the number of unknowns."""
        return self.own_bytes / (self.unknowns or 1)


@dataclass(frozen=True)
class Settings:
    """How cases are run.

    Attributes:
        mpiexec: program that starts ranks with `-n`.
        limit: seconds after which a run is ended.
        petsc: further PETSc options.
    """

    mpiexec: Path
    limit: float = 600.0
    petsc: tuple[str, ...] = field(default=())


def cases(
    scenes: Iterable[str], options_files: Iterable[str], ranks: Iterable[int], partitions: Iterable[str] = ("",)
) -> list[Case]:
    """All combinations; on one rank there is nothing to partition, so that it comes once."""
    partitions = list(partitions)
    return [
        Case(scene, file, n, kind if n > 1 else "")
        for scene, file, n in product(scenes, options_files, ranks)
        for kind in (partitions if n > 1 else partitions[:1])
    ]


def measure(chosen: Sequence[Case], settings: Settings, repetitions: int, progress: Progress) -> list[Run]:
    """Run all cases, then all again, so that a slow minute of the machine does not hit one case alone.

    Args:
        chosen: see `cases`.
        settings: how they are run.
        repetitions: of each case.
        progress: called with a line for each run.

    Returns:
        One run per case and repetition, with those that failed or took too long.
    """
    runs = []
    for repetition in range(repetitions):
        for case in chosen:
            runs.append(run(case, settings, repetition))
            progress(f"[{len(runs)}/{repetitions * len(chosen)}] {case}: {describe(runs[-1])}")
    return runs


def describe(run: Run) -> str:
    """One line on a run."""
    if run.outcome != "ok":
        return run.outcome
    return (
        f"{run.iterations} iterations, set-up {run.setup_seconds:.2f} s, solve {run.solve_seconds:.2f} s, "
        f"{run.bytes_per_unknown:,.0f} bytes per unknown"
    )


def run(case: Case, settings: Settings, repetition: int = 0) -> Run:
    """Run a case in processes of its own."""
    same = (Path(case.scene).name, case.options_file, case.partition, case.ranks, repetition)
    with tempfile.TemporaryDirectory() as folder:
        report, log = Path(folder) / "report.json", Path(folder) / "log.csv"
        extra = ["--report", str(report), "-log_view", f":{log}:ascii_csv"]
        started, before = time.perf_counter(), _processor_seconds()
        outcome, _ = solve(case, settings, extra)
        if outcome:
            return Run(*same, outcome=outcome)
        share = (_processor_seconds() - before) / (time.perf_counter() - started) / case.ranks
        measured = numbers(json.loads(report.read_text(encoding="utf-8")), read_events(log))
        return Run(*same, **measured, processor_share=share)


def _processor_seconds() -> float:
    """What ended processes below this one have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def solve(case: Case, settings: Settings, extra: Sequence[str]) -> tuple[str, str]:
    """Call `petsc-fs solve` on a case; why it gave no result ("" if it did), and what it printed.

    A solve that misses its tolerance is a result.
    """
    command = [str(settings.mpiexec), "-n", str(case.ranks), sys.executable, "-m", "petsc_fs", "solve", case.scene]
    command += ["-options_file", case.options_file] if case.options_file else []
    command += ["-petsc_fs_partition", case.partition] if case.partition else []
    process = subprocess.Popen(
        [*command, *settings.petsc, *extra],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(os.environ),  # as Python found it: MPI in this process would add to it what mpiexec refuses
        start_new_session=True,  # so that the ranks end with mpiexec
    )
    try:
        out, err = process.communicate(timeout=settings.limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return f"ended after {settings.limit:g} s", ""
    if process.returncode not in (0, 1) or "peak memory" not in out:
        lines = [line for line in err.splitlines() if line.strip()]
        return next((line for line in lines if line.startswith("petsc-fs:")), f"exit code {process.returncode}"), out
    return "", out


def read_events(path: Path) -> dict[str, Event]:
    """PETSc's log in its CSV format, stages added up.

    Raises:
        UsageError: the file is no such log.
    """
    events: dict[str, Event] = {}
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        if rows.fieldnames is None or not {"Event Name", "Rank", *COLUMNS} <= set(rows.fieldnames):
            raise UsageError(f"{path}: not a log that -log_view :FILE:ascii_csv has written")
        for row in rows:
            event = events.setdefault(row["Event Name"].strip(), {column: [] for column in COLUMNS})
            rank = int(row["Rank"])
            for column in COLUMNS:
                event[column].extend([0.0] * (rank + 1 - len(event[column])))
                event[column][rank] += float(row[column])
    return events


def numbers(report: Mapping[str, Any], events: Mapping[str, Event]) -> dict[str, Any]:
    """The columns of a `Run`, from a report of `petsc-fs solve` and PETSc's log."""
    none: Event = {column: [0.0] for column in COLUMNS}
    solve, krylov = events.get("KSPSolve", none), events.get("KSPGMRESOrthog", none)
    memory, sizes = report["memory_bytes"], report["fields"]
    greatest = [max(ranks) for ranks in zip(*memory["peak"].values(), strict=True)]
    return {
        **{name: report[name] for name in ("dimension", "iterations", "converged")},
        **{name: report[name] for name in ("read_seconds", "setup_seconds", "solve_seconds")},
        "unknowns": sum(sizes.values()),
        "small_unknowns": sum(sizes.get(name, 0) for name in ("contact", "intf_force", "intf_flow")),
        "peak_bytes": sum(greatest),
        "own_bytes": sum(greatest) - sum(memory["start"]),
        "rank_bytes": max(greatest),
        "messages": round(sum(solve["Num Messages"])),
        "message_bytes": round(sum(solve["Message Length"])),
        "reductions": round(max(solve["Num Reductions"])),
        "krylov_reductions": round(max(krylov["Num Reductions"])),
        "exchanges": round(max(events.get("VecScatterBegin", none)["Count"])),
        "krylov_seconds": max(krylov["Time"]),
        "preconditioner_seconds": max(events.get("PCApply", none)["Time"]),
        "mechanics_seconds": max(events.get("KSPSolve_FS_0", none)["Time"]),
    }


def read_hierarchies(printed: str) -> list[list[tuple[int, int]]]:
    """Rows and entries of each level of each hierarchy in what hypre prints of its set-up."""
    found: list[list[tuple[int, int]]] = []
    for part in printed.split("Operator Matrix Information:")[1:]:
        table = part.split("Interpolation Matrix Information:")[0]
        found.append([(int(m[1]), int(m[2])) for m in map(LEVEL.match, table.splitlines()) if m])
    return found


def write_csv(runs: Iterable[Run], target: Path) -> None:
    """Write one row per run.

    Raises:
        UsageError: the file cannot be written.
    """
    with complete(target) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Run)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(run) for run in runs)


def read_csv(path: Path) -> list[Run]:
    """Read what `write_csv` has written.

    Raises:
        UsageError: the file is none of those.
    """
    kinds: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float, "bool": "True".__eq__}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                Run(**{f.name: kinds[str(f.type)](row[f.name]) for f in fields(Run)}) for row in csv.DictReader(file)
            ]
    except (OSError, KeyError, TypeError, ValueError) as e:
        raise UsageError(f"{path}: not a table of scaling runs ({e})") from e


def median(runs: Sequence[Run], column: str) -> float:
    """Median of a column over runs that worked; of an even number the lower of the two in the middle."""
    values = sorted(float(getattr(run, column)) for run in runs if run.outcome == "ok")
    return values[(len(values) - 1) // 2] if values else float("nan")


def by_case(runs: Iterable[Run]) -> dict[tuple[str, str, str, int], list[Run]]:
    """Repetitions of the same case together: key scene, options file, partition, ranks."""
    together: dict[tuple[str, str, str, int], list[Run]] = {}
    for run in runs:
        together.setdefault((run.scene, run.options_file, run.partition, run.ranks), []).append(run)
    return together
