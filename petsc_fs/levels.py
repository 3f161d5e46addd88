"""The levels of a set-up preconditioner tree, in one walk for all who look into it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from petsc4py import PETSc


def levels(pc: PETSc.PC) -> Iterator[PETSc.PC]:
    """A PC and all PCs in it, each before those in it, in the order of elimination.

    Collective. Goes into PCFIELDSPLIT and into the Python PCs of this package, not into what is local to a rank, as
    the subdomains of PCASM are. What is in a PC is asked for only once the caller has had the PC itself: whoever walks
    may set it up first. A Python PC that is not set up has nothing in it; a PCFIELDSPLIT has to be.
    """
    yield pc
    if pc.getType() == "fieldsplit":
        for ksp in pc.getFieldSplitSubKSP():
            yield from levels(ksp.getPC())
    elif pc.getType() == "python":
        context = pc.getPythonContext()
        inner = getattr(context, "inner", None)
        for one in [inner] if inner is not None else getattr(context, "inners", ()):
            yield from levels(one)
