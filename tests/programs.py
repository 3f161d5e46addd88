"""Programs in processes of their own, on several ranks, and what is left of them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import petsc_fs

ROOT = Path(petsc_fs.__path__[0]).parent
MPIEXEC = ROOT / "scripts" / "mpiexec"
ENVIRONMENT = dict(
    os.environ,
    OMP_NUM_THREADS="1",
    PYTHONPATH=os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    OMPI_MCA_mpi_yield_when_idle="1",
)
"""As this session was started (MPI has added to what a process below it would get otherwise); ranks that wait for
each other make room for those that work."""

SECONDS_TO_END = 10.0


class Program:
    """A Python program on some ranks, in a folder of its own; the text is also a mark to find its processes by."""

    def __init__(self, folder: Path, text: str, ranks: int = 2, arguments: tuple[str, ...] = ()) -> None:
        self.script = folder / f"program{time.monotonic_ns()}.py"
        self.script.write_text(text)
        command = [sys.executable, "-u", str(self.script), *arguments]
        if ranks > 1:
            command = [str(MPIEXEC), "-n", str(ranks), *command]
        self.files = self.script.with_suffix(".out"), self.script.with_suffix(".err")
        self.started = time.monotonic()
        with self.files[0].open("w") as output, self.files[1].open("w") as errors:
            self.process = subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stdout=output, stderr=errors)

    def texts(self) -> tuple[str, str]:
        """Standard output and error, so far."""
        return self.files[0].read_text(), self.files[1].read_text()

    def end(self, limit: float) -> tuple[int, str, str]:
        """Exit code, standard output and error; fails if it takes longer, or leaves a rank behind."""
        try:
            self.process.wait(timeout=limit)
        except subprocess.TimeoutExpired:
            left = self.ranks()
            for rank in left:
                os.kill(rank, signal.SIGKILL)
            self.process.kill()
            self.process.wait()
            raise AssertionError("\n".join([f"{len(left)} ranks after {limit} s", *self.texts()])) from None
        assert not self.ranks()
        return self.process.returncode, *self.texts()

    def wait_for(self, word: str, limit: float = 60.0) -> list[str]:
        """Lines of output once one of them has the word in it: Open MPI 5 may send it to the wrong one of the two."""
        while word not in (text := "".join(self.texts())):
            if self.process.poll() is not None or time.monotonic() > self.started + limit:
                raise AssertionError(f"no {word!r} in {text!r}\n{self.end(1.0)}")
            time.sleep(0.05)
        return text.splitlines()

    def end_killed(self, rank: int) -> str:
        """Standard output once the process of a rank was killed: all end soon, without a traceback."""
        os.kill(rank, signal.SIGKILL)
        started = time.monotonic()
        code, out, err = self.end(60)
        assert time.monotonic() - started < SECONDS_TO_END
        assert code != 0
        assert "Traceback" not in err
        assert "PETSC ERROR" not in err
        return out

    def ranks(self) -> list[int]:
        """Numbers of the processes that run the program."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    words = (entry / "cmdline").read_bytes().split(b"\0")
                except OSError:
                    continue
                if words[:1] == [sys.executable.encode()] and str(self.script).encode() in words:
                    found.append(int(entry.name))
        return sorted(found)
