"""One rank has whole scenes, the others help to solve them: PETSc's linear-solver server, for scenes.

A program that is serial, such as a simulator in Python, runs on rank 0. The other ranks wait in a loop for what
rank 0 asks of them, as with PETSc's own `-mpi_linear_solver_server` (PCMPI), which knows one matrix without fields.

    client = server.start()  # ranks other than 0 come back when rank 0 has called client.stop(), with None
    if client is not None:
        solver = ServedSolver(client, scene)  # as petsc_fs.solver.Solver
        result = solver.solve()  # result.solution has all rows
        solver.update(next_scene)
        client.stop()

Where a scene goes is decided once, by its partition. Each block is a PETSc matrix that is filled from the entries
rank 0 has (MatSetPreallocationCOO, and MatSetValuesCOO for new values): PETSc itself knows which goes where. Blocks
whose pattern has changed are laid out anew, the others only get values.
"""

from __future__ import annotations

import atexit
import math
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NoReturn

from mpi4py import MPI
from mpi4py.util import pkl5

from petsc_fs.errors import SolveError, UsageError, portable

if TYPE_CHECKING:
    from petsc_fs.partition import Layout
    from petsc_fs.result import Result
    from petsc_fs.scene import Scene

SECONDS_TO_AGREE = 5.0
"""How long a rank that failed waits for the others before it takes them for stuck."""

LEAST_ROWS = 3000
"""Default of -petsc_fs_least_rows: from twice as many unknowns on, set-up on two ranks takes no longer than on one."""

SHORTEST_NAP, LONGEST_NAP = 1e-5, 5e-3
"""Seconds between two looks for a message: the longest keeps a waiting rank below 1 % of a core."""


# Rank 0


class Client:
    """Rank 0's end of the server.

    Attributes:
        comm: communicator of all ranks.
        running: whether the other ranks listen.
    """

    def __init__(self, comm: MPI.Intracomm) -> None:
        """Use `start`, which lets the other ranks listen."""
        self.comm = comm
        self.running = True
        self.rank = _Rank(comm)
        self._handles = 0
        self._dropped: list[int] = []
        self._options: dict[str, str | None] | None = None

    def new_handle(self) -> int:
        """A number for one more solver."""
        self._handles += 1
        return self._handles

    def call(self, command: str, *args: Any, load: Any = None) -> Any:
        """Have all ranks do something, with the options database as it is here. Collective for those who listen.

        An interrupt from the keyboard has to wait until all ranks are through.

        Args:
            command: name of a method of `_Rank`.
            args: sent to all ranks.
            load: what only rank 0 gets.

        Raises:
            UsageError: the server is stopped.
            PetscFsError: the error of the lowest rank that had one, on rank 0.
        """
        if not self.running:
            raise UsageError("the server is stopped; petsc_fs.server.start() starts another one")
        with _interrupts_later():
            while self._dropped:
                self._send("drop", self._dropped.pop())
            options = _database()
            if options != self._options:
                self._send("set_options", options)
                self._options = options
            return self._send(command, *args, load=load)

    def share(self, function: Callable[[Any], Any], tasks: Sequence[Any]) -> list[Any]:
        """Have each rank apply a function to its task, and collect what comes of it. Collective for those who listen.

        Args:
            function: known to all ranks by its name.
            tasks: one for each rank.

        Raises:
            Exception: of the function, of the lowest rank that had one; of others than this as `portable` has it.
        """
        self.call("work", function, load=tasks)
        results: list[Any] = self.call("collect")
        return results

    def drop(self, handle: int) -> None:
        """Forget a solver on all ranks, at the next opportunity. Local: garbage collection may call it."""
        self._dropped.append(handle)

    def stop(self) -> None:
        """Let the other ranks go, once; collective with them. May be called twice."""
        global _client  # noqa: PLW0603
        if not self.running:
            return
        try:
            self._send("close")
        finally:
            self.running = False
            atexit.unregister(self.stop)
            if _client is self:
                _client = None

    def _send(self, command: str, *args: Any, load: Any = None) -> Any:
        for other in range(1, self.comm.size):
            self.rank.control.send((command, args), other)
        return self.rank.execute(command, args, load)


_client: Client | None = None


def start(comm: MPI.Intracomm | None = None) -> Client | None:
    """Start the server, where none is running. Collective.

    Rank 0 goes on at once; when its process ends, for whatever reason, the server stops by itself. The other ranks
    come back when it does.

    Args:
        comm: all ranks that take part, default MPI_COMM_WORLD.

    Returns:
        The client on rank 0, None on the other ranks.
    """
    global _client  # noqa: PLW0603
    if _client is not None:
        return _client
    import petsc_fs.pc
    import petsc_fs.solver  # noqa: F401  (what they do at exit comes after the stop, on all ranks alike)

    _restore_terminate()
    comm = comm or MPI.COMM_WORLD
    if comm.rank > 0:
        _serve(_Rank(comm))
        return None
    _client = Client(comm)
    atexit.register(_client.stop)
    return _client


def join() -> Client | None:
    """Start the server for the rest of the program: ranks other than 0 end here, when rank 0 does. Collective.

    Returns:
        The client; None where there is only one rank, which needs no server.
    """
    if MPI.COMM_WORLD.size == 1:
        return None
    client = start()
    if client is None:
        leave()
    return client


def leave() -> NoReturn:
    """End this process with exit code 0, as C's `exit` does: what stands after this in the program is for rank 0.

    `finally` clauses of the program are left out, PETSc and MPI end in good order. Collective.
    """
    from petsc4py import PETSc

    atexit._run_exitfuncs()
    PETSc._finalize()
    if not MPI.Is_finalized():
        MPI.Finalize()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


class ServedSolver:
    """`petsc_fs.solver.Solver` on all ranks, for scenes that rank 0 has. On rank 0 only.

    Attributes:
        layout: distribution of the rows.
        rebuilds: how often the solver was made anew because the fields or grids had changed.
        transfer_seconds: spent since the last update began on calling the ranks and bringing solutions back; what
            brings the values of a scene to them is building.
    """

    def __init__(self, client: Client, scene: Scene, *, prefix: str = "") -> None:
        """Distribute a scene and build the system; nothing is factored yet.

        Args:
            client: of a running server.
            scene: all rows.
            prefix: of all options of the solver.

        Raises:
            PetscFsError: see `petsc_fs.solver.Solver`.
        """
        self.prefix = prefix
        self.rebuilds = -1
        self._client = client
        self._handle = client.new_handle()
        self._sizes: dict[str, int] = {}
        self.layout: Layout
        self.update(scene)

    def update(self, scene: Scene) -> None:
        """Take another scene; the solver stays where fields and sizes do."""
        started = time.perf_counter()
        if scene.sizes != self._sizes or not self._client.rank.knows(self._handle):
            self.rebuilds += 1
            self._sizes = {}  # an error on the way leaves nothing to start from
            self.layout = self._client.call("build", self._handle, self.prefix, sum(scene.sizes.values()), load=scene)
            self._sizes = dict(scene.sizes)
        else:
            self._client.call("update", self._handle, load=scene)
        self.transfer_seconds = time.perf_counter() - started - self._client.rank.built_seconds(self._handle)

    def solve(
        self, rtol: float | None = None, *, error: float = math.inf, rounding: Mapping[str, float] | None = None
    ) -> Result:
        """Solve; see `petsc_fs.solver.Solver.solve`, also for the arguments.

        Returns:
            What the solve did; `solution` has all rows of each field in the scene's numbering.
        """
        result: Result
        result, solution, seconds = self._client.call("solve", self._handle, rtol, error, rounding)
        self.transfer_seconds += seconds
        return replace(result, solution=solution)

    def destroy(self) -> None:
        """Forget it on all ranks. May be called twice."""
        self._client.drop(self._handle)

    def __del__(self) -> None:
        self.destroy()


# All ranks


class _Rank:
    """What all ranks can do together; the methods are the commands of the server, each collective."""

    def __init__(self, comm: MPI.Intracomm) -> None:
        self.comm = comm
        self.control = pkl5.Intracomm(comm.Dup())  # its messages may be larger than 2 GiB
        self._kept: dict[int, Any] = {}  # solvers, None where this rank has no part in one
        self._comms: dict[int, MPI.Intracomm | None] = {comm.size: comm}
        self._result: Any = None

    def execute(self, command: str, args: Sequence[Any], load: Any = None) -> Any:
        """Do something on all ranks. Collective.

        Raises:
            Exception: if any rank failed: on rank 0 its own error, else that of the lowest rank; where other
                ranks are stuck because of it, the program ends with the traceback.
        """
        error: BaseException | None = None
        result = None
        try:
            result = getattr(self, command)(*args, load) if load is not None else getattr(self, command)(*args)
        except BaseException as e:  # whatever it is, the other ranks have to know
            error = e
        self._wait_for_others(error)
        errors = self.control.allgather(None if error is None else portable(error))
        first = next((e for e in errors if e is not None), None)
        if first is None:
            return result
        if command in ("build", "update", "solve"):
            self.drop(args[0])
        if error is not None:
            raise error
        raise first

    def _wait_for_others(self, error: BaseException | None) -> None:
        arrived = self.control.Ibarrier()
        deadline = time.monotonic() + SECONDS_TO_AGREE
        for _ in _naps():
            if arrived.Test():
                return
            if error is not None and time.monotonic() > deadline:
                text = "".join(traceback.format_exception(error))
                sys.stderr.write(f"{text}on rank {self.comm.rank}, for which the other ranks wait: all are ended\n")
                sys.stderr.flush()
                self.comm.Abort(getattr(error, "exit_code", 1))

    def wait(self) -> tuple[str, tuple[Any, ...]]:
        """The next command of rank 0, waited for without burning a core. Not on rank 0."""
        for _ in _naps():
            if self.control.iprobe(source=0):
                break
        command: tuple[str, tuple[Any, ...]] = self.control.recv(source=0)
        return command

    def knows(self, handle: int) -> bool:
        """Whether a solver is there. Local, the same on all ranks."""
        return handle in self._kept

    def built_seconds(self, handle: int) -> float:
        """Of a solver that was just built or updated. On rank 0."""
        return float(self._kept[handle].built_seconds)

    def set_options(self, options: Mapping[str, str | None]) -> None:
        """Take over rank 0's options database."""
        from petsc4py import PETSc

        if self.comm.rank == 0:
            return
        database = PETSc.Options()
        mine = database.getAll()
        for name in mine.keys() - options.keys():
            database.delValue(name)
        for name, value in options.items():
            if name not in mine or mine[name] != value:
                database.setValue(name, value)

    def build(self, handle: int, prefix: str, unknowns: int, scene: Scene | None = None) -> Layout | None:
        """Make a solver for the scene that rank 0 has, on as many ranks as it is large enough for."""
        from petsc_fs.solver import Solver

        self.drop(handle)
        comm = self._first(min(max(unknowns // _least_rows(prefix), 1), self.comm.size))
        self._kept[handle] = None if comm is None else Solver(scene, comm, prefix=prefix, root_only=True)
        return None if comm is None else self._kept[handle].layout

    def _first(self, ranks: int) -> MPI.Intracomm | None:
        """A communicator of the first ranks; None on the others. Collective."""
        if ranks not in self._comms:
            part = self.comm.Split(0 if self.comm.rank < ranks else MPI.UNDEFINED)
            self._comms[ranks] = part if isinstance(part, MPI.Intracomm) and part != MPI.COMM_NULL else None
        return self._comms[ranks]

    def update(self, handle: int, scene: Scene | None = None) -> None:
        """Give a solver the next scene."""
        if self._kept[handle] is not None:
            self._kept[handle].update(scene)

    def solve(
        self, handle: int, rtol: float | None, error: float, rounding: Mapping[str, float] | None
    ) -> tuple[Result, Any, float] | None:
        """What the solve did; on rank 0 all of the solution; seconds it took to come. None on ranks without a part."""
        if handle not in self._kept:
            raise SolveError("there is nothing to solve: an earlier error left no system")
        solver = self._kept[handle]
        if solver is None:
            return None
        result = solver.solve(rtol, error=error, rounding=rounding)
        started = time.perf_counter()
        return result, solver.system.gather(result.solution), time.perf_counter() - started

    def work(self, function: Callable[[Any], Any], tasks: Sequence[Any] = ()) -> None:
        """Apply a function to this rank's task of those that rank 0 has; `collect` brings the results."""
        for other in range(1, len(tasks)):
            self.control.send(tasks[other], other)
        self._result = function(tasks[0] if self.comm.rank == 0 else self.control.recv(source=0))

    def collect(self) -> list[Any]:
        """On rank 0 what `work` has made on each rank, in their order."""
        result, self._result = self._result, None
        if self.comm.rank == 0:
            return [result, *(self.control.recv(source=other) for other in range(1, self.comm.size))]
        self.control.send(result, 0)
        return []

    def drop(self, handle: int) -> None:
        """Forget a solver."""
        solver = self._kept.pop(handle, None)
        if solver is not None:
            solver.destroy()

    def close(self) -> None:
        """Forget all solvers."""
        for handle in sorted(self._kept):
            self.drop(handle)


def _serve(rank: _Rank) -> None:
    """Do what rank 0 asks for, until it asks to stop. An interrupt from the keyboard is for rank 0 to handle."""
    before = signal.getsignal(signal.SIGINT)
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        command = ""
        while command != "close":
            command, args = rank.wait()
            try:
                rank.execute(command, args)
            except Exception:
                pass  # rank 0 has it too, and says what happens next
    finally:
        if in_main_thread and before is not None:
            signal.signal(signal.SIGINT, before)


def _least_rows(prefix: str) -> int:
    """Unknowns that a rank should have. Local, the same on all ranks."""
    from petsc4py import PETSc

    return max(int(PETSc.Options(prefix).getInt("petsc_fs_least_rows", LEAST_ROWS)), 1)


def _naps() -> Iterator[None]:
    """Naps that grow longer and longer; the first look comes before the first nap."""
    nap = SHORTEST_NAP
    while True:
        yield
        time.sleep(nap)
        nap = min(1.5 * nap, LONGEST_NAP)


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Keep an interrupt from the keyboard back until the end of the block; a second one comes through at once."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    came: list[int] = []

    def remember(number: int, frame: Any) -> None:
        if came:
            before(number, frame)
        came.append(number)

    signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        signal.raise_signal(signal.SIGINT)


def _restore_terminate() -> None:
    """Let a request to terminate end the process as before PETSc, which would explain it on every rank at length."""
    handler = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is threading.main_thread() and handler is not None:
        signal.signal(signal.SIGTERM, handler)


def _database() -> dict[str, str | None]:
    """PETSc's options database."""
    from petsc4py import PETSc

    return dict(PETSc.Options().getAll())
