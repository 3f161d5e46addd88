"""What the Python PCs share: an inner PC with its own prefix on another matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from petsc4py import PETSc

from petsc_fs.dm import Members, Problem
from petsc_fs.errors import UsageError


class WrapperPC(ABC):
    """A PC that builds a matrix from its operator and applies an inner PC to it.

    The inner PC takes the prefix of this one followed by `prefix`. A second set-up, after the
    operator changed, makes the inner PC anew: its options are read again and all its levels see
    the new values. (A kept PCFIELDSPLIT would miss them below a MatNest in PETSc before 3.24.2.)
    """

    prefix: str
    inner: Any = None

    @abstractmethod
    def build(self, pc: PETSc.PC, problem: Problem, members: Members) -> tuple[PETSc.Mat, PETSc.DM]:
        """Matrix and DM of the inner PC. Collective; called at each set-up."""

    def setUp(self, pc: PETSc.PC) -> None:
        """Build the matrix and set the inner PC up. Collective.

        Raises:
            UsageError: the PC has no DM that names the fields.
        """
        dm = pc.getDM()
        if not dm or dm.getType() != "shell" or dm.getAppCtx() is None:
            raise UsageError(f"{type(self).__name__} needs the field names of a petsc_fs DM (petsc_fs.dm.field_dm)")
        self._release()
        matrix, inner_dm = self.build(pc, *dm.getAppCtx())
        self.inner = PETSc.PC().create(pc.comm)
        self.inner.setOptionsPrefix((pc.getOptionsPrefix() or "") + self.prefix)
        self.inner.incrementTabLevel(1, parent=pc)
        self.inner.setOperators(matrix, matrix)
        self.inner.setDM(inner_dm)
        self.inner.setFromOptions()
        self.inner.setUp()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = inner PC applied to x. Collective."""
        self.inner.apply(x, y)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """Print the operator and the inner PC. Collective."""
        if viewer.getType() != PETSc.Viewer.Type.ASCII:
            return
        viewer.printfASCII(f"{type(self).__name__}: {self.describe()}\n")
        if self.inner is not None:
            self.inner.view(viewer)

    @abstractmethod
    def describe(self) -> str:
        """One line on what is applied, with the options chosen."""

    def destroy(self, pc: PETSc.PC) -> None:
        """Free the inner PC. Collective; may be called twice."""
        self._release()

    def _release(self) -> None:
        if self.inner is not None:
            self.inner.destroy()
            self.inner = None


def choice(pc: PETSc.PC, option: str, choices: tuple[str, ...]) -> str:
    """Value of an option of a PC; the first choice is the default.

    Raises:
        UsageError: the value is none of the choices.
    """
    prefix = pc.getOptionsPrefix() or ""
    value = PETSc.Options(prefix).getString(option, choices[0])
    if value not in choices:
        raise UsageError(f"-{prefix}{option} {value}: expected {' or '.join(choices)}")
    return str(value)
