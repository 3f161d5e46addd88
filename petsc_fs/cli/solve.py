"""`petsc-fs solve`: the steps of a sequence in order, by one solver that is updated as in a run; a scene is one."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petsc_fs import options
from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.fields import learn_aliases
from petsc_fs.io import hdf5, sequence
from petsc_fs.io.bundled import check_targets, find_scene, versions
from petsc_fs.io.files import write_text
from petsc_fs.memory import Phases

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.options import Choice, Facts
    from petsc_fs.partition import Layout
    from petsc_fs.scene import Scene
    from petsc_fs.solver import Result, Solver

TOTALS = ("iterations", "read_seconds", "setup_seconds", "solve_seconds")

EPILOG = """\
PETSc options follow the scene, for example
  -options_file FILE   an options file of yours, or the name of a shipped one
  -ksp_rtol 1e-6       relative tolerance
  -ksp_monitor         residual at each iteration
  -ksp_view            the solver tree
  -log_view            where time goes
  -help                what PETSc knows of the solver at hand

exit codes: 0 converged, by the residual of the system in the file; 1 not converged, or the solve
failed; 2 wrong call or option; 3 a scene that cannot be read or does not fit together"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`."""
    parser.epilog = EPILOG
    parser.add_argument("scene", metavar="SCENE", help="file, or name of a bundled one such as model1.h5")
    parser.add_argument(
        "--fields", type=learn_aliases, metavar="NAME=FIELD,...", help="other names of fields there: u=momentum,p=mass"
    )
    parser.add_argument("--report", type=Path, metavar="FILE.json", help="write what was done and measured")
    parser.add_argument("--save", type=Path, metavar="FILE.h5", help="write the solution, in the scene's numbering")
    parser.add_argument("--steps", metavar="A:B", help="of a sequence, solve these only; from 0, B excluded")
    parser.add_argument("--petscrc", action="store_true", help="let PETSc read .petscrc here and in the home folder")


@dataclass(frozen=True)
class Step:
    """One system to solve.

    Attributes:
        index: in its sequence; None for a scene.
        sizes: global number of unknowns of each field.
        rtol: relative tolerance that a run had it solved to, if it was no more than that.
        record: what the report has of it beside the solve.
    """

    index: int | None
    sizes: dict[str, int]
    rtol: float | None = None
    record: dict[str, Any] = field(default_factory=dict)

    def find(self, file: Any) -> contextlib.AbstractContextManager[Any]:
        """Its group in the open file."""
        return contextlib.nullcontext(file) if self.index is None else sequence.find_step(file, self.index)


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Solve what the arguments of `add_arguments` name, print a table and write what is asked for. Collective.

    Returns:
        0 if all steps converged, else 1.

    Raises:
        PetscFsError: a step cannot be read or solved, an option is wrong or did nothing, or a file cannot be written.
    """
    with together(comm):
        path = find_scene(args.scene)
        about, steps = _steps(path, args.steps)
        given = options.Given.of(petsc)
        check_targets(args.report, args.save, sources=(path, *given.files))
        if args.save is not None and len(steps) > 1:
            raise UsageError("--save: writes the solution of one step; choose it with --steps K")
        if given.files:
            options.fitting_file(str(given.files[0]), steps[0].sizes)
    given.start(petscrc=args.petscrc)
    smallest = not given.files or "pc_type" not in given.values
    player = Player(path, comm, smallest=smallest)
    args.close = player.close
    records = []
    warning = ""
    for step in _progress(steps, comm):
        records.append(player.play(step))
        if len(records) == 1:
            warning = given.judge(comm, player.left_out)
    report = about | {
        "ranks": comm.size,
        "converged": all(record["converged"] for record in records),
        "options_file": player.choice.file and player.choice.file.name if player.choice else given.files[0].name,
        "left_out": list(player.left_out),
        "options": options.database(),
        "versions": versions(),
        "memory_bytes": player.phases.report(comm),
    }
    if steps[0].index is None:
        report |= records[0]
    else:
        report |= {"steps": records, "totals": {total: sum(record[total] for record in records) for total in TOTALS}}
    solution = player.solution() if args.save is not None else None
    from petsc_fs.result import finite

    with together(comm):
        if comm.rank == 0 and args.report is not None:
            write_text(args.report, json.dumps(finite(report), indent=2, allow_nan=False) + "\n")
        if solution is not None and player.scene is not None:
            hdf5.write_solution(solution, args.save, player.scene)
    if comm.rank == 0:
        from petsc_fs.cli import tables

        if warning:
            print(f"petsc-fs: warning: {warning}", file=sys.stderr)
        print(tables.solve_table(report) if steps[0].index is None else tables.sequence_table(report), flush=True)
    return 0 if report["converged"] else 1


def _steps(path: Path, chosen: str | None) -> tuple[dict[str, Any], list[Step]]:
    """What the report says of a file, and what is to be solved of it. Local.

    Raises:
        UsageError: there are no such steps.
        SceneError: the file is no scene and no sequence.
    """
    if not sequence.is_sequence(path):
        if chosen is not None:
            raise UsageError(f"--steps: {path} is no sequence")
        return {"scene": path.name}, [Step(None, hdf5.read_sizes(path)[1])]
    contents = sequence.read_contents(path)
    numbers = range(len(contents.steps)) if chosen is None else sequence.parse_steps(chosen, len(contents.steps))
    steps = []
    for step in (contents.steps[k] for k in numbers):
        known = {name: getattr(step, name) for name in ("time_step_index", "newton_index", "contact_states")}
        record = {"step": step.index, **known, "unknowns": sum(step.sizes.values())}
        record["iterations_in_run"] = step.run.get("iterations")
        steps.append(Step(step.index, step.sizes, step.run.get("forcing"), record))
    about = {"sequence": path.name, "model": contents.model, "complete": contents.complete}
    return about | {"steps_in_sequence": len(contents.steps)}, steps


class Player:
    """Solves steps one after the other as a run does: where only values change, the solver is kept.

    Attributes:
        scene: the part of this rank of the last step, without its blocks.
        result: of the last step.
        choice: the smallest solver for the steps so far, where the caller gives none.
        phases: memory by phase.
    """

    def __init__(self, path: Path, comm: MPI.Intracomm, *, smallest: bool) -> None:
        """Nothing is read yet.

        Args:
            path: of the scene or sequence.
            comm: communicator.
            smallest: whether the solver is chosen by the scene; else its options must be in PETSc's database.
        """
        self.path, self.comm, self.smallest = path, comm, smallest
        self.scene: Scene | None = None
        self.result: Result | None = None
        self.solver: Solver | None = None
        self.choice: Choice | None = None
        self.phases = Phases()
        self._facts: Facts | None = None
        self._inserted: tuple[str, ...] = ()
        self._layout: Layout | None = None

    @property
    def left_out(self) -> tuple[str, ...]:
        """What of the canonical solver is not there, a line each."""
        return () if self.choice is None else self.choice.left_out

    def play(self, step: Step) -> dict[str, Any]:
        """Read and solve one step; what the report has of it. Collective.

        Raises:
            PetscFsError: the step cannot be read, or PETSc failed.
        """
        started = time.perf_counter()
        scene, layout = self._read(step)
        read_seconds = time.perf_counter() - started
        self.phases.end("read")
        sizes = {f: layout.sizes(f)[1] for f in layout.fields}
        try:
            result = self._solve(scene, layout, step.rtol)
        except PetscFsError as e:
            if step.index is None:
                raise
            raise type(e)(f"step {step.index}: {e}") from e
        meta = scene.metadata
        about = {name: getattr(meta, name) for name in ("model", "time_step_index", "newton_index")}
        known = {"dimension": scene.dimension, "fields": sizes, **about} if step.index is None else {}
        return step.record | known | {"read_seconds": read_seconds, **result.report()}

    def _read(self, step: Step) -> tuple[Scene, Layout]:
        """The part of this rank of one step; cells stay on their ranks as long as the fields keep their sizes."""
        from petsc_fs.io.reader import read_distributed
        from petsc_fs.partition import chosen

        layout = self._layout
        if layout is not None and {f: layout.sizes(f)[1] for f in layout.fields} != step.sizes:
            layout = None
            self._forget_solver()
        how = chosen()
        self.scene, self._layout = read_distributed(self.path, self.comm, *how, layout=layout, find=step.find)
        return self.scene, self._layout

    def _solve(self, scene: Scene, layout: Layout, rtol: float | None) -> Result:
        from petsc_fs.solver import Solver

        if self.smallest:
            self._choose(scene)
        if self.solver is None:
            self.solver = Solver(scene, self.comm, layout=layout, release=True)
        else:
            self.solver.update(scene)
        self.phases.end("build")
        self.solver.set_up()
        self.phases.end("set-up")
        self.result = self.solver.solve(rtol)
        self.phases.end("solve")
        return self.result

    def _choose(self, scene: Scene) -> None:
        """Have the options of the smallest solver in PETSc's database, for what the steps have shown so far."""
        facts = options.Facts.of(scene, self.comm)
        if self._facts is not None and self._facts.fields == facts.fields:
            facts = facts.or_either(self._facts)
        if facts != self._facts:
            self._forget_solver()
            options.delete_all(self._inserted)
            self._facts, self.choice = facts, options.choose(facts)
            self._inserted = options.insert_all(self.choice.values)

    def solution(self) -> dict[str, Any] | None:
        """All rows of the last step's solution, on rank 0. Collective."""
        assert self.solver is not None and self.result is not None
        found: dict[str, Any] | None = self.solver.system.gather(self.result.solution)
        return found

    def close(self) -> None:
        """Free PETSc's objects, at the same time on all ranks. Collective."""
        self._forget_solver()
        self.result = None
        gc.collect()

    def _forget_solver(self) -> None:
        if self.solver is not None:
            self.solver.destroy()
            self.solver = None


def _progress(steps: list[Step], comm: MPI.Intracomm) -> Iterator[Step]:
    """The steps, with their number on rank 0's terminal where there are several."""
    show = comm.rank == 0 and len(steps) > 1 and sys.stderr.isatty()
    for k, step in enumerate(steps, start=1):
        if show:
            print(
                f"\rstep {k} of {len(steps)}", end="\r" if k < len(steps) else "\r\x1b[K", file=sys.stderr, flush=True
            )
        yield step
