"""Files: scenes, sequences and PETSc's binary format."""
