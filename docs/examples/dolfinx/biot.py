"""Consolidation by DOLFINx, P2 displacements and P1 pressure, on the blocked matrix that DOLFINx assembles."""

import sys
from pathlib import Path

import dolfinx_solver  # noqa: F401 (of the wheel dolfinx-solver-real: orders MPI before all else)
import numpy as np
import petsc4py

petsc4py.init(sys.argv)  # -options_file FILE
import dolfinx.fem.petsc as fem_petsc  # noqa: E402
import ufl  # noqa: E402
from dolfinx import fem, mesh  # noqa: E402
from mpi4py import MPI  # noqa: E402
from petsc4py import PETSc  # noqa: E402

from petsc_fs import nest  # noqa: E402

options, comm = PETSc.Options(), MPI.COMM_WORLD
D, n = options.getInt("dim", 2), options.getInt("n", 16)

# Lengths in 100 m, stresses in GPa: stiffness, storage and mobility times time step are of the order of one.
E, nu, alpha, storage, mobility, load = 1.0, 0.25, 1.0, 0.02, 1e-4, 1e-3
G, lame = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))

domain = mesh.create_unit_square(comm, n, n) if D == 2 else mesh.create_unit_cube(comm, n, n, n)
V, Q = fem.functionspace(domain, ("Lagrange", 2, (D,))), fem.functionspace(domain, ("Lagrange", 1))
u, v, p, q = ufl.TrialFunction(V), ufl.TestFunction(V), ufl.TrialFunction(Q), ufl.TestFunction(Q)


def strain(w):
    """Of small displacements."""
    return ufl.sym(ufl.grad(w))


stress = lame * ufl.div(u) * ufl.Identity(D) + 2 * G * strain(u)
form = fem.form(
    [
        [ufl.inner(stress, strain(v)) * ufl.dx, -alpha * p * ufl.div(v) * ufl.dx],
        [
            alpha * q * ufl.div(u) * ufl.dx,
            (storage * p * q + mobility * ufl.dot(ufl.grad(p), ufl.grad(q))) * ufl.dx,
        ],
    ]
)

# A load on the upper side, which is drained; rollers below and on the sides.
facets = D - 1
domain.topology.create_connectivity(facets, D)
top = np.sort(mesh.locate_entities_boundary(domain, facets, lambda x: np.isclose(x[D - 1], 1)))
ds = ufl.Measure("ds", domain, subdomain_data=mesh.meshtags(domain, facets, top, np.ones_like(top)))
rhs_form = fem.form([-load * v[D - 1] * ds(1), fem.Constant(domain, 0.0) * q * ufl.dx])
fixed = [fem.dirichletbc(0.0, fem.locate_dofs_topological(Q, facets, top), Q)]
for i in range(D):
    side = mesh.locate_entities_boundary(
        domain, facets, lambda x, i=i: np.isclose(x[i], 0) | ((i < D - 1) & np.isclose(x[i], 1))
    )
    fixed.append(fem.dirichletbc(0.0, fem.locate_dofs_topological(V.sub(i), facets, side), V.sub(i)))

A = fem_petsc.assemble_matrix(form, bcs=fixed, kind="nest")
A.assemble()
parts = fem_petsc.assemble_vector(rhs_form, kind="nest")
fem_petsc.apply_lifting(parts, form, bcs=fem.bcs_by_block(fem.extract_function_spaces(form, 1), fixed))
for part in parts.getNestSubVecs():
    part.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
fem_petsc.set_bc(parts, fem.bcs_by_block(fem.extract_function_spaces(rhs_form), fixed))

# Names, and what travels on the blocks.
momentum, mass = A.getNestSubMatrix(0, 0), A.getNestSubMatrix(1, 1)
momentum.setName("momentum")
mass.setName("mass")
if not options.hasName("algebraic"):  # else FixedStress makes do with the matrix
    lumped = fem_petsc.assemble_vector(fem.form(q * ufl.dx))  # the integrals of the hat functions
    lumped.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    base, ratio = mass.createVecLeft(), mass.createVecLeft()
    base.setArray(lumped.getArray() * alpha**2 / (4 * G + 2 * lame))
    ratio.set((4 * G + 2 * lame) / (2 * G / D + lame))
    mass.compose("fixed_stress_base", base)
    mass.compose("fixed_stress_ratio", ratio)
places = momentum.createVecLeft()
places.setArray(V.tabulate_dof_coordinates()[: places.getLocalSize() // D, :D])
momentum.setNearNullSpace(PETSc.NullSpace().createRigidBody(places))

x, b = A.createVecs()
b.setArray(np.concatenate([part.getArray() for part in parts.getNestSubVecs()]))
if (folder := Path(options.getString("write", ""))) != Path():  # as `petsc-fs convert` does, for solve.py of petsc4py
    (folder / "fields").mkdir(parents=True, exist_ok=True)
    rows = A.getNestISs()[0]
    things = {"matrix": A.convert("aij", PETSc.Mat()), "rhs": b, "fields/momentum": rows[0], "fields/mass": rows[1]}
    for what in ("fixed_stress_base", "fixed_stress_ratio"):
        if (vector := mass.query(what)) is not None:
            things[f"fields/mass.{what}"] = vector
    for name, thing in things.items():
        viewer = PETSc.Viewer().createBinary(str(folder / f"{name}.petsc"), "w", comm=comm)
        thing.view(viewer)
        viewer.destroy()

ksp = PETSc.KSP().create(comm)
ksp.setOperators(A)
nest.give_fields(ksp)
ksp.setFromOptions()
ksp.solve(b, x)

difference = ""
if options.getBool("direct", True):
    one = A.convert("aij", PETSc.Mat())
    direct = PETSc.KSP().create(comm)
    direct.setOperators(one)
    direct.setType("preonly")
    direct.getPC().setType("lu")
    direct.getPC().setFactorSolverType("mumps")
    exact = b.duplicate()
    direct.solve(b, exact)
    difference = f", difference to a direct solver {(x - exact).norm() / exact.norm():.1e}"
PETSc.Sys.Print(
    f"{b.getSize()} unknowns on {comm.size} ranks: {ksp.its} iterations, true relative residual "
    f"{(b - A * x).norm() / b.norm():.1e}{difference}"
)
