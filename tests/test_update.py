"""Updates of a system: blocks that did not change are left alone, and the result is that of setting all of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from programs import Program

import petsc_fs
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene
from petsc_fs.system import PatternChanged, System

pytestmark = pytest.mark.mpi
comm = MPI.COMM_WORLD
SCENE = Path(petsc_fs.__path__[0]) / "scenes" / "model2.h5"
CHANGING = ("contact", "contact")


def part() -> tuple[Scene, Layout]:
    whole = hdf5.read(SCENE)
    layout = Layout.contiguous(comm, whole.dimension, whole.sizes)
    return whole.restrict(layout), layout


def with_factor(scene: Scene, factor: float) -> Scene:
    """The same scene with one block multiplied."""
    blocks = dict(scene.blocks)
    b = blocks[CHANGING]
    blocks[CHANGING] = CSR(b.indptr, b.indices, factor * b.data)
    return replace(scene, blocks=blocks)


def assert_holds(system: System, scene: Scene, factors: dict[str, float] | None = None) -> None:
    for rc, block in scene.blocks.items():
        indptr, indices, values = system.blocks[rc].getValuesCSR()
        np.testing.assert_array_equal(np.diff(indptr), np.diff(block.indptr))
        np.testing.assert_array_equal(indices, block.indices)
        np.testing.assert_array_equal(values, (factors or {}).get(rc[0], 1.0) * block.data)


def test_values_are_those_of_the_scene_after_any_number_of_updates():
    scene, layout = part()
    system = System(scene, layout)
    for factor in (1.0, 2.0, 2.0, 3.0, 1.0):
        changed = with_factor(scene, factor)
        system.update(changed)
        assert_holds(system, changed)


def test_blocks_are_equal_only_where_they_are_so_on_all_ranks():
    scene, layout = part()
    system = System(scene, layout)
    assert system._equal_blocks(scene) == set()
    assert system._equal_blocks(scene) == set(system.blocks)
    last = comm.rank == comm.size - 1
    assert system._equal_blocks(with_factor(scene, 5.0 if last else 1.0)) == set(system.blocks) - {CHANGING}


@pytest.mark.parametrize("scaled", [1, 2])
def test_scaled_rows_are_what_they_were_before(scaled):
    scene, layout = part()
    system = System(scene, layout)
    factors = {f: 2.0 ** (k - 2) for k, f in enumerate(scene.fields)}
    factors["momentum"] = factors["intf_force"]
    for number in range(3):
        system.update(scene)
        assert_holds(system, scene)
        if number < scaled:
            system.scale_rows(factors)
            assert_holds(system, scene, factors)


def test_a_block_with_a_new_entry_is_made_anew_and_no_other():
    scene, layout = part()
    b = scene.blocks[CHANGING]
    kept = np.ones(b.data.size, dtype=bool)
    kept[b.indptr[1:] - 1] = np.diff(b.indptr) == 0  # the last entry of each row is missing
    counts = np.diff(np.concatenate([[0], np.cumsum(kept)])[b.indptr])
    fewer = CSR(np.concatenate([[0], np.cumsum(counts)]), b.indices[kept], b.data[kept])
    system = System(replace(scene, blocks=scene.blocks | {CHANGING: fewer}), layout)
    handles = {rc: matrix.handle for rc, matrix in system.blocks.items()}
    system.update(scene, grow=True)
    assert_holds(system, scene)
    assert {rc for rc, matrix in system.blocks.items() if matrix.handle != handles[rc]} == {CHANGING}
    k = layout.fields.index("contact")
    assert system.J.getNestSubMatrix(k, k).handle == system.blocks[CHANGING].handle


def test_as_many_entries_in_other_places_are_another_pattern():
    scene, layout = part()
    system = System(scene, layout)
    b = scene.blocks[CHANGING]
    columns = b.indices.copy()
    columns[b.indptr[1] - 1] = scene.sizes["contact"] - 1 if comm.rank == 0 else columns[b.indptr[1] - 1]
    assert comm.rank > 0 or (np.diff(columns[: b.indptr[1]]) > 0).all()
    with pytest.raises(PatternChanged, match="an entry is new"):
        system.update(replace(scene, blocks=scene.blocks | {CHANGING: CSR(b.indptr, columns, b.data)}))


GROWS_ON_ONE_RANK = """
import sys
import petsc4py; petsc4py.init([])
from pathlib import Path
import numpy as np
from mpi4py import MPI
import petsc_fs
from petsc_fs import options
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR
from petsc_fs.solver import Solver

comm = MPI.COMM_WORLD
options.insert(options.find_options_file("contact_poromechanics.opts"))
whole = hdf5.read(Path(petsc_fs.__path__[0]) / "scenes" / "model2.h5")
layout = Layout.contiguous(comm, whole.dimension, whole.sizes)
full, less = whole.restrict(layout), whole.restrict(layout)
if comm.rank == 1:
    b = less.blocks["contact", "contact"]
    less.blocks["contact", "contact"] = CSR(np.minimum(b.indptr, b.indptr[-1] - 1), b.indices[:-1], b.data[:-1])
solver = Solver(less, layout=layout)
solver.update(full)
converged = solver.solve().converged
sys.stdout.write(f"rebuilds {solver.rebuilds} converged {converged}\\n")  # print() writes a word at a time
solver.destroy()
del solver
"""


def test_program_ends_after_a_block_has_grown_on_one_rank(tmp_path: Path):
    """An exception that one rank kept held PETSc's objects there, and the ranks waited for each other at exit."""
    if comm.size > 1:
        pytest.skip("starts ranks itself")
    code, out, err = Program(tmp_path, GROWS_ON_ONE_RANK).end(30)
    assert code == 0, err
    assert out.splitlines().count("rebuilds 0 converged True") == 2
