"""`petsc-fs stress`: extreme scenes through the options files, and whether each answer was right.

Solves run in processes apart (see `petsc_fs.measure`), with the tolerances that their options files have.
What it hands on as converged is held against a reference solution (`petsc_fs.reference`) field by field.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import hdf5, options
from petsc_fs.compare import split_petsc
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.files import write_text
from petsc_fs.measure import Job, Record, measure
from petsc_fs.stress_cases import StressCase, catalogue

if TYPE_CHECKING:
    from mpi4py import MPI

WORST = 1e-2
"""Error of a field beyond which no condition number excuses a solution."""
UNCONDITIONED = 1e-3
"""Error of a field that counts as right where its condition number could not be computed."""
SAFETY = 100.0
"""What an estimate of the condition number from below may be short of."""
TOLERANCE = 1e-10
"""Relative tolerance of the shipped options files."""
SINGULAR_BACKWARD = 1e-8
"""Componentwise backward error up to which a solution of a singular system counts as one."""

OUTCOMES = {
    "right": "converged, and the relative error of every field is at most "
    f"{SAFETY:g} times its condition number times the tolerance, and {WORST:g}; "
    f"{UNCONDITIONED:g} where the condition number is not known, and if the matrix is singular, "
    f"the componentwise backward error at most {SINGULAR_BACKWARD:g}",
    "refusal": "not converged, or an error, and said so",
    "wrong": "said to be converged, but the error of a field is larger",
    "hang": "no end within the time limit",
    "crash": "the process ended without saying why",
}
"""What can come of a solve."""

SMALLEST = "(smallest tree)"
"""In place of an options file: the solver that `petsc-fs solve` cuts for the scene."""
SCALED = "(smallest tree, scaled)"
"""The same with -petsc_fs_scaling always."""


@dataclass(frozen=True)
class Truth:
    """What is known of a case before anything is solved.

    Attributes:
        name: of the case.
        group: heading.
        hard: what makes it hard.
        source: where it comes from.
        fields: of the scene.
        unknowns: number of them.
        path: of the scene.
        reference: file of the reference solution; "" if there is none.
        no_reference: why.
        conditions: see `petsc_fs.conditioning.field_conditions`.
        singular: whether the catalogue says so.
    """

    name: str
    group: str
    hard: str
    source: str
    fields: tuple[str, ...]
    unknowns: int
    path: str
    reference: str
    no_reference: str
    conditions: dict[str, float]
    singular: bool


@dataclass(frozen=True)
class Finding:
    """What came of one case with one options file on some ranks.

    Attributes:
        case: its name.
        file: name of the options file, or `SMALLEST` or `SCALED`.
        ranks: number of them.
        outcome: one of `OUTCOMES`.
        kind: of `petsc_fs.measure.KINDS`.
        message: what was said.
        iterations: of the outer Krylov method.
        reason: why it stopped.
        true_residual: relative, in the norm that the solver judges by.
        error_by_field: relative, in natural norms.
        allowed_by_field: the largest errors that count as right.
        backward_error: normwise and componentwise.
        seconds: set-up and solve.
    """

    case: str
    file: str
    ranks: int
    outcome: str
    kind: str
    message: str
    iterations: int | None
    reason: str | None
    true_residual: float | None
    error_by_field: dict[str, float] | None
    allowed_by_field: dict[str, float]
    backward_error: dict[str, float] | None
    seconds: float | None


def prepare(cases: Iterable[StressCase], folder: Path, say: Callable[[str], None]) -> list[Truth]:
    """Write the scenes, with reference solutions and condition numbers. Initialises PETSc; on one rank."""
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from petsc_fs import conditioning, reference

    found = []
    for case in cases:
        scene = case.make()
        path = hdf5.write(scene, folder / f"{case.name}.h5", compression=None)
        target, why, conditions = "", "", dict[str, float]()
        try:
            exact = reference.solve(scene, "direct")
            target = os.fspath(folder / f"{case.name}.npz")
            reference.write(exact, target)
            conditions = conditioning.field_conditions(scene, exact.solution)
        except (SolveError, FloatingPointError) as e:
            why = str(e)
        found.append(
            Truth(
                name=case.name,
                group=case.group,
                hard=case.hard,
                source=case.source,
                fields=scene.fields,
                unknowns=sum(scene.sizes.values()),
                path=os.fspath(path),
                reference="" if case.singular else target,
                no_reference=why,
                conditions=conditions,
                singular=case.singular,
            )
        )
    say(f"{len(found)} scenes, {sum(bool(t.reference) for t in found)} with a reference solution")
    return found


def files_for(truth: Truth, names: Sequence[str] | None = None) -> list[str]:
    """What a case is solved by: options files for its fields, and the smallest tree."""
    fitting = [f.path.name for f in options.shipped() if f.fits(truth.fields)]
    everything = [SMALLEST, SCALED, *fitting]
    return everything if names is None else [n for n in everything if n in names]


def run(
    truths: Sequence[Truth],
    ranks: int,
    *,
    names: Sequence[str] | None = None,
    more: Mapping[str, str | None] | None = None,
    time_limit: float = 60.0,
    mpiexec: str | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Iterator[Finding]:
    """Solve every case by every file that fits, one process at a time.

    A process goes on from scene to scene; after one that ended by an error another process takes the rest.

    Args:
        truths: from `prepare`.
        ranks: of each process.
        names: options files to use; None for all that fit.
        more: PETSc options, which win over the files.
        time_limit: seconds without a sign of life after which a solve counts as hanging.
        mpiexec: program that starts ranks.
        say: called with a line per options file.
    """
    wanted = dict.fromkeys(file for truth in truths for file in files_for(truth, names))
    for file in wanted:
        left = [truth for truth in truths if file in files_for(truth, names)]
        counts: Counter[str] = Counter()
        started = time.perf_counter()
        while left:
            job = Job(
                scenes=[t.path for t in left],
                options_file=None if file in (SMALLEST, SCALED) else file,
                options={**({"petsc_fs_scaling": "always"} if file == SCALED else {}), **(more or {})},
                ranks=ranks,
                errors=True,
                references={t.path: t.reference for t in left if t.reference},
                time_limit=time_limit,
                keep_going=True,
            )
            records = measure(job, mpiexec=mpiexec)
            by_path = {t.path: t for t in left}
            for record in records:
                finding = judge(by_path[record["scene"]], file, ranks, record)
                counts[finding.outcome] += 1
                yield finding
            done = {record["scene"] for record in records}
            left = [t for t in left if t.path not in done]
        words = ", ".join(f"{n} {outcome}" for outcome, n in counts.items())
        say(f"{file} on {ranks} rank{'s' if ranks > 1 else ''}: {words}; {time.perf_counter() - started:.0f} s")


def judge(truth: Truth, file: str, ranks: int, record: Record) -> Finding:
    """What a record of `petsc_fs.measure` amounts to."""
    tolerance = max(record["tolerance"] or 0.0, TOLERANCE)
    allowed = {f: UNCONDITIONED for f in truth.fields}
    allowed |= {f: min(WORST, SAFETY * tolerance * max(c, 1.0)) for f, c in truth.conditions.items()}
    errors, kind = record["error_by_field"], record["kind"]
    if kind in ("hang", "crash"):
        outcome = kind
    elif kind not in ("converged", "unused_option"):
        outcome = "refusal"
    elif errors is not None and truth.reference:
        outcome = "right" if all(errors[f] <= allowed[f] for f in errors) else "wrong"
    else:
        backward = (record["backward_error"] or {}).get("componentwise", np.inf)
        outcome = "right" if backward <= SINGULAR_BACKWARD else "wrong"
    seconds = [record[key] for key in ("setup_seconds", "solve_seconds")]
    return Finding(
        case=truth.name,
        file=file,
        ranks=ranks,
        outcome=outcome,
        kind=kind,
        message=record["message"],
        iterations=record["iterations"],
        reason=record["reason"],
        true_residual=record["true_residual"],
        error_by_field=errors,
        allowed_by_field=allowed,
        backward_error=record["backward_error"],
        seconds=None if None in seconds else float(sum(seconds)),
    )


def report(truths: Sequence[Truth], findings: Sequence[Finding], command: str) -> dict[str, Any]:
    """Everything, for JSON."""
    counts = {
        str(n): dict(Counter(f.outcome for f in findings if f.ranks == n)) for n in sorted({f.ranks for f in findings})
    }
    cases = [{k: v for k, v in asdict(t).items() if k not in ("path", "reference")} for t in truths]
    return {"command": command, "counts": counts, "cases": cases, "findings": [asdict(f) for f in findings]}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs stress`."""
    parser.epilog = EPILOG
    parser.add_argument("--suite", choices=("quick", "full"), default="quick", help="default %(default)s")
    parser.add_argument("--ranks", type=int, nargs="+", metavar="N", help="numbers of ranks, as -n; default 1")
    parser.add_argument("--only", nargs="+", metavar="CASE", help="these cases instead of a suite")
    parser.add_argument("--files", nargs="+", metavar="FILE", help="these options files only")
    parser.add_argument("--list", action="store_true", help="print the catalogue and end")
    parser.add_argument("--report", type=Path, metavar="FILE.json", help="write everything that was found")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="write it as a page, with a picture beside it")
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="S", help="of one solve; default %(default)s")
    parser.add_argument("--mpiexec", metavar="PROGRAM", help="that starts ranks")


EPILOG = """\
-n RANKS says on how many ranks; other PETSc options win over those of the options files. Exit code 1 if an answer was
wrong, a solve hung or a process crashed; refusals are honest and count as none of these."""


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs stress`."""
    if comm.size > 1:
        raise UsageError("stress starts mpiexec itself: call it without, and give it -n RANKS")
    from petsc_fs.cli import check_folders

    check_folders(args.report, args.page)
    numbers, more = split_petsc(petsc)
    cases = _chosen(args)
    if args.list:
        for case in cases:
            print(f"{case.name:32} {case.group:18} {case.hard}  [{case.source}]")
        return 0
    ranks = sorted({*(args.ranks or ()), *numbers}) or [1]
    started = time.perf_counter()
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory(prefix="petsc_fs-stress-") as folder:
        truths = prepare(cases, Path(folder), _say)
        for n in ranks:
            findings += run(
                truths, n, names=args.files, more=more, time_limit=args.time_limit, mpiexec=args.mpiexec, say=_say
            )
    words = f"petsc-fs stress --suite {args.suite} --ranks {' '.join(map(str, ranks))}"
    found = report(truths, findings, words)
    if args.report is not None:
        write_text(args.report, json.dumps(found, indent=1) + "\n")
    if args.page is not None:
        from petsc_fs.stress_page import write_page

        write_page(found, args.page)
    for finding in findings:
        if finding.outcome not in ("right", "refusal"):
            print(f"{finding.outcome.upper()}: {describe(finding)}")
    for n, counts in found["counts"].items():
        print(f"{n} rank{'s' if n != '1' else ''}: " + ", ".join(f"{counts.get(o, 0)} {o}" for o in OUTCOMES))
    print(f"{len(truths)} cases, {len(findings)} solves, {time.perf_counter() - started:.0f} s")
    return 1 if any(f.outcome not in ("right", "refusal") for f in findings) else 0


def describe(finding: Finding) -> str:
    """One line on what is wrong with a finding."""
    worst = ""
    if finding.error_by_field:
        off = {f: e for f, e in finding.error_by_field.items() if not e <= finding.allowed_by_field.get(f, np.inf)}
        worst = ", ".join(f"{f} {e:.1e} (allowed {finding.allowed_by_field[f]:.1e})" for f, e in off.items())
    where = f"{finding.case} by {finding.file} on {finding.ranks}"
    return f"{where}: {finding.kind} {finding.reason or ''} {finding.message} {worst}".rstrip()


def _chosen(args: argparse.Namespace) -> list[StressCase]:
    """The cases of a call.

    Raises:
        UsageError: there is no such case or file.
    """
    known = {case.name: case for case in catalogue()}
    for name in args.only or ():
        if name not in known:
            similar = options.closest(name, known)
            raise UsageError(f"no case {name!r}" + (f"; did you mean {' or '.join(similar)}?" if similar else ""))
    files = [SMALLEST, SCALED, *(f.path.name for f in options.shipped())]
    for name in args.files or ():
        if name not in files:
            raise UsageError(f"no options file {name!r}; there are {', '.join(files)}")
    if args.only:
        return [known[name] for name in args.only]
    return [case for case in known.values() if args.suite == "full" or case.quick]


def _say(line: str) -> None:
    print(line, flush=True)
