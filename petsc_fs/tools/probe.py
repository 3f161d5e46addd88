"""The process that `petsc_fs.tools.measure` starts: it solves what a job says, and writes what it finds, event by event.

Run as `mpiexec -n RANKS python -m petsc_fs.tools.probe JOB.json EVENTS`. An event is a JSON object on a line of its own: a
finished record (with a `kind`, see `petsc_fs.tools.measure`), further entries of the record with number `supplement`, or
else where the process is (`phase`).
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.tools.measure import MEMORY, Job, Record

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.scene import Scene
    from petsc_fs.solver import Result, Solver
    from petsc_fs.system import FieldArrays

SECONDS_TO_AGREE = 5.0
"""How long a rank that failed waits for the others to fail."""

DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of Linux: no rank outlives mpiexec."""


def main() -> int:
    """Run the job that the command line names. Collective on all ranks."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
    job = Job.from_json(Path(sys.argv[1]).read_text(encoding="utf-8"))
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    if job.memory_limit is not None:
        resource.setrlimit(resource.RLIMIT_AS, (job.memory_limit, job.memory_limit))
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
    """One scene of a job, on all ranks."""

    def __init__(self, job: Job, scene: str | os.PathLike[str], comm: MPI.Intracomm, log: Log) -> None:
        self.job, self.path, self.comm, self.log = job, Path(scene), comm, log
        self.rtols = job.rtols or (None,)
        self.inserted: list[str] = []
        self.judge: Judge | None = None  # on rank 0, once there are solutions

    def run(self) -> bool:
        """Measure all repetitions; whether all ended by a verdict on the residual. Collective."""
        self.log.phase("read", scene=os.fspath(self.path), repetition=0, rtol=self.rtols[0])
        try:
            self._read()
            if self.job.warm_up:
                self._warm_up()
            for repetition in range(self.job.repetitions):
                if not self._repeat(repetition):
                    return False
        except (PetscFsError, MemoryError) as e:
            if not self._all_failed():
                self.log.last_words(_explain(e))
                self.comm.Abort(1)
            self.log.record(_explain(e))
            return False
        finally:
            self._remove_options()
        return True

    def _all_failed(self) -> bool:
        """Whether all ranks come here soon, or else others wait for this one in vain."""
        request, deadline = self.comm.Ibarrier(), time.monotonic() + SECONDS_TO_AGREE
        while not request.Test():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def _read(self) -> None:
        """Put the options for the scene into the database, and read it. Collective."""
        from mpi4py import MPI
        from petsc4py import PETSc

        from petsc_fs import options
        from petsc_fs.io.reader import read_distributed
        from petsc_fs.partition import chosen

        with together(self.comm):
            self.given = self._options()
        self.comm.Barrier()
        started, cpu = MPI.Wtime(), time.process_time()
        self.scene, self.layout = read_distributed(self.path, self.comm, *chosen(), index_type=PETSc.IntType)
        self.read_seconds = self._slowest(MPI.Wtime() - started)
        self.read_cpu = self._slowest(time.process_time() - cpu)
        if self.job.options_file is None:
            self._insert(options.choose(options.Facts.of(self.scene, self.comm)).values)
        options.insert_all({"options_left": "no"})
        reset_peak()
        self.base = self.comm.allgather(resident())

    def _options(self) -> list[str]:
        """Put the job's options into the database, the file's after those that win over it; their names. Local."""
        from petsc_fs import options
        from petsc_fs.io import hdf5

        sizes = hdf5.read_sizes(self.path)[1]
        self._insert(self.job.options)
        if self.job.options_file is not None:
            file = options.find_options_file(os.fspath(self.job.options_file))
            header = options.read_header(file)
            if not header.fits(sizes):
                raise UsageError(f"{file.name} is not for the fields {', '.join(sizes)}")
            self._insert(options.parse(file))
        return list(self.inserted)

    def _insert(self, values: Any) -> None:
        from petsc4py import PETSc

        from petsc_fs import options

        there = PETSc.Options().getAll()
        self.inserted += [name for name in values if name not in there]
        options.insert_all(values)

    def _remove_options(self) -> None:
        from petsc4py import PETSc

        for name in self.inserted:
            PETSc.Options().delValue(name)

    def _set_up(self) -> tuple[Solver, float]:
        """A solver, and the seconds until it is set up. Collective."""
        from mpi4py import MPI

        from petsc_fs.solver import Solver

        self.comm.Barrier()
        started = MPI.Wtime()
        solver = Solver(self.scene, self.comm, layout=self.layout)
        solver.set_up()
        return solver, self._slowest(MPI.Wtime() - started)

    def _warm_up(self) -> None:
        """Set up and solve once, to the first tolerance. Collective."""
        self.log.phase("set-up")
        solver, _ = self._set_up()
        try:
            self.log.phase("solve")
            set_tolerance(solver, self.rtols[0])
            solver.solve()
        finally:
            solver.destroy()

    def _repeat(self, repetition: int) -> bool:
        """Set up once and solve for each tolerance; whether all options were used. Collective."""
        self.log.phase("set-up", repetition=repetition, rtol=self.rtols[0])
        cpu = time.process_time()
        solver, setup_seconds = self._set_up()
        setup_cpu = self._slowest(time.process_time() - cpu)
        monitor = Monitor(solver.ksp)
        solved: list[tuple[int, FieldArrays | None]] = []
        try:
            for rtol in self.rtols:
                self.log.phase("solve", rtol=rtol)
                set_tolerance(solver, rtol)
                self.comm.Barrier()
                cpu = time.process_time()
                watch = monitor.listener = Stopwatch()
                result = solver.solve()
                cpu = self._slowest(time.process_time() - cpu)
                monitor.listener = None
                useless = self._useless()
                number = self.log.record(
                    {
                        "kind": "unused_option" if useless else verdict(result),
                        "message": useless,
                        "iterations": result.iterations,
                        "reason": result.reason,
                        "limited_by_rounding": result.limited_by_rounding,
                        "tolerance": result.tolerance,
                        "read_seconds": self.read_seconds,
                        "setup_seconds": setup_seconds,
                        "solve_seconds": self._slowest(result.solve_seconds),
                        "cpu_seconds": setup_cpu + cpu,
                        "cpu_by_phase": {"read": self.read_cpu, "setup": setup_cpu, "solve": cpu},
                        "true_residual": result.true_relative_residual,
                        "residual_by_field": result.residual_by_field,
                        "base_rss": self.base,
                        "peak_rss": self.comm.allgather(peak()),
                        "fallback": result.fallback,
                        "direct": solver.ksp.getPC().getType() in ("lu", "cholesky"),
                    }
                )
                if useless:
                    return False
                solved.append((number, solver.system.gather(result.solution)))
            if self.job.errors or self.job.history:
                self._compute_errors(solved)
            if self.job.history and repetition == self.job.repetitions - 1:
                self.log.phase("history")
                self.log.write({"supplement": number, "history": self._history(solver, monitor, watch)})
        finally:
            solver.destroy()
        return True

    def _slowest(self, seconds: float) -> float:
        from mpi4py import MPI

        return float(self.comm.allreduce(seconds, op=MPI.MAX))

    def _useless(self) -> str:
        """What to say of options of the job that nothing asked for, on any rank; "" if there are none. Collective."""
        from petsc_fs import options

        names = options.refused([name for name in options.unused() if name in self.given])
        found = sorted(set().union(*self.comm.allgather(names)))
        if not found:
            return ""
        file = options.find_options_file(os.fspath(self.job.options_file)) if self.job.options_file else None
        return options.explain(found, self.job.options, file)

    def _compute_errors(self, solved: list[tuple[int, FieldArrays | None]]) -> None:
        """Forward and backward errors of solutions, each with the number of its record. Collective."""
        from petsc_fs.io import hdf5

        self.log.phase("errors")
        with together(self.comm):
            if self.comm.rank == 0 and self.judge is None:
                self.judge = Judge(hdf5.read(self.path), self.job.references.get(os.fspath(self.path)))
            for number, solution in solved:
                if solution is not None and self.judge is not None:
                    self.log.write({"supplement": number, **self.judge.errors(solution)})

    def _history(self, solver: Solver, monitor: Monitor, watch: Stopwatch) -> Record:
        """Errors and residuals by iteration, from one more solve; times from the one that was watched. Collective."""
        rows: list[Record] = []
        system = solver.system
        scale = system.b.norm() or 1.0

        def look(ksp: Any, number: int) -> None:
            if len(rows) >= len(watch.seconds) or number == 0 < len(rows):
                return  # a restart repeats the last iterate
            x = ksp.buildSolution()
            r = x.duplicate()
            system.J.mult(x, r)
            r.aypx(-1.0, system.b)
            by_field = {f: n / scale for f, n in system.field_norms(system.by_field(r)).items()}
            whole = system.gather(system.by_field(x))
            row = {"residual": float(np.linalg.norm(list(by_field.values()))), "residual_by_field": by_field}
            if whole is not None and self.judge is not None:
                row |= self.judge.errors(whole, backward=False)
            rows.append(row)
            r.destroy()

        monitor.listener = look
        solver.solve()
        monitor.listener = None
        table: Record = {"seconds": watch.seconds[: len(rows)], "cpu_seconds": watch.cpu_seconds[: len(rows)]}
        table |= {"residual": [row["residual"] for row in rows]}
        for name in ("residual_by_field", "error_by_field"):
            if rows and rows[0].get(name):
                table[name] = {f: [row[name][f] for row in rows] for f in rows[0][name]}
        if rows and rows[0].get("forward_error") is not None:
            table["forward_error"] = [row["forward_error"] for row in rows]
        return table


def set_tolerance(solver: Solver, rtol: float | None) -> None:
    """Make the relative tolerance the only one, unless it is None."""
    if rtol is not None:
        solver.ksp.setTolerances(rtol=rtol, atol=0.0)
        solver.rtol = solver.true_rtol = rtol


class Monitor:
    """Hands each iterate of a KSP to whoever listens."""

    def __init__(self, ksp: Any) -> None:
        """Join the monitors of the KSP, for as long as it lives."""
        self.listener: Callable[[Any, int], None] | None = None
        ksp.setMonitor(self._tell)

    def _tell(self, ksp: Any, number: int, norm: float) -> None:
        if self.listener is not None:
            self.listener(ksp, number)


class Stopwatch:
    """When each iterate of a KSP came to be: seconds since now by the clock, and of this rank's processor."""

    def __init__(self) -> None:
        """Start."""
        self.seconds: list[float] = []
        self.cpu_seconds: list[float] = []
        self._started, self._cpu = time.perf_counter(), time.process_time()

    def __call__(self, ksp: Any, number: int) -> None:
        """Note the time of an iterate; a restart repeats the last one."""
        if number or not self.seconds:
            self.seconds.append(time.perf_counter() - self._started)
            self.cpu_seconds.append(time.process_time() - self._cpu)


class Judge:
    """Computes the errors of solutions of one scene, on one rank."""

    def __init__(self, scene: Scene, reference: str | os.PathLike[str] | None) -> None:
        from petsc_fs.tools import reference as references

        self.scene = scene
        self.ruler = None if reference is None else references.ruler(scene, references.read(reference))

    def errors(self, solution: dict[str, Any], backward: bool = True) -> Record:
        """Forward errors where there is a reference, and backward errors if asked for."""
        from petsc_fs.tools.accuracy import backward_error, residual, row_magnitudes
        from petsc_fs.tools.conditioning import fieldwise_backward_error

        found: Record = {}
        if self.ruler is not None:
            errors = self.ruler.errors(solution)
            found |= {"forward_error": errors.total, "error_by_field": errors.by_field}
        if backward:
            known = (solution, residual(self.scene, solution), row_magnitudes(self.scene, solution))
            fieldwise = {"fieldwise": fieldwise_backward_error(self.scene, *known)}
            found["backward_error"] = backward_error(self.scene, *known) | fieldwise
        return found


def verdict(result: Result) -> str:
    """Kind of a solve that came to an end."""
    if result.converged:
        return "converged"
    blown_up = result.reason in ("DIVERGED_DTOL", "DIVERGED_NANORINF") or not result.true_relative_residual <= 1.0
    return "diverged" if blown_up else "stagnated"


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


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


def reset_peak() -> None:
    """Let `peak` count from now on, where the system can do that."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak() -> int:
    """Most bytes of this process that were ever in memory, or since `reset_peak`."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii") as file:
        for line in file:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    factor = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * factor


if __name__ == "__main__":
    sys.exit(main())
