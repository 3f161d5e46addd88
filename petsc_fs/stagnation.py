"""Stagnation: ends a Krylov method whose residual has not fallen for a long time.

GMRES may stand still for dozens of iterations and converge after all: on scenes in other units the residual falls by
less than 1e-4 of itself in 60 iterations in a row, and then by ten decades in 20. No short window tells that from
a method that has come to its end; the default one is for methods that may take hundreds of iterations.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from petsc4py import PETSc

from petsc_fs.errors import UsageError
from petsc_fs.options import number

WINDOW = 100
"""Default of -petsc_fs_stagnation_window."""
RATIO = 0.99
"""Default of -petsc_fs_stagnation_ratio."""


@dataclass
class Stagnation:
    """Watches the residual norms of a KSP, and stops it where the lowest one has hardly fallen over a window.

    A monitor, so that PETSc's own convergence test stays as the options have it; only a KSP that is to be stopped
    gets another one, for the rest of that solve. -ksp_converged_reason then names the limit of iterations.

    Options:
        -petsc_fs_stagnation_window n: iterations; default 100, 0 for none.
        -petsc_fs_stagnation_ratio r: the lowest residual norm of the last n iterations over the lowest one before
            them at which the KSP is stopped; default 0.99.

    Attributes:
        window: see above.
        ratio: see above.
        stopped: whether the last solve was.
    """

    window: int = WINDOW
    ratio: float = RATIO
    stopped: bool = False
    _lowest: deque[float] = field(default_factory=deque, repr=False)

    @classmethod
    def from_options(cls, prefix: str = "") -> Stagnation:
        """By the options above. Local.

        Raises:
            UsageError: an option has an impossible value.
        """
        window = number("petsc_fs_stagnation_window", WINDOW, prefix)
        ratio = number("petsc_fs_stagnation_ratio", RATIO, prefix)
        if window < 0 or not 0 < ratio <= 1:
            raise UsageError(
                f"-{prefix}petsc_fs_stagnation_window must not be negative, _ratio be in (0, 1]; "
                f"found {window} and {ratio:g}"
            )
        return cls(window, ratio)

    def watch(self, ksp: PETSc.KSP) -> None:
        """Join the monitors of a KSP, for as long as it lives."""
        if self.window:
            ksp.setMonitor(self._look)

    def restart(self, ksp: PETSc.KSP) -> None:
        """Forget the solve before, and have PETSc's own convergence test again where it was stopped."""
        if self.stopped:
            ksp.setConvergenceTest(None)
            self.stopped = False
        self._lowest.clear()

    def __str__(self) -> str:
        """Why a solve was stopped, for people; "" if it was not."""
        if not self.stopped:
            return ""
        return (
            f"stagnated: the residual fell by less than {1 - self.ratio:.2g} of itself over the last "
            f"{self.window} iterations"
        )

    def _look(self, ksp: PETSc.KSP, number: int, norm: float) -> None:
        if number == 0:
            self._lowest.clear()
        lowest = self._lowest
        lowest.append(min(norm, lowest[-1]) if lowest else norm)
        if len(lowest) > self.window and lowest[-1] > self.ratio * lowest.popleft() and not self.stopped:
            self.stopped = True
            ksp.setConvergenceTest(_stop)


def _stop(ksp: PETSc.KSP, number: int, norm: float) -> int:
    """A convergence test that ends a solve at once."""
    return int(PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT)
