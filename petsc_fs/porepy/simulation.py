"""Run a model with `FieldSplitSolver`: rank 0 runs PorePy, all ranks solve its linear systems.

PorePy is imported when a run starts, not when this module is: the command line can describe the
arguments without it.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs import options, server
from petsc_fs.errors import PetscFsError, SolveError, UsageError, portable, together
from petsc_fs.io.bundled import versions
from petsc_fs.io.files import write_text
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.cases import CASES, ModelParameters
from petsc_fs.porepy.export import add_model_arguments, parameters_of, run_attributes, write_to_stderr

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.io.sequence import Writer

Floats = NDArray[np.float64]
Record = dict[str, Any]

RECORDS, SUMMARY, PICTURE, SEQUENCE, VTU = "solves.jsonl", "summary.json", "contact_states", "sequence.h5", "vtu"
"""Names of what a run writes."""

PHASES = ("meshing", "discretisation", "assembly", "transfer", "setup", "solve", "output")
"""Where the seconds of a run go. What is left is PorePy's own: residuals, line search and bookkeeping."""

PICTURES = ("png", "svg", "pdf", "none")

EPILOG = """\
MODEL is one of {models}, or one of yours:
path/to/file.py:Class or package.module:Class, any PorePy model made of contact mechanics, momentum
balance and single-phase flow. FieldSplitSolver is put before its bases where it is not among them.
Where the file has dictionaries named model_params and solver_params, as in PorePy's tutorials, the
model and PorePy's nonlinear solver get these.

PETSc options follow, for example
  -options_file FILE   an options file of yours, or the name of a shipped one
  -ksp_rtol 1e-6       relative tolerance

Written to DIR: solves.jsonl, one record per linear solve as soon as its Newton step is done;
contact_states.png; summary.json; and, if asked for, sequence.h5 and vtu/.

exit codes: 0 the run went to its end; 1 Newton or a linear solve failed; 2 wrong call or option;
130 interrupted by Ctrl-C. What there is by then is kept, a sequence as sequence.partial.h5."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`; needs no PorePy."""
    parser.epilog = EPILOG.format(models=", ".join(CASES))
    parser.add_argument("model", metavar="MODEL", help="name of a model, or FILE.py:CLASS")
    add_model_arguments(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go; default MODEL_run")
    parser.add_argument("--picture", choices=PICTURES, default="png", help="format of the picture of contact states")
    parser.add_argument("--vtu", action="store_true", help="write the states for ParaView, by PorePy's exporter")
    parser.add_argument("--sequence", action="store_true", help="write all linear systems, for petsc-fs solve")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run what the arguments of `add_arguments` ask for; progress goes to stderr. Collective.

    On rank 0 `args.summary` then is what the run took.

    Raises:
        UsageError: PorePy is missing, there is no such model or parameter, or an option did nothing.
        SolveError: Newton did not converge, or a linear solve failed.
        KeyboardInterrupt: the run was interrupted; the message says what it has left.
    """
    with together(comm):
        parameters = parameters_of(args)
        is_case = args.model in CASES
        if not is_case:
            _split_name(args.model)
            if parameters.changes():
                raise UsageError(f"{args.model}: {parameters.changes()}: only the models of this package take these")
        folder = args.out or Path(f"{args.model if is_case else args.model.rpartition(':')[2]}_run")
        given = options.Given.of(petsc)
        if len(given.files) > 1:
            raise UsageError("-options_file: a run takes one")
        require_porepy()  # on all ranks, which discretise
        if comm.rank == 0:
            _make_folder(folder)
    given.start(files=False)
    error: BaseException | None = None
    with _terminate_as_interrupt(comm.rank):
        client = server.start(comm) if comm.size > 1 else None
        if comm.rank == 0:
            try:
                file = given.files[0] if given.files else None
                args.summary = Simulation(args, parameters, folder, file, comm.size).go()
            except BaseException as e:
                error = e
            finally:
                if client is not None:
                    client.stop()
        sent = error if error is None or isinstance(error, KeyboardInterrupt) else portable(error)
        other = comm.bcast(sent)
    if other is not None:
        raise error or other
    return 0


@contextmanager
def _terminate_as_interrupt(rank: int) -> Iterator[None]:
    """Take a request to terminate for an interrupt: some MPI launchers send one for the other.

    Only rank 0 listens; it tells the other ranks. Local.
    """

    def interrupt(number: int, frame: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, interrupt if rank == 0 else signal.SIG_IGN)
    before_interrupt = signal.getsignal(signal.SIGINT)
    if rank > 0:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before if before is not None else signal.SIG_DFL)
        signal.signal(signal.SIGINT, before_interrupt if before_interrupt is not None else signal.default_int_handler)


class Simulation:
    """One run on rank 0, and what it leaves in its folder.

    Records are written one JSON object a line, each as soon as its Newton step is judged, so that a run that is
    interrupted keeps what it has.

    Attributes:
        records: what is in the file; see `petsc_fs.porepy.solver.LinearSolve` for most of their entries.
        seconds: per phase.
        time_steps: number of time steps that converged.
        cuts: number of time steps that were tried again with a shorter step.
    """

    def __init__(
        self, args: argparse.Namespace, parameters: ModelParameters, folder: Path, file: Path | None, ranks: int
    ) -> None:
        self.args, self.parameters, self.folder, self.file, self.ranks = args, parameters, folder, file, ranks
        self.records: list[Record] = []
        self.seconds = dict.fromkeys(PHASES, 0.0)
        self.time_steps = self.cuts = 0
        self.files: list[str] = [RECORDS]
        self.notes: list[str] = []
        self.model: Any = None
        self.name = args.model
        self.writer: Writer | None = None
        self._started = time.perf_counter()
        self._phase: str | None = None
        self._counted = dict(self.seconds)
        self._pending: Record | None = None
        for name in (RECORDS, SUMMARY, SEQUENCE, *(f"{PICTURE}.{suffix}" for suffix in PICTURES[:-1])):
            (folder / name).unlink(missing_ok=True)  # of an earlier run
        (folder / RECORDS).touch()

    def go(self) -> dict[str, Any]:
        """Run to the end, and write everything; what is in the summary."""
        result = "finished"
        error: BaseException | None = None
        try:
            self._simulate()
        except KeyboardInterrupt as e:
            result, error = "interrupted", e
        except BaseException as e:
            result, error = "failed", e
            raise
        finally:
            self._flush()
            summary = self._finish(result, error)
        if error is not None:
            kept = f"{len(self.records)} solves in {summary['time_steps']} complete time steps"
            raise KeyboardInterrupt(f"interrupted; {self.folder} keeps {kept}") from error
        return summary

    def _simulate(self) -> None:
        runner: Callable[[], None]
        self.model, runner = _prepare_model(self.args.model, self.parameters, self.folder, self.args.vtu)
        self.name = getattr(self.model, "scene_name", type(self.model).__name__)
        self.model.simulation = self
        if self.file is not None:
            self.model.params["petsc_fs_options_file"] = str(self.file)
        if self.args.sequence:
            from petsc_fs.io import sequence

            self.writer = sequence.Writer(self.folder / SEQUENCE, model=self.name)
        runner()

    # What the model tells, see `Observed`

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Count the time of a block; a block within a block counts for the outer one."""
        if self._phase is not None:
            yield
            return
        self._phase = name
        started = time.perf_counter()
        try:
            yield
        finally:
            self._phase = None
            self.seconds[name] += time.perf_counter() - started

    def end_solve(self, model: Any) -> None:
        """Begin the record of a linear solve."""
        last = model.linear_solves[-1]
        for name in ("transfer", "setup", "solve"):
            self.seconds[name] += getattr(last, f"{name}_seconds")
        self._pending = asdict(last) | {
            "time": float(model.time_manager.time),
            "time_step_length": float(model.time_manager.dt),
            **{f"{n}_seconds": self.seconds[n] - self._counted[n] for n in ("discretisation", "assembly")},
        }
        self._counted = dict(self.seconds)
        if self.writer is not None:
            from petsc_fs.porepy.adapter import scene_from_model

            with self.phase("output"):
                self.writer.append(scene_from_model(model), run_attributes(model))

    def end_newton_step(self, model: Any, converged: bool) -> None:
        """Complete the record of a Newton step with what PorePy's convergence check has found."""
        if self._pending is not None:
            found = model.nonlinear_solver_statistics
            norms = {"increment": found.nonlinear_increment_norms, "residual": found.residual_norms}
            self._pending |= {f"newton_{name}": values[-1] if values else None for name, values in norms.items()}
            self._pending["newton_converged"] = bool(converged)
            self._flush()

    def end_time_step(self) -> bool:
        """Count a time step that converged; whether the run has to end with it."""
        self.time_steps += 1
        return self.args.time_steps is not None and self.time_steps >= self.args.time_steps

    def _flush(self) -> None:
        """Write a record that waits for its Newton step to be judged."""
        if self._pending is None:
            return
        record: Record = {n: _finite(v) if isinstance(v, float) else v for n, v in self._pending.items()}
        self._pending = None
        self.records.append(record)
        with (self.folder / RECORDS).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, allow_nan=False) + "\n")
        parts = [
            f"time step {record['time_step']} of {_expected_time_steps(self.model, self.args.time_steps)}, "
            f"Newton step {record['newton_index']}: {record['iterations']} Krylov iterations"
            + ("" if record["converged"] else " (NOT CONVERGED)"),
            f"residual {record['newton_residual']:.1e}" if record.get("newton_residual") is not None else "",
            ", ".join(f"{n} {state}" for state, n in record["contact_states"].items()),
        ]
        write_to_stderr("; ".join(filter(None, parts)))

    # What is left of the run

    def _finish(self, result: str, error: BaseException | None) -> dict[str, Any]:
        """Complete the sequence, draw the picture and write the summary; none of it hides an error of the run."""
        try:
            if self.writer is not None:
                kept = self.writer.finish() if result == "finished" else self.writer.abandon()
                self.files += [kept.name] if kept is not None else []
            if (self.folder / VTU).is_dir() and self.args.vtu:
                self.files.append(VTU)
            if result != "interrupted":  # then there may be no time: MPI launchers kill after a second
                self._draw()
            summary = self._summary(result, error)
            write_text(self.folder / SUMMARY, json.dumps(summary, indent=2) + "\n")
        except PetscFsError:
            if error is None:
                raise
            summary = self._summary(result, error)
        return summary

    def _draw(self) -> None:
        """Draw the contact states, if there are any."""
        from petsc_fs.tools.plots import plot_contact_states

        if self.args.picture == "none" or not any(r["contact_states"] for r in self.records):
            return
        target = self.folder / f"{PICTURE}.{self.args.picture}"
        try:
            with self.phase("output"):
                plot_contact_states(self.records, target, title=self.name, cells=_fracture_cells(self.model))
            self.files.append(target.name)
        except UsageError as e:  # no matplotlib
            self.notes.append(f"no picture of the contact states: {e}")

    def _summary(self, result: str, error: BaseException | None) -> dict[str, Any]:
        total, records = time.perf_counter() - self._started, self.records
        return {
            "model": self.name,
            "result": result,
            "message": None if error is None else str(error) or type(error).__name__,
            "ranks": self.ranks,
            "unknowns": records[-1]["unknowns"] if records else None,
            "time_steps": self.time_steps,
            "time_step_cuts": self.cuts,
            "newton_steps": len(records),
            "iterations": sum(r["iterations"] for r in records),
            "not_converged": sum(not r["converged"] for r in records),
            "contact_states": records[-1]["contact_states"] if records else {},
            "seconds": {**self.seconds, "other": max(total - sum(self.seconds.values()), 0.0), "total": total},
            "folder": str(self.folder),
            "files": [*self.files, SUMMARY],
            "notes": self.notes,
            "options_file": None if self.file is None else self.file.name,
            "options": options.database(),
            "versions": {**versions(), "porepy": str(require_porepy().__version__)},
        }


def _timed(name: str, phase: str) -> Any:
    """A method that counts the time of that of the next class."""

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self.simulation.phase(phase):
            return getattr(super(Observed, self), name)(*args, **kwargs)

    return method


class Observed:
    """Mixin that tells a `Simulation` what a model does; it goes before all other bases.

    Attributes:
        simulation: set it before the model is prepared.
        stop: raised to end the run after the last time step asked for.
    """

    simulation: Simulation
    stop: type[Exception]

    set_geometry = _timed("set_geometry", "meshing")
    set_discretization_parameters = _timed("set_discretization_parameters", "discretisation")
    discretize = _timed("discretize", "discretisation")
    rediscretize = _timed("rediscretize", "discretisation")
    assemble_linear_system = _timed("assemble_linear_system", "assembly")
    save_data_time_step = _timed("save_data_time_step", "output")

    def solve_linear_system(self) -> Floats:
        """Solve, by the next class that does."""
        update: Floats = super().solve_linear_system()  # type: ignore[misc]
        self.simulation.end_solve(self)
        return update

    def check_convergence(self, *args: Any, **kwargs: Any) -> tuple[bool, bool]:
        """Look at the Newton step."""
        converged, diverged = super().check_convergence(*args, **kwargs)  # type: ignore[misc]
        self.simulation.end_newton_step(self, converged)
        return converged, diverged

    def after_nonlinear_convergence(self) -> None:
        """End a time step, and perhaps the run."""
        super().after_nonlinear_convergence()  # type: ignore[misc]
        if self.simulation.end_time_step():
            raise self.stop

    def after_nonlinear_failure(self) -> None:
        """Try again with a shorter time step, where the model does that."""
        super().after_nonlinear_failure()  # type: ignore[misc]
        self.simulation.cuts += 1


def _prepare_model(name: str, parameters: ModelParameters, folder: Path, vtu: bool) -> tuple[Any, Callable[[], None]]:
    """The model, with the mixins it needs, and what runs it."""
    from petsc_fs.porepy import models
    from petsc_fs.porepy.solver import FieldSplitSolver

    if name in CASES:
        mixins: tuple[type, ...] = (
            (Observed, models.VtuExport, FieldSplitSolver) if vtu else (Observed, FieldSplitSolver)
        )
        model = models.make_model(name, parameters, mixins=mixins)
        model.params |= {"folder_name": str(folder / VTU), "file_name": name}
        model.stop = models.StopRun
        return model, lambda: models.run(model)
    module, cls = _load(name)
    bases = (Observed, cls) if issubclass(cls, FieldSplitSolver) else (Observed, FieldSplitSolver, cls)
    export: dict[str, Any] = {"folder_name": str(folder / VTU)} if vtu else {"times_to_export": []}
    model = type(cls.__name__, bases, {})(_dictionary(module, "model_params") | export)
    model.stop = models.StopRun
    return model, lambda: _run_own(model, _dictionary(module, "solver_params"))


def _fracture_cells(model: Any) -> tuple[Floats, NDArray[np.int8]]:
    """Centres of the fracture cells in m, and their contact states at the current iterate."""
    from petsc_fs.porepy.adapter import Adapter, contact_state

    fractures = Adapter(model).grids("contact")
    centers = np.concatenate([sd.cell_centers.T for sd in fractures]) * float(model.units.m)
    return centers, contact_state(model, fractures)


def _run_own(model: Any, settings: dict[str, Any]) -> None:
    """Run a model of the user's as PorePy does.

    Raises:
        SolveError: Newton did not converge.
    """
    from petsc_fs.porepy.models import StopRun

    pp = require_porepy()
    timed = model._is_time_dependent()
    try:
        (pp.run_time_dependent_model if timed else pp.run_stationary_model)(model, settings)
    except StopRun:
        pass
    except ValueError as e:
        if "onverge" not in str(e):
            raise
        step = f"time step {model.time_manager.time_index}"
        raise SolveError(f"{type(model).__name__}: Newton did not converge in {step}: {e}") from e


def _split_name(name: str) -> tuple[str, str]:
    """File or module, and class.

    Raises:
        UsageError: there is no class, or no such file.
    """
    where, colon, cls = name.rpartition(":")
    if not (colon and where and cls.isidentifier()):
        raise UsageError(f"unknown model {name!r}; models are {', '.join(CASES)}, or FILE.py:CLASS or MODULE:CLASS")
    if where.endswith(".py") and not Path(where).is_file():
        raise UsageError(f"{where}: no such file")
    return where, cls


def _load(name: str) -> tuple[Any, type]:
    """Module and class of a model of the user's.

    Raises:
        UsageError: the module cannot be imported, or has no such class.
    """
    where, class_name = _split_name(name)
    if where.endswith(".py"):
        spec = spec_from_file_location(Path(where).stem, where)
        assert spec is not None and spec.loader is not None
        module = sys.modules[spec.name] = module_from_spec(spec)
        sys.path.insert(0, str(Path(where).resolve().parent))  # as Python does for a script
        spec.loader.exec_module(module)
    else:
        try:
            module = import_module(where)
        except ModuleNotFoundError as e:
            raise UsageError(f"{name}: {e}") from e
    found = getattr(module, class_name, None)
    if not (isinstance(found, type) and hasattr(found, "prepare_simulation")):
        raise UsageError(f"{where} has no PorePy model of the name {class_name}")
    return module, found


def _dictionary(module: Any, name: str) -> dict[str, Any]:
    """A dictionary of a module, copied; empty if there is none."""
    found = getattr(module, name, {})
    if not isinstance(found, dict):
        raise UsageError(f"{module.__name__}.{name}: expected a dictionary, found {type(found).__name__}")
    return dict(found)


def _expected_time_steps(model: Any, limit: int | None) -> int:
    """How many time steps there will be if none is cut."""
    manager = model.time_manager
    whole = max(round(float(manager.schedule[-1] - manager.schedule[0]) / float(manager.dt)), 1)
    return whole if limit is None else min(whole, limit)


def _make_folder(folder: Path) -> None:
    """The folder of results, made if it is missing.

    Raises:
        UsageError: it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".petsc_fs"
        probe.touch()
        probe.unlink()
    except OSError as e:
        raise UsageError(f"{folder}: cannot be written to: {e.strerror}") from e


def _finite(value: float) -> float | None:
    """A number as JSON has it: None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None
