"""`petsc-fs stress`: extreme scenes through the options files, and whether each answer was right.

Solves run in processes apart (see `petsc_fs.tools.measure`), with the tolerances that their options files have.
What it hands on as converged is held against a reference solution (`petsc_fs.tools.reference`) field by field.
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

from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.files import write_text
from petsc_fs.tools.compare import split_petsc
from petsc_fs.tools.measure import Job, Record, measure
from petsc_fs.tools.stress_cases import StressCase, catalogue
from petsc_fs.tools.stress_held_out import held_out
from petsc_fs.tools.stress_repairs import REPAIRED, variants

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
SINGULAR_BACKWARD = SAFETY * TOLERANCE
"""Fieldwise backward error up to which a solution of a singular system counts as one: it has no forward error."""

OUTCOMES = {
    "right": "converged, and the relative error of every field is at most "
    f"{SAFETY:g} times its condition number times the tolerance, and {WORST:g}; "
    f"{UNCONDITIONED:g} where the condition number is not known, and if the matrix is singular, "
    f"the residual of each field at most {SINGULAR_BACKWARD:g} of |J| |x| + |b| in its rows",
    "refusal": "not converged, or an error, and said so",
    "wrong": "said to be converged, but the error of a field is larger, or there is no solution",
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
        conditions: see `petsc_fs.tools.conditioning.field_conditions`.
        singular: whether the catalogue says so.
        solvable: whether there is a solution.
        held_out: whether the case is held out, see `petsc_fs.tools.stress_held_out`.
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
    solvable: bool = True
    held_out: bool = False


@dataclass(frozen=True)
class Finding:
    """What came of one case with one options file on some ranks.

    Attributes:
        case: its name.
        file: name of the options file, or `SMALLEST` or `SCALED`, with further options behind it.
        ranks: number of them.
        outcome: one of `OUTCOMES`.
        kind: of `petsc_fs.tools.measure.KINDS`.
        message: what was said.
        iterations: of the outer Krylov method.
        reason: why it stopped.
        fallback: rung of -petsc_fs_fallback that found the solution; "" if none did.
        true_residual: relative, in the norm that the solver judges by.
        tolerance: what the solver held it against, `TOLERANCE` at least.
        error_by_field: relative, in natural norms.
        allowed_by_field: the largest errors that count as right.
        backward_error: normwise, componentwise and fieldwise.
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
    fallback: str
    true_residual: float | None
    tolerance: float
    error_by_field: dict[str, float] | None
    allowed_by_field: dict[str, float]
    backward_error: dict[str, float] | None
    seconds: float | None


def prepare(cases: Iterable[StressCase], folder: Path, say: Callable[[str], None]) -> list[Truth]:
    """Write the scenes, with reference solutions and condition numbers. Initialises PETSc; on one rank."""
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from petsc_fs.tools import conditioning, reference

    found = []
    for case in cases:
        scene = case.make()
        path = hdf5.write(scene, folder / f"{case.name}.h5", compression=None)
        target, why, conditions = "", "", dict[str, float]()
        try:
            with np.errstate(all="ignore"):  # what is not finite is looked for
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
                solvable=case.solvable,
                held_out=case.held_out,
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
    label: str = "",
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
        label: what these are called behind the name of the file.
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
                finding = judge(by_path[record["scene"]], file + label, ranks, record)
                counts[finding.outcome] += 1
                yield finding
            done = {record["scene"] for record in records}
            left = [t for t in left if t.path not in done]
        words = ", ".join(f"{n} {outcome}" for outcome, n in counts.items())
        where = f"{ranks} rank{'s' if ranks > 1 else ''}"
        say(f"{file}{label} on {where}: {words}; {time.perf_counter() - started:.0f} s")


def judge(truth: Truth, file: str, ranks: int, record: Record) -> Finding:
    """What a record of `petsc_fs.tools.measure` amounts to."""
    tolerance = max(record["tolerance"] or 0.0, TOLERANCE)
    allowed = {f: UNCONDITIONED for f in truth.fields}
    allowed |= {f: min(WORST, SAFETY * tolerance * max(c, 1.0)) for f, c in truth.conditions.items()}
    errors, kind = record["error_by_field"], record["kind"]
    if kind in ("hang", "crash"):
        outcome = kind
    elif kind != "converged":
        outcome = "refusal"
    elif not truth.solvable:
        outcome = "wrong"
    elif errors is not None and truth.reference:
        outcome = "right" if all(errors[f] <= allowed[f] for f in errors) else "wrong"
    else:
        backward = (record["backward_error"] or {}).get("fieldwise", np.inf)
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
        fallback=record["fallback"] or "",
        true_residual=record["true_residual"],
        tolerance=tolerance,
        error_by_field=errors,
        allowed_by_field=allowed,
        backward_error=record["backward_error"],
        seconds=None if None in seconds else float(sum(seconds)),
    )


def report(
    truths: Sequence[Truth], findings: Sequence[Finding], command: str, repairs: Sequence[Finding] = ()
) -> dict[str, Any]:
    """Everything, for JSON."""
    cases = [{k: v for k, v in asdict(t).items() if k not in ("path", "reference")} for t in truths]
    found = {"command": command, "cases": cases, "findings": [asdict(f) for f in findings]}
    return found | {"repairs": [asdict(f) for f in repairs], "counts": counts(found)}


def counts(found: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Number of each outcome by number of ranks."""
    numbers = sorted({f["ranks"] for f in found["findings"]})
    return {str(n): dict(Counter(f["outcome"] for f in found["findings"] if f["ranks"] == n)) for n in numbers}


def merge(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Several reports as one; where two have the same case, file and ranks, the later one counts."""
    cases = {case["name"]: case for part in parts for case in part["cases"]}
    found: dict[str, Any] = {"command": "; ".join(dict.fromkeys(p["command"] for p in parts))}
    found["cases"] = list(cases.values())
    for which in ("findings", "repairs"):
        latest = {(f["file"], f["ranks"], f["case"]): f for part in parts for f in part.get(which, ())}
        found[which] = list(latest.values())
    return found | {"counts": counts(found)}


def read_report(path: Path) -> dict[str, Any]:
    """A report as `--report` wrote it.

    Raises:
        UsageError: it is none.
    """
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if not {"command", "cases", "findings"} <= set(found):
            raise ValueError("it has no cases")
    except (OSError, ValueError, TypeError) as e:
        raise UsageError(f"{path}: not a report of petsc-fs stress ({e})") from e
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs stress`."""
    parser.epilog = EPILOG
    parser.add_argument("--suite", choices=SUITES, default="quick", help="default %(default)s")
    parser.add_argument("--ranks", type=int, nargs="+", metavar="N", help="numbers of ranks, as -n; default 1")
    parser.add_argument("--only", nargs="+", metavar="CASE", help="these cases instead of a suite")
    parser.add_argument("--files", nargs="+", metavar="FILE", help="these options files only")
    parser.add_argument("--repairs", action="store_true", help="each repair without and with it, too")
    parser.add_argument("--list", action="store_true", help="print the catalogue and end")
    parser.add_argument("--report", type=Path, metavar="FILE.json", help="write everything that was found")
    parser.add_argument("--read", type=Path, nargs="+", metavar="FILE.json", help="read reports instead of solving")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="write it as a page, with a picture beside it")
    parser.add_argument("--limits", type=Path, metavar="FILE.md", help="write where each options file can be trusted")
    parser.add_argument("--time-limit", type=float, default=60.0, metavar="S", help="of one solve; default %(default)s")
    parser.add_argument("--mpiexec", metavar="PROGRAM", help="that starts ranks")


SUITES = ("quick", "full", "held-out")
EPILOG = """\
-n RANKS says on how many ranks; other PETSc options win over those of the options files. The full suite has the
held-out cases, too. Exit code 1 if an answer was wrong, a solve hung or a process crashed; refusals are honest and
count as none of these, and so does what comes of solvers without their repairs."""


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs stress`."""
    if comm.size > 1:
        raise UsageError("stress starts mpiexec itself: call it without, and give it -n RANKS")
    from petsc_fs.io.bundled import check_targets

    check_targets(args.report, args.page, args.limits)
    numbers, more = split_petsc(petsc)
    cases = _chosen(args)
    if args.list:
        for case in cases:
            print(f"{case.name:32} {case.group:18} {case.hard}  [{case.source}]")
        return 0
    started = time.perf_counter()
    if args.read:
        found = merge([read_report(path) for path in args.read])
    else:
        found = _solve(args, cases, sorted({*(args.ranks or ()), *numbers}) or [1], more)
    if args.report is not None:
        write_text(args.report, json.dumps(found, indent=1) + "\n")
    if args.page is not None:
        from petsc_fs.tools.stress_page import write_page

        write_page(found, args.page)
    if args.limits is not None:
        from petsc_fs.tools.stress_limits import write_limits

        write_limits(found, args.limits)
    bad = [f for f in found["findings"] if f["outcome"] not in ("right", "refusal")]
    for finding in bad:
        print(f"{finding['outcome'].upper()}: {describe(Finding(**finding))}")
    for n, numbers_of in found["counts"].items():
        print(f"{n} rank{'s' if n != '1' else ''}: " + ", ".join(f"{numbers_of.get(o, 0)} {o}" for o in OUTCOMES))
    solves = len(found["findings"]) + len(found["repairs"])
    print(f"{len(found['cases'])} cases, {solves} solves, {time.perf_counter() - started:.0f} s")
    return 1 if bad else 0


def _solve(
    args: argparse.Namespace, cases: Sequence[StressCase], ranks: Sequence[int], more: Mapping[str, str | None]
) -> dict[str, Any]:
    """Run the chosen cases; a report."""
    findings: list[Finding] = []
    repaired: list[Finding] = []
    common: dict[str, Any] = {"time_limit": args.time_limit, "mpiexec": args.mpiexec, "say": _say}
    with tempfile.TemporaryDirectory(prefix="petsc_fs-stress-") as folder:
        truths = prepare(cases, Path(folder), _say)
        for n in ranks:
            findings += run(truths, n, names=args.files, more=more, **common)
        if args.repairs:
            for label, values in variants().items():
                repaired += run(truths, ranks[0], names=[REPAIRED], more={**values, **more}, label=label, **common)
    words = f"--only {' '.join(args.only)}" if args.only else f"--suite {args.suite}"
    words += f" --ranks {' '.join(map(str, ranks))}" + (" --repairs" if args.repairs else "")
    return report(truths, findings, f"petsc-fs stress {words}", repaired)


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
    known = {case.name: case for case in [*catalogue(), *held_out()]}
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
    if args.suite == "held-out":
        return [case for case in known.values() if case.held_out]
    return [case for case in known.values() if args.suite == "full" or case.quick]


def _say(line: str) -> None:
    print(line, flush=True)
