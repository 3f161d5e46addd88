"""Solve all steps of a sequence in order, with one solver that is updated from step to step as in a run."""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petsc_fs import options
from petsc_fs.cli import main as cli
from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.io import sequence
from petsc_fs.io.files import write_text
from petsc_fs.partition import Layout
from petsc_fs.pattern import UnionPattern
from petsc_fs.tree import Facts, Tree, shipped_tree

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.io.sequence import Contents, Step
    from petsc_fs.scene import Scene
    from petsc_fs.solver import Result, Solver

TOTALS = ("iterations", "read_seconds", "setup_seconds", "solve_seconds")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """What `petsc-fs solve` does with a sequence. Collective.

    Returns:
        0 if all steps converged, else 1.

    Raises:
        PetscFsError: as `petsc-fs solve` has them.
    """
    with together(comm):
        path = cli.find_scene(args.scene)
        contents = sequence.read_contents(path)
        chosen = contents.steps
        if args.steps is not None:
            chosen = tuple(chosen[k] for k in sequence.parse_steps(args.steps, len(chosen)))
        cli.check_folders(args.report, args.save)
        if args.save is not None and len(chosen) > 1:
            raise UsageError("--save: writes the solution of one step; choose it with --steps K")
        petsc, file = cli.with_options_file(petsc, tuple(chosen[0].sizes))
    given = cli.GivenOptions.start_petsc(petsc, file)
    player = Player(path, comm, smallest_tree=file is None)
    records = []
    for step in _progress(chosen, comm):
        records.append(player.play(step))
        if len(records) == 1:
            with together(comm):
                given.refuse_unused(player.tree)
    player.save(args.save)
    player.close()
    report = _report(path.name, contents, records, file=file, tree=player.tree, ranks=comm.size)
    with together(comm):
        if comm.rank == 0 and args.report is not None:
            write_text(args.report, json.dumps(report, indent=2) + "\n")
    if comm.rank == 0:
        from petsc_fs.cli.tables import replay_table

        print(replay_table(report), flush=True)
    return 0 if report["converged"] else 1


class Player:
    """Solves steps one after the other as a run does.

    From step to step only values change. Patterns are united, and where that does not help because an entry is new,
    the solver makes its matrices anew. Where the fields have other sizes, there is a new solver.

    Attributes:
        tree: the smallest solver for the steps so far, where no options file is used.
    """

    def __init__(self, path: Path, comm: MPI.Intracomm, *, smallest_tree: bool) -> None:
        """Nothing is read yet.

        Args:
            path: of the sequence.
            comm: communicator.
            smallest_tree: whether the solver is cut from the canonical file; else the options of one must be in
                PETSc's database.
        """
        self.path = path
        self.comm = comm
        self.solver: Solver | None = None
        self.result: Result | None = None
        self.tree: Tree | None = None
        self._cut = smallest_tree
        self._facts: Facts | None = None
        self._inserted: tuple[str, ...] = ()
        self._union = UnionPattern()
        self._layout: Layout | None = None

    def play(self, step: Step) -> dict[str, Any]:
        """Read and solve one step; what the report has of it. Collective.

        Raises:
            SceneError: the step cannot be read.
            SolveError: PETSc failed.
        """
        started = time.perf_counter()
        scene, layout = self._read(step)
        read_seconds = time.perf_counter() - started
        try:
            result = self._solve(scene, layout, step.run.get("forcing"))
        except PetscFsError as e:
            raise type(e)(f"step {step.index}: {e}") from e
        return {
            "step": step.index,
            "time_step_index": step.time_step_index,
            "newton_index": step.newton_index,
            "unknowns": sum(step.sizes.values()),
            "contact_states": step.contact_states,
            "iterations_in_run": step.run.get("iterations"),
            "read_seconds": read_seconds,
            **result.report(),
        }

    def _read(self, step: Step) -> tuple[Scene, Layout]:
        """The part of this rank of one step; cells stay on their ranks as long as the fields keep their sizes."""
        from petsc4py import PETSc

        from petsc_fs.io.reader import read_distributed
        from petsc_fs.partition import chosen

        layout = self._layout
        if layout is not None and {f: layout.sizes(f)[1] for f in layout.fields} != step.sizes:
            layout = None
        scene, self._layout = read_distributed(
            self.path,
            self.comm,
            *chosen(),
            layout=layout,
            index_type=PETSc.IntType,
            find=lambda file: sequence.find_step(file, step.index),
        )
        return scene, self._layout

    def save(self, target: Path | None) -> None:
        """Write the solution of the last step. Collective."""
        if target is None:
            return
        from petsc_fs.io import hdf5

        if self.solver is None or self.result is None:
            return
        everything = self.solver.system.gather(self.result.solution)
        with together(self.comm):
            if everything is not None:
                hdf5.write_solution(everything, target, self.solver.scene)

    def close(self) -> None:
        """Free PETSc's objects, at the same time on all ranks. Collective."""
        from petsc_fs.solver import collect_garbage

        self._forget_solver()
        self.result = None
        gc.collect()
        collect_garbage(self.comm)

    def _solve(self, scene: Scene, layout: Layout, rtol: float | None) -> Result:
        from petsc_fs.solver import Solver

        if self._cut:
            self._choose(scene)
        if self.solver is not None:
            known = self.solver.layout
            if {f: known.sizes(f)[1] for f in known.fields} != {f: n for f, n in scene.sizes.items() if n}:
                self._forget_solver()
        if self.solver is None:
            self._union = UnionPattern()
        with together(self.comm):
            scene = self._union.fit(scene)
        if self.solver is None:
            self.solver = Solver(scene, self.comm, layout=layout)
        else:
            self.solver.update(scene)
        self.result = self.solver.solve(rtol)
        return self.result

    def _choose(self, scene: Scene) -> None:
        """Have the options of the smallest solver in PETSc's database, for what the steps have shown so far."""
        facts = Facts.of(scene, self.comm).for_all_contact_states()
        if self._facts is not None:
            facts = facts.or_either(self._facts)
        if facts == self._facts:
            return
        self._forget_solver()
        options.delete_all(self._inserted)
        self.tree = shipped_tree(facts)
        self._inserted = options.insert_all(self.tree.options)
        self._facts = facts

    def _forget_solver(self) -> None:
        if self.solver is not None:
            self.solver.destroy()
            self.solver = None


def _progress(steps: Sequence[Step], comm: MPI.Intracomm) -> Iterable[Step]:
    """The steps, with a bar that runs along where rank 0 has a terminal."""
    if comm.rank or not sys.stderr.isatty():
        return steps
    from rich.console import Console
    from rich.progress import track

    return track(steps, "replay", console=Console(stderr=True), transient=True)


def _report(
    name: str, contents: Contents, records: list[dict[str, Any]], *, file: Path | None, tree: Tree | None, ranks: int
) -> dict[str, Any]:
    """What --report writes and the table shows. Local."""
    return {
        "sequence": name,
        "model": contents.model,
        "complete": contents.complete,
        "steps_in_sequence": len(contents.steps),
        "ranks": ranks,
        "converged": all(record["converged"] for record in records),
        "totals": {total: sum(record[total] for record in records) for total in TOTALS},
        "steps": records,
        "options_file": None if file is None else file.name,
        "left_out": [] if tree is None else [str(part) for part in tree.left_out],
        "options": cli.database(),
        "versions": cli.versions(),
    }
