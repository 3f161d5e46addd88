"""Preconditioners that go wrong, for tests of what becomes of it."""

import os
import time

from petsc_fs.errors import SolveError


class Crash:
    def setUp(self, pc):
        os.abort()


class Exit:
    def setUp(self, pc):
        os._exit(3)


class Hang:
    def setUp(self, pc):
        time.sleep(3600)


class Greedy:
    def setUp(self, pc):
        self.much = bytearray(2**40)


class Lonely:
    def setUp(self, pc):
        if pc.comm.rank:
            raise SolveError("only here")
        pc.comm.tompi4py().Barrier()


class Wrong:
    def apply(self, pc, x, y):
        x.copy(y)
        y.scale(float("nan"))
