"""A small scene that has everything, dense matrices, and what it means for two scenes to be the same."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

import petsc_fs
from petsc_fs.fields import FIELD
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Material, Metadata, Scene

SCENES = Path(petsc_fs.__path__[0]) / "scenes"
CELLS = {"contact": 2, "intf_force": 4, "momentum": 5, "intf_flow": 3, "mass": 6}


def csr(dense: np.ndarray) -> CSR:
    """Compressed rows of a dense matrix."""
    rows, columns = np.nonzero(dense)
    counts = np.bincount(rows, minlength=dense.shape[0])
    return CSR(np.concatenate([[0], np.cumsum(counts)]), columns, dense[rows, columns])


def dense(scene: Scene, fields: Iterable[str] = ()) -> np.ndarray:
    """The matrix of a whole scene, fields one after the other."""
    names = tuple(fields) or scene.fields
    start = dict(zip(names, np.cumsum([0, *(scene.sizes[f] for f in names)]), strict=False))
    matrix = np.zeros((sum(scene.sizes.values()),) * 2)
    for (r, c), block in scene.blocks.items():
        rows = np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))
        matrix[start[r] + rows, start[c] + block.indices] = block.data
    return matrix


def sparse_random(rng: np.random.Generator, shape: tuple[int, int], density: float = 0.4) -> np.ndarray:
    """Dense matrix with many zeros."""
    return rng.standard_normal(shape) * (rng.random(shape) < density)


def full_scene(dimension: int = 2, cells: dict[str, int] = CELLS, seed: int = 0) -> Scene:
    """Random numbers in every place that a scene has; some blocks are missing."""
    rng = np.random.default_rng(seed)
    sizes = {f: n * FIELD[f].block_size(dimension) for f, n in cells.items()}
    missing = {("contact", "mass"), ("intf_flow", "contact")}
    blocks = {(r, c): csr(sparse_random(rng, (m, n))) for r, m in sizes.items() for c, n in sizes.items()}
    material = {name: rng.random(cells["mass"]) for name in ("shear_modulus", "lame_lambda", "porosity", "normal_jump")}
    return Scene(
        dimension=dimension,
        sizes=sizes,
        blocks={rc: block for rc, block in blocks.items() if rc not in missing},
        rhs={f: rng.standard_normal(n) for f, n in sizes.items()},
        reference={f: rng.standard_normal(n) for f, n in sizes.items()},
        cell_centers={f: rng.random((n, 3)) for f, n in cells.items()},
        cell_volumes={f: rng.random(n) for f, n in cells.items()},
        cell_dimension=rng.integers(0, dimension + 1, cells["mass"]),
        contact_state=rng.integers(0, 3, cells["contact"]) if "contact" in cells else None,
        material=Material(
            **material, biot_coefficient=0.5, fluid_compressibility=1e-10, fluid_density=1e3, time_step=60.0
        ),
        metadata=Metadata(
            model="random",
            time_step_index=4,
            newton_index=2,
            time=240.0,
            units={"kg": 1e10, "m": 1.0},
            producers={"numpy": "some version"},
        ),
    )


def assert_same(a: Scene, b: Scene) -> None:
    """Every attribute is equal; of the producers, `b` has those of `a`, or who wrote it since."""
    assert (a.dimension, a.sizes, a.fields, a.rows) == (b.dimension, b.sizes, b.fields, b.rows)
    assert set(a.blocks) == set(b.blocks)
    for rc, block in a.blocks.items():
        for what, x, y in zip(CSR._fields, block, b.blocks[rc], strict=True):
            np.testing.assert_array_equal(x, y, err_msg=f"block {rc}, {what}")
    for what in ("rhs", "reference", "cell_centers", "cell_volumes"):
        left, right = getattr(a, what), getattr(b, what)
        assert set(left) == set(right)
        for name, values in left.items():
            np.testing.assert_array_equal(values, right[name], err_msg=f"{what} of {name}")
    for what in ("cell_dimension", "contact_state"):
        left, right = getattr(a, what), getattr(b, what)
        assert (left is None) == (right is None)
        if left is not None:
            np.testing.assert_array_equal(left, right, err_msg=what)
    assert (a.material is None) == (b.material is None)
    if a.material is not None and b.material is not None:
        assert a.material.time_step == b.material.time_step
        for name, value in a.material.cell_data().items():
            np.testing.assert_array_equal(value, b.material.cell_data()[name], err_msg=name)
    for what in ("model", "time_step_index", "newton_index", "time", "units"):
        np.testing.assert_equal(getattr(a.metadata, what), getattr(b.metadata, what))
    found, now = b.metadata.producers, hdf5.versions()
    assert all(found[name] in (version, now.get(name)) for name, version in a.metadata.producers.items())
