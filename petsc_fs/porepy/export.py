"""Run a model with a direct solver and write scenes of chosen Newton steps.

PorePy is imported when a run starts, not when this module is: the command line can describe the
arguments without it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError, UsageError
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.cases import CASES, FRACTURE_PERMEABILITY, PHYSICS, ModelParameters, find_case
from petsc_fs.scene import CONTACT_STATES, Scene, contact_state_counts

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.porepy.adapter import Adapter

Floats = NDArray[np.float64]
Progress = Callable[[str], None]

BUNDLED = {
    "model1": (2.0, "mixed@6"),
    "model2": (2.0, "3:2"),
    "model3": (0.25, "2:1"),
    "biot": (2.0, "1:0"),
    "flow": (2.0, "1:0"),
    "contact": (2.0, "4:1"),
}
"""Refinement and Newton step (see `Steps.parse`) of each scene that comes with the package."""


@dataclass(frozen=True)
class Steps:
    """Which Newton steps to write.

    Attributes:
        numbers: pairs of time step, from 1, and Newton step, from 0.
        every: all of them.
        last: the last one of the run.
        mixed: from this time step on, the first one with sticking, sliding and open cells at once;
            0 for none.
    """

    numbers: frozenset[tuple[int, int]] = frozenset()
    every: bool = False
    last: bool = False
    mixed: int = 0

    @classmethod
    def parse(cls, text: str) -> Steps:
        """Read for example "1:3,2:0", "mixed,last", "mixed@3" or "all".

        Raises:
            UsageError: it cannot be read.
        """
        numbers: set[tuple[int, int]] = set()
        words: set[str] = set()
        mixed = 0
        for part in (p.strip() for p in text.split(",")):
            time_step, colon, newton = part.partition(":")
            word, at, first = part.partition("@")
            if part in ("all", "last"):
                words.add(part)
            elif word == "mixed" and (not at or (first.isdecimal() and int(first) > 0)):
                mixed = int(first or 1)
            elif colon and time_step.isdecimal() and newton.isdecimal() and int(time_step) > 0:
                numbers.add((int(time_step), int(newton)))
            else:
                raise UsageError(
                    f"steps: cannot read {part!r}; expected TIME:NEWTON with time steps from 1 and Newton "
                    'steps from 0, such as "1:3,2:0", or "last", "mixed", "mixed@TIME" or "all"'
                )
        return cls(frozenset(numbers), "all" in words, "last" in words, mixed)


class _Recorder:
    """Takes scenes from a running model and writes them."""

    def __init__(
        self, steps: Steps, path: Callable[[int, int], Path], reference: bool, progress: Progress | None
    ) -> None:
        self.steps = steps
        self.path = path
        self.reference = reference
        self.progress = progress
        self.written: list[Path] = []
        self.pending = set(steps.numbers)
        self.mixed_pending = steps.mixed > 0
        self.latest: tuple[Scene, Floats] | None = None
        self.adapter: Adapter | None = None

    def __call__(self, model: Any, solution: Floats) -> None:
        """Look at one Newton step; ends the run when nothing is left to write."""
        from petsc_fs.porepy.adapter import Adapter
        from petsc_fs.porepy.models import StopRun

        if self.adapter is None:
            self.adapter = Adapter(model)
        step = (model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration)
        if self.pending and step > max(self.pending) and not (self.steps.every or self.steps.last):
            self._check_found()
        scene = self.adapter.scene()
        states = {} if scene.contact_state is None else contact_state_counts(scene.contact_state)
        if self.progress is not None:
            text = ", ".join(f"{states[s]} {s}" for s in CONTACT_STATES) if states else "no contact"
            self.progress(f"time step {step[0]}, Newton step {step[1]}: {text}")
        mixed = bool(states) and all(states.values()) and step[0] >= self.steps.mixed
        if self.steps.every or step in self.pending or (self.mixed_pending and mixed):
            self._write(scene, solution)
        self.mixed_pending = self.mixed_pending and not mixed
        self.pending.discard(step)
        if self.steps.last:
            self.latest = (scene, solution)
        if not (self.steps.every or self.steps.last or self.mixed_pending or self.pending):
            raise StopRun

    def finish(self) -> list[Path]:
        """Write the last step if asked for; all paths written."""
        if self.latest is not None:
            self._write(*self.latest)
        self._check_found()
        return self.written

    def _check_found(self) -> None:
        if self.pending:
            missing = ", ".join(f"{t}:{n}" for t, n in sorted(self.pending))
            raise UsageError(f"steps: the run has no Newton step {missing}")
        if self.mixed_pending:
            raise UsageError("steps: no Newton step of the run has sticking, sliding and open cells at once")

    def _write(self, scene: Scene, solution: Floats) -> None:
        from petsc_fs import hdf5

        path = self.path(scene.metadata.time_step_index, scene.metadata.newton_index)
        if path in self.written:
            return
        if self.reference:
            assert self.adapter is not None
            scene.reference = self.adapter.from_porepy(solution)
        self.written.append(hdf5.write(scene, path))
        if self.progress is not None:
            self.progress(f"wrote {path}")


def export(
    model_name: str,
    refinement: float = 1.0,
    directory: str | os.PathLike[str] = ".",
    *,
    steps: str | Steps = "last",
    parameters: ModelParameters | None = None,
    reference: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """Run a model with a direct solver and write scenes `MODEL_gREFINEMENT_tTIME_nNEWTON.h5`.

    Args:
        model_name: a name in `petsc_fs.porepy.cases.CASES`.
        refinement: cells are 100 m / refinement wide; taken from `parameters` if these are given.
        directory: where the files go; made if missing.
        steps: see `Steps.parse`. The run ends after the last step asked for.
        parameters: what else to vary.
        reference: also store the solution of `petsc_fs.porepy.direct.solve`.
        progress: called with a line of text per Newton step and per file.

    Returns:
        The paths written, in the order of writing.

    Raises:
        UsageError: PorePy is missing, there is no such model, or a step does not occur.
        SolveError: Newton did not converge.
        SceneError: a file cannot be written.
    """
    find_case(model_name)
    chosen = Steps.parse(steps) if isinstance(steps, str) else steps
    settings = parameters if parameters is not None else ModelParameters(refinement=refinement)
    require_porepy()
    from petsc_fs.porepy.direct import solve
    from petsc_fs.porepy.models import make_model
    from petsc_fs.porepy.models import run as run_model

    target = Path(directory)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"{target}: cannot be made a directory: {e.strerror}") from e
    model = make_model(model_name, settings)

    def path(time_step: int, newton: int) -> Path:
        return target / f"{model_name}_g{settings.refinement:g}_t{time_step}_n{newton}.h5"

    recorder = _Recorder(chosen, path, reference, progress)
    run_model(model, on_newton_step=recorder, linear_solve=lambda model: solve(*model.linear_system))
    return recorder.finish()


def export_bundled(
    directory: str | os.PathLike[str], names: Iterable[str] = BUNDLED, progress: Progress | None = None
) -> list[Path]:
    """Make the scenes that come with the package, `NAME.h5`, with reference solutions.

    Args:
        directory: where the files go; made if missing.
        names: which of `BUNDLED`.
        progress: see `export`.

    Raises:
        PetscFsError: see `export`.
    """
    target = Path(directory)
    made = []
    for name in names:
        if name not in BUNDLED:
            raise UsageError(f"no bundled scene {name!r}; there are {', '.join(BUNDLED)}")
        refinement, steps = BUNDLED[name]
        if progress is not None:
            progress(f"{name}, refinement {refinement:g}:")
        (path,) = export(name, refinement, target, steps=steps, reference=True, progress=progress)
        made.append(path.replace(target / f"{name}.h5"))
    return made


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`; needs no PorePy."""
    parser.add_argument("model", choices=list(CASES), help="name of the model")
    parser.add_argument(
        "--refine", dest="refinement", type=float, default=1.0, metavar="G", help="cells are 100 m / G wide"
    )
    parser.add_argument("--out", dest="directory", default=".", metavar="DIR", help="where the scenes go")
    parser.add_argument(
        "--steps",
        default="last",
        help='Newton steps to write: TIME:NEWTON such as "1:3,2:0" (times from 1, Newton steps from 0), '
        '"mixed" (the first with sticking, sliding and open cells; "mixed@3": from time step 3 on), '
        '"last" or "all"',
    )
    parser.add_argument("--friction", type=float, default=0.577, metavar="F", help="Coulomb coefficient")
    parser.add_argument(
        "--normal-stiffness",
        type=float,
        default=1.2e9,
        metavar="KN",
        help="of the fractures, in Pa/m; 0 is off",
    )
    parser.add_argument(
        "--pressure-ratio",
        type=float,
        metavar="R",
        help="pressure in the east over the reference pressure, if not the model's own",
    )
    parser.add_argument("--physics", choices=PHYSICS, default="full", help="restricted: linear fluid mass")
    parser.add_argument("--fracture-permeability", choices=FRACTURE_PERMEABILITY, help="if not the model's own")
    parser.add_argument("--reference", action="store_true", help="store an accurate solution too")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Export what the arguments of `add_arguments` ask for; progress goes to stderr.

    Raises:
        PetscFsError: see `export`.
    """
    if comm.size > 1:
        raise UsageError("export runs on one rank, as PorePy does; start it without mpiexec")
    parameters = ModelParameters(
        refinement=args.refinement,
        friction=args.friction,
        normal_stiffness=args.normal_stiffness,
        pressure_ratio=args.pressure_ratio,
        physics=args.physics,
        fracture_permeability=args.fracture_permeability,
    )
    export(
        args.model,
        directory=args.directory,
        steps=args.steps,
        parameters=parameters,
        reference=args.reference,
        progress=write_to_stderr,
    )
    return 0


def write_to_stderr(line: str) -> None:
    """One line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
