"""What the smallest tree saves against the canonical one on the bundled scenes, as a page."""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs import hdf5, options
from petsc_fs.fields import FIELDS
from petsc_fs.files import write_text
from petsc_fs.scene import CSR, Scene
from petsc_fs.tree import canonical_name

SCENES = Path(__file__).parent / "scenes"
TREES = ("smallest", "unpruned")
WARM = 3
"""Solves in each process of which the median counts, after a first one that loads libraries."""

ALL_DATA = {"ablation_pc_python_type": "any"}
"""An idle option: a Python PC that `Solver` does not know might use anything, so all data are computed."""

Measurement = dict[str, Any]


def ablation(target: Path, repetitions: int, progress: Callable[[str], None]) -> None:
    """Measure both trees on each bundled scene, in alternation, each in its own process; write a Markdown page.

    Args:
        target: page to write.
        repetitions: processes for each scene and tree.
        progress: called with a line for each scene.
    """
    scenes = sorted(SCENES.glob("*.h5"))
    rows = []
    for scene in scenes:
        runs: dict[str, list[Measurement]] = {tree: [] for tree in TREES}
        for _ in range(repetitions):
            for tree in TREES:
                runs[tree].append(_child("measure", scene, tree))
        medians = {tree: _medians(found) for tree, found in runs.items()}
        rows.append((scene.stem, medians))
        progress(f"{scene.stem}: {medians}")
    imports = {scene.stem: _child("imports", scene, "") for scene in scenes if scene.stem in ("flow", "model2")}
    write_text(target, "\n".join(_page(rows, imports, repetitions)) + "\n")


QUANTITIES = {
    "iterations": ("iterations", "{:.0f}"),
    "pcs": ("PCs", "{:.0f}"),
    "setup_seconds": ("set-up, s", "{:.3f}"),
    "solve_seconds": ("solve, s", "{:.3f}"),
    "memory": ("memory, MB", "{:.1f}"),
    "first_iteration_seconds": ("first iteration, s", "{:.2f}"),
}


def _page(
    rows: list[tuple[str, dict[str, Measurement]]],
    imports: Mapping[str, Measurement],
    repetitions: int,
) -> list[str]:
    """Lines of the page."""
    lines = [
        "# What the smallest tree saves",
        "",
        "Written by `scripts/ablation`: each bundled scene solved by the tree that is cut to fit it, and by the one of",
        f"`{canonical_name()}` as it is. For the latter a scene is padded with one cell of each field that it lacks,",
        "which acts on nothing, and all data beside the matrix are computed (rigid-body modes, fixed stress).",
        "(Fields of size zero would not do: the solver drops them, and the file does not fit then.)",
        "Both are held to the relative tolerance, without the absolute one of the file.",
        "",
        f"Medians of {repetitions} processes for each line, the two trees in alternation, on one rank with",
        f"OMP_NUM_THREADS={os.environ.get('OMP_NUM_THREADS', '(not set)')}. Seconds are those of the processor, not of "
        "the clock. *Set-up* is the choice of the tree,",
        "PETSc's matrices and the preconditioner, *solve* the Krylov method, both in a process where libraries are",
        "loaded already. *Memory* is by how much the greatest resident size of the process exceeds that with the scene",
        "read and PETSc initialised. *First iteration* counts from the start of the process. *PCs* are the",
        "preconditioners in the tree.",
        "",
        f"| scene | tree | {' | '.join(name for name, _ in QUANTITIES.values())} |",
        f"|{'---|' * (len(QUANTITIES) + 2)}",
    ]
    for scene, medians in rows:
        for tree in TREES:
            cells = [form.format(medians[tree][key]) for key, (_, form) in QUANTITIES.items()]
            lines.append(f"| {scene} | {tree} | {' | '.join(cells)} |")
        ratios = [f"{medians['unpruned'][key] / medians['smallest'][key]:.2f}" for key in QUANTITIES]
        lines.append(f"| | *ratio* | {' | '.join(ratios)} |")
    lines += ["", "Left out of the canonical tree:", ""]
    for scene, medians in rows:
        lines.append(f"- {scene}: {'; '.join(medians['smallest']['left_out']) or 'nothing'}")
    lines += ["", "## What is imported", "", "By `petsc-fs solve` in a fresh process, beside Python's own modules:", ""]
    for scene, found in imports.items():
        lines.append(f"- {scene}: {', '.join(found['packages'])}; in it {', '.join(found['modules'])}")
    only = sorted(set(imports["model2"]["modules"]) - set(imports["flow"]["modules"]))
    lines += ["", f"So flow alone does without {', '.join(only)}."]
    versions = rows[0][1]["smallest"]["versions"]
    return [*lines, "", f"PETSc {versions['petsc']}, petsc_fs {versions['petsc_fs']}."]


def _medians(runs: list[Measurement]) -> Measurement:
    """The median of each number; of anything else the first."""
    first = runs[0]
    return {
        key: statistics.median(run[key] for run in runs) if isinstance(value, int | float) else value
        for key, value in first.items()
    }


def _child(task: str, scene: Path, tree: str) -> Measurement:
    """What a task finds in a process of its own."""
    program = "from petsc_fs.ablation import child; child()"
    command = [sys.executable, "-c", program, task, str(scene), tree]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    if done.returncode:
        raise RuntimeError(f"{task} {scene} {tree}: exit code {done.returncode}\n{done.stderr}")
    found: Measurement = json.loads(done.stdout.splitlines()[-1])
    return found


def child() -> None:
    """Do the task that the command line names, and print what was found as JSON."""
    task, scene, tree = sys.argv[1:]
    found = _measure(Path(scene), tree) if task == "measure" else _imports(scene)
    print("\n" + json.dumps(found))


def _imports(scene: str) -> Measurement:
    """Packages and our modules that a solve imports."""
    listing = [sys.executable, "-c", "import sys; print(*sys.modules)"]
    idle = subprocess.run(listing, capture_output=True, text=True, check=True).stdout.split()
    from petsc_fs.cli import main

    if main(["solve", scene]):
        raise RuntimeError(f"{scene}: not solved")
    packages = {name.split(".")[0] for name in sys.modules} - {name.split(".")[0] for name in idle}
    packages -= set(sys.stdlib_module_names)
    return {
        "packages": sorted(p for p in packages if not p.startswith("_")),
        "modules": sorted(m for m in sys.modules if m.startswith("petsc_fs.") and m != __name__),
    }


def _measure(path: Path, kind: str) -> Measurement:
    """Time, memory and iterations of one tree on one scene."""
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from mpi4py import MPI
    from petsc4py import PETSc

    from petsc_fs.solver import Solver
    from petsc_fs.tree import Facts, canonical_options, smallest_tree

    scene = hdf5.read(path)
    canonical = canonical_options()
    canonical.pop("ksp_atol", None)  # both trees are held to the relative tolerance
    if kind == "unpruned":
        scene = padded(scene)
        options.insert_all({**canonical, **ALL_DATA})
    found: Measurement = {"versions": {"petsc": ".".join(map(str, PETSc.Sys.getVersion())), **hdf5.versions()}}
    first: list[float] = []
    before = _resident()
    setups, solves = [], []
    for _ in range(1 + WARM):
        started = time.process_time()
        if kind == "smallest":
            tree = smallest_tree(canonical, Facts.of(scene, MPI.COMM_SELF))
            options.insert_all(tree.options)
            found["left_out"] = [str(part) for part in tree.left_out]
        solver = Solver(scene)
        solver.set_up()
        setups.append(time.process_time() - started)
        solver.ksp.setMonitor(lambda _, n, __: first.append(time.process_time()) if n == 1 else None)
        started = time.process_time()
        result = solver.solve()
        solves.append(time.process_time() - started)
        if "memory" not in found:
            found["memory"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before) / 1e6
            found["pcs"] = _count(solver.ksp.getPC())
        solver.destroy()
    if not result.converged:
        raise RuntimeError(f"{path} {kind}: {result}")
    return found | {
        "iterations": result.iterations,
        "setup_seconds": statistics.median(setups[1:]),
        "solve_seconds": statistics.median(solves[1:]),
        "first_iteration_seconds": first[0],
    }


def _resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _count(pc: Any) -> int:
    """Number of PCs in a tree."""
    if pc.getType() == "fieldsplit":
        return 1 + sum(_count(ksp.getPC()) for ksp in pc.getFieldSplitSubKSP())
    inner = getattr(pc.getPythonContext(), "inner", None) if pc.getType() == "python" else None
    return 1 if inner is None else 1 + _count(inner)


def padded(scene: Scene) -> Scene:
    """The scene with all five fields: those that it lacks have one cell, which acts on no other field.

    The one exception are contact and interface displacement, which act on each other.

    Args:
        scene: whole; it has interface displacements if and only if it has contact.
    """
    D = scene.dimension
    added = [f for f in FIELDS if f.name not in scene.sizes]
    n = {f.name: f.block_size(D) for f in added}
    blocks = {(f, f): _identity(size, 2.0 if f == "contact" else 1.0) for f, size in n.items()}
    if "contact" in n:
        blocks |= {pair: _identity(D) for pair in (("contact", "intf_force"), ("intf_force", "contact"))}
    zeros = {f: np.zeros(size) for f, size in n.items()}
    centers = {f.name: np.array([[k, k * k, 0.0]]) for k, f in enumerate(added, start=1)}
    return replace(
        scene,
        sizes=scene.sizes | n,
        blocks=scene.blocks | blocks,
        rhs=scene.rhs | zeros,
        reference=scene.reference | zeros,
        cell_centers=scene.cell_centers | centers,
        contact_state=np.zeros(1, dtype=np.int64) if "contact" in n else scene.contact_state,
    )


def _identity(n: int, factor: float = 1.0) -> CSR:
    return CSR(np.arange(n + 1), np.arange(n), np.full(n, factor))
