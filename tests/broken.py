"""Broken input: scenes and options files with one thing or several wrong, by number, and what becomes of them.

As a program, `python tests/broken.py COUNT` tries numbers 0 to COUNT - 1 in processes of their own and prints how many
ended how; exit code 1 if one crashed, hung, raised anything but a clear error, or left a half-written file.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import h5py
import numpy as np
from sample import full_scene

from petsc_fs import hdf5, options
from petsc_fs.errors import PetscFsError
from petsc_fs.scene import Scene

BATCH = 250
LIMIT = 20.0
OUTCOMES = ("answer", "not converged", "clear error", "other error", "half-written", "crash", "hang")
HOSTILE = (0, -1, 1, 2**31, 2**62, -(2**62), np.nan, np.inf, "", "mass", b"\xff\xfe", "x" * 70000, [], [1, 2], "../..")


def healthy(rng: np.random.Generator) -> Scene:
    """A small scene that can be solved, with random fields."""
    cells = {"contact": 2, "intf_force": 4, "momentum": 5, "intf_flow": 3, "mass": 6}
    kept = {f: int(rng.integers(0, 3)) if rng.random() < 0.1 else n for f, n in cells.items() if rng.random() < 0.85}
    known = {"contact": 0, "mass": 0} | kept or {"mass": 3}
    scene = full_scene(2, known, int(rng.integers(1000))).only(kept or ("mass",))
    for f, n in scene.sizes.items():
        if n:
            block = scene.blocks[f, f] if (f, f) in scene.blocks else None
            dense = np.eye(n) * 10.0
            if block is not None:
                rows = np.repeat(np.arange(n), np.diff(block.indptr))
                dense[rows, block.indices] += block.data
            rows, columns = np.nonzero(dense)
            indptr = np.searchsorted(rows, np.arange(n + 1))
            scene.blocks[f, f] = type(next(iter(scene.blocks.values())))(indptr, columns, dense[rows, columns])
    if "mass" not in scene.sizes:
        scene.material = None
    return scene


def datasets(file: h5py.File) -> list[str]:
    found: list[str] = []
    file.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(found)


def hurt(path: Path, rng: np.random.Generator) -> str:
    """Damage a scene file in one way; returns which."""
    way = str(rng.choice(["bits", "cut", "array", "array", "array", "attribute", "missing", "link", "none"]))
    if way == "bits":
        raw = bytearray(path.read_bytes())
        for _ in range(int(rng.integers(1, 6))):
            raw[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(raw)
    elif way == "cut":
        raw = path.read_bytes()
        path.write_bytes(raw[: int(rng.integers(len(raw)))] + rng.bytes(int(rng.integers(3))))
    elif way != "none":
        with h5py.File(path, "r+") as file:
            name = str(rng.choice(datasets(file)))
            if way == "array":
                values = twist(file[name][()], rng)
                del file[name]
                file[name] = values
            elif way == "missing":
                del file[name if rng.random() < 0.5 else name.rsplit("/", 1)[0]]
            elif way == "link":
                del file[name]
                file[name] = h5py.ExternalLink("nowhere.h5", "x") if rng.random() < 0.5 else h5py.SoftLink("/" + name)
            else:
                group = file[str(rng.choice([name.rsplit("/", 1)[0], "/"]))]
                names = sorted(group.attrs)
                if names:
                    value = HOSTILE[int(rng.integers(len(HOSTILE)))]
                    group.attrs[str(rng.choice(names))] = value if not isinstance(value, bytes) else np.void(value)
    return way


def twist(values: np.ndarray, rng: np.random.Generator) -> object:  # noqa: PLR0911
    """An array with something wrong."""
    values = np.array(values)
    ways = [
        "nan",
        "inf",
        "huge",
        "negative",
        "order",
        "repeat",
        "short",
        "long",
        "dtype",
        "int64",
        "uint64",
        "shape",
        "zero",
    ]
    way = str(rng.choice(ways))
    flat = values.ravel()
    if way in ("nan", "inf", "huge", "negative"):
        value = {"nan": np.nan, "inf": np.inf, "huge": 1e308, "negative": -7}[way]
        if flat.size and (values.dtype.kind == "f" or way == "negative"):
            if values.dtype.kind in "if":
                flat[int(rng.integers(flat.size))] = value
        return flat.reshape(values.shape)
    if way == "order":
        return rng.permutation(values) if values.ndim else values
    if way == "repeat" and values.ndim and len(values) > 1:
        values[1:] = values[:-1]
        return values
    if way == "short":
        return values[:-1] if values.ndim else values
    if way == "long" and values.ndim and len(values):
        return np.append(values, values[-1:], axis=0)
    if way == "dtype":
        return values.astype(rng.choice(["f4", "c16", "i1", "S3", "?"]))
    if way in ("int64", "uint64"):
        wide = values.astype("i8" if way == "int64" else "u8")
        if wide.size and rng.random() < 0.5:
            wide.ravel()[-1] = 2**33
        return wide
    if way == "shape":
        return values[None] if rng.random() < 0.5 else np.float64(1.0)
    return np.zeros_like(values)


def hurt_options(text: str, rng: np.random.Generator) -> str:
    """Options with lines lost, repeated, swapped, and with values that make no sense."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    for _ in range(int(rng.integers(1, 4))):
        k, way = int(rng.integers(len(lines))), int(rng.integers(6))
        if way == 0:
            del lines[k]
        elif way == 1:
            lines.insert(k, lines[int(rng.integers(len(lines)))])
        elif way == 2:
            lines[k] = lines[k][: int(rng.integers(len(lines[k]) + 1))]
        elif way == 3:
            lines[k] = (
                lines[k].split(" ")[0] + " " + str(rng.choice(["-1", "nan", "1e400", "xyz", "0", "\x00", "9" * 30]))
            )
        elif way == 4:
            lines.insert(k, str(rng.choice(["-prefix_pop", "-prefix_push", "garbage", "-", "--", "- x", "\ufeff-a"])))
        else:
            lines[k] = "".join(rng.permutation(list(lines[k])))
        lines = lines or ["-x"]
    return "\n".join(lines)


def attempt(number: int, folder: Path) -> str:
    """Make the broken input of this number and use it; how that ended."""
    rng = np.random.default_rng(number)
    path = folder / "scene.h5"
    scene = healthy(rng)
    try:
        if number % 5 == 4:
            file = options.shipped()[int(rng.integers(len(options.shipped())))].path
            target = folder / "broken.opts"
            target.write_text(hurt_options(file.read_text(), rng))
            options.parse(target)
            options.read_header(target)
            return "answer"
        hdf5.write(scene, path)
        before = sorted(p.name for p in folder.iterdir())
        hurt(path, rng)
        return use(path, folder, before)
    except PetscFsError as e:
        return "clear error" if "\n" not in str(e) and str(e) else f"other error: {e!r}"
    except Exception as e:
        return f"other error: {type(e).__name__}: {e}"
    finally:
        for p in folder.iterdir():
            p.unlink()


def use(path: Path, folder: Path, before: list[str]) -> str:
    """Read a scene, solve it and write what came out."""
    from mpi4py import MPI

    from petsc_fs.cli import tree_for
    from petsc_fs.solver import Solver

    scene = hdf5.read(path)
    new = options.insert_all(tree_for(scene, MPI.COMM_SELF).options)
    try:
        solver = Solver(scene, MPI.COMM_SELF)
        try:
            result = solver.solve()
            hdf5.write_solution(result.solution, folder / "x.h5", scene)
        finally:
            solver.destroy()
    finally:
        options.delete_all(new)
        left = sorted(p.name for p in folder.iterdir())
    if set(left) - {*before, "x.h5"}:
        return f"half-written: {left}"
    return "answer" if result.converged else "not converged"


def child(first: int, last: int) -> None:
    import petsc4py

    petsc4py.init([])
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        for number in range(first, last):
            print(json.dumps([number, "started"]), flush=True)
            print(json.dumps([number, attempt(number, Path(folder))]), flush=True)


def main(count: int) -> int:
    counts: Counter[str] = Counter()
    number, started = 0, time.monotonic()
    while number < count:
        last = min(count, number + BATCH)
        with tempfile.TemporaryFile("w+") as output:
            command = [sys.executable, __file__, "--child", str(number), str(last)]
            process = subprocess.Popen(command, stdout=output, stderr=subprocess.DEVNULL, start_new_session=True)
            seen, deadline = 0, time.monotonic() + LIMIT
            while process.poll() is None:
                size = os.fstat(output.fileno()).st_size
                if size > seen:
                    seen, deadline = size, time.monotonic() + LIMIT
                if time.monotonic() > deadline:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
                    break
                time.sleep(0.02)
            output.seek(0)
            lines = [json.loads(line) for line in output.read().splitlines() if line.endswith("]")]
        done = [(n, what) for n, what in lines if what != "started"]
        for n, what in done:
            kind = what.split(":")[0]
            counts[kind] += 1
            if kind in ("other error", "half-written"):
                print(n, what, flush=True)
        number = done[-1][0] + 1 if done else number
        if number < last:  # the child ended in the middle of this one
            kind = "hang" if process.returncode == -signal.SIGKILL else "crash"
            counts[kind] += 1
            print(number, kind, process.returncode, flush=True)
            number += 1
    print(", ".join(f"{counts[o]} {o}" for o in OUTCOMES), f"of {count}, {time.monotonic() - started:.0f} s")
    return 1 if any(counts[o] for o in OUTCOMES[3:]) else 0


if __name__ == "__main__":
    if sys.argv[1] == "--child":
        child(int(sys.argv[2]), int(sys.argv[3]))
    else:
        sys.exit(main(int(sys.argv[1])))
