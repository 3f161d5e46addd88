"""Measure solves in processes of their own, so that a crash, a hang or divergence is an outcome and not the end.

`measure` starts `mpiexec -n RANKS python -m petsc_fs.tools.probe`, which solves scenes or sequences by an options file
and further options; `measure_all` does so for all combinations of systems, variants and ranks, in turns. Either gives
one *record* for each solve, a dictionary that JSON can hold:

    scene              path of the scene or sequence, as given
    rtol               relative tolerance asked for; None: as the options say
    repetition         number of the repetition, from 0
    kind               one of `KINDS`, below
    message            one line on what went wrong; "" if nothing did
    phase              where the process was: "start", "read", "set-up", "solve" or "errors"

and, where the solve came to an end (kinds converged, stagnated, diverged and unused_option; else None), summed over the
steps of a sequence where that makes sense, the worst of them else:

    iterations         of the outer Krylov method
    reason             PETSc's name for why it stopped, for example "CONVERGED_RTOL"
    tolerance          what the true residual was held against
    seconds            {"read": ..., "build": ..., "setup": ..., "solve": ...}, by the clock; set-up, of which building
                       PETSc's matrices is a part, is one for all tolerances
    cpu_seconds        the same of the processor: less noisy where others compute, too
    true_residual      |b - J x| / |b| of the user's system
    residual_by_field  |r_f| / |b| of each field
    base_rss           list, per rank: bytes of resident memory with the scene read, before any PETSc object
    peak_rss           list, per rank: most bytes since then; from the second repetition on, errors count with it

and, where the job names references or asks for errors (else None; see `petsc_fs.tools.reference`):

    forward_error      against the reference, all fields in one number
    error_by_field     the same per field, each in its natural norm, relative to the reference
    backward_error     {"normwise": ..., "componentwise": ..., "fieldwise": ...}

Times are the slowest rank's. Where a solve crashes, records of those before it are kept.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from petsc_fs import options as options_files
from petsc_fs.errors import UsageError

Record = dict[str, Any]
Path_ = str | os.PathLike[str]

KINDS = {
    "converged": "the verdict of the solver is that the solution is one",
    "stagnated": "the method stopped, without blowing up, at what the verdict does not accept",
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
    "iterations reason tolerance seconds cpu_seconds true_residual residual_by_field peak_rss base_rss "
    "forward_error error_by_field backward_error".split()
)
"""The keys that only a solve that ended fills."""

CLOCKS = {"wall": "wall clock", "cpu": "processor time"}
"""What seconds can be. Processor time, the busiest rank's, is steadier where other programs run, but hides what waits
for others."""

HOME = Path(__file__).resolve().parent.parent.parent
"""Where the package lies."""
GRACE = 5.0
"""Seconds that mpiexec has to end its ranks before it is killed."""
POLL = 0.02
"""Seconds between looks at a running process."""
DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of Linux: by which a process ends with its parent."""

MEMORY = re.compile(
    r"out of memory|MemoryError|bad_alloc|cannot allocate memory|Memory requested|INFOG\(1\)=-(?:9|13|19)\b",
    re.IGNORECASE,
)
"""What programs say whose memory ran out."""

SIGNAL = re.compile(r"exited on signal (\d+)|Caught signal number (\d+)|\(signal (\d+)\)")
"""How Open MPI, PETSc and MPICH name the signal that ended a rank."""


def seconds_of(record: Record, clock: str = "wall") -> dict[str, float]:
    """Seconds of a record by phase: "read", "build", "setup" and "solve"; and "total", of the last two."""
    found = record["seconds" if clock == "wall" else "cpu_seconds"]
    return {**found, "total": found["setup"] + found["solve"]}


def grown(record: Record) -> int:
    """Bytes that all ranks' memory grew by in set-up and solve."""
    return sum(record["peak_rss"]) - sum(record["base_rss"])


@dataclass(frozen=True, kw_only=True)
class Job:
    """What one process measures: each scene, with each tolerance, repeated."""

    scenes: Sequence[Path_] = ()  # files; sequences are replayed as a run would solve them
    options_file: Path_ | None = None  # None for the default solver of each scene, as `petsc-fs solve` chooses it
    options: Mapping[str, str | None] = field(default_factory=dict)  # without the dash, which win over the file
    ranks: int = 1
    rtols: Sequence[float] = ()  # of solves after one set-up; they win over -ksp_rtol and -ksp_atol, which is then 0
    repetitions: int = 1  # set-ups and solves of each scene
    warm_up: bool = False  # whether an unrecorded solve goes before, so that no time goes to loading libraries
    errors: bool = False  # whether backward errors are computed; forward errors too where there is a reference
    references: Mapping[str, Path_] = field(default_factory=dict)  # scene to file of `petsc_fs.tools.reference.write`
    time_limit: float = 300.0  # seconds for each step: start and reading, set-up, one solve, errors
    memory_limit: int | None = None  # bytes of address space that each rank may have
    keep_going: bool = False  # whether the next scene follows after an error that all ranks raised
    mpiexec: Path_ | None = None  # program that starts ranks; None for that of `find_mpiexec`


@dataclass(frozen=True)
class Variant:
    """One way to solve: an options file, perhaps with further options."""

    label: str  # what tables call it
    path: str = ""  # of the file; "" for the default solver of each scene
    options: Mapping[str, str | None] = field(default_factory=dict)  # without the dash, which win over the file
    fields: tuple[str, ...] = ()  # that a scene must have; empty if any will do
    not_for: tuple[str, ...] = ()  # models that it is known to fail on
    purpose: str = ""  # first line of the file
    text: str = ""  # the file, verbatim

    @classmethod
    def of(cls, words: str, more: Mapping[str, str | None] | None = None) -> Variant:
        """Read "FILE -option value ...", with further options that all variants have; or raise a UsageError."""
        name, *own = shlex.split(words)
        path = options_files.find_options_file(name)
        options_files.parse(path)
        header = options_files.read_header(path)
        label, chosen = " ".join([path.stem, *own]), {**(more or {}), **options_files.Given.of(own).values}
        text = path.read_text(encoding="utf-8")
        return cls(label, str(path), chosen, header.fields, header.not_for, header.purpose, text)

    def fits(self, fields: Sequence[str], names: Sequence[str] = ()) -> bool:
        """Whether it is for a scene with these fields, known by these names, as far as its header says."""
        return (not self.fields or set(self.fields) == set(fields)) and not set(names) & set(self.not_for)


def split_ranks(petsc: Sequence[str]) -> tuple[list[int], dict[str, str | None]]:
    """The number of ranks that `-n` says, if it is there, and PETSc's other options by name; or a UsageError."""
    found = options_files.Given.of(petsc).values
    ranks = [found.pop(name) or "" for name in ("n", "np") if name in found]
    if not all(number.isdecimal() and int(number) for number in ranks):
        raise UsageError("-n: expected a number of ranks; --ranks takes several")
    return [int(number) for number in ranks[-1:]], found


def positive(kind: type[int] | type[float]) -> Callable[[str], float]:
    """A type of arguments for argparse: numbers above zero."""

    def number(text: str) -> float:
        found = kind(text)
        if not found > 0:
            raise argparse.ArgumentTypeError(f"expected a positive number, found {text}")
        return found

    return number


def refuse_twice(what: str, names: Sequence[str]) -> None:
    """Refuse a call in which a name stands for two things by a UsageError."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"{twice}: named twice; {what} need different names, as tables tell them apart by these")


def make_folder(folder: Path) -> None:
    """Make the folder of --out, or raise a UsageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise UsageError(f"--out {folder}: cannot be made: {e.strerror}") from e


def say(line: str) -> None:
    """Tell who waits what is going on."""
    print(line, file=sys.stderr, flush=True)


def measure_all(
    systems: Sequence[Path_],
    variants: Sequence[Variant],
    job: Job,
    *,
    ranks: Sequence[int] = (1,),
    repeat: int = 1,
    fits: Callable[[str, Variant], bool] = lambda system, variant: True,
    batch: bool = False,
) -> Iterator[list[Record]]:
    """Measure all combinations, in turns: each once before any is measured again, the first variant another each time.

    So that noise of the machine falls on all alike, and ratios are of what was measured at about the same time.

    Args:
        systems: scenes and sequences.
        variants: to solve them by.
        job: all that is the same; scenes, options and ranks are put in.
        ranks: numbers of ranks.
        repeat: rounds.
        fits: whether a variant is to be measured on a system.
        batch: whether a process takes all systems, one after the other, and not one alone.

    Yields:
        The records of a process, with `variant` (its label), `ranks` and `round` beside what `measure` gives. A
        combination that hung is not measured in later rounds.
    """
    names = [os.fspath(s) for s in systems]
    hung: set[tuple[str, str, int]] = set()
    groups = [names] if batch else [[name] for name in names]
    for number, group, n in itertools.product(range(repeat), groups, ranks):
        shift = number % max(len(variants), 1)
        for v in [*variants[shift:], *variants[:shift]]:
            left = [s for s in group if fits(s, v) and (s, v.label, n) not in hung]
            while left:
                references = {s: job.references[s] for s in left if s in job.references}
                what = replace(job, scenes=left, ranks=n, references=references)
                found = measure(replace(what, options_file=v.path or None, options=v.options))
                hung |= {(r["scene"], v.label, n) for r in found if r["kind"] == "hang"}
                yield [r | {"variant": v.label, "ranks": n, "round": number} for r in found]
                done = {r["scene"] for r in found}
                left = [s for s in left if s not in done]


def measure(job: Job) -> list[Record]:
    """Measure in a process of its own and say how it ended: records in the order scene, repetition, tolerance.

    Blocks until the process has ended or was ended. Whatever happens in it is in the records; where it did not come
    to its end, the last record says how, for the solve that was under way, and later solves have none. Ctrl-C ends
    the process before it is raised here; where this process is killed, it ends, too (on Linux).

    Raises:
        UsageError: there is no mpiexec.
    """
    with tempfile.TemporaryDirectory(prefix="petsc_fs-") as folder:
        events, request, output = (Path(folder) / name for name in ("events", "job.json", "output"))
        request.write_text(json.dumps(asdict(job), default=os.fspath), encoding="utf-8")
        events.touch()
        program = [sys.executable, "-m", "petsc_fs.tools.probe", str(request), str(events)]
        with output.open("wb") as sink:
            process = subprocess.Popen(
                [*launcher(job.ranks, job.mpiexec), *program],
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


def _end_with_parent() -> None:
    """In a process that is about to become mpiexec: let it end where this one is killed. Linux only."""
    if sys.platform == "linux":
        _LIBC.prctl(DEATH_SIGNAL, signal.SIGTERM)


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

    Events are a JSON object a line, see `petsc_fs.tools.probe`, of which the last may be cut short; the exit code is
    None if the process was ended here because time was up; and `said` is all of its output.
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
    telling = [line for line in lines if re.match(r"[\w.]*(Error|Exception|Exit)\b", line)]
    telling = telling or [line for line in lines if re.search("error|exception|abort", line, re.IGNORECASE)] or lines
    return "crash", f"exit code {code} in phase {phase}: {telling[-1] if telling else 'no output'}"


def _signal_number(code: int, said: str) -> int:
    """The signal that ended a process, by its exit code or what mpiexec and PETSc say; 0 for none."""
    spoken = SIGNAL.search(said)
    if spoken is not None:
        return int(next(group for group in spoken.groups() if group))
    return -code if code < 0 else code - 128 if 128 < code < 192 else 0


def launcher(ranks: int, mpiexec: Path_ | None = None) -> list[str]:
    """Command that starts a program on some ranks; a UsageError where several are asked for and there is no mpiexec."""
    program = mpiexec or find_mpiexec()
    if program is None and ranks > 1:
        raise UsageError("no mpiexec on PATH: install one, or name it with MPIEXEC")
    return [] if program is None else [os.fspath(program), "-n", str(ranks)]


def find_mpiexec() -> str | None:
    """`scripts/mpiexec` of a source tree, or what MPIEXEC names, or the one beside Python, or the one on PATH."""
    script = HOME / "scripts" / "mpiexec"
    return str(script) if script.is_file() else os.environ.get("MPIEXEC") or _installed_mpiexec()


def _installed_mpiexec() -> str | None:
    places = [str(Path(sys.base_prefix) / "bin"), os.environ.get("PATH", os.defpath)]
    return shutil.which("mpiexec", path=os.pathsep.join(places))


def environment() -> dict[str, str]:
    """Environment of measured processes: one thread a rank unless told otherwise, and no trace of an MPI job here.

    `os.environ` does not hold what the MPI library of this process put into its environment.
    """
    traces = ("PMIX_", "PMI_", "OMPI_COMM_WORLD_", "OMPI_UNIVERSE_", "OMPI_APP_", "OMPI_FILE_LOCATION", "PRTE_LAUNCHED")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(traces)}
    paths = [str(HOME), *kept.get("PYTHONPATH", "").split(os.pathsep)]
    defaults = {"OMP_NUM_THREADS": "1", "MPIEXEC": _installed_mpiexec() or "mpiexec"}
    return defaults | kept | {"PYTHONPATH": os.pathsep.join(p for p in paths if p)}


def describe_machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions that measurements were made with."""
    from petsc_fs.io.bundled import versions

    cpuinfo = Path("/proc/cpuinfo")
    said = cpuinfo.read_text(encoding="utf-8") if cpuinfo.exists() else ""
    model = re.findall(r"^model name\s*: (.*)$", said, flags=re.MULTILINE) or [platform.processor()]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": f"{model[0]}, {os.cpu_count()} cores, {memory:.0f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "threads per rank": environment()["OMP_NUM_THREADS"],
        "versions": ", ".join(f"{name} {number}" for name, number in versions().items()),
    }
