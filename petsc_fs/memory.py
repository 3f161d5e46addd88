"""Memory of each rank by phase: what it holds at the end, and the most it held on the way.

The operating system counts: resident memory, with everything that PETSc, hypre, MPI and Python take. Linux
can set its record of the peak back, so that each phase has a peak of its own; elsewhere, or where that is
forbidden, the peak of a phase is the peak up to its end.
"""

from __future__ import annotations

import ctypes
import re
import resource
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mpi4py import MPI

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""Written to `CLEAR`, sets the peak of resident memory back to its present value (Linux 4.0 and later)."""


def return_freed() -> None:
    """Give what is freed back to the system, so that it does not count as held. Local.

    The C library may keep it otherwise. That it gives large blocks back by itself is forbidden for the whole process
    by SuperLU_DIST, which many builds of PETSc load, and has its price: in a run of PorePy, which makes and frees
    matrices all the time, page faults were a quarter of the time. Without effect where the C library is not glibc.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def held() -> int:
    """Resident memory of this process in bytes; the peak where the system does not tell. Local."""
    return _status("VmRSS") or peak()


def peak() -> int:
    """Peak of resident memory of this process in bytes, since the last `reset_peak`. Local."""
    unit = 1 if sys.platform == "darwin" else 1024
    return _status("VmHWM") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def reset_peak() -> bool:
    """Give back what is freed, and forget the peak so far; whether the system did. Local."""
    return_freed()
    try:
        CLEAR.write_text(RESET_PEAK, encoding="ascii")
    except OSError:
        return False
    return True


def _status(name: str) -> int:
    """An entry of Linux's process status in bytes, 0 where there is none."""
    try:
        found = re.search(rf"^{name}:\s+(\d+) kB", STATUS.read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) * 1024 if found else 0


class Phases:
    """Memory of this rank in one phase of a program after the other.

        phases = Phases()
        scene = hdf5.read(path)
        phases.end("read")

    Attributes:
        start: bytes held when the first phase began: interpreter and libraries.
        peaks: most bytes held in each phase.
        helds: bytes held at the end of each phase.
        separate: whether each phase has its own peak, see `reset_peak`.
    """

    def __init__(self) -> None:
        self.separate = reset_peak()
        self.start = held()
        self.peaks: dict[str, int] = {}
        self.helds: dict[str, int] = {}

    def end(self, phase: str) -> None:
        """The phase that began with the end of the last one is over; it may have several parts. Local."""
        self.peaks[phase] = max(peak(), self.peaks.get(phase, 0))
        self.separate = reset_peak() and self.separate
        self.helds[phase] = held()

    def report(self, comm: MPI.Intracomm) -> dict[str, Any]:
        """All ranks' memory in bytes, as JSON can hold it.

        Collective.

        Returns:
            `start`: per rank; `peak` and `held`: per phase and rank; `peak_all_ranks`: the sum of the ranks'
            greatest peaks, which bounds what the run needed at any time; `separate_peaks`.
        """
        starts = comm.allgather(self.start)
        peaks, helds = comm.allgather(self.peaks), comm.allgather(self.helds)
        return {
            "start": starts,
            "peak": {phase: [rank[phase] for rank in peaks] for phase in self.peaks},
            "held": {phase: [rank[phase] for rank in helds] for phase in self.helds},
            "peak_all_ranks": sum(max(rank.values(), default=0) for rank in peaks),
            "separate_peaks": all(comm.allgather(self.separate)),
        }


def text(report: dict[str, Any]) -> str:
    """One line on the memory of a run: greatest peak of a rank in each phase, and the sum over ranks."""
    peaks = ", ".join(f"{phase} {in_units(max(ranks))}" for phase, ranks in report["peak"].items())
    ranks = len(report["start"])
    return f"peak memory{' of a rank' if ranks > 1 else ''}: {peaks}" + (
        f"; of all {ranks} ranks {in_units(report['peak_all_ranks'])}" if ranks > 1 else ""
    )


def in_units(size: float) -> str:
    """A number of bytes with a binary unit, to three digits."""
    for unit in ("B", "KiB", "MiB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} GiB"
