"""Discretisation error against run time: how far linear systems need to be solved before it no longer shows.

`measure` runs one problem whose solution is known (`petsc_fs.porepy.analytic`) with one grid and one tolerance of
the linear solver; `study` does so for all of them, and `needed_tolerance` says which tolerance is enough. PorePy is
imported when a run starts, not when this module is.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petsc_fs.errors import SolveError, UsageError
from petsc_fs.files import write_text
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.analytic import Consolidation, Mandel, SlidingFracture

if TYPE_CHECKING:
    from mpi4py import MPI

Progress = Callable[[str], None]

REFINEMENTS = (1.0, 2.0, 4.0)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10)

DEFAULT_RTOL = 1e-10
"""-ksp_rtol of the shipped options files; what a looser tolerance saves is measured against it."""

MARGIN = 0.05
"""A tolerance is tight enough if no error differs by more than this part from that of the tightest tolerance.

Errors that are smaller count too: there algebra and discretisation happen to err in different directions.
"""

NEWTON = {"progressbars": False, "nl_convergence_tol": math.inf, "nl_convergence_tol_res": 1e-8, "max_iterations": 100}
"""PorePy's solver parameters; linear problems have one step."""


@dataclass(frozen=True)
class Case:
    """A problem with a known solution.

    Attributes:
        title: for people.
        options_file: name of the shipped options file.
        errors: names of the errors that are measured; the first one is drawn.
        make: given the mixins and a refinement, the model.
    """

    title: str
    options_file: str
    errors: tuple[str, ...]
    make: Callable[..., Any]


def _consolidation(mixins: tuple[type, ...], refinement: float, **params: Any) -> Any:
    from petsc_fs.porepy import analytic_models as models

    cls = type("ConsolidationModel", (*mixins, models.ConsolidationModel), {})
    return models.make_consolidation(cls, Consolidation(), 0.03, refinement, **params)


def _mandel(mixins: tuple[type, ...], refinement: float, **params: Any) -> Any:
    from petsc_fs.porepy import analytic_models as models

    cls = type("MandelModel", (*mixins, models.MandelModel), {})
    return models.make_consolidation(cls, Mandel(), 0.05, refinement, **params)


def _sliding(mixins: tuple[type, ...], refinement: float, **params: Any) -> Any:
    from petsc_fs.porepy import analytic_models as models

    cls = type("SlidingFractureModel", (*mixins, models.SlidingFractureModel), {})
    return models.make_sliding(cls, SlidingFracture(), refinement, **params)


CASES: dict[str, Case] = {
    "terzaghi": Case("Terzaghi's consolidation", "poromechanics.opts", ("pressure", "displacement"), _consolidation),
    "mandel": Case("Mandel's problem", "poromechanics.opts", ("pressure", "displacement"), _mandel),
    "sliding": Case("Sliding fracture", "contact_mechanics.opts", ("slip", "displacement"), _sliding),
}
"""Name of a case to what it is."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of a case.

    Attributes:
        case: name in `CASES`.
        refinement: of grid and time steps.
        rtol: -ksp_rtol of the linear solves.
        cells: of all grids.
        unknowns: of a linear system.
        solves: linear solves of the run.
        iterations: of the Krylov method, in all solves.
        errors: relative to the known solution, by name, at the end of the run.
        seconds: processor time of the run, from meshing on.
        linear_seconds: processor time of the linear solves in it.
    """

    case: str
    refinement: float
    rtol: float
    cells: int
    unknowns: int
    solves: int
    iterations: int
    errors: dict[str, float]
    seconds: float
    linear_seconds: float


@dataclass
class Study:
    """Runs, in the order they were made, and the versions of the programs that made them."""

    runs: list[Run] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)

    def of(self, case: str, rtol: float | None = None) -> list[Run]:
        """Runs of a case, of one tolerance or all; by refinement, then from the loosest tolerance on."""
        found = [r for r in self.runs if r.case == case and (rtol is None or r.rtol == rtol)]
        return sorted(found, key=lambda r: (r.refinement, -r.rtol))

    @property
    def cases(self) -> list[str]:
        """Names of the cases that were run."""
        return list(dict.fromkeys(r.case for r in self.runs))

    def tightest(self, case: str) -> list[Run]:
        """The run of each refinement with the tightest tolerance, by refinement."""
        return list({r.refinement: r for r in self.of(case)}.values())


def measure(name: str, refinement: float, rtol: float) -> Run:
    """Run one case on one rank.

    Args:
        name: in `CASES`.
        refinement: cells are 1 / (8 g) wide, and consolidation takes 4 g time steps.
        rtol: relative tolerance of the linear solves.

    Raises:
        UsageError: PorePy is missing, or there is no such case.
        SolveError: Newton or a linear solve failed.
    """
    case = find_case(name)
    require_porepy()
    import porepy as pp

    from petsc_fs.porepy.solver import FieldSplitSolver

    class Timed:
        """Adds up processor time of the linear solves."""

        linear_seconds = 0.0

        def solve_linear_system(self) -> Any:
            started = time.process_time()
            try:
                return super().solve_linear_system()  # type: ignore[misc]
            finally:
                self.linear_seconds += time.process_time() - started

    with tolerance(rtol):
        started = time.process_time()
        model = case.make((Timed, FieldSplitSolver), refinement, petsc_fs_options_file=case.options_file)
        try:
            pp.run_time_dependent_model(model, dict(NEWTON))
        except ValueError as e:
            if "onverge" not in str(e):
                raise
            raise SolveError(f"{name}: Newton did not converge with rtol {rtol:g} at refinement {refinement:g}") from e
        seconds = time.process_time() - started
    errors = model.errors()
    if not all(math.isfinite(e) for e in errors.values()):
        raise SolveError(f"{name}: the solution is not finite with rtol {rtol:g} at refinement {refinement:g}")
    return Run(
        case=name,
        refinement=refinement,
        rtol=rtol,
        cells=sum(sd.num_cells for sd in model.mdg.subdomains()),
        unknowns=model.linear_solves[-1].unknowns,
        solves=len(model.linear_solves),
        iterations=sum(solve.iterations for solve in model.linear_solves),
        errors=errors,
        seconds=seconds,
        linear_seconds=model.linear_seconds,
    )


def study(
    names: Sequence[str] = tuple(CASES),
    refinements: Sequence[float] = REFINEMENTS,
    tolerances: Sequence[float] = TOLERANCES,
    *,
    progress: Progress | None = None,
    keep: Callable[[Study], None] | None = None,
) -> Study:
    """Measure every case with every grid and tolerance; see `measure` for what is raised.

    Args:
        names: in `CASES`.
        refinements: see `measure`.
        tolerances: see `measure`.
        progress: called with a line of text per run.
        keep: called after each run with what there is by then.
    """
    require_porepy()
    from petsc_fs.porepy.parity import versions

    result = Study(versions=versions())
    for name in names:
        measure(name, min(refinements), max(tolerances))  # what is loaded and compiled once is no run's time
        for refinement in sorted(set(refinements)):
            for rtol in sorted(set(tolerances), reverse=True):
                run = measure(name, refinement, rtol)
                result.runs.append(run)
                if progress is not None:
                    progress(_line(run))
                if keep is not None:
                    keep(result)
    return result


@contextmanager
def tolerance(rtol: float) -> Iterator[None]:
    """Have -ksp_rtol in PETSc's database within a block."""
    from petsc4py import PETSc

    database = PETSc.Options()
    before = database.getAll().get("ksp_rtol")
    database.setValue("ksp_rtol", repr(rtol))
    try:
        yield
    finally:
        if before is None:
            database.delValue("ksp_rtol")
        else:
            database.setValue("ksp_rtol", before)


def orders(runs: Sequence[Run], name: str) -> list[float]:
    """Observed orders of convergence of an error, between successive refinements: log(e1 / e2) / log(g2 / g1).

    Args:
        runs: of one case and one tolerance, by refinement.
        name: of the error.
    """
    return [
        math.log(a.errors[name] / b.errors[name]) / math.log(b.refinement / a.refinement) for a, b in pairwise(runs)
    ]


def needed_tolerance(runs: Sequence[Run]) -> float:
    """Loosest tolerance that, with all tighter ones, leaves every error within `MARGIN` of that of the tightest.

    Nor does it cost Newton steps: there are no more solves than with the tightest one.

    Args:
        runs: of one case and one refinement.
    """
    by_rtol = sorted(runs, key=lambda r: r.rtol)
    best = by_rtol[0]
    needed = best.rtol
    for run in by_rtol:
        off = any(abs(run.errors[name] - error) > MARGIN * error for name, error in best.errors.items())
        if off or run.solves > best.solves:
            break
        needed = run.rtol
    return needed


def find_case(name: str) -> Case:
    """A case by name.

    Raises:
        UsageError: there is none.
    """
    if name not in CASES:
        raise UsageError(f"unknown case {name!r}; cases are {', '.join(CASES)}")
    return CASES[name]


def to_json(result: Study) -> str:
    """A study as JSON, one run a line."""
    runs = ",\n".join("  " + json.dumps(asdict(run)) for run in result.runs)
    return f'{{\n "versions": {json.dumps(result.versions)},\n "runs": [\n{runs}\n ]\n}}\n'


def from_json(path: Path) -> Study:
    """A study from a file of `to_json`.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return Study([Run(**run) for run in data["runs"]], data["versions"])
    except (OSError, ValueError, TypeError, KeyError) as e:
        raise UsageError(f"{path}: not a file of discretisation runs: {e}") from e


def joined(studies: Sequence[Study]) -> Study:
    """Studies as one; of a run in several, the last.

    Raises:
        UsageError: they were made by different versions of programs.
    """
    versions = studies[0].versions
    if any(s.versions != versions for s in studies):
        raise UsageError("the studies were made by different versions of PorePy, PETSc or others; measure anew")
    runs = {(run.case, run.refinement, run.rtol): run for s in studies for run in s.runs}
    return Study(list(runs.values()), versions)


def to_csv(result: Study) -> str:
    """A study as CSV: one run a row, empty where a case does not have an error."""
    names = list(dict.fromkeys(name for run in result.runs for name in run.errors))
    text = io.StringIO()
    plain = ("case", "refinement", "rtol", "cells", "unknowns", "solves", "iterations", "seconds", "linear_seconds")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*plain, *(f"error_{name}" for name in names)])
    for run in result.runs:
        writer.writerow([*(getattr(run, p) for p in plain), *(run.errors.get(name, "") for name in names)])
    return text.getvalue()


def _line(run: Run) -> str:
    errors = ", ".join(f"{name} {error:.3e}" for name, error in run.errors.items())
    return (
        f"{run.case}, refinement {run.refinement:g}, rtol {run.rtol:g}: errors {errors}; "
        f"{run.iterations} iterations in {run.solves} solves, {run.linear_seconds:.1f} of {run.seconds:.1f} s"
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`; needs no PorePy."""
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"default all: {', '.join(CASES)}")
    parser.add_argument(
        "--refine", type=float, nargs="+", default=list(REFINEMENTS), metavar="G", help="cells are 1 / (8 G) wide"
    )
    parser.add_argument(
        "--rtol", type=float, nargs="+", default=list(TOLERANCES), metavar="R", help="tolerances of the linear solves"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where discretisation.* go")
    parser.add_argument(
        "--from", dest="files", type=Path, nargs="+", default=[], metavar="FILE.json",
        help="run nothing; write the pages of earlier studies anew, as one",
    )  # fmt: skip


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run a study, and write discretisation.json, .csv, .png and .md; progress goes to stderr.

    The JSON file is complete after every run. Raises what `study` does.
    """
    if comm.size > 1:
        raise UsageError("discretisation measures on one rank; start it without mpiexec")
    for name in args.cases:
        find_case(name)
    for what, values in (("--refine", args.refine), ("--rtol", args.rtol)):
        if not all(math.isfinite(v) and v > 0 for v in values):
            raise UsageError(f"{what}: expected positive numbers, found {' '.join(f'{v:g}' for v in values)}")
    from petsc_fs.plot import pyplot
    from petsc_fs.porepy import discretisation_page

    pyplot()  # or an error, before anything is measured
    earlier = joined([from_json(file) for file in args.files]) if args.files else None
    if earlier is None:
        require_porepy()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise UsageError(f"{args.out}: cannot be made a directory: {e.strerror}") from e
    target = args.out / "discretisation.json"
    if earlier is not None:
        result = earlier
    else:
        import petsc4py

        petsc4py.init(["petsc-fs"])
        result = study(
            args.cases or list(CASES),
            args.refine,
            args.rtol,
            progress=_write_to_stderr,
            keep=lambda result: write_text(target, to_json(result)),
        )
    write_text(target, to_json(result))
    write_text(args.out / "discretisation.csv", to_csv(result))
    discretisation_page.draw(result, args.out / "discretisation.png")
    write_text(args.out / "discretisation.md", discretisation_page.page(result))
    _write_to_stderr(f"written: {args.out}/discretisation.json, .csv, .png, .md")
    return 0


def _write_to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
