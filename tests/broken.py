"""Broken input: strategies that draw scenes and options files with things wrong, and what becomes of them.

As a program, `python tests/broken.py COUNT` draws so many in processes of their own and prints how they ended, by what
was wrong; exit code 1 if one crashed, hung, raised anything but one clear error, left a half-written file, or was
answered by numbers that are not finite. `--two COUNT` tries more on two ranks, `--seed S` draws others.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import hypothesis
import numpy as np
from hypothesis import strategies as st
from mpi4py import MPI
from sample import CELLS, csr, full_scene

from petsc_fs import options
from petsc_fs.errors import PetscFsError
from petsc_fs.fields import FIELD_NAMES
from petsc_fs.io import hdf5
from petsc_fs.io.files import write_text
from petsc_fs.scene import Scene
from petsc_fs.tools.measure import environment

BATCH = 250
LIMIT = 30.0
"""Seconds without a sign of life after which an attempt counts as hanging."""
GOOD = ("answer", "not converged", "clear error")
MEANING = {
    "answer": "converged, by finite numbers",
    "not converged": "said so",
    "clear error": "one of this package's errors, the same on all ranks",
    "other error": "another exception",
    "several errors": "ranks that ended differently",
    "not finite": "an answer with NaN or Inf in it",
    "half-written": "a file left that is not complete",
    "crash": "the interpreter ended",
    "hang": f"no sign of life for {LIMIT:g} s",
}
BAD = ("other error", "several errors", "not finite", "half-written", "crash", "hang")
UNFIT = (OSError, KeyError, RuntimeError, ValueError, TypeError, IndexError, AttributeError, OverflowError)
"""What damaging a file raises where an earlier damage has left nothing to do it to."""
HOSTILE: tuple[Any, ...] = (
    0, -1, 1, 2**31, 2**62, -(2**62), np.nan, np.inf, "", "mass", b"\xff\xfe", "x" * 60000, [], [1, 2], "../..", "nan",
    ["mass", "mass"], ["momentum", "contact", "heat"], 1e308, True,
)  # fmt: skip
VALUES = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf, "huge": 1e308, "tiny": 1e-320, "negative": -7, "zero": 0}
WAYS = (
    *VALUES, "all zero", "order", "repeat", "short", "long", "empty", "f4", "f2", "c16", "i1", "S3", "bool", "int64",
    "uint64", "int64 beyond 32 bits", "big-endian", "more dimensions", "no dimension",
)  # fmt: skip
NONSENSE = ("-1", "nan", "1e400", "xyz", "0", "\x00", "9" * 30, "-", "", "1e-400", "true", "2147483648", "hypre", "lu")
LINES = (
    "-prefix_pop",
    "-prefix_push",
    "-prefix_push x_",
    "garbage",
    "-",
    "--",
    "- x",
    "\ufeff-a",
    "-ksp_type",
    "\\",
    "-5 6",
)


@dataclass(frozen=True)
class Damage:
    """One thing that is wrong with a scene's file.

    Attributes:
        kind: "array", "block", "attribute", "lost", "link", "hidden", "bits", "cut" or "none".
        place: which dataset, group or byte, as a fraction of all.
        way: what is done to it.
        at: which entry of it, as a fraction.
    """

    kind: str
    place: float = 0.0
    way: Any = ""
    at: float = 0.0


@dataclass(frozen=True)
class Broken:
    """A broken input.

    Attributes:
        dimension: of the scene.
        cells: number of each field, for the fields it has.
        seed: of its numbers.
        damage: of its file, in order.
        file: options file that is broken, too; "" for the solver that the scene is given by default.
        edits: of the options file: what, which line as a fraction, with what.
    """

    dimension: int
    cells: dict[str, int]
    seed: int
    damage: tuple[Damage, ...]
    file: str = ""
    edits: tuple[tuple[str, float, str], ...] = ()

    def kinds(self) -> str:
        """What is wrong, in words."""
        found = [d.kind + (f" {d.way}" if d.kind in ("array", "block") else "") for d in self.damage]
        return " + ".join(found or (["options"] if self.file else ["none"]))


fractions = st.floats(0.0, 1.0, exclude_max=True)
values = st.one_of(
    st.sampled_from(HOSTILE), st.integers(-(2**63), 2**63 - 1), st.floats(), st.text(max_size=20), st.binary(max_size=9)
)
kinds = {
    "array": st.builds(Damage, st.just("array"), fractions, st.sampled_from(WAYS), fractions),
    "block": st.builds(
        Damage, st.just("block"), fractions, st.sampled_from(("duplicate", "missing", "swap")), fractions
    ),
    "attribute": st.builds(Damage, st.just("attribute"), fractions, values, fractions),
    "lost": st.builds(
        Damage, st.just("lost"), fractions, st.sampled_from(("dataset", "group", "attribute")), fractions
    ),
    "link": st.builds(Damage, st.just("link"), fractions, st.sampled_from(("outside", "itself", "other"))),
    "hidden": st.builds(
        Damage, st.just("hidden"), fractions, st.sampled_from(("virtual", "external", "unwritten", "half"))
    ),
    "bits": st.builds(Damage, st.just("bits"), fractions, st.integers(0, 7)),
    "cut": st.builds(Damage, st.just("cut"), fractions, st.integers(0, 2)),
}
damages = st.sampled_from([*["array"] * 12, *["block"] * 4, *["attribute"] * 4, *["bits"] * 3, *kinds]).flatmap(
    kinds.get
)
edits = st.tuples(
    st.sampled_from(("delete", "repeat", "cut", "value", "insert", "scramble")),
    fractions,
    st.one_of(st.sampled_from((*NONSENSE, *LINES)), st.text(max_size=12)),
)


def cells_of(known: dict[str, int | None]) -> dict[str, int]:
    """Numbers of cells of the fields that a scene has, some of them 0 or 1."""
    found = {
        f: CELLS.get(f, CELLS["mass" if f == "energy" else "intf_flow"]) if n is None else n for f, n in known.items()
    }
    return found or {"mass": 3}


fields = st.dictionaries(
    st.sampled_from(FIELD_NAMES), st.one_of(st.none(), st.none(), st.integers(0, 2)), max_size=5
).map(cells_of)
whole = st.just(dict(CELLS))
scenes = st.builds(
    Broken,
    st.sampled_from((2, 2, 3)),
    st.one_of(fields, whole),
    st.integers(0, 999),
    st.lists(damages, min_size=1, max_size=3).map(tuple),
)
files = st.builds(
    Broken,
    st.just(2),
    whole,
    st.integers(0, 999),
    st.just(()),
    st.sampled_from([f.path.name for f in options.shipped() if f.fits(CELLS)]),
    st.lists(edits, min_size=1, max_size=3).map(tuple),
)
inputs = st.integers(0, 5).flatmap(lambda k: scenes if k else files)


def healthy(broken: Broken) -> Scene:
    """A small scene that can be solved: its diagonal dominates."""
    known = {"contact": 0, "mass": 0} | broken.cells
    scene = full_scene(broken.dimension, known, broken.seed).only(tuple(broken.cells))
    for f, n in scene.sizes.items():
        dense = np.eye(n) * 10.0
        if (f, f) in scene.blocks:
            block = scene.blocks[f, f]
            dense[np.repeat(np.arange(n), np.diff(block.indptr)), block.indices] += block.data
        scene.blocks[f, f] = csr(dense)
    if "mass" not in scene.sizes:
        scene.material = None
    return scene


def pick(items: list[Any], place: float) -> Any:
    """The item at a fraction of a list."""
    return items[min(int(place * len(items)), len(items) - 1)]


def names_in(file: h5py.File, kind: type) -> list[str]:
    """Names of all datasets or groups."""
    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, kind) else None)
    return sorted(found)


def hurt(path: Path, damage: Damage) -> None:
    """Do one thing to a scene's file; nothing where an earlier damage leaves no such place."""
    if damage.kind in ("bits", "cut"):
        raw = bytearray(path.read_bytes())
        at = int(damage.place * len(raw))
        if damage.kind == "cut":
            path.write_bytes(bytes(raw[:at]) + b"\xa5" * damage.way)
        elif raw:
            raw[at] ^= 1 << damage.way
            path.write_bytes(raw)
        return
    with contextlib.suppress(*UNFIT), h5py.File(path, "r+") as file:
        hurt_inside(file, damage)


def hurt_inside(file: h5py.File, damage: Damage) -> None:  # noqa: PLR0911
    """Do one thing to what a scene's file holds."""
    kind, way = damage.kind, damage.way
    if kind == "block":
        return hurt_block(file, damage)
    if kind == "attribute" or way == "attribute":
        group = pick(
            [file, *(file[name] for name in names_in(file, h5py.Group) if len(file[name].attrs))], damage.place
        )
        if not len(group.attrs):
            return None
        name = pick(sorted(group.attrs), damage.at)
        del group.attrs[name]
        if kind == "attribute":
            with contextlib.suppress(TypeError, ValueError, OverflowError, UnicodeEncodeError):
                group.attrs[name] = np.void(way) if isinstance(way, bytes) and way else way
        return None
    groups = way == "group"
    names = names_in(file, h5py.Group if groups else h5py.Dataset)
    if kind == "array" and way in VALUES and way not in ("negative", "zero"):
        names = [name for name in names if file[name].dtype.kind == "f" and file[name].size]
    if not names:
        return None
    name = pick(names, damage.place)
    if kind == "array":
        twisted = twist(np.array(file[name][()]), way, damage.at)
        del file[name]
        file[name] = twisted
        return None
    if kind == "hidden":
        return hide(file, name, way)
    del file[name]
    if kind == "link":
        links = {"outside": h5py.ExternalLink("nowhere.h5", "x"), "itself": h5py.SoftLink("/" + name)}
        file[name] = links.get(way, h5py.SoftLink("/" + pick(names, damage.at)))
    return None


def hide(file: h5py.File, name: str, way: str) -> None:
    """Put the numbers of a dataset into a file that is not there, or do not write all of them."""
    values = np.array(file[name][()])
    del file[name]
    if way == "virtual":
        layout = h5py.VirtualLayout(values.shape, values.dtype)
        layout[...] = h5py.VirtualSource("nowhere.h5", "x", values.shape)
        file.create_virtual_dataset(name, layout)
    elif way == "external":
        file.create_dataset(name, values.shape, values.dtype, external=[("nowhere.raw", 0, values.nbytes)])
    else:
        dataset = file.create_dataset(name, values.shape, values.dtype, chunks=(1,) * values.ndim)
        if way == "half":
            dataset[: len(values) // 2] = values[: len(values) // 2]


def hurt_block(file: h5py.File, damage: Damage) -> None:
    """An entry of a block twice, or not there, or two columns of it in the wrong order: sizes fit all the same."""
    blocks = [name for name in names_in(file, h5py.Group) if name.startswith("blocks/") and "indptr" in file[name]]
    if not blocks:
        return
    group = file[pick(blocks, damage.place)]
    indptr, columns, numbers = (np.array(group[name]) for name in ("indptr", "indices", "data"))
    if not columns.size:
        return
    at = int(damage.at * columns.size)
    row = int(np.searchsorted(indptr, at, side="right")) - 1
    if damage.way == "swap":
        columns[at : at + 2] = columns[at : at + 2][::-1].copy()
    else:
        twice = damage.way == "duplicate"
        columns, numbers = (np.insert(a, at, a[at]) if twice else np.delete(a, at) for a in (columns, numbers))
        indptr[row + 1 :] += 1 if twice else -1
    for name, array in (("indptr", indptr), ("indices", columns), ("data", numbers)):
        del group[name]
        group[name] = array


def twist(array: np.ndarray, way: str, at: float) -> object:  # noqa: PLR0911, PLR0912
    """An array with something wrong."""
    if way in VALUES:
        value = VALUES[way]
        if array.size and array.dtype.kind in "iuf":
            array.ravel()[int(at * array.size)] = np.asarray(value).astype(array.dtype)
        return array
    if way == "order":
        return np.random.default_rng(int(at * 1e6)).permutation(array) if array.ndim else array
    if way == "repeat" and array.ndim and len(array) > 1:
        array[1:] = array[:-1].copy()
        return array
    if way == "short":
        return array[:-1] if array.ndim else array
    if way == "long" and array.ndim and len(array):
        return np.append(array, array[-1:], axis=0)
    if way == "empty":
        return array[:0] if array.ndim else array
    if way in ("f4", "f2", "c16", "i1", "S3", "bool"):
        return array.astype(way)
    if way.startswith(("int64", "uint64")):
        wide = array.astype("u8" if way == "uint64" else "i8")
        if wide.size and way.endswith("bits"):
            wide.ravel()[int(at * wide.size)] = 2**33
        return wide
    if way == "big-endian":
        return array.astype(array.dtype.newbyteorder(">"))
    if way == "more dimensions":
        return array[None]
    if way == "no dimension":
        return np.float64(1.0)
    return np.zeros_like(array)


def hurt_options(text: str, changes: tuple[tuple[str, float, str], ...]) -> str:
    """Options with lines lost, repeated, cut, scrambled and put in, and with values that make no sense."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    for what, place, word in changes:
        k = min(int(place * len(lines)), len(lines) - 1)
        if what == "delete":
            del lines[k]
        elif what == "repeat":
            lines.insert(k, lines[(k * 7 + 3) % len(lines)])
        elif what == "cut":
            lines[k] = lines[k][: (len(word) * 5) % (len(lines[k]) + 1)]
        elif what == "value":
            lines[k] = lines[k].split("-", 1)[0] + "-" + lines[k].strip()[1:].split(" ")[0] + " " + word
        elif what == "insert":
            lines.insert(k, word)
        else:
            lines[k] = "".join(sorted(lines[k], key=lambda c: (ord(c) * 7919 + len(word)) % 101))
        lines = lines or ["-x"]
    return "\n".join(lines) + "\n"


@contextlib.contextmanager
def shared_folder(comm: MPI.Intracomm) -> Iterator[Path]:
    """A temporary folder, the same one on all ranks. Collective."""
    with contextlib.ExitStack() as stack:
        name = stack.enter_context(tempfile.TemporaryDirectory()) if comm.rank == 0 else None
        yield Path(comm.bcast(name))
        comm.Barrier()


def attempt(broken: Broken, comm: MPI.Intracomm) -> str:
    """Make a broken input and use it; how that ended, the same on all ranks. Collective."""
    with shared_folder(comm) as folder:
        path, target = folder / "scene.h5", folder / "broken.opts"
        if comm.rank == 0:
            hdf5.write(healthy(broken), path)
            for damage in broken.damage:
                hurt(path, damage)
            if broken.file:
                text = options.find_options_file(broken.file).read_text(encoding="utf-8")
                target.write_text(hurt_options(text, broken.edits), encoding="utf-8", errors="surrogatepass")
        comm.Barrier()
        before = {p.name for p in folder.iterdir()}
        comm.Barrier()
        try:
            found = use(path, target if broken.file else None, comm)
        except PetscFsError as e:
            found = "clear error" if str(e).strip() else f"other error: {e!r}"
        except Exception as e:
            found = f"other error: {type(e).__name__}: {e}"
        said = comm.allgather(found)
        left = {p.name for p in folder.iterdir()} - before - {"x.h5"}
        if left:
            return f"half-written: {sorted(left)}"
        return said[0] if len({s.partition(":")[0] for s in said}) == 1 else f"several errors: {said}"


def use(path: Path, file: Path | None, comm: MPI.Intracomm) -> str:
    """Read a scene, solve it and write what came out, as `petsc-fs solve` does. Collective."""
    from petsc_fs.io.reader import read_distributed
    from petsc_fs.solver import Solver

    new: tuple[str, ...] = ()
    try:
        if file is not None:
            options.read_header(file)
            new = options.insert_all(options.parse(file))
        scene, layout = read_distributed(path, comm)
        solver = Solver(scene, comm, layout=layout)
        try:
            result = solver.solve()
            whole = solver.system.gather(result.solution)
            if whole is not None:
                hdf5.write_solution(whole, path.with_name("x.h5"), scene)
        finally:
            solver.destroy()
    finally:
        options.delete_all(new)
    finite = all(np.isfinite(v).all() for v in result.solution.values())
    if not comm.allreduce(finite, MPI.LAND):
        return "not finite"
    return "answer" if result.converged else "not converged"


def child(seed: int, count: int, log: Path) -> None:
    """Draw and try so many inputs, a line in the log before and after each; ranks follow the first. Collective."""
    import petsc4py

    petsc4py.init([])
    comm = MPI.COMM_WORLD
    first = comm.rank == 0

    def write(*words: Any) -> None:
        with log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(words) + "\n")

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count, database=None, deadline=None, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    @hypothesis.given(inputs)
    def draw(broken: Broken) -> None:
        write("started", repr(broken), broken.kinds())
        comm.bcast(broken)
        write(attempt(broken, comm))

    with np.errstate(all="ignore"):
        if first:
            draw()
            comm.bcast(None)
        else:
            while (broken := comm.bcast(None)) is not None:
                attempt(broken, comm)


def run_child(seed: int, count: int, ranks: int, log: Path) -> str:
    """Run `child` in a process of its own; "" or how it ended if not well."""
    launcher = [str(Path(__file__).parent.parent / "scripts" / "mpiexec"), "-n", str(ranks)] if ranks > 1 else []
    command = [*launcher, sys.executable, __file__, "--child", str(seed), str(count), str(log)]
    log.touch()
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True, env=environment()
    )
    seen, deadline = 0, time.monotonic() + LIMIT
    while process.poll() is None:
        size = log.stat().st_size
        if size > seen:
            seen, deadline = size, time.monotonic() + LIMIT
        if time.monotonic() > deadline:
            os.killpg(process.pid, signal.SIGTERM if ranks > 1 else signal.SIGKILL)
            process.wait()
            return "hang"
        time.sleep(0.05)
    return f"crash: exit code {process.returncode}" if process.returncode else ""


def main() -> int:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("--two", type=int, default=0, metavar="COUNT", help="so many more on two ranks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="write the counts as a page, too")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        child(int(args.child[0]), int(args.child[1]), Path(args.child[2]))
        return 0
    runs = {ranks: try_all(count, ranks, args.seed) for ranks, count in ((1, args.count), (2, args.two)) if count}
    text = "\n".join(page(runs)) + "\n"
    print(text)
    if args.page:
        write_text(args.page, text)
    return 1 if any(outcome.partition(":")[0] in BAD for run in runs.values() for outcome, _, _ in run) else 0


def try_all(count: int, ranks: int, seed: int) -> list[tuple[str, str, str]]:
    """Try so many inputs: how each ended, what was wrong, and the input."""
    found: list[tuple[str, str, str]] = []
    while (left := count - len(found)) > 0:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log"
            ended = run_child(seed, min(BATCH, left), ranks, log)
            text = log.read_text(encoding="utf-8")
        lines = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
        last: list[str] = []
        for words in lines:
            if words[0] != "started":
                found.append((words[0], last[2], last[1]))
            last = words if words[0] == "started" else []
        if ended or not lines:
            found.append((ended or "crash: nothing was drawn", *(last[:0:-1] or ["none", f"seed {seed}"])))
            if not last:
                break
        seed += 1
    return found


def page(runs: dict[int, list[tuple[str, str, str]]]) -> list[str]:
    """The counts in Markdown."""
    lines = [
        "# Broken input",
        "",
        "Written by `python tests/broken.py COUNT --two COUNT --page FILE`: small scenes with random fields, some of",
        "size 0 or 1, with up to three things wrong with their files, and options files with up to three edits, drawn",
        "by hypothesis and used as by `petsc-fs solve`. Where damage leaves another, sound system, an answer should",
        "come. In the tables an input with several damages counts with each.",
        "",
        *("- **" + name + "**: " + words for name, words in MEANING.items()),
    ]
    for ranks, run in runs.items():
        counts = Counter(outcome.partition(":")[0] for outcome, _, _ in run)
        outcomes = [*GOOD, *(o for o in BAD if counts[o])]
        by_kind = Counter((part, o.partition(":")[0]) for o, kinds, _ in run for part in kinds.split(" + "))
        lines += ["", f"## {len(run)} inputs on {ranks} rank{'s' if ranks > 1 else ''}", ""]
        lines += ["| what is wrong | " + " | ".join(outcomes) + " |", "| --- " * (len(outcomes) + 1) + "|"]
        for kind in sorted({kind for kind, _ in by_kind}):
            lines.append(f"| {kind} | " + " | ".join(str(by_kind[kind, o]) for o in outcomes) + " |")
        lines.append("| **all** | " + " | ".join(str(counts[o]) for o in outcomes) + " |")
        lines += [f"\n{outcome}: `{what}`" for outcome, _, what in run if outcome.partition(":")[0] in BAD]
    return lines


if __name__ == "__main__":
    sys.exit(main())
