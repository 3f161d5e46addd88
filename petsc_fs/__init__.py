"""Nested fieldsplit preconditioners for contact poromechanics, the PETSc way.

Importing this package neither initialises PETSc nor imports a simulator. The parts:

- `petsc_fs.scene.Scene`: one linear system in fields, and `petsc_fs.io.hdf5` to keep it in a file;
- `petsc_fs.solver.Solver`: solves scenes by PETSc options;
- `petsc_fs.pc`: the Python PCs that options files name;
- `petsc_fs.porepy`: scenes from PorePy models.
"""

__version__ = "0.1.0"
