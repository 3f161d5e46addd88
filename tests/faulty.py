"""Preconditioners that go wrong, for tests of what becomes of it."""

import os
import signal
import time

import numpy as np
from petsc4py import PETSc


class Crashing:
    def setUp(self, pc: PETSc.PC) -> None:
        os.kill(os.getpid(), signal.SIGSEGV)


class Hanging:
    def setUp(self, pc: PETSc.PC) -> None:
        time.sleep(3600)


class Hungry:
    def setUp(self, pc: PETSc.PC) -> None:
        self.much = np.empty(2**38)  # two terabytes


class Growing:
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        x.copy(y)
        y.scale(1e9)
