"""When a multigrid that was built for one matrix serves the next one too, over Newton steps and time steps.

The blocks of linear elasticity never change, and what contact adds to them changes near fractures only. A hierarchy
that is not the latest any more costs iterations; building the latest costs seconds. `Reuse` keeps what its triggers
let it keep. Whatever the triggers are, a solve is as accurate as without: only the preconditioner is an older one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import UsageError
from petsc_fs.options import number

if TYPE_CHECKING:
    from mpi4py import MPI

LEVELS = ("none", "mechanics")
"""Values of -petsc_fs_reuse; the first is the default."""


PATIENCE = 2.0
"""Iterations that a solve with an older hierarchy may take, over those of the first one with it."""


class Keepable(Protocol):
    """What can be kept: it has to be freed in the end, by all ranks together."""

    def destroy(self) -> None:
        """Free it. Collective; may be called twice."""


@dataclass(frozen=True)
class Triggers:
    """What has a hierarchy built anew.

    The length of the time step is none of them: it is in the flow's part of the matrix alone, whose multigrid is
    always the latest.

    Attributes:
        changed: part of the fracture cells whose contact state is another one than when it was built.
        growth: iterations per digit of the residual, over those of the first solve with it.
        age: number of matrices that it has served; 0 for no limit.
    """

    changed: float = 0.1
    growth: float = 1.25
    age: int = 0

    def __post_init__(self) -> None:
        if not (self.changed >= 0 and self.growth >= 1 and self.age >= 0):
            raise UsageError(
                "-petsc_fs_reuse_changed and _age must not be negative and _growth not less than 1; "
                f"found {self.changed:g}, {self.age} and {self.growth:g}"
            )


class Reuse:
    """Decides before each set-up whether what was built for an earlier matrix is kept, and keeps it.

    The same on all ranks, as long as all call it alike.

    Attributes:
        level: which hierarchies are kept from one matrix to the next, see `LEVELS`.
        triggers: what ends that.
        keeping: whether the next set-up takes what is kept.
        row_scale: what the rows of the present matrix have been multiplied by.
        builds: number of hierarchies built.
        reason: why the last one was built, in words.
    """

    def __init__(self, level: str = LEVELS[0], triggers: Triggers | None = None) -> None:
        self.level = level
        self.triggers = triggers or Triggers()
        self.keeping = False
        self.row_scale = 1.0
        self._built_scale = 1.0
        self.builds = 0
        self.reason = "first matrix"
        self._kept: dict[str, Keepable] = {}
        self._states: NDArray[Any] | None = None
        self._latest: NDArray[Any] | None = None
        self._first_rate = self._last_rate = math.nan
        self._age = 0

    @classmethod
    def from_options(cls, prefix: str = "") -> Reuse:
        """By -petsc_fs_reuse, _reuse_changed, _reuse_growth and _reuse_age. Local.

        Raises:
            UsageError: an option has an impossible value.
        """
        from petsc4py import PETSc

        level = PETSc.Options(prefix).getString("petsc_fs_reuse", LEVELS[0])
        if level not in LEVELS:
            raise UsageError(f"-{prefix}petsc_fs_reuse {level}: expected {' or '.join(LEVELS)}")
        default = Triggers()
        triggers = Triggers(
            changed=number("petsc_fs_reuse_changed", default.changed, prefix),
            growth=number("petsc_fs_reuse_growth", default.growth, prefix),
            age=number("petsc_fs_reuse_age", default.age, prefix),
        )
        return cls(level, triggers)

    @property
    def scale(self) -> float:
        """What the kept hierarchy, as an inverse, has to be multiplied by to be one of the present matrix."""
        return self._built_scale / self.row_scale

    def take_matrix(self, states: NDArray[Any] | None, comm: MPI.Intracomm, row_scale: float = 1.0) -> None:
        """Decide for a new matrix. Collective.

        Args:
            states: contact states of the fracture cells of this rank at which it was assembled; None if unknown.
            comm: communicator.
            row_scale: see `Reuse`.
        """
        self._age += 1
        self.row_scale = row_scale
        self._latest = None if states is None else np.array(states)
        self._decide(self._find_reason(states, comm))

    def give_up(self) -> None:
        """The next set-up is for the same matrix, for which what was kept is not good enough."""
        self._decide(f"more than {PATIENCE:g} times the iterations")

    def _decide(self, reason: str) -> None:
        """Keep what there is, or, where there is a reason, have it built anew."""
        self.reason = reason
        self.keeping = not reason
        if reason:
            self._states = self._latest
            self._first_rate = self._last_rate = math.nan
            self._age = 0

    def iteration_limit(self, rtol: float) -> int | None:
        """Iterations after which a solve to a relative tolerance had better build the latest; None if it has it."""
        if not (self.keeping and self._age and self._first_rate > 0 and 0 < rtol < 1):
            return None
        return math.ceil(PATIENCE * self._first_rate * max(-math.log10(rtol), 1.0))

    def take_scaled(self, row_scale: float) -> None:
        """The next set-up is for the same matrix with its rows multiplied by another number.

        What was built for it is kept, whatever the triggers say.
        """
        self.row_scale = row_scale
        self.keeping = True

    def _find_reason(self, states: NDArray[Any] | None, comm: MPI.Intracomm) -> str:
        """Why a new matrix needs a hierarchy of its own; "" if it does not. Collective."""
        if self.level == "none":
            return "nothing is kept"
        if not self._kept:
            return "first matrix"
        if self.triggers.age and self._age >= self.triggers.age:
            return f"age {self._age}"
        if self._last_rate > self.triggers.growth * self._first_rate:
            return f"iterations grown by a factor of {self._last_rate / self._first_rate:.2f}"
        counts = np.zeros(2)
        if states is not None and self._states is not None and states.shape == self._states.shape:
            counts[:] = np.count_nonzero(states != self._states), states.size
        changed, cells = comm.allreduce(counts)
        if cells and changed > self.triggers.changed * cells:
            return f"contact states of {int(changed)} of {int(cells)} fracture cells changed"
        return ""

    def note_solve(self, iterations: int, residual: float) -> None:
        """Remember what a solve took.

        Args:
            iterations: of the Krylov method.
            residual: relative residual that they came to.
        """
        if not 0 < residual < 1:
            return
        rate = iterations / max(-math.log10(residual), 1.0)
        self._last_rate = rate
        if math.isnan(self._first_rate):
            self._first_rate = rate

    def kept(self, name: str) -> Keepable | None:
        """What was kept under a name, if the present matrix may have it; else it is freed. Collective."""
        if self.keeping:
            return self._kept.get(name)
        before = self._kept.pop(name, None)
        if before is not None:
            before.destroy()
        return None

    def keep(self, name: str, built: Keepable) -> None:
        """Keep what was just built for the present matrix."""
        self._kept[name] = built
        self._built_scale = self.row_scale
        self.builds += 1

    def release(self) -> None:
        """Free all that is kept. Collective; may be called twice."""
        while self._kept:
            self._kept.popitem()[1].destroy()
        self.keeping = False
