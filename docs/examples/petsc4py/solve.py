"""Solve what `petsc-fs convert` wrote: a MatNest with named blocks, vectors composed on them, and an options file."""

import sys
from pathlib import Path

import numpy as np
import petsc4py

petsc4py.init(sys.argv)  # -options_file FILE
from petsc4py import PETSc  # noqa: E402

from petsc_fs import nest  # noqa: E402

options = PETSc.Options()
folder, dimension = Path(options.getString("dir", "model1_petsc")), options.getInt("dim", 2)
files = ("contact", "intf_force", "momentum", "intf_flow", "mass")
files = tuple(file for file in files if (folder / "fields" / f"{file}.petsc").exists())
names = options.getString("names", ",".join(files)).split(",")  # of the fields, as this program calls them


def load(thing: PETSc.Object, name: str) -> PETSc.Object:
    """A Mat, Vec or IS from a file of the folder."""
    viewer = PETSc.Viewer().createBinary(str(folder / name), "r")
    thing.load(viewer)
    viewer.destroy()
    return thing


A = load(PETSc.Mat().create(), "matrix.petsc")
b = load(PETSc.Vec().create(), "rhs.petsc")

# Rows of each field. The block size comes before the file, so that no cell is cut between ranks.
fields = {}
for name, file in zip(names, files, strict=True):
    rows = PETSc.IS().create()
    rows.setType("general")
    rows.setBlockSize(1 if file in ("intf_flow", "mass") else dimension)
    fields[name] = load(rows, f"fields/{file}.petsc")

# A block per pair of fields; those on the diagonal carry the names, and that of pressure what FixedStress needs.
J = nest.split(A, fields)
mass = J.getNestSubMatrix(len(files) - 1, len(files) - 1)
for what in ("fixed_stress_base", "fixed_stress_ratio"):
    mass.compose(what, load(mass.createVecLeft(), f"fields/mass.{what}.petsc"))

# A vector of the nest has, on each rank, one field after the other.
x, rhs = J.createVecs()
there = np.concatenate([rows.getIndices() for rows in fields.values()])
PETSc.Scatter().create(b, PETSc.IS().createGeneral(there), rhs, None).scatter(b, rhs)

ksp = PETSc.KSP().create()
ksp.setOperators(J)
nest.give_fields(ksp)  # for files that begin with a PCFIELDSPLIT
ksp.setFromOptions()
ksp.solve(rhs, x)
PETSc.Sys.Print(f"{ksp.its} iterations, true relative residual {(rhs - J * x).norm() / rhs.norm():.1e}")
