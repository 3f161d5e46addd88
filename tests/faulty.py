"""Preconditioners that go wrong, for tests of what becomes of it."""

import time

import numpy as np
from petsc4py import PETSc


class Hanging:
    def setUp(self, pc: PETSc.PC) -> None:
        time.sleep(3600)


class Hungry:
    def setUp(self, pc: PETSc.PC) -> None:
        self.much = np.empty(2**38)  # two terabytes
