"""The process that `petsc_fs.tools.measure` starts: it solves what a job says, and writes what it finds.

Run as `mpiexec -n RANKS python -m petsc_fs.tools.probe JOB.json EVENTS`. An event is a JSON object on a line: a
finished record (with a `kind`, see `petsc_fs.tools.measure`), further entries of the record with number `supplement`,
or else where the process is (`phase`).
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from petsc_fs import memory, options
from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.tools.measure import DEATH_SIGNAL, MEMORY, Job, Path_, Record

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.partition import Layout
    from petsc_fs.scene import Scene
    from petsc_fs.solver import Result, Solver

Value = TypeVar("Value")

SECONDS_TO_AGREE = 5.0
"""How long a rank that failed waits for the others to fail."""
WARM_UP_STEPS = 2
"""Of a sequence: so many that a solver has been updated."""


def main() -> int:
    """Run the job that the command line names. Collective on all ranks."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)  # no rank outlives mpiexec
    job = Job(**json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    import petsc4py

    petsc4py.init(["petsc-fs", "-skip_petscrc", "-options_left", "no"])
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    if job.memory_limit is not None:
        resource.setrlimit(resource.RLIMIT_AS, (job.memory_limit, job.memory_limit))
    memory.return_freed()
    log = Log(Path(sys.argv[2]), comm)
    try:
        for scene in job.scenes:
            if not Probe(job, scene, comm, log).run() and not job.keep_going:
                break
        log.phase("done")
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        comm.Abort(70)  # the other ranks may be waiting for this one
    return 0


class Log:
    """Events of this process; rank 0 writes them."""

    def __init__(self, path: Path, comm: MPI.Intracomm) -> None:
        self._path, self._writes = path, comm.rank == 0
        self.where: Record = {}
        self.records = 0

    def phase(self, phase: str, **where: Any) -> None:
        """Say what is about to be done. Local."""
        self.where = {**self.where, **where, "phase": phase}
        self.write(self.where)

    def record(self, record: Record) -> int:
        """Write a record; its number. Local."""
        self.write(self.where | record)
        self.records += 1
        return self.records - 1

    def last_words(self, record: Record) -> None:
        """Write a record and the end of it all, from any rank. Local."""
        self._writes = True
        self.write(self.where | record, {"phase": "done"})

    def write(self, *events: Record) -> None:
        """Write a line for each event, at once. Local."""
        if self._writes:
            with self._path.open("a", encoding="utf-8") as file:
                file.write("".join(json.dumps(event) + "\n" for event in events))


class Probe:
    """One scene or sequence of a job, on all ranks."""

    def __init__(self, job: Job, scene: Path_, comm: MPI.Intracomm, log: Log) -> None:
        self.job, self.path, self.comm, self.log = job, Path(scene), comm, log
        self.rtols: Sequence[float | None] = job.rtols or (None,)
        self.inserted: tuple[str, ...] = ()
        self.steps: list[tuple[Scene, Layout, float | None]] = []  # with the tolerance that the run had
        self.solver: Solver | None = None
        self.truth: tuple[Scene, Mapping[str, Any] | None] | None = None  # with the reference; on rank 0, once needed

    def run(self) -> bool:
        """Measure all repetitions; whether all ended by a verdict. Collective."""
        self.log.phase("read", scene=os.fspath(self.path), repetition=0, rtol=self.rtols[0])
        try:
            self._read()
            fine = all(self._repeat(k) for k in range(-1 if self.job.warm_up else 0, self.job.repetitions))
        except (PetscFsError, MemoryError) as e:
            if not self._all_failed():
                self.log.last_words(_explain(e))
                self.comm.Abort(1)
            self.log.record(_explain(e))
            fine = False
        self._forget()
        options.delete_all(self.inserted)
        return fine

    def _all_failed(self) -> bool:
        """Whether all ranks come here soon, or else others wait for this one in vain."""
        request, deadline = self.comm.Ibarrier(), time.monotonic() + SECONDS_TO_AGREE
        while not request.Test():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def _timed(self, action: Callable[[], Value]) -> tuple[Value, tuple[float, float]]:
        """What an action gives, and its seconds by the clock and of the processor, the slowest rank's. Collective."""
        from mpi4py import MPI

        self.comm.Barrier()
        wall, cpu = time.perf_counter(), time.process_time()
        value = action()
        taken = time.perf_counter() - wall, time.process_time() - cpu
        return value, (self.comm.allreduce(taken[0], op=MPI.MAX), self.comm.allreduce(taken[1], op=MPI.MAX))

    def _read(self) -> None:
        """Put the options for the scene into the database, and read it, or all steps. Collective."""
        from petsc_fs.io import hdf5, sequence

        with together(self.comm):
            steps = sequence.read_contents(self.path).steps if sequence.is_sequence(self.path) else ()
            self.inserted = options.insert_all(
                self._options(steps[0].sizes if steps else hdf5.read_sizes(self.path)[1])
            )
        self.is_sequence = bool(steps)
        self.steps, self.read_seconds = self._timed(lambda: self._read_steps(steps))
        memory.reset_peak()
        self.base = self.comm.allgather(memory.held())

    def _read_steps(self, steps: Sequence[Any]) -> list[tuple[Scene, Layout, float | None]]:
        """The scene, or all of its steps; cells stay on their ranks as long as fields keep their sizes. Collective."""
        from petsc_fs.io import sequence
        from petsc_fs.io.reader import read_distributed
        from petsc_fs.partition import chosen

        found: list[tuple[Scene, Layout, float | None]] = []
        layout: Layout | None = None
        for step in steps or [None]:
            find: Any = nullcontext if step is None else partial(sequence.find_step, step=step.index)
            if step is not None and layout is not None and _sizes(layout) != {f: n for f, n in step.sizes.items() if n}:
                layout = None
            scene, layout = read_distributed(self.path, self.comm, *chosen(), layout=layout, find=find)
            found.append((scene, layout, None if step is None else step.run.get("forcing")))
        return found

    def _options(self, sizes: Mapping[str, int]) -> dict[str, str | None]:
        """The job's options, which win over those of its file. Local."""
        file, rtols = self.job.options_file, self.job.rtols
        found = {} if file is None else options.parse(options.fitting_file(os.fspath(file), sizes))
        exact = {"ksp_rtol": f"{min(rtols):g}", "ksp_atol": "0"} if rtols else {}
        return {**found, **self.job.options, **exact}

    def _repeat(self, repetition: int) -> bool:
        """Set up and solve for each tolerance, step by step; whether all options were used. Collective.

        Repetition -1 is a warm-up, without records.
        """
        self._forget()
        steps, rtols = self.steps, self.rtols
        if repetition < 0:
            steps, rtols = steps[:WARM_UP_STEPS], rtols[:1]
        sums: dict[float | None, Record] = {rtol: {} for rtol in rtols}
        solved: list[tuple[int, Any]] = []
        for k, (scene, layout, forcing) in enumerate(steps):
            self.log.phase("set-up", repetition=max(repetition, 0), rtol=self.rtols[0])
            solver, build = self._timed(partial(self._build, scene, layout))
            _, rest = self._timed(solver.set_up)
            for rtol in rtols:
                self.log.phase("solve", rtol=rtol)
                result, solve = self._timed(partial(solver.solve, forcing if rtol is None else rtol))
                sums[rtol] = _worst(sums[rtol], self._describe(result, build, rest, solve))
                if repetition < 0 or k + 1 < len(steps):
                    continue
                useless = self._useless()
                what = {"kind": "unused_option", "message": useless} if useless else {}
                number = self.log.record(sums[rtol] | what)
                if useless:
                    return False
                if self.job.errors and not self.is_sequence:
                    solved.append((number, solver.system.gather(result.solution)))
        if solved:
            self._compute_errors(solved)
        return True

    def _build(self, scene: Scene, layout: Layout) -> Solver:
        """A solver with its matrices: the last step's, updated, where fields have the same sizes. Collective."""
        from petsc_fs.solver import Solver

        if self.solver is not None and _sizes(self.solver.layout) == _sizes(layout):
            self.solver.update(replace(scene))
        else:
            self._forget()
            self.solver = Solver(replace(scene), self.comm, layout=layout)
        return self.solver

    def _forget(self) -> None:
        if self.solver is not None:
            self.solver.destroy()
            self.solver = None

    def _describe(self, result: Result, *phases: tuple[float, float]) -> Record:
        """The record of one solve, by the seconds of building, of the rest of set-up and of the solve. Collective."""
        seconds = [
            {"read": read, "build": build, "setup": build + rest, "solve": solve}
            for read, build, rest, solve in zip(self.read_seconds, *phases, strict=True)
        ]
        return {
            "kind": verdict(result),
            "message": "" if result.converged else "; ".join(result.notes),
            "iterations": result.iterations,
            "reason": result.reason,
            "tolerance": result.tolerance,
            "seconds": seconds[0],
            "cpu_seconds": seconds[1],
            "true_residual": result.true_relative_residual,
            "residual_by_field": result.residual_by_field,
            "base_rss": self.base,
            "peak_rss": self.comm.allgather(memory.peak()),
        }

    def _useless(self) -> str:
        """What to say of options of the job that nothing on any rank asked for; "" if there are none. Collective."""
        idle = set.intersection(*map(set, self.comm.allgather(options.unused())))
        found = options.refused(sorted(idle & set(self.inserted)))
        if not found:
            return ""
        file = options.find_options_file(os.fspath(self.job.options_file)) if self.job.options_file else None
        return options.explain(found, self.job.options, file)

    def _compute_errors(self, solved: list[tuple[int, Any]]) -> None:
        """Forward and backward errors of solutions, each with the number of its record. Collective."""
        from petsc_fs.io import hdf5
        from petsc_fs.tools import reference

        self.log.phase("errors")
        with together(self.comm):
            if self.comm.rank == 0 and self.truth is None:
                file = self.job.references.get(os.fspath(self.path))
                self.truth = hdf5.read(self.path), None if file is None else reference.read(file).solution
            for number, solution in solved:
                if solution is not None and self.truth is not None:
                    self.log.write({"supplement": number, **_errors(*self.truth, solution)})


def _sizes(layout: Layout) -> dict[str, int]:
    return {f: layout.sizes(f)[1] for f in layout.fields if layout.sizes(f)[1]}


def _errors(scene: Scene, exact: Mapping[str, Any] | None, solution: Mapping[str, Any]) -> Record:
    """Backward errors of a solution, and forward errors where an exact one is known. Local."""
    from petsc_fs.tools.reference import backward_error, forward_error

    found: Record = {"backward_error": backward_error(scene, solution)}
    if exact is not None:
        total, by_field = forward_error(scene, exact, solution)
        found |= {"forward_error": total, "error_by_field": by_field}
    return found


def verdict(result: Result) -> str:
    """Kind of a solve that came to an end."""
    if result.converged:
        return "converged"
    blown_up = result.reason in ("DIVERGED_DTOL", "DIVERGED_NANORINF") or not result.true_relative_residual <= 1.0
    return "diverged" if blown_up else "stagnated"


def _worst(before: Record, now: Record) -> Record:
    """Two steps as one: sums of iterations and seconds, else what is of the worse one."""
    if not before:
        return now
    found = dict(max((before, now), key=lambda r: (r["kind"] != "converged", r["true_residual"])))
    found["iterations"] = before["iterations"] + now["iterations"]
    for clock in ("seconds", "cpu_seconds"):
        found[clock] = now[clock] | {k: before[clock][k] + now[clock][k] for k in ("build", "setup", "solve")}
    return found | {"peak_rss": now["peak_rss"]}


def _explain(error: Exception) -> Record:
    """Kind and message of a solve that came to no end."""
    message = " ".join(str(error).split())
    if isinstance(error, MemoryError) or MEMORY.search(message):
        kind = "out_of_memory"
    elif isinstance(error, UsageError):
        kind = "refused"
    elif "not finite" in message:
        kind = "diverged"
    else:
        kind = "failed"
    return {"kind": kind, "message": message or type(error).__name__}


if __name__ == "__main__":
    sys.exit(main())
