"""The process that `petsc_fs.bench` starts: it solves one scene or sequence by several options files in turns.

Run as `mpiexec -n RANKS python -m petsc_fs.bench_probe JOB.json EVENTS`. Rank 0 appends one JSON object per line, as
soon as there is something to say, so that what was measured before a crash is kept. See `petsc_fs.bench` for what
the objects hold.
"""

from __future__ import annotations

import cProfile
import ctypes
import gc
import json
import os
import pstats
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import memory, options
from petsc_fs.compare import split_petsc
from petsc_fs.errors import PetscFsError
from petsc_fs.replay import Player

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.layout import Layout
    from petsc_fs.scene import Scene
    from petsc_fs.sequence import Step

STREAM_DOUBLES = 1 << 23
"""Length of the vectors of the bandwidth test on each rank: 64 MiB each, more than any cache holds."""

STREAM_RUNS = 7

WARM_UP_STEPS = 3
"""Of a sequence: so many that a solver has been updated."""

GMRES_RESTART = 30
"""PETSc's default."""

COMPILED = re.compile(r"petsc4py|mpi4py|h5py|_hl[/.]")
"""What cProfile calls functions of PETSc, MPI and HDF5, with what they call in turn."""

Record = dict[str, Any]


def main() -> int:
    """Run the job that the command line names. Collective on all ranks."""
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    import petsc4py

    petsc4py.init(["petsc-fs", "-options_left", "no"])
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    memory.return_freed()
    for module in ("petsc_fs.solver", "petsc_fs.pc"):
        import_module(module)  # which the first solve would be charged with, and compiling them

    def write(record: Record) -> None:
        if comm.rank == 0:
            with open(sys.argv[2], "a", encoding="utf-8") as events:
                events.write(json.dumps(record) + "\n")

    write({"kind": "machine", "bandwidth": bandwidth(comm)})
    kept = Kept(Path(job["input"]), comm)
    write({"kind": "input", **kept.describe()})
    for number in range(-1, job["repeat"]):
        files = job["files"][number % len(job["files"]) :] + job["files"][: number % len(job["files"])]
        for file in files:
            write({"kind": "start", "file": file, "round": number})
            write({"file": file, "round": number, **_measure(kept, file, job, warm_up=number < 0)})
    write({"kind": "done"})
    return 0


class Kept:
    """A scene, or the steps of a sequence, in memory on the ranks that solve them, in each distribution asked for.

    Attributes:
        steps: of a sequence; empty for a scene.
        scenes: rows of this rank of each step, or of the scene.
        layout: of the rows.
    """

    def __init__(self, path: Path, comm: MPI.Intracomm) -> None:
        """Read everything. Collective."""
        from petsc_fs import sequence

        self.path, self.comm = path, comm
        self.steps: tuple[Step, ...] = sequence.read_contents(path).steps if sequence.is_sequence(path) else ()
        self._known: dict[tuple[str, str], tuple[list[Scene], Layout]] = {}
        self.scenes: list[Scene]
        self.layout: Layout
        self.distribute()

    def distribute(self) -> None:
        """Have the rows where and in the order the options database says; reads them unless it did. Collective."""
        from petsc_fs.partition import chosen

        choice = chosen()
        if choice not in self._known:
            self._known[choice] = self._read(*choice)
        self.scenes, self.layout = self._known[choice]

    def _read(self, kind: str, ordering: str) -> tuple[list[Scene], Layout]:
        from petsc4py import PETSc

        from petsc_fs import sequence
        from petsc_fs.distributed_reader import read_distributed

        finders: Sequence[Any] = [lambda file, k=step.index: sequence.find_step(file, k) for step in self.steps]
        scenes: list[Scene] = []
        layout: Layout | None = None
        for find in finders or [nullcontext]:
            scene, layout = read_distributed(
                self.path, self.comm, kind, ordering, layout=layout, index_type=PETSc.IntType, find=find
            )
            scenes.append(scene)
        assert layout is not None
        return scenes, layout

    def describe(self) -> Record:
        """Sizes and entries, of the first step. Collective."""
        scene = self.scenes[0]
        entries = {f"{r} {c}": self.comm.allreduce(b.data.size) for (r, c), b in sorted(scene.blocks.items())}
        return {
            "model": scene.metadata.model,
            "dimension": scene.dimension,
            "sizes": scene.sizes,
            "entries": entries,
            "steps": len(self.steps),
        }


class KeptPlayer(Player):
    """Replays steps that are in memory already."""

    def __init__(self, kept: Kept) -> None:
        super().__init__(kept.path, kept.comm, smallest_tree=False)
        self._kept = kept

    def _read(self, step: Step) -> tuple[Scene, Layout]:
        place = self._kept.steps.index(step)
        return replace(self._kept.scenes[place]), self._kept.layout


def _measure(kept: Kept, file: str, job: Record, *, warm_up: bool) -> Record:
    """Solve once by one options file; what there is to say of it. Collective."""
    name, more = entry(file)
    chosen = {**options.parse(options.find_options_file(name)), **more, **job["options"]}
    known = set(options.unused())
    if warm_up:
        chosen |= dict.fromkeys(_statistics_options(chosen), "1")
    inserted = options.insert_all(chosen)
    kept.distribute()
    gc.collect()
    memory.reset_peak()
    before = memory.held()
    profile = cProfile.Profile(time.process_time) if warm_up else None
    try:
        with captured() as printed:
            if profile is not None:
                profile.enable()
            solved = _replay(kept, WARM_UP_STEPS if warm_up else None) if kept.steps else _solve(kept)
            if profile is not None:
                profile.disable()
        record: Record = {"kind": "warm-up" if warm_up else "solved", **solved}
    except PetscFsError as e:
        record = {"kind": "failed", "message": " ".join(str(e).split())}
    finally:
        useless = sorted(set(options.refused(options.unused())) - known)
        options.delete_all(inserted)
    grown = kept.comm.allgather(memory.peak() - before)
    if record["kind"] != "failed" and useless and warm_up:
        record = {"kind": "failed", "message": f"option -{useless[0]} was not used"}
    record["peak_bytes"] = grown
    if warm_up and profile is not None and record["kind"] == "warm-up":
        record["restart"] = int(chosen.get("ksp_gmres_restart") or GMRES_RESTART)
        record |= {"hierarchies": read_hierarchies(printed()), "python_share": python_share(pstats.Stats(profile))}
    return record


def _solve(kept: Kept) -> Record:
    """Set up and solve a scene. Collective."""
    from mpi4py import MPI

    from petsc_fs.solver import Solver

    comm = kept.comm
    comm.Barrier()
    wall, cpu = time.perf_counter(), time.process_time()
    solver = Solver(replace(kept.scenes[0]), comm, layout=kept.layout)
    try:
        solver.set_up()
        wall_setup, cpu_setup = time.perf_counter() - wall, time.process_time() - cpu
        result = solver.solve()
        cpu_solve = time.process_time() - cpu - cpu_setup
    finally:
        solver.destroy()
    seconds = np.array([wall_setup, result.solve_seconds, cpu_setup, cpu_solve])
    comm.Allreduce(MPI.IN_PLACE, seconds, op=MPI.MAX)
    return {
        "iterations": result.iterations,
        "solves": 1,
        "converged": result.converged,
        "true_residual": result.true_relative_residual,
        "wall": {"setup": seconds[0], "solve": seconds[1]},
        "cpu": {"setup": seconds[2], "solve": seconds[3]},
    }


def _replay(kept: Kept, first: int | None) -> Record:
    """Set up and solve the first steps of a sequence, or all of them. Collective."""
    from mpi4py import MPI

    player = KeptPlayer(kept)
    found = []
    cpu = time.process_time()
    try:
        for step in kept.steps[:first]:
            found.append(player.play(step))
        cpu = time.process_time() - cpu
    finally:
        player.close()
    setup, solve = (sum(record[f"{phase}_seconds"] for record in found) for phase in ("setup", "solve"))
    seconds = np.array([setup, solve, cpu])
    kept.comm.Allreduce(MPI.IN_PLACE, seconds, op=MPI.MAX)
    share = seconds[0] / (seconds[0] + seconds[1])
    return {
        "iterations": sum(record["iterations"] for record in found),
        "iterations_by_step": [record["iterations"] for record in found],
        "solves": len(found),
        "converged": all(record["converged"] for record in found),
        "true_residual": max(record["true_relative_residual"] for record in found),
        "wall": {"setup": seconds[0], "solve": seconds[1]},
        # the processor's seconds of a replay are known in all, and divided as those by the clock
        "cpu": {"setup": seconds[2] * share, "solve": seconds[2] * (1 - share)},
    }


def bandwidth(comm: MPI.Intracomm) -> float:
    """Bytes per second that all ranks together move in STREAM's triad, w = a x + y; the best of some runs.

    PETSc's VecWAXPY does it; 24 bytes are counted for each entry, as STREAM does (J. D. McCalpin, "Memory bandwidth and
    machine balance in current high performance computers", 1995). Collective. By processor time, which is that of the
    clock where the machine does nothing else.
    """
    from mpi4py import MPI
    from petsc4py import PETSc

    x, y, w = (PETSc.Vec().createMPI((STREAM_DOUBLES, None), comm=comm) for _ in range(3))
    x.set(1.0)
    y.set(2.0)
    best = np.inf
    for _ in range(STREAM_RUNS):
        comm.Barrier()
        started = time.process_time()
        w.waxpy(3.0, x, y)
        best = min(best, comm.allreduce(time.process_time() - started, op=MPI.MAX))
    for vector in (x, y, w):
        vector.destroy()
    return 24.0 * STREAM_DOUBLES * comm.size / best


def python_share(profile: pstats.Stats) -> float:
    """Part of the profiled time that is not spent in compiled functions of PETSc, MPI and HDF5."""
    times: dict[tuple[str, int, str], float] = {k: v[2] for k, v in profile.stats.items()}  # type: ignore[attr-defined]
    compiled = sum(seconds for (where, _, name), seconds in times.items() if COMPILED.search(f"{where} {name}"))
    whole = sum(times.values())
    return 1 - compiled / whole if whole else 0.0


def _statistics_options(chosen: Record) -> Iterator[str]:
    """Options that make BoomerAMG print its hierarchies."""
    for name, value in chosen.items():
        if name.endswith("pc_type") and value == "hypre":
            yield name.removesuffix("pc_type") + "pc_hypre_boomeramg_print_statistics"


def entry(text: str) -> tuple[str, dict[str, str | None]]:
    """Options file, and further options that win over it, from "FILE -option value ..."."""
    name, *words = shlex.split(text)
    return name, split_petsc(words)[1]


TITLE = "Operator Matrix Information:"
OPERATOR = re.compile(r"^\s*\d+\s+(\d+)\s+(\d+)\s+[\d.]+\s+\d+\s+\d+\s+[\d.]+(?:\s+\S+){2}\s*$", re.MULTILINE)
MEMORY = re.compile(r"^\s*memory = ([\d.]+)", re.MULTILINE)
SWEEPS = re.compile(r"Number of sweeps:\s+(\d+)\s+(\d+)")
TYPES = re.compile(r"Type 0=Jac.*:\s+(\d+)\s+(\d+)")


def read_hierarchies(printed: str) -> list[Record]:
    """What hypre prints of each multigrid that is set up.

    Returns:
        Per hierarchy `levels`, rows and entries of each; `memory`, hypre's memory complexity: entries of all operators
        and interpolations over those of the finest operator; `sweeps` and `relaxation`, number and hypre's type of
        the smoothers on the way down and up.
    """
    found = []
    for part in printed.split(TITLE)[1:]:
        table = part.split("Interpolation Matrix Information:")[0]
        memory_complexity, sweeps, types = MEMORY.search(part), SWEEPS.search(part), TYPES.search(part)
        found.append(
            {
                "levels": [(int(m[1]), int(m[2])) for m in OPERATOR.finditer(table)],
                "memory": float(memory_complexity[1]) if memory_complexity else 0.0,
                "sweeps": [int(n) for n in sweeps.groups()] if sweeps else [1, 1],
                "relaxation": [int(n) for n in types.groups()] if types else [6, 6],
            }
        )
    return found


@contextmanager
def captured() -> Iterator[Callable[[], str]]:
    """What Python and C write to standard output in the block; to be asked for after it."""
    text = ""
    sys.stdout.flush()
    saved = os.dup(1)
    with tempfile.TemporaryFile("w+", errors="replace") as file:
        os.dup2(file.fileno(), 1)
        try:
            yield lambda: text
        finally:
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
            os.dup2(saved, 1)
            os.close(saved)
            file.seek(0)
            text = file.read()


if __name__ == "__main__":
    sys.exit(main())
