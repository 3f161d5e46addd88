"""What the Python PCs share: inner PCs that are made once and updated, options, and a safe end."""

from __future__ import annotations

import atexit
import ctypes
import functools
import gc
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import PetscFsError, UsageError

_alive: dict[int, None] = {}
"""Handles of the PCs that have a context of ours, in the order of their making."""
_ending: list[bool] = []
"""Not empty once the program is at its end."""


@atexit.register
def _end() -> None:
    """Take our contexts from PCs that a program has not destroyed, and make them PCNONE.

    PETSc ends after Python has, and a Python PC that is still there then makes petsc4py crash. Local: what inner PCs
    hold is left as it is, for it may take all ranks to free it, and they may not all be here.
    """
    _ending.append(True)
    for handle in list(_alive):
        nest.call("PCSetType", ctypes.c_void_p(handle), b"none")


def _collect(_: None) -> int:
    gc.enable()
    return 0


_collect_again = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(_collect)


def told(method: Callable[..., None]) -> Callable[..., None]:
    """A method that PETSc calls, which prints its errors where nobody else would.

    Through PETSc an error comes to a program in Python as it is, but to one in C or Fortran as a blank one. PETSc has
    printed its own errors by then. What happened on all ranks is printed by all, for the first to end ends the others.

    On the way through PETSc, petsc4py's error handler formats line numbers, where Python 3.12 and newer collect garbage
    that is due, forget the error for it, and petsc4py crashes. So collection is off until Python's interpreter goes on,
    which makes pending calls then. It would also do so after any call in here, hence the iterator.
    """

    @functools.wraps(method)
    def told_method(self: BasePC, pc: PETSc.PC, *vectors: PETSc.Vec) -> None:
        try:
            method(self, pc, *vectors)
        except Exception as e:
            first: BaseException = e
            while isinstance(first, PETSc.Error) and first.__cause__ is not None:  # as newer petsc4py has it
                first = first.__cause__
            if not hasattr(first, "__notes__"):  # else it has come through another PC of ours
                first.add_note(f"in {type(self).__name__} with options -{pc.getOptionsPrefix() or ''}")
                if not sys.orig_argv and not isinstance(first, PETSc.Error):  # the interpreter was started by PETSc
                    if not isinstance(first, PetscFsError):
                        traceback.print_exc()
                    sys.stderr.write(f"[{pc.comm.rank}] petsc_fs: {first}\n")
                    sys.stderr.flush()
            if gc.isenabled():
                gc.disable()
                (refused,) = map(ctypes.pythonapi.Py_AddPendingCall, (_collect_again,), (None,))
                if refused:
                    gc.enable()
            raise

    return told_method


class BasePC(ABC):
    """A PC in Python with inner PCs, which PETSc sets up as often as it has a new matrix.

    Inner PCs are made at the first set-up, with options of their own, and get new matrices at further ones; so
    `-..._ksp_reuse_preconditioner` and the like decide what is built anew.

    Attributes:
        inners: PCs, in the order of elimination.
    """

    inners: tuple[PETSc.PC, ...] = ()

    def create(self, pc: PETSc.PC) -> None:
        """Note that the PC is there: it may never be set up, where another one fails. Local."""
        _alive[pc.handle] = None

    @told
    def setUp(self, pc: PETSc.PC) -> None:
        """Take a new matrix. Collective."""
        self.update(pc)
        PETSc.garbage_cleanup(pc.comm)  # on several ranks petsc4py keeps what Python drops

    @abstractmethod
    def update(self, pc: PETSc.PC) -> None:
        """Build what there is to build from the operator of the PC. Collective."""

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """Print what is applied, and the first inner PC. Collective."""
        if viewer.getType() != PETSc.Viewer.Type.ASCII:
            return
        viewer.printfASCII(f"{type(self).__name__}: {self.describe()}\n")
        if self.inners:
            self.inners[0].view(viewer)

    @abstractmethod
    def describe(self) -> str:
        """One line on what is applied, with the options chosen."""

    def destroy(self, pc: PETSc.PC) -> None:
        """Free everything. Collective, but at the end of the program; may be called twice."""
        _alive.pop(pc.handle, None)
        for inner in self.inners:
            if _ending:
                inner.incRef()
            else:
                inner.destroy()
        self.inners = ()
        if not _ending:
            self.release()

    @abstractmethod
    def release(self) -> None:
        """Free what is kept beside the inner PCs. Collective; may be called twice."""


class WrapperPC(BasePC):
    """A PC that applies an inner PC to a matrix that it builds from its operator.

    The inner PC takes the prefix of this one followed by `prefix`. It gets a new MatNest object at each set-up, and
    with it new sub-matrices: in PETSc before 3.24.2 those of a MatNest that is kept miss new values.
    """

    prefix: str
    _matrix: Any = None

    @abstractmethod
    def build(self, pc: PETSc.PC) -> PETSc.Mat:
        """The matrix of the inner PC. Collective."""

    def update(self, pc: PETSc.PC) -> None:
        """Build the matrix and set the inner PC up. Collective."""
        matrix, before = self.build(pc), self._matrix
        if not self.inners:
            inner = PETSc.PC().create(pc.comm)
            inner.setOptionsPrefix((pc.getOptionsPrefix() or "") + self.prefix)
            inner.incrementTabLevel(1, parent=pc)
            inner.setOperators(matrix, matrix)
            if matrix.getType() == "nest" or matrix.getAttr(nest.COMPONENTS):
                inner.setDM(nest.field_dm(matrix))
            inner.setFromOptions()
            self.inners = (inner,)
        self.inners[0].setOperators(matrix, matrix)
        self.inners[0].setUp()
        self._matrix = matrix
        if before is not None:
            before.destroy()

    @told
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = inner PC applied to x. Collective."""
        self.inners[0].apply(x, y)

    def release(self) -> None:
        """Free the matrix. Collective; may be called twice."""
        if self._matrix is not None:
            self._matrix.destroy()
            self._matrix = None


def choice(pc: PETSc.PC, option: str, choices: tuple[str, ...]) -> str:
    """Value of an option of a PC; the first choice is the default. Local.

    Raises:
        UsageError: the value is none of the choices.
    """
    value = text(pc, option, choices[0])
    if value not in choices:
        raise UsageError(f"-{pc.getOptionsPrefix() or ''}{option} {value}: expected {' or '.join(choices)}")
    return value


def text(pc: PETSc.PC, option: str, default: str) -> str:
    """Value of an option of a PC as text. Local."""
    return str(PETSc.Options(pc.getOptionsPrefix() or "").getString(option, default))
