"""The PCs on a MatNest made by hand: set-ups over Newton steps, fields and names of other codes, nothing left over."""

import ast
import gc
import re
import resource
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import petsc_fs
from petsc_fs import nest, options
from petsc_fs.io import hdf5
from petsc_fs.io.petsc_binary import companions
from petsc_fs.pc.base import BasePC

pytestmark = pytest.mark.mpi
PACKAGE = Path(petsc_fs.__path__[0])
FILE = options.find_options_file("contact_poromechanics_fast.opts")
FIELDS = ("contact", "intf_force", "momentum", "intf_flow", "mass")
MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_"
RANK, RANKS = PETSc.COMM_WORLD.rank, PETSc.COMM_WORLD.size


def share(n: int, size: int) -> slice:
    """Rows of a field on this rank: whole cells, as many as on the next."""
    cells = n // size
    return slice(*(size * (cells * rank // RANKS) for rank in (RANK, RANK + 1)))


class Model:
    """model1 as a program of its own would have it: blocks, and a Newton step that changes them all."""

    def __init__(self) -> None:
        self.scene = hdf5.read(PACKAGE / "scenes" / "model1.h5")
        self.size = dict(zip(FIELDS, (2, 2, 2, 1, 1), strict=True))
        self.rhs = np.concatenate([v[share(v.size, self.size[f])] for f, v in self.scene.rhs.items()])

    def blocks(self, step: int = 0) -> nest.Blocks:
        """New matrices with other values at each step."""
        blocks = {(r, c): self.block(r, c, step) for r, c in self.scene.blocks}
        for f in FIELDS:
            blocks[f, f].setName(f)
            for what, values in companions(self.scene, f).items():
                vector = blocks[f, f].createVecLeft()
                vector.setArray(values[share(values.size, self.size[f])])
                blocks[f, f].compose(what, vector)
                vector.destroy()
        return blocks

    def block(self, r: str, c: str, step: int) -> PETSc.Mat:
        indptr, indices, data = self.scene.blocks[r, c]
        m, n = self.scene.sizes[r], self.scene.sizes[c]
        rows, columns = share(m, self.size[r]), share(n, self.size[c])
        entries = slice(indptr[rows.start], indptr[rows.stop])
        wave = 1 + 0.02 * step * np.cos(np.arange(n) // self.size[c])
        csr = (indptr[rows.start : rows.stop + 1] - entries.start, indices[entries], (data * wave[indices])[entries])
        sizes = tuple((s.stop - s.start, total) for s, total in ((rows, m), (columns, n)))
        csr = (csr[0].astype(PETSc.IntType), csr[1].astype(PETSc.IntType), csr[2])
        return PETSc.Mat().createAIJ(sizes, bsize=(self.size[r], self.size[c]), csr=csr)


@contextmanager
def solver(A: PETSc.Mat, **more: object):
    """A KSP by the fast file and further options."""
    prefix = "native_"
    with options.inserted(options.parse(FILE) | {k: str(v) for k, v in more.items()}, prefix):
        ksp = PETSc.KSP().create()
        ksp.setOptionsPrefix(prefix)
        ksp.setOperators(A)
        ksp.setFromOptions()
        yield ksp
        ksp.destroy()


def solve(ksp: PETSc.KSP, rhs: np.ndarray) -> tuple[int, np.ndarray]:
    A, _ = ksp.getOperators()
    x, b = A.createVecs()
    b.setArray(rhs)
    ksp.solve(b, x)
    assert ksp.getConvergedReason() > 0
    assert (b - A * x).norm() <= 1e-5 * b.norm()  # as far as rounding allows
    return ksp.getIterationNumber(), x.getArray().copy()


def set_ups() -> int:
    return PETSc.Log.Event("PCSetUp").getPerfInfo()["count"]


def all_levels(ksp: PETSc.KSP) -> list[PETSc.PC]:
    return list(nest.levels(ksp.getPC()))


def test_the_pcs_know_petsc_and_nothing_of_scenes():
    allowed = ("petsc_fs.nest", "petsc_fs.errors", "petsc_fs.pc")
    for path in (PACKAGE / "nest.py", *(PACKAGE / "pc").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                modules = [f"{node.module}.{a.name}" if node.module == "petsc_fs" else node.module for a in node.names]
            assert all(m.startswith(allowed) for m in modules if m.startswith("petsc_fs"))


@pytest.mark.parametrize("reuse", [False, True])
def test_over_newton_steps_every_level_is_set_up_once_and_kept(reuse, monkeypatch):
    model, kept = Model(), {f"{MECHANICS}ksp_reuse_preconditioner": 1} if reuse else {}
    in_python: list[str] = []
    set_up = BasePC.setUp
    monkeypatch.setattr(BasePC, "setUp", lambda self, pc: (in_python.append(pc.getOptionsPrefix()), set_up(self, pc)))
    PETSc.Log.begin()
    count = set_ups()
    with solver(nest.nest_of(FIELDS, model.blocks()), **kept) as ksp:
        solve(ksp, model.rhs)
        before, prefixes = [pc.handle for pc in all_levels(ksp)], sorted(in_python)
        types = [pc.getType() for pc in all_levels(ksp)]
        sweep = next(pc for pc in all_levels(ksp) if pc.getOptionsPrefix() == f"native_{MECHANICS}").getPythonContext()
        hierarchies = [pc.getOperators()[1].handle for pc in sweep.inners]
        assert (types.count("python"), types.count("hypre"), len(set(prefixes))) == (3, 3, 3)
        # PETSc logs no set-up within another, which the inner PCs of ours are; the ILU in ASM is no level of its own
        logged = (
            len(types)
            + types.count("asm")
            - sum(len(pc.getPythonContext().inners) for pc in all_levels(ksp) if pc.getType() == "python")
        )
        first = set_ups() - count
        nested = first < logged and PETSc.Sys.getVersion() > (3, 19)  # which sets more levels up within another
        assert nested or first == logged
        for step in (1, 2, 3):
            in_python.clear()
            count = set_ups()
            A = nest.nest_of(FIELDS, model.blocks(step))
            ksp.setOperators(A)
            found, x = solve(ksp, model.rhs)
            assert set_ups() - count == first - (reuse and not nested)
            assert sorted(in_python) == [p for p in prefixes if not reuse or p != f"native_{MECHANICS}"]
            assert [pc.handle for pc in all_levels(ksp)] == before
            assert ([pc.getOperators()[1].handle for pc in sweep.inners] == hierarchies) == reuse
            with solver(A) as fresh:
                expected, exact = solve(fresh, model.rhs)
            assert abs(found - expected) <= (10 if reuse else 0)
            largest = MPI.COMM_WORLD.allreduce(np.abs(exact).max(), MPI.MAX)
            np.testing.assert_allclose(x, exact, rtol=0, atol=(1e-6 if reuse else 1e-12) * largest)


LEVEL_3 = "qr_fieldsplit_1_fieldsplit_1_fs_"
WITH_HEAT = {
    "qr_pc_fieldsplit_1_fields": "1,2,3,4",
    "qr_fieldsplit_1_pc_fieldsplit_1_fields": "1,2,3",
    f"{LEVEL_3}pc_fieldsplit_1_fields": "1,2",
    f"{LEVEL_3}pc_fieldsplit_schur_precondition": "a11",  # selfp multiplies, which PETSc cannot do with a MatNest
    f"{LEVEL_3}fieldsplit_1_ksp_type": "preonly",
    f"{LEVEL_3}fieldsplit_1_pc_type": "fieldsplit",
    f"{LEVEL_3}fieldsplit_1_pc_fieldsplit_type": "multiplicative",
    f"{LEVEL_3}fieldsplit_1_fieldsplit_mass_ksp_type": "preonly",
    f"{LEVEL_3}fieldsplit_1_fieldsplit_mass_pc_type": "hypre",
    f"{LEVEL_3}fieldsplit_1_fieldsplit_temperature_ksp_type": "preonly",
    f"{LEVEL_3}fieldsplit_1_fieldsplit_temperature_pc_type": "hypre",
}


def test_a_field_that_no_pc_knows_passes_through_by_reference():
    model, names = Model(), (*FIELDS, "temperature")
    with solver(nest.nest_of(FIELDS, model.blocks()), **{f"{LEVEL_3}pc_fieldsplit_schur_precondition": "a11"}) as ksp:
        expected, _ = solve(ksp, model.rhs)
    blocks = model.blocks()
    heat = blocks["mass", "mass"].duplicate(copy=True)  # a Laplacian too
    heat.shift(heat.norm(PETSc.NormType.INFINITY) * 0.01)
    heat.setName("temperature")
    convection, expansion = blocks["mass", "mass"].duplicate(copy=True), blocks["momentum", "mass"].duplicate(copy=True)
    convection.scale(1e-2)
    expansion.scale(0.5)
    blocks |= {("temperature", "temperature"): heat, ("temperature", "mass"): convection}
    blocks["momentum", "temperature"] = expansion
    rhs = np.concatenate([model.rhs, np.ones(heat.getLocalSize()[0])])
    with solver(nest.nest_of(names, blocks), **WITH_HEAT) as ksp:
        found, _ = solve(ksp, rhs)
        assert found <= expected + 3
        levels = all_levels(ksp)
        transformed = levels[0].getPythonContext().inners[0].getOperators()[1]
        damped = next(pc for pc in levels if pc.getOptionsPrefix() == f"native_{LEVEL_3}").getOperators()[1]
        for matrix in (transformed, damped):
            fields = nest.field_names(matrix)
            k, m = fields.index("temperature"), fields.index("mass")
            assert matrix.getNestSubMatrix(k, k).handle == heat.handle
            assert matrix.getNestSubMatrix(k, m).handle == convection.handle
        prefixes = [pc.getOptionsPrefix() for pc in levels]
        assert f"native_{LEVEL_3}fieldsplit_1_fieldsplit_temperature_" in prefixes


def test_nothing_is_left_over_from_one_update_to_the_next(capfd):
    model, sizes = Model(), []
    PETSc.garbage_cleanup(PETSc.COMM_WORLD)
    passed_on = model.block("intf_flow", "mass", 0)  # by reference through all levels
    with solver(nest.nest_of(FIELDS, model.blocks())) as ksp:
        for step in range(22):
            blocks = model.blocks(step % 3) | {("intf_flow", "mass"): passed_on}
            A = nest.nest_of(FIELDS, blocks)
            ksp.setOperators(A)
            ksp.setUp()
            x, b = A.createVecs()
            ksp.getPC().apply(b, x)  # which sets the inner levels up
            for block in (x, b, A, *blocks.values()):
                if block.handle != passed_on.handle:
                    block.destroy()
            gc.collect()
            sizes.append((passed_on.getRefCount(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
        PETSc.garbage_view(PETSc.COMM_WORLD)  # what petsc4py keeps on several ranks, a line a rank
    assert set(re.findall(r"entries: (\d+)", capfd.readouterr().out)) <= {"0"}
    counts, memory = zip(*sizes, strict=True)
    assert set(counts[2:]) == {counts[1]}
    assert memory[-1] - memory[5] < 2000  # KiB; a set-up makes ten times as many
