"""Memory by phase, and that the large blocks of a scene are not held more often than needed."""

import gc
import platform
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from sample import SCENES, full_scene

from petsc_fs import csr as csr_module
from petsc_fs import memory, options
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver

MIB = 1 << 20
linux = pytest.mark.skipif(not memory.CLEAR.exists(), reason="needs Linux's /proc")


glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")


def in_own_process(call: str) -> str:
    """What a function of this file prints in a process of its own.

    What other tests have freed would be filled first here, and hide what is new.
    """
    command = [sys.executable, "-c", f"import test_memory; test_memory.{call}()"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


@linux
@glibc
def test_a_phase_has_its_own_peak():
    separate, large_peak, large_held, small_peak = map(int, in_own_process("print_phases").split())
    assert separate
    assert large_peak > 60 * MIB > large_held
    assert small_peak < large_peak - 50 * MIB


def print_phases() -> None:
    """Whether peaks are separate, and bytes since the start: peak and held with a large array, peak after it."""
    phases = memory.Phases()
    array = np.ones(8 * MIB)
    del array
    phases.end("large")
    phases.end("small")
    since = [size - phases.start for size in (phases.peaks["large"], phases.helds["large"], phases.peaks["small"])]
    print(int(phases.separate), *since)


def test_without_proc_the_peak_is_that_of_the_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    before = memory.peak()
    monkeypatch.setattr(memory, "STATUS", tmp_path / "status")
    monkeypatch.setattr(memory, "CLEAR", tmp_path / "nowhere" / "clear_refs")
    phases = memory.Phases()
    phases.end("read")
    phases.end("solve")
    assert not phases.separate
    assert before // 2 < phases.peaks["read"] <= phases.peaks["solve"]


@pytest.mark.mpi
def test_report_has_every_rank():
    comm = MPI.COMM_WORLD
    phases = memory.Phases()
    phases.peaks, phases.helds = {"a": 10 + comm.rank, "b": 5}, {"a": 1, "b": 2}
    report = phases.report(comm)
    assert report["peak"] == {"a": [10 + r for r in range(comm.size)], "b": [5] * comm.size}
    assert report["held"]["b"] == [2] * comm.size == [2 for _ in report["start"]]
    assert report["peak_all_ranks"] == sum(10 + r for r in range(comm.size))


def test_text():
    report = {"start": [1, 1], "peak": {"read": [3 * MIB, 5 * MIB], "solve": [1, 2]}, "peak_all_ranks": 2000 * MIB}
    assert memory.text(report) == "peak memory of a rank: read 5 MiB, solve 2 B; of all 2 ranks 1.95 GiB"
    assert memory.text(report | {"start": [1]}) == "peak memory: read 5 MiB, solve 2 B"


def test_units():
    assert [memory.in_units(n) for n in (999, 1000, 1023 * MIB, 20 * 1024 * MIB)] == [
        "999 B",
        "0.977 KiB",
        "0.999 GiB",
        "20 GiB",
    ]


@pytest.mark.mpi
@pytest.mark.parametrize("release", [False, True])
def test_source_is_freed_once_petsc_has_it(release: bool):
    scene = full_scene()
    before = {rc: weakref.ref(block.data) for rc, block in scene.blocks.items()}
    solver = Solver(scene, release=release)
    gc.collect()
    assert bool(scene.blocks) is not release
    if MPI.COMM_WORLD.size > 1:  # on one rank matrices are in these very arrays
        assert all((ref() is None) is release for ref in before.values())
    solver.destroy()


@linux
@glibc
def test_building_does_not_hold_the_matrix_twice():
    assert abs(float(in_own_process("build_and_print"))) < 3, "a copy is 12 bytes an entry"


def build_and_print() -> None:
    """Bytes held after building a system, per entry of its matrix."""
    scene = banded_scene(rows=12_000, width=150)
    entries = scene.blocks["momentum", "momentum"].data.size
    memory.return_freed()
    phases = memory.Phases()
    solver = Solver(scene, MPI.COMM_SELF, release=True)
    phases.end("build")
    print((phases.helds["build"] - phases.start) / entries)
    solver.destroy()


@linux
@glibc
def test_nothing_is_left_of_a_destroyed_solver():
    assert abs(float(in_own_process("destroy_and_print"))) < 0.2, "1 is a matrix for each solver"


def destroy_and_print() -> None:
    """Bytes that three solvers leave behind, made and destroyed one after the other, in matrices."""
    held = []
    for _ in range(5):
        scene = banded_scene(rows=6_000, width=100)
        scene.sizes["mass"] = 3
        scene.rhs["mass"] = np.ones(3)
        identity = CSR(np.arange(4, dtype=PETSc.IntType), np.arange(3, dtype=PETSc.IntType), np.ones(3))
        scene.blocks["mass", "mass"] = identity
        size = 12 * scene.blocks["momentum", "momentum"].data.size
        Solver(scene, MPI.COMM_SELF, release=True).destroy()
        memory.return_freed()
        held.append(memory.held())
    print((held[-1] - held[1]) / 3 / size)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["model1", "model3"])
def test_storage_of_mechanics_changes_nothing(name: str, clean: PETSc.Options):
    scene = hdf5.read(SCENES / f"{name}.h5")
    clean.setValue("ksp_max_it", 12)
    options.insert(options.find_options_file("contact_poromechanics.opts"))
    histories, types = [], []
    for mat_type in (None, "aij"):
        if mat_type:
            clean.setValue("qr_mechanics_mat_type", mat_type)
        solver = Solver(scene)
        solver.solve()
        histories.append(solver.history())
        block = mechanics_block(solver)
        types.append(block.getType())
        assert block.getBlockSize() == scene.dimension
        solver.destroy()
    assert types[0] == "hypre" and types[1].endswith("aij")
    np.testing.assert_allclose(histories[0][:8], histories[1][:8], rtol=1e-6)


def test_matrix_is_cut_into_the_same_blocks_in_any_pieces(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(1)
    n = 30
    dense = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.4) + np.eye(n)
    order = rng.permutation(n)
    fields = {"momentum": order[:20], "mass": order[20:]}
    rows, columns = np.nonzero(dense)
    matrix = CSR(np.searchsorted(rows, np.arange(n + 1)), columns, dense[rows, columns])
    results = []
    for slab in (1, 7, 1 << 20):
        monkeypatch.setattr(csr_module, "SLAB", slab)
        results.append(Scene.from_matrix(matrix, np.ones(n), fields, dimension=2).blocks)
    for found in results:
        assert found.keys() == results[0].keys()
        for rc, block in found.items():
            for a, b in zip(block, results[-1][rc], strict=True):
                np.testing.assert_array_equal(a, b)
    r, c = "momentum", "mass"
    block = results[0][r, c]
    part = np.zeros((20, 10))
    part[np.repeat(np.arange(20), np.diff(block.indptr)), block.indices] = block.data
    np.testing.assert_array_equal(part, dense[np.ix_(fields[r], fields[c])])


def mechanics_block(solver: Solver) -> PETSc.Mat:
    """The block of mechanics that the inner PC of ContactTransform works on."""
    _, nest = solver.ksp.getPC().getPythonContext().inners[0].getOperators()
    return nest.getNestSubMatrix(1, 1)


def banded_scene(rows: int, width: int) -> Scene:
    """One field of displacements with `2 width` entries in most rows."""
    first = np.maximum(np.arange(rows) - width, 0)
    last = np.minimum(np.arange(rows) + width, rows)
    indptr = np.concatenate([[0], np.cumsum(last - first)])
    indices = (np.arange(indptr[-1]) - np.repeat(indptr[:-1] - first, last - first)).astype(PETSc.IntType)
    block = CSR(indptr.astype(PETSc.IntType), indices, np.ones(indices.size))
    return Scene(
        dimension=3,
        sizes={"momentum": rows},
        blocks={("momentum", "momentum"): block},
        rhs={"momentum": np.ones(rows)},
    )
