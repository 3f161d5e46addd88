"""Measure solves in processes of their own, so that a crash, a hang or divergence is an outcome and not the end.

`measure` starts `mpiexec -n RANKS python -m petsc_fs.tools.probe`, which solves one or more scenes by an options file and
further options, and gives back one *record* for each solve, a dictionary that JSON can hold:

    scene              path of the scene, as given
    rtol               relative tolerance asked for; None: as the options say
    repetition         number of the repetition, from 0
    kind               one of `KINDS`, below
    message            one line on what went wrong; "" if nothing did
    phase              where the process was: "start", "read", "set-up", "solve", "errors" or "history"

and, where the solve came to an end (kinds converged, stagnated, diverged and unused_option; else None):

    iterations         of the outer Krylov method
    reason             PETSc's name for why it stopped, for example "CONVERGED_RTOL"
    limited_by_rounding  whether the residual cannot be told from rounding, though the tolerance is not met
    tolerance          what the true residual was held against
    read_seconds       reading the scene: the same for all records of a scene and process
    setup_seconds      PETSc's matrices and the preconditioner: once for all tolerances of a repetition
    solve_seconds      the Krylov method
    cpu_seconds        processor time of set-up and solve, the busiest rank's: less noisy where others compute, too
    cpu_by_phase       the same of each phase: {"read": ..., "setup": ..., "solve": ...}
    true_residual      |b - J x| / |b| of the untransformed system
    residual_by_field  the same, restricted to each field
    base_rss           list, per rank: bytes of resident memory with the scene read, before any PETSc object
    peak_rss           list, per rank: most bytes since then; from the second repetition on, errors count with it
    fallback           rung of -petsc_fs_fallback that found the solution; "" if none was needed
    direct             whether the outermost preconditioner is a factorisation of the whole matrix

and, where the job names references or asks for errors (else None; see `petsc_fs.tools.accuracy`):

    forward_error      against the reference, all fields in one number
    error_by_field     the same per field, each in its natural norm, relative to the reference
    backward_error     {"normwise": ..., "componentwise": ..., "fieldwise": ...}

and, where the job asks for a history, on the records of the last repetition with the least tolerance (else None):

    history            {"seconds": [...], "residual": [...], "residual_by_field": {field: [...]},
                        "forward_error": [...], "error_by_field": {field: [...]}, "cpu_seconds": [...]}, all by
                       iteration, from 0; seconds are those of the timed solve, errors of a second one

Times are wall-clock, the slowest rank's. Where a solve crashes, records of those before it are kept.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from petsc_fs.errors import UsageError

Record = dict[str, Any]

KINDS = {
    "converged": "the true residual meets the tolerance",
    "stagnated": "the method stopped, without blowing up, before the true residual met the tolerance",
    "diverged": "the residual grew by the tolerance for divergence, or is not finite",
    "failed": "PETSc reported an error in set-up or solve",
    "refused": "an option has an impossible value, or the file does not fit the scene",
    "unused_option": "the solve ended, but nothing asked for one of the options: misspelt, or without effect",
    "out_of_memory": "an allocation failed, or the system ended the process for want of memory",
    "crash": "the process ended by a signal, or without saying why",
    "hang": "the time limit passed",
}
"""Outcomes, and what each means."""

EMPTY: Record = dict.fromkeys(
    (
        "iterations",
        "reason",
        "limited_by_rounding",
        "tolerance",
        "read_seconds",
        "setup_seconds",
        "solve_seconds",
        "cpu_seconds",
        "cpu_by_phase",
        "true_residual",
        "residual_by_field",
        "peak_rss",
        "base_rss",
        "fallback",
        "direct",
        "forward_error",
        "error_by_field",
        "backward_error",
        "history",
    )
)
"""The keys that only a solve that ended fills."""

GRACE = 5.0
"""Seconds that mpiexec has to end its ranks before it is killed."""
POLL = 0.02
"""Seconds between looks at a running process."""

MEMORY = re.compile(
    r"out of memory|MemoryError|bad_alloc|cannot allocate memory|Memory requested|INFOG\(1\)=-(?:9|13|19)\b",
    re.IGNORECASE,
)
"""What programs say whose memory ran out."""

SIGNAL = re.compile(r"exited on signal (\d+)|Caught signal number (\d+)|\(signal (\d+)\)")
"""How Open MPI, PETSc and MPICH name the signal that ended a rank."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What one process measures: each scene, with each tolerance, repeated.

    Attributes:
        scenes: files.
        options_file: path; None for the smallest solver for each scene, as `petsc-fs solve` chooses it.
        options: further PETSc options without the dash, which win over the file; None where there is no value.
        ranks: number of MPI ranks.
        rtols: relative tolerances, solved for with one set-up; they win over -ksp_rtol, -ksp_atol (which is then 0)
            and -petsc_fs_true_rtol. Empty: as the options say.
        repetitions: set-ups and solves of each scene.
        warm_up: whether one more set-up and solve goes before, unrecorded, so that no time goes to loading libraries.
        errors: whether backward errors are computed; forward errors too where there is a reference.
        references: scene to a file of `petsc_fs.tools.reference.write`.
        history: whether the last solve of each scene is done once more for its errors by iteration.
        time_limit: seconds for each step: start and reading, set-up, one solve, errors.
        memory_limit: bytes of address space that each rank may have; None for what the system allows.
        keep_going: whether the process goes on with the next scene after an error that all ranks raised.
    """

    scenes: Sequence[str | os.PathLike[str]]
    options_file: str | os.PathLike[str] | None = None
    options: Mapping[str, str | None] = field(default_factory=dict)
    ranks: int = 1
    rtols: Sequence[float] = ()
    repetitions: int = 1
    warm_up: bool = False
    errors: bool = False
    references: Mapping[str, str | os.PathLike[str]] = field(default_factory=dict)
    history: bool = False
    time_limit: float = 300.0
    memory_limit: int | None = None
    keep_going: bool = False

    def to_json(self) -> str:
        """What the measured process reads."""
        return json.dumps(asdict(self), default=os.fspath)

    @classmethod
    def from_json(cls, text: str) -> Job:
        """Read what `to_json` wrote."""
        return cls(**json.loads(text))


def measure(job: Job, *, mpiexec: str | os.PathLike[str] | None = None) -> list[Record]:
    """Measure in a process of its own and say how it ended.

    Blocks until the process has ended or was ended. Whatever happens in it is in the records; where it did not come
    to its end, the last record says how, for the solve that was under way, and later solves have none. Ctrl-C ends
    the process before it is raised here; where this process is killed, it ends, too (on Linux).

    Args:
        job: what to measure.
        mpiexec: program that starts ranks; default `find_mpiexec`.

    Returns:
        Records in the order scene, repetition, tolerance.

    Raises:
        UsageError: there is no mpiexec.
    """
    with tempfile.TemporaryDirectory(prefix="petsc_fs-") as folder:
        events, request, output = (Path(folder) / name for name in ("events", "job.json", "output"))
        request.write_text(job.to_json(), encoding="utf-8")
        events.touch()
        command = [
            *launcher(job.ranks, mpiexec),
            sys.executable,
            "-m",
            "petsc_fs.tools.probe",
            str(request),
            str(events),
        ]
        with output.open("wb") as sink:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                env=environment(),
                start_new_session=True,
                preexec_fn=_end_with_parent,  # noqa: PLW1509 -- takes no lock
            )
            try:
                hung = _wait(process, events, job.time_limit)
            finally:
                end(process)
        said = output.read_text(encoding="utf-8", errors="replace")
        return _records(job, events.read_text(encoding="utf-8"), None if hung else process.returncode, said)


_LIBC = ctypes.CDLL(None)
_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG


def _end_with_parent() -> None:
    """In a process that is about to become mpiexec: let it end where this one is killed. Linux only."""
    if sys.platform == "linux":
        _LIBC.prctl(_DEATH_SIGNAL, signal.SIGTERM)


def _wait(process: subprocess.Popen[bytes], events: Path, time_limit: float) -> bool:
    """Wait for the end of a process; whether it wrote no event for too long instead."""
    seen, deadline = 0, time.monotonic() + time_limit
    while process.poll() is None:
        size = events.stat().st_size
        if size > seen:
            seen, deadline = size, time.monotonic() + time_limit
        if time.monotonic() > deadline:
            return True
        time.sleep(POLL)
    return False


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process, if it still runs, with its ranks: mpiexec passes SIGTERM on, but not SIGKILL."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            return
        os.killpg(process.pid, number)
        try:
            process.wait(GRACE)
        except subprocess.TimeoutExpired:
            continue


def _records(job: Job, events: str, code: int | None, said: str) -> list[Record]:
    """Records of a process from its events, and one more where it did not come to its end.

    Args:
        job: what was asked for.
        events: a JSON object a line, see `petsc_fs.tools.probe`; the last line may be cut short.
        code: exit code; None if the process was ended here because time was up.
        said: all of its output.
    """
    found: list[Record] = []
    at: Record = {"phase": "start"}
    for line in events.splitlines(keepends=True):
        if not line.endswith("\n"):
            break
        event = json.loads(line)
        if "kind" in event:
            found.append(EMPTY | event)
        elif "supplement" in event:
            found[event.pop("supplement")] |= event
        elif event["phase"] == "done":
            return found
        else:
            at = event
    where = {"scene": os.fspath(job.scenes[0]), "rtol": None, "repetition": 0} | at
    kind, message = _explain_end(code, said, job.time_limit, at["phase"])
    return [*found, EMPTY | where | {"kind": kind, "message": message}]


def _explain_end(code: int | None, said: str, time_limit: float, phase: str) -> tuple[str, str]:
    """Kind and message of a process that did not come to its end."""
    if code is None:
        return "hang", f"no result within {time_limit:g} s; in phase {phase}"
    lines = [line.strip() for line in said.splitlines() if line.strip() and not line.startswith("---")]
    shortage = next((line for line in lines if MEMORY.search(line)), "")
    number = _signal_number(code, said)
    if shortage or number == signal.SIGKILL:
        return "out_of_memory", shortage or f"the system killed the process, as for want of memory; in phase {phase}"
    if number in set(signal.Signals):
        return "crash", f"{signal.Signals(number).name} in phase {phase}"
    telling = [line for line in lines if re.search("error|exception|abort", line, re.IGNORECASE)] or lines
    return "crash", f"exit code {code} in phase {phase}: {telling[-1] if telling else 'no output'}"


def _signal_number(code: int, said: str) -> int:
    """The signal that ended a process, by its exit code or what mpiexec and PETSc say; 0 for none."""
    spoken = SIGNAL.search(said)
    if spoken is not None:
        return int(next(group for group in spoken.groups() if group))
    return -code if code < 0 else code - 128 if 128 < code < 192 else 0


def launcher(ranks: int, mpiexec: str | os.PathLike[str] | None = None) -> list[str]:
    """Command that starts a program on some ranks.

    Raises:
        UsageError: there is no mpiexec and more than one rank is asked for.
    """
    program = find_mpiexec() if mpiexec is None else os.fspath(mpiexec)
    if program is None:
        if ranks == 1:
            return []
        raise UsageError("no mpiexec on PATH: install one, or name it with MPIEXEC")
    return [program, "-n", str(ranks)]


def find_mpiexec() -> str | None:
    """`scripts/mpiexec` of a source tree, or what MPIEXEC names, or the one beside Python, or the one on PATH."""
    script = Path(__file__).resolve().parent.parent.parent / "scripts" / "mpiexec"
    return str(script) if script.is_file() else os.environ.get("MPIEXEC") or _mpiexec_beside_python()


def _mpiexec_beside_python() -> str | None:
    beside = Path(sys.base_prefix) / "bin" / "mpiexec"
    return str(beside) if beside.is_file() else shutil.which("mpiexec")


def environment() -> dict[str, str]:
    """Environment of measured processes: one thread a rank unless told otherwise, and no trace of an MPI job here.

    `os.environ` does not hold what the MPI library of this process put into its environment.
    """
    traces = ("PMIX_", "PMI_", "OMPI_COMM_WORLD_", "OMPI_UNIVERSE_", "OMPI_APP_", "OMPI_FILE_LOCATION", "PRTE_LAUNCHED")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(traces)}
    here = str(Path(__file__).resolve().parent.parent.parent)
    paths = [here, *kept.get("PYTHONPATH", "").split(os.pathsep)]
    defaults = {"OMP_NUM_THREADS": "1", "MPIEXEC": _mpiexec_beside_python() or "mpiexec"}
    return defaults | kept | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}
