"""Run a model and write scenes of chosen Newton steps, or all of them as one sequence.

PorePy is imported when a run starts, not when this module is: the command line can describe the
arguments without it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError, UsageError
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.cases import CASES, FRACTURE_PERMEABILITY, PHYSICS, ModelParameters, find_case
from petsc_fs.scene import Scene, contact_state_counts

if TYPE_CHECKING:
    from mpi4py import MPI

SOLVERS = ("direct", "fieldsplit")
"""How a run gets from one Newton step to the next: by an accurate direct solver, for small models, or as
`petsc_fs.porepy.FieldSplitSolver` does by default."""

Floats = NDArray[np.float64]
Progress = Callable[[str], None]


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


def export(
    model_name: str,
    refinement: float = 1.0,
    directory: str | os.PathLike[str] = ".",
    *,
    steps: str | Steps = "last",
    parameters: ModelParameters | None = None,
    time_steps: int | None = None,
    reference: bool = False,
    solver: str = "direct",
    progress: Progress | None = None,
) -> list[Path]:
    """Run a model and write scenes `MODEL_gREFINEMENT_tTIME_nNEWTON.h5`.

    Args:
        model_name: a name in `petsc_fs.porepy.cases.CASES`.
        refinement: cells are 100 m / refinement wide; taken from `parameters` if these are given.
        directory: where the files go; made if missing.
        steps: see `Steps.parse`. The run ends after the last step asked for.
        parameters: what else to vary.
        time_steps: the run ends after so many; None for all.
        reference: also store the solution of `petsc_fs.porepy.direct.solve`.
        solver: one of `SOLVERS`, which takes the run from one Newton step to the next.
        progress: called with a line of text per Newton step and per file.

    Returns:
        The paths written, in the order of writing.

    Raises:
        UsageError: PorePy is missing, there is no such model, or a step does not occur.
        SolveError: Newton did not converge.
        SceneError: a file cannot be written.
    """
    from petsc_fs.io import hdf5

    if reference and solver != "direct":
        raise UsageError("a reference solution is that of the direct solver; leave the solver at direct")
    chosen = Steps.parse(steps) if isinstance(steps, str) else steps
    settings = parameters if parameters is not None else ModelParameters(refinement=refinement)
    run = _Run(model_name, settings, solver)
    target = _folder(Path(directory))
    say = progress or (lambda line: None)
    pending, mixed_pending = set(chosen.numbers), chosen.mixed > 0
    latest: Scene | None = None
    written: list[Path] = []

    def check_found() -> None:
        if pending:
            missing = ", ".join(f"{t}:{n}" for t, n in sorted(pending))
            raise UsageError(f"steps: the run has no Newton step {missing}")
        if mixed_pending:
            raise UsageError("steps: no Newton step of the run has sticking, sliding and open cells at once")

    def write(scene: Scene) -> None:
        meta = scene.metadata
        name = f"{model_name}_g{settings.refinement:g}_t{meta.time_step_index}_n{meta.newton_index}.h5"
        if target / name not in written:
            written.append(hdf5.write(scene, target / name))
            say(f"wrote {written[-1]}")

    def look(scene: Scene) -> bool:
        """Write a scene if it is wanted; whether nothing is left to write."""
        nonlocal mixed_pending, latest
        step = scene.metadata.time_step_index, scene.metadata.newton_index
        if pending and step > max(pending) and not (chosen.every or chosen.last):
            check_found()
        say(_step_text(scene))
        states = {} if scene.contact_state is None else contact_state_counts(scene.contact_state)
        mixed = bool(states) and all(states.values()) and step[0] >= chosen.mixed
        if chosen.every or step in pending or (mixed_pending and mixed):
            write(scene)
        mixed_pending = mixed_pending and not mixed
        pending.discard(step)
        latest = scene if chosen.last else None
        return not (chosen.every or chosen.last or mixed_pending or pending)

    def advance(scene: Scene) -> Floats | None:
        solution = None
        if reference:
            solution = run.solve()
            scene.reference = run.adapter.from_porepy(solution)
        return None if look(scene) else run.solve() if solution is None else solution

    run.go(advance, time_steps)
    if latest is not None:
        write(latest)
    check_found()
    return written


def export_sequence(
    model_name: str,
    path: str | os.PathLike[str],
    *,
    parameters: ModelParameters | None = None,
    time_steps: int | None = None,
    solver: str = "direct",
    progress: Progress | None = None,
) -> Path:
    """Run a model and write the linear system of every Newton step into one file, see `petsc_fs.io.sequence`.

    A run that fails or is interrupted leaves the steps so far in an incomplete sequence beside the path.

    Args:
        model_name: a name in `petsc_fs.porepy.cases.CASES`.
        path: of the file; its folder is made if missing.
        parameters: what to vary.
        time_steps: the run ends after so many; None for all.
        solver: see `export`; of "fieldsplit" the sequence also keeps the iterations.
        progress: called with a line of text per Newton step and per file.

    Raises:
        PetscFsError: see `export`.
    """
    from petsc_fs.io import sequence

    run = _Run(model_name, parameters or ModelParameters(), solver)
    target = Path(path)
    _folder(target.parent)
    writer = sequence.Writer(target, model=run.model.scene_name)
    say = progress or (lambda line: None)

    def advance(scene: Scene) -> Floats:
        solution = run.solve()
        writer.append(scene, run_attributes(run.model))
        say(f"step {writer.steps - 1}: {_step_text(scene)}")
        return solution

    try:
        run.go(advance, time_steps)
    except BaseException:
        if kept := writer.abandon():
            say(f"the run did not end; {kept} has its first {writer.steps} Newton steps")
        raise
    say(f"wrote {writer.finish()}")
    return target


def run_attributes(model: Any) -> dict[str, Any]:
    """What a sequence keeps of the last linear solve of a model; nothing if it is not a `FieldSplitSolver`."""
    solves = getattr(model, "linear_solves", None)
    if not solves:
        return {}
    last = solves[-1]
    names = ("ranks", "iterations", "reason", "converged", "action", "rebuilds", "setup_seconds", "solve_seconds")
    inexact = {} if model._forcing is None else {"forcing": last.forcing}
    return {name: getattr(last, name) for name in names} | inexact


class _Run:
    """A model, and what takes it from one Newton step to the next.

    Raises:
        UsageError: there is no such model or solver, or PorePy is missing.
    """

    def __init__(self, model_name: str, parameters: ModelParameters, solver: str) -> None:
        find_case(model_name)
        if solver not in SOLVERS:
            raise UsageError(f"solver {solver!r}: expected {' or '.join(SOLVERS)}")
        require_porepy()
        from petsc_fs.porepy import direct
        from petsc_fs.porepy.models import make_model
        from petsc_fs.porepy.solver import FieldSplitSolver

        mixins = (FieldSplitSolver,) if solver == "fieldsplit" else ()
        self.model = make_model(model_name, parameters, mixins=mixins)
        self._solve: Callable[[Any], Floats] = FieldSplitSolver.solve_linear_system
        if not mixins:
            self._solve = lambda model: direct.solve(*model.linear_system)

    def solve(self) -> Floats:
        """The Newton update."""
        return self._solve(self.model)

    def go(self, advance: Callable[[Scene], Floats | None], time_steps: int | None) -> None:
        """Run to the end, or of some time steps, or until what is called with each scene returns no update."""
        from petsc_fs.porepy.adapter import Adapter
        from petsc_fs.porepy.models import StopRun, run

        self.model.prepare_simulation()
        self.adapter = Adapter(self.model)

        def linear_solve(model: Any) -> Floats:
            if time_steps is not None and model.time_manager.time_index > time_steps:
                raise StopRun
            update = advance(self.adapter.scene())
            if update is None:
                raise StopRun
            return update

        run(self.model, linear_solve=linear_solve)


def _step_text(scene: Scene) -> str:
    """One line on a Newton step."""
    states = {} if scene.contact_state is None else contact_state_counts(scene.contact_state)
    text = ", ".join(f"{n} {state}" for state, n in states.items()) or "no contact"
    return f"time step {scene.metadata.time_step_index}, Newton step {scene.metadata.newton_index}: {text}"


def _folder(path: Path) -> Path:
    """A folder, made if it is missing."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"{path}: cannot be made a directory: {e.strerror}") from e
    return path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`; needs no PorePy."""
    parser.add_argument("model", choices=list(CASES), help="name of the model")
    add_model_arguments(parser)
    parser.add_argument(
        "--out", dest="directory", metavar="DIR", help="where the scenes go; with --sequence, folder or file (.h5)"
    )
    parser.add_argument(
        "--steps",
        help='Newton steps to write: TIME:NEWTON such as "1:3,2:0" (times from 1, Newton steps from 0), '
        '"mixed" (the first with sticking, sliding and open cells; "mixed@3": from time step 3 on), '
        '"last" (default) or "all"',
    )
    parser.add_argument("--sequence", action="store_true", help="write all Newton steps into one file, for replay")
    parser.add_argument("--reference", action="store_true", help="store an accurate solution too")
    parser.add_argument(
        "--solver", choices=SOLVERS, default="direct", help="for the steps on the way; direct is for small models"
    )


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe what can be varied in a model, for `parameters_of`, and `--time-steps`; needs no PorePy."""
    parser.add_argument(
        "--refine", dest="refinement", type=float, default=1.0, metavar="G", help="cells are 100 m / G wide"
    )
    parser.add_argument("--time-steps", type=_positive, metavar="N", help="end the run after N time steps")
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


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 on, found {text!r}")
    return int(text)


def parameters_of(args: argparse.Namespace) -> ModelParameters:
    """What the arguments of `add_model_arguments` say.

    Raises:
        UsageError: a value is outside its range.
    """
    return ModelParameters(
        refinement=args.refinement,
        friction=args.friction,
        normal_stiffness=args.normal_stiffness,
        pressure_ratio=args.pressure_ratio,
        physics=args.physics,
        fracture_permeability=args.fracture_permeability,
    )


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Export what the arguments of `add_arguments` ask for; progress goes to stderr.

    Raises:
        PetscFsError: see `export`.
    """
    if comm.size > 1:
        raise UsageError("export runs on one rank, as PorePy does; start it without mpiexec")
    parameters = parameters_of(args)
    if args.sequence:
        if args.steps is not None or args.reference:
            raise UsageError("--sequence writes every Newton step, without reference solutions; --time-steps ends it")
        export_sequence(
            args.model,
            _sequence_path(args.directory or ".", f"{args.model}_g{parameters.refinement:g}"),
            parameters=parameters,
            time_steps=args.time_steps,
            solver=args.solver,
            progress=write_to_stderr,
        )
        return 0
    export(
        args.model,
        directory=args.directory or ".",
        steps=args.steps or "last",
        parameters=parameters,
        time_steps=args.time_steps,
        reference=args.reference,
        solver=args.solver,
        progress=write_to_stderr,
    )
    return 0


def _sequence_path(out: str, name: str) -> Path:
    """The file itself if it has a suffix, else one in this folder."""
    path = Path(out)
    return path if path.suffix and not path.is_dir() else path / f"{name}_sequence.h5"


def write_to_stderr(line: str) -> None:
    """One line of progress."""
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
