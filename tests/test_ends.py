"""How programs end after an error: no crash in garbage collection, no rank that waits for another, nothing kept.

Each program runs in processes of its own, with a limit of time.
"""

import pytest
from programs import Program
from sample import SCENES

LIMIT = 60

RAISING = """
import gc, sys
from mpi4py import MPI  # first, for wheels in which it is what finds libmpi
import petsc4py
petsc4py.init([])
from petsc4py import PETSc
from petsc_fs import pc as ours

def innermost(error):
    while error.__cause__ is not None:
        error = error.__cause__
    return error

A = PETSc.Mat().createAIJ((40, 40), nnz=1)
A.setUp()
for i in range(*A.getOwnershipRange()):
    A[i, i] = 1.0
A.assemble()
x, b = A.createVecs()
database = PETSc.Options()
database["pc_type"], database["pc_python_type"] = "python", "petsc_fs.pc.Assembled"
database["assembled_pc_type"], database["assembled_pc_python_type"] = "python", "petsc_fs.pc.ContactTransform"
gc.set_threshold({threshold}, 2, 2)
found = []
for k in range(60):
    ksp = PETSc.KSP().create()
    ksp.setOperators(A)
    ksp.setFromOptions()
    waiting = [[] for _ in range(k)]  # that collection is due at a different place each time
    try:
        ksp.solve(b, x) if k % 2 else ksp.setUp()
    except Exception as e:
        found.append(str(innermost(e)))
    assert gc.isenabled()
    ksp.destroy()
assert len(found) == 60 and all(f.startswith("ContactTransform needs a MatNest") for f in found), found
gc.disable()
try:
    ksp = PETSc.KSP().create()
    ksp.setOperators(A)
    ksp.setFromOptions()
    ksp.setUp()
except Exception:
    pass
assert not gc.isenabled()  # as the program had it
sys.stdout.write("over\\n")  # at once
"""


@pytest.mark.parametrize("threshold", [1, 20, 700])
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_pc_that_raises_in_set_up_crashes_no_program_by_garbage_collection(tmp_path, threshold, ranks):
    code, out, errors = Program(tmp_path, RAISING.format(threshold=threshold), ranks).end(LIMIT)
    assert (code, out.split()) == (0, ["over"] * ranks), errors


FOREIGN = """
import gc, sys, types
from mpi4py import MPI
import petsc4py
petsc4py.init([])
from petsc4py import PETSc
import petsc_fs

class Raising:
    def setUp(self, pc):
        raise ValueError("no")

pcs = types.ModuleType("pcs")
pcs.Raising = Raising
sys.modules["pcs"] = pcs
scene = petsc_fs.hdf5.read(sys.argv[1])
database = PETSc.Options()
database["pc_type"], database["pc_python_type"] = "python", "pcs.Raising"
{retry}
gc.set_threshold(20, 2, 2)
for k in range(30):
    waiting = [[] for _ in range(k)]
    solver = petsc_fs.Solver(scene)
    try:
        solver.solve()
    except Exception as e:
        assert (type(e).__name__, str(e)) in (("ValueError", "no"), ("SolveError", "set-up failed: ValueError: no")), e
    else:
        raise AssertionError
    solver.destroy()
    assert gc.isenabled()
sys.stdout.write("over\\n")  # at once
"""
RETRY = """
open("raising.opts", "w").write("-pc_type python\\n-pc_python_type pcs.Raising\\n")
database["petsc_fs_retry"] = "raising.opts"
"""


@pytest.mark.parametrize("retry", ["", RETRY], ids=["first", "retry"])
def test_nor_does_a_foreign_pc_in_a_solver(tmp_path, retry):
    program = Program(tmp_path, FOREIGN.format(retry=retry), 1, (str(SCENES / "flow.h5"),))
    code, out, errors = program.end(LIMIT)
    assert (code, out) == (0, "over\n"), errors


ONE_RANK_FAILS = """
import gc, sys
gc.disable()  # what is gone at the end is gone by itself
from mpi4py import MPI
from petsc_fs.cli.main import main
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5

def write_solution(*_):
    raise SceneError("cannot be written")

hdf5.write_solution = write_solution  # which rank 0 calls, after the solve
code = main(["solve", sys.argv[1], "--save", "x.h5"])
from petsc4py import PETSc
from petsc_fs.solver import Solver
kept = [o for o in gc.get_objects() if isinstance(o, Solver | PETSc.KSP | PETSc.Mat | PETSc.PC)]
sys.stdout.write(f"kept {len(kept)}\\n")  # at once
sys.exit(code)
"""


def test_an_error_on_one_rank_keeps_no_solver(tmp_path):
    code, out, errors = Program(tmp_path, ONE_RANK_FAILS, 2, (str(SCENES / "flow.h5"),)).end(LIMIT)
    assert code == 3
    assert out.split() == ["kept", "0"] * 2
    assert errors.count("petsc-fs: cannot be written") == 1


ALIVE_ON_SOME = """
import gc, sys
from mpi4py import MPI  # first, for wheels in which it is what finds libmpi
import petsc4py
petsc4py.init([])
import petsc_fs

class Holder:
    pass

rank, keeps = MPI.COMM_WORLD.rank, int(sys.argv[2])
solver = petsc_fs.Solver(petsc_fs.hdf5.read(sys.argv[1]))
result = solver.solve()
assert result.converged
if rank == keeps:
    holder = Holder()
    holder.circle, holder.kept = holder, [solver, solver.ksp, solver.ksp.getPC(), solver.system]
    if {loose}:
        del holder, solver, result
else:
    del solver, result
    gc.collect()
sys.stdout.write("over\\n")  # at once
{last}
"""


@pytest.mark.parametrize(
    ("keeps", "loose", "last"),
    [(0, False, "sys.exit(3)"), (0, True, "raise RuntimeError"), (1, False, ""), (1, True, "sys.exit(3)")],
    ids=["0_held_exit", "0_in_a_cycle_raise", "1_held_end", "1_in_a_cycle_exit"],
)
def test_ranks_end_that_do_not_hold_the_same(tmp_path, keeps, loose, last):
    text = ALIVE_ON_SOME.format(loose=loose, last=last)
    code, out, errors = Program(tmp_path, text, 2, (str(SCENES / "model1.h5"), str(keeps))).end(LIMIT)
    assert (code != 0, out.split()) == (bool(last), ["over"] * 2), errors
    assert "SEGV" not in errors
