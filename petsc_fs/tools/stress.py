"""`petsc-fs stress`: extreme scenes through the options files, and whether each answer was right.

Solves run in processes apart (see `petsc_fs.tools.measure`), with the tolerances that their options files have.
What it hands on as converged is held against a reference solution (`petsc_fs.tools.reference`) field by field.

A residual of each field of at most tol (|J| |x| + |b|) in its rows bounds the field's error by √fields κ tol. The
Krylov method sees to the residual of all fields together, so that a small field may miss this bound, and κ is estimated
from below: hence the factor `SAFETY`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import textwrap
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.files import write_text
from petsc_fs.tools.measure import Job, Record, Variant, measure_all, positive, seconds_of, split_ranks
from petsc_fs.tools.pages import markdown
from petsc_fs.tools.stress_cases import StressCase, catalogue, held_out

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

DEFAULT = "(default)"
"""In place of an options file: what `petsc-fs solve` takes for the scene."""
RETRY = "(default, retry)"
"""The same with -petsc_fs_retry retry.opts."""


Case = dict[str, Any]
"""What is known of a case before anything is solved, as JSON can hold it: what `StressCase` says of it in words, and

    fields, unknowns     of the scene, and their number
    conditions           of each field, see `petsc_fs.tools.reference.field_conditions`
    no_reference         why there is no reference solution; "" if there is one
    path, reference      files of the scene and of the reference, "" if there is none or no single one; not reported
"""

Finding = dict[str, Any]
"""What came of one case with one options file on some ranks; as `petsc_fs.tools.measure` has it, but for

    case, file           names; file may be DEFAULT or RETRY
    outcome              one of OUTCOMES
    allowed_by_field     the largest errors that count as right
    seconds              set-up and solve
"""


def prepare(cases: Iterable[StressCase], folder: Path) -> list[Case]:
    """Write the scenes, with reference solutions and condition numbers. Initialises PETSc; on one rank."""
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from petsc_fs.tools import reference

    found = []
    for case in cases:
        scene = case.make()
        path = hdf5.write(scene, folder / f"{case.name}.h5", compression=None)
        known = {name: getattr(case, name) for name in "name group hard source singular solvable held_out".split()}
        known |= {"fields": scene.fields, "unknowns": sum(scene.sizes.values()), "path": os.fspath(path)}
        known |= {"reference": "", "no_reference": "", "conditions": {}}
        try:
            with np.errstate(all="ignore"):  # what is not finite is looked for
                exact = reference.solve(scene, "direct")
                target = folder / f"{case.name}.npz"
                reference.write(exact, target)
                known["reference"] = "" if case.singular else os.fspath(target)
                known["conditions"] = reference.field_conditions(scene, exact.solution)
        except (SolveError, FloatingPointError) as e:
            known["no_reference"] = str(e)
        found.append(known)
    return found


def variants(more: Mapping[str, str | None]) -> list[Variant]:
    """All that can be tried: the default, with and without a second attempt, and every shipped file."""
    retried = {"petsc_fs_retry": "retry.opts", **more}
    files = [Variant(f.path.name, str(f.path), more, f.fields) for f in options.shipped()]
    return [Variant(DEFAULT, options=more), Variant(RETRY, options=retried), *files]


def run(cases: Sequence[Case], chosen: Sequence[Variant], job: Job, ranks: Sequence[int] = (1,)) -> Iterator[Finding]:
    """Solve every case by every variant that fits, on every number of ranks, one process at a time, as a job says.

    A process goes on from scene to scene; after one that ended by an error another process takes the rest.
    """
    by_path = {case["path"]: case for case in cases}
    references = {path: case["reference"] for path, case in by_path.items() if case["reference"]}
    job = replace(job, errors=True, references=references, keep_going=True)

    def fits(system: str, variant: Variant) -> bool:
        return variant.fits(by_path[system]["fields"])

    for records in measure_all(list(by_path), chosen, job, ranks=ranks, fits=fits, batch=True):
        found = [judge(by_path[record["scene"]], record) for record in records]
        words = ", ".join(f"{n} {outcome}" for outcome, n in Counter(f["outcome"] for f in found).items())
        _say(f"{found[0]['file']}{_on(found[0]['ranks'])}: {words}")
        yield from found


def judge(case: Case, record: Record) -> Finding:
    """What a record of `petsc_fs.tools.measure.measure_all` amounts to."""
    allowed = dict.fromkeys(case["fields"], UNCONDITIONED)
    allowed |= {f: min(WORST, SAFETY * TOLERANCE * max(c, 1.0)) for f, c in case["conditions"].items()}
    errors, kind = record["error_by_field"], record["kind"]
    if kind in ("hang", "crash"):
        outcome = kind
    elif kind != "converged":
        outcome = "refusal"
    elif not case["solvable"]:
        outcome = "wrong"
    elif errors is not None and case["reference"]:
        outcome = "right" if all(errors[f] <= allowed[f] for f in errors) else "wrong"
    else:
        backward = (record["backward_error"] or {}).get("fieldwise", np.inf)
        outcome = "right" if backward <= SINGULAR_BACKWARD else "wrong"
    said = {key: record[key] for key in "ranks kind message iterations reason error_by_field backward_error".split()}
    seconds = None if record["seconds"] is None else seconds_of(record)["total"]
    about = {"case": case["name"], "file": record["variant"], "outcome": outcome}
    return about | said | {"allowed_by_field": allowed, "seconds": seconds}


def report(cases: Iterable[Case], findings: Iterable[Finding], command: str) -> dict[str, Any]:
    """Everything, for JSON, with the number of each outcome by number of ranks."""
    known = [{k: v for k, v in case.items() if k not in ("path", "reference")} for case in cases]
    found = list(findings)
    numbers = sorted({f["ranks"] for f in found})
    counts = {str(n): dict(Counter(f["outcome"] for f in found if f["ranks"] == n)) for n in numbers}
    return {"command": command, "cases": known, "findings": found, "counts": counts}


def merge(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Several reports as one; where two have the same case, file and ranks, the later one counts."""
    cases = {case["name"]: case for part in parts for case in part["cases"]}
    latest = {(f["file"], f["ranks"], f["case"]): f for part in parts for f in part["findings"]}
    return report(cases.values(), latest.values(), "; ".join(dict.fromkeys(p["command"] for p in parts)))


def read_report(path: Path) -> dict[str, Any]:
    """A report as `--report` wrote it; a UsageError where it is none."""
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if not {"command", "cases", "findings"} <= set(found):
            raise ValueError("it has no cases")
    except (OSError, ValueError, TypeError) as e:
        raise UsageError(f"{path}: not a report of petsc-fs stress ({e})") from e
    return found


# --- the page


def write_page(found: Mapping[str, Any], target: Path) -> list[Path]:
    """Write a report as a page in Markdown, and beside it, called like it, the picture that it shows; both files."""
    from petsc_fs.tools.plots import plot_matrix

    picture = plot_matrix(found["cases"], found["findings"], list(OUTCOMES), target.with_suffix(".png"))
    held = {case["name"] for case in found["cases"] if case["held_out"]}
    lines = [
        "# Extreme scenes",
        "",
        f"Written by `{found['command']}`. Every case is solved with the tolerances of the options files; what",
        "is handed on as converged is held against a reference solution. Thresholds were chosen on the catalogue; the",
        "held-out cases were drawn at random after that.",
        "",
        *(f"- **{name}**: {words}" for name, words in OUTCOMES.items()),
        "",
        f"![Outcome of each case with each options file]({picture.name})",
        "",
    ]
    for title, drawn in (("Catalogue", False), ("Held out", True)):
        if mine := [f for f in found["findings"] if (f["case"] in held) == drawn]:
            lines += [f"## {title}: {len({f['case'] for f in mine})} cases", "", *markdown(*_by_file(mine)), ""]
    lines += ["## Cases", "", *markdown(*_cases(found)), ""]
    lines += [f"Condition: of the worst field. Iterations and error: of {DEFAULT}."]
    write_text(target, "\n".join(lines) + "\n")
    return [target, picture]


def _by_file(findings: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[object]]]:
    """Outcomes by file and ranks, with iterations of what was right and the names of what was not."""
    groups: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for f in findings:
        groups.setdefault((f["file"], f["ranks"]), []).append(f)
    rows: list[list[object]] = []
    for (file, n), mine in groups.items():
        numbers = Counter(f["outcome"] for f in mine)
        iterations = sum(f["iterations"] or 0 for f in mine if f["outcome"] == "right")
        bad = ", ".join(f["case"] for f in mine if f["outcome"] != "right") or "–"
        rows.append([file, n, *(numbers[o] for o in OUTCOMES), iterations, bad])
    return ["file", "ranks", *OUTCOMES, "iterations", "does not solve"], rows


def _cases(found: Mapping[str, Any]) -> tuple[list[str], list[list[object]]]:
    """The catalogue, with what the default makes of it."""
    best = {f["case"]: f for f in reversed(found["findings"]) if f["file"] == DEFAULT}
    rows: list[list[object]] = []
    for case in found["cases"]:
        known = [c for c in case["conditions"].values() if math.isfinite(c)]
        condition = "singular" if case["singular"] else f"{max(known):.0e}" if known else "not known"
        end: tuple[object, str] = ("", "")
        if case["name"] in best:
            f = best[case["name"]]
            right = f["outcome"] == "right"
            error = f"{max(f['error_by_field'].values()):.0e}" if right and f["error_by_field"] else ""
            end = (f["iterations"] if right else f["outcome"], error)
        rows.append([case["name"], case["unknowns"], case["hard"], case["source"], condition, *end])
    return ["case", "unknowns", "what makes it hard", "from", "condition", "iterations", "worst error"], rows


# --- the command line

SUITES = ("quick", "full", "held-out")
EPILOG = """\
-n RANKS says on how many ranks; other PETSc options win over those of the options files. The full suite has the
held-out cases, too. Exit code 1 if an answer was wrong, a solve hung or a process crashed; refusals are honest and
count as none of these."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs stress`."""
    parser.epilog = EPILOG
    add = parser.add_argument
    add("--suite", choices=SUITES, default="quick", help="default %(default)s")
    add("--ranks", type=positive(int), nargs="+", metavar="N", help="numbers of ranks, as -n; default 1")
    add("--only", nargs="+", metavar="CASE", help="these cases instead of a suite")
    add("--files", nargs="+", metavar="FILE", help=f"these options files only; also {DEFAULT}, {RETRY}")
    add("--list", action="store_true", help="print the catalogue and end")
    add("--report", type=Path, metavar="FILE.json", help="write everything that was found")
    add("--read", type=Path, nargs="+", metavar="FILE.json", help="read reports instead of solving")
    add("--page", type=Path, metavar="FILE.md", help="write it as a page, with a picture beside it")
    add("--time-limit", type=positive(float), default=60.0, metavar="S", help="of one solve; default %(default)s")
    add("--mpiexec", metavar="PROGRAM", help="that starts ranks")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs stress`."""
    if comm.size > 1:
        raise UsageError("stress starts mpiexec itself: call it without, and give it -n RANKS")
    from petsc_fs.io.bundled import check_targets

    check_targets(args.report, args.page)
    numbers, more = split_ranks(petsc)
    cases = _chosen(args)
    if args.list:
        for case in cases:
            about = textwrap.fill(f"{case.hard} [{case.source}]", 80, initial_indent="    ", subsequent_indent="    ")
            print(f"{case.name} ({case.group})\n{about}")
        return 0
    started = time.perf_counter()
    if args.read:
        found = merge([read_report(path) for path in args.read])
    else:
        from petsc_fs.petsc_errors import check_build

        check_build()
        ranks = sorted({*(args.ranks or ()), *numbers}) or [1]
        known = {v.label: v for v in variants(more)}
        for name in args.files or ():
            if name not in known:
                raise UsageError(f"no options file {name!r}; there are {', '.join(known)}")
        with tempfile.TemporaryDirectory(prefix="petsc_fs-stress-") as folder:
            prepared = prepare(cases, Path(folder))
            _say(f"{len(prepared)} scenes, {sum(bool(c['reference']) for c in prepared)} with a reference solution")
            job = Job(time_limit=args.time_limit, mpiexec=args.mpiexec)
            findings = list(run(prepared, [known[n] for n in args.files or known], job, ranks))
        words = f"--only {' '.join(args.only)}" if args.only else f"--suite {args.suite}"
        found = report(prepared, findings, f"petsc-fs stress {words} --ranks {' '.join(map(str, ranks))}")
    if args.report is not None:
        write_text(args.report, json.dumps(found, indent=1) + "\n")
    if args.page is not None:
        write_page(found, args.page)
    bad = [f for f in found["findings"] if f["outcome"] not in ("right", "refusal")]
    for finding in bad:
        _say(f"{finding['outcome'].upper()}: {describe(finding)}")
    for n, counts in found["counts"].items():
        _say(f"{n} rank{'s' if n != '1' else ''}: " + ", ".join(f"{counts.get(o, 0)} {o}" for o in OUTCOMES))
    seconds = time.perf_counter() - started
    _say(f"{len(found['cases'])} cases, {len(found['findings'])} solves, {seconds:.0f} s")
    return 1 if bad else 0


def describe(finding: Finding) -> str:
    """One line on what is wrong with a finding."""
    allowed, errors = finding["allowed_by_field"], finding["error_by_field"] or {}
    off = {f: e for f, e in errors.items() if not e <= allowed.get(f, np.inf)}
    worst = ", ".join(f"{f} {e:.1e} (allowed {allowed[f]:.1e})" for f, e in off.items())
    where = f"{finding['case']} by {finding['file']} on {finding['ranks']}"
    return f"{where}: {finding['kind']} {finding['reason'] or ''} {finding['message']} {worst}".rstrip()


def _chosen(args: argparse.Namespace) -> list[StressCase]:
    """The cases of a call; a UsageError where there is no such case."""
    known = {case.name: case for case in [*catalogue(), *held_out()]}
    for name in args.only or ():
        if name not in known:
            similar = options.closest(name, known)
            raise UsageError(f"no case {name!r}" + (f"; did you mean {' or '.join(similar)}?" if similar else ""))
    if args.only:
        return [known[name] for name in args.only]
    if args.suite == "held-out":
        return [case for case in known.values() if case.held_out]
    return [case for case in known.values() if args.suite == "full" or case.quick]


def _on(ranks: int) -> str:
    return f" on {ranks} rank{'s' if ranks > 1 else ''}"


def _say(line: str) -> None:
    print(line, flush=True)
