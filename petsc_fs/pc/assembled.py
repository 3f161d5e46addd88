"""A MatNest as one matrix, for what cannot work on blocks."""

from __future__ import annotations

from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.pc.base import WrapperPC


class Assembled(WrapperPC):
    """An inner PC on the operator as one AIJ, of which a copy is made if it is a MatNest: direct solvers need it.

    Options, with the prefix of this PC:
        -assembled_*: of the inner PC.
    """

    prefix = "assembled_"

    def build(self, pc: PETSc.PC) -> PETSc.Mat:
        """The operator, assembled. Collective."""
        operator = pc.getOperators()[1]
        return nest.one_matrix(operator) if operator.getType() == "nest" else operator

    def describe(self) -> str:
        """In one line."""
        return "inner PC on the blocks as one matrix"
