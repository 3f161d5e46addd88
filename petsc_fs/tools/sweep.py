"""Sweeps: searches of a space of PETSc options for files that are faster, smaller or more accurate than the base file.

A trial writes the base file with some options changed, and solves each scene with it in a process of its own
(`petsc_fs.tools.measure`), so that whatever goes wrong is an outcome of the trial. It counts only if the true residual meets
the tolerance, which a trial cannot change, and the forward error stays near that of the base file. The base file is
measured again between trials; what is compared are ratios to it, on the same scene and at the same time.

Everything a sweep knows is in its folder, in optuna's SQLite storage: the same command again goes on where a sweep
was interrupted or killed. The only module that imports optuna.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import math
import os
import statistics
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.files import write_text
from petsc_fs.tools import measure
from petsc_fs.tools.space import Space, Value, find_space, read

if TYPE_CHECKING:
    from mpi4py import MPI

Summary = dict[str, Any]
"""What was measured on one scene: seconds, iterations, memory (bytes), error, residual."""

SAMPLERS = ("tpe", "random", "grid", "nsga2")
OBJECTIVES = ("time", "memory", "error")
AGGREGATES = ("mean", "worst")
CLOCKS = ("wall", "cpu")

OUTCOMES = {
    "solved": "the true residual and the error are good enough on all scenes",
    "inaccurate": "the true residual meets the tolerance, but the error is far above that of the base file",
    "pruned": "far slower than the front: given up",
    **{kind: text for kind, text in measure.KINDS.items() if kind != "converged"},
    "interrupted": "the sweep was interrupted or killed meanwhile; the same options were tried again",
}
"""How trials end, and what each means."""

ERROR_FACTOR = 10.0
"""A trial may have this many times the error of the base file."""
SLACK = 3.0
"""Seconds by which starting a process may take longer than it did for the base file."""
SHORT = 1.0
"""Seconds of a solve below which one more, unrecorded, goes before."""
RECENT = 3
"""Measurements of the base file, the last ones, whose median a trial is compared with."""
STARTUP_TRIALS = 20
"""Random trials before TPE has a model to go by."""
EDGE = 0.02
"""Part of a range that counts as its end."""
POPULATION = 24
"""Of NSGA-II."""

EPILOG = """\
A space is a YAML file that names a base options file and what may change in it; amg.yaml (multigrid of
mechanics and pressure) and flow.yaml (small, for a first try) come along, and petsc_fs/space.py explains the format.

The folder --out holds the sweep: the same command again goes on where it was interrupted or killed, and one with
more --trials goes on from its end. In it are, at the end,
  best.opts    the fastest file that was confirmed, for petsc-fs solve -options_file best.opts
  report.md    what came out, with front.png; trials.csv and sweep.json hold all figures
  trials/      the options file of each trial

exit codes: 0 there is a best file; 1 no trial was solved accurately, or the base file is not; 2 wrong call or space;
130 interrupted"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a sweep is asked to do.

    Attributes:
        scenes: that every trial solves.
        hold_out: that only the base file and the best one solve, at the end.
        space: what may change.
        out: folder of the sweep.
        trials: number of trials, finished ones of earlier runs included.
        sampler: one of `SAMPLERS`.
        objectives: some of `OBJECTIVES`; the first one chooses the best file.
        aggregate: of the ratios on several scenes, the geometric mean or the worst.
        ranks: of MPI.
        rtol: relative tolerance; None for that of the base file.
        repetitions: solves of each scene in a trial, of which the median counts.
        base_every: number of trials from one measurement of the base file to the next.
        time_limit: seconds for one solve, with start and set-up.
        memory_limit: bytes of address space of each rank; None for no limit.
        patience: a trial is given up that takes this many times what the slowest file of the front takes, or
            the base file if that is faster; 0 for never.
        finalists: files measured again at the end, to choose the best.
        confirm: number of measurements of each of them, and on the scenes held out.
        clock: what time is: of the wall, or of the busiest rank's processor, for machines where others compute.
        seed: of the sampler.
    """

    scenes: tuple[Path, ...]
    space: Space
    out: Path
    hold_out: tuple[Path, ...] = ()
    trials: int = 200
    sampler: str = "tpe"
    objectives: tuple[str, ...] = ("time", "memory")
    aggregate: str = "mean"
    ranks: int = 1
    rtol: float | None = None
    repetitions: int = 1
    base_every: int = 1
    time_limit: float = 300.0
    memory_limit: int | None = None
    patience: float = 3.0
    finalists: int = 3
    confirm: int = 3
    clock: str = "wall"
    seed: int = 0

    @property
    def tolerance(self) -> float:
        """Relative tolerance of all solves."""
        return self.rtol or float(options.parse(self.space.base).get("ksp_rtol") or 1e-5)

    def command(self) -> str:
        """The command line, with names of files for their paths."""
        words = ["petsc-fs sweep", *(p.name for p in self.scenes), "--space", self.space.path.name]
        words += ["--trials", str(self.trials), "--sampler", self.sampler, "--objective", *self.objectives]
        words += ["--aggregate", self.aggregate] if len(self.scenes) > 1 else []
        words += ["--ranks", str(self.ranks)] if self.ranks > 1 else []
        words += ["--rtol", f"{self.rtol:g}"] if self.rtol else []
        words += ["--clock", self.clock, "--base-every", str(self.base_every), "--repetitions", str(self.repetitions)]
        words += ["--patience", f"{self.patience:g}", "--time-limit", f"{self.time_limit:g}"]
        words += ["--memory-limit", f"{self.memory_limit / 1e9:g}"] if self.memory_limit else []
        words += ["--finalists", str(self.finalists), "--confirm", str(self.confirm), "--seed", str(self.seed)]
        words += ["--hold-out", *(p.name for p in self.hold_out)] if self.hold_out else []
        return " ".join(words)

    def identity(self) -> dict[str, str]:
        """What may not change when a sweep goes on."""
        from petsc_fs.tools.reference import digest

        return {
            "scenes": " ".join(f"{path.name} ({digest(path)[:12]})" for path in self.scenes),
            "space": json.dumps([repr(p) for p in self.space.parameters]),
            "base file": self.space.base.read_text(encoding="utf-8"),
            "objectives": " ".join(self.objectives),
            "aggregate": self.aggregate,
            "ranks": str(self.ranks),
            "tolerance": f"{self.tolerance:g}",
            "clock": self.clock,
        }


def aggregate(ratios: Sequence[float], how: str) -> float:
    """Geometric mean or worst of ratios.

    >>> aggregate([0.5, 2.0], "mean"), aggregate([0.5, 2.0], "worst")
    (1.0, 2.0)
    """
    return max(ratios) if how == "worst" else math.exp(statistics.fmean(math.log(max(r, 1e-300)) for r in ratios))


def summary(records: Sequence[measure.Record], clock: str = "wall") -> Summary:
    """What the repetitions of a solve of one scene say: medians, and the most of the memory."""
    wall = statistics.median(r["setup_seconds"] + r["solve_seconds"] for r in records)
    known = [r["forward_error"] for r in records if r["forward_error"] is not None]
    return {
        "seconds": wall if clock == "wall" else statistics.median(r["cpu_seconds"] for r in records),
        "wall_seconds": wall,
        "setup_seconds": statistics.median(r["setup_seconds"] for r in records),
        "iterations": records[-1]["iterations"],
        "memory": max(sum(r["peak_rss"]) - sum(r["base_rss"]) for r in records),
        "residual": max(r["true_residual"] for r in records),
        "error": max(known) if known else None,
    }


def ratios(mine: Summary, base: Summary) -> dict[str, float]:
    """Time, memory and error in multiples of those of the base file; errors by residuals where none are known."""
    error = "error" if mine["error"] is not None and base["error"] is not None else "residual"
    return {
        "time": mine["seconds"] / base["seconds"],
        "memory": max(mine["memory"], 1) / max(base["memory"], 1),
        "error": max(mine[error], 1e-300) / max(base[error], 1e-300),
    }


def front(points: Sequence[Sequence[float]]) -> list[int]:
    """Numbers of the points of which none is better in everything.

    >>> front([(1, 3), (2, 2), (3, 3), (1, 3)])
    [0, 1, 3]
    """
    return [
        k
        for k, p in enumerate(points)
        if not any(all(b <= a for a, b in zip(p, q, strict=True)) and tuple(q) != tuple(p) for q in points)
    ]


@dataclass(frozen=True)
class Attempt:
    """One finished trial.

    Attributes:
        number: of the trial.
        values: of its parameters.
        outcome: one of `OUTCOMES`.
        message: one line on what went wrong.
        scenes: by name of the scene, what was measured, with `ratios` to the base file.
        same_as: number of the earlier trial that tried the same options, and was not measured again.
        seconds: the whole trial took.
    """

    number: int
    values: dict[str, Value]
    outcome: str
    message: str
    scenes: dict[str, Summary]
    same_as: int | None
    seconds: float

    def total(self, objective: str, how: str) -> float:
        """An objective, aggregated over scenes."""
        return aggregate([s["ratios"][objective] for s in self.scenes.values()], how)


class Sweep:
    """A search in a folder. One process at a time works in it.

    Args:
        settings: what to do.
        watch: called after each trial, and with a line of text before anything that takes long.
        mpiexec: program that starts ranks, see `petsc_fs.tools.measure.launcher`.
    """

    def __init__(
        self,
        settings: Settings,
        watch: Callable[[Sweep, str], None] = lambda sweep, text: None,
        mpiexec: str | os.PathLike[str] | None = None,
    ) -> None:
        self.settings = settings
        self.watch = watch
        self.mpiexec = mpiexec
        self.study: Any = None
        self.attempts: dict[int, Attempt] = {}
        self.interrupted = 0
        self._tried: dict[str, int] = {}  # what was changed: number of the trial
        self._recent: dict[str, list[Summary]] = {}
        self._overhead: dict[str, float] = {}
        self._trials_since_base = 0

    def run(self) -> dict[str, Any]:
        """Search, or go on with it, choose the best file and measure it on the scenes held out.

        Returns:
            What came out, see `results`; files are written by `petsc_fs.tools.sweep_report.write`.

        Raises:
            UsageError: the folder holds another sweep, or a scene does not fit the base file.
            SolveError: the base file does not solve a scene.
        """
        (self.settings.out / "trials").mkdir(parents=True, exist_ok=True)
        with _alone(self.settings.out):
            self.study = self._open()
            self._recover()
            self._measure_base()
            self._queue()
            while len(self.attempts) < self.settings.trials:
                if self.settings.sampler == "grid" and not self._waiting():
                    break
                self._trial()
            self._choose()
            return self.results()

    # --- storage ---

    def _open(self) -> Any:
        """The study in the folder, made if there is none."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        settings = self.settings
        storage = self._storage()
        identity = settings.identity()
        if optuna.get_all_study_names(storage):
            study = optuna.load_study(study_name="sweep", storage=storage)
        else:
            directions = ["minimize"] * len(settings.objectives)
            study = optuna.create_study(storage=storage, study_name="sweep", directions=directions)
        there = study.user_attrs.get("identity", identity)
        other = next((key for key in identity if there.get(key) != identity[key]), None)
        if other is not None:
            raise UsageError(f"--out {settings.out}: the sweep in it has another {other}; name another folder")
        study.set_user_attr("identity", identity)
        study.sampler = self._sampler(len(study.trials))
        return study

    def _storage(self) -> Any:
        """Where optuna keeps the study; SQLite's transactions survive a kill at any moment."""
        from optuna.storages import RDBStorage

        return RDBStorage(f"sqlite:///{self.settings.out.resolve() / 'study.db'}")

    def _sampler(self, offset: int) -> Any:
        """Optuna's sampler; one that goes on must not draw the same numbers again, hence the offset of its seed."""
        from optuna import samplers

        seed = self.settings.seed + offset
        match self.settings.sampler:
            case "tpe":
                return samplers.TPESampler(seed=seed, n_startup_trials=STARTUP_TRIALS, multivariate=True, group=True)
            case "nsga2":
                return samplers.NSGAIISampler(seed=seed, population_size=POPULATION)
            case _:
                return samplers.RandomSampler(seed=seed)

    def _recover(self) -> None:
        """Take finished trials over; finish one that was measured, and repeat one that was not, when the end came."""
        from optuna.trial import TrialState

        for trial in self.study.get_trials(deepcopy=False):
            if trial.state == TrialState.RUNNING and "result" in trial.user_attrs:
                self._tell(_attempt(trial))
            elif trial.state == TrialState.RUNNING:
                self.study.enqueue_trial(trial.system_attrs.get("fixed_params", {}) | trial.params)
                self.study.tell(trial.number, state=TrialState.FAIL)
        for trial in self.study.get_trials(deepcopy=False):
            if trial.state == TrialState.FAIL:
                self.interrupted += 1
            elif trial.state in (TrialState.COMPLETE, TrialState.PRUNED):
                self.attempts[trial.number] = _attempt(trial)
                changes = json.dumps(self.settings.space.changes(trial.params), sort_keys=True)
                self._tried.setdefault(changes, trial.number)

    def _waiting(self) -> bool:
        from optuna.trial import TrialState

        return bool(self.study.get_trials(deepcopy=False, states=(TrialState.WAITING,)))

    def _queue(self) -> None:
        """Put into line what does not come from the sampler: all of a grid, or else the base file itself."""
        settings = self.settings
        if settings.sampler == "grid":
            size = sum(1 for _ in settings.space.grid())
            if size > settings.trials:
                raise UsageError(
                    f"the grid of {settings.space.path} has {size:,} points, more than --trials {settings.trials}; "
                    "declare coarser steps or fewer points, allow more trials, or take --sampler random"
                )
            for values in settings.space.grid():
                self.study.enqueue_trial(values, skip_if_exists=True)
        elif not self.study.trials:
            self.study.enqueue_trial(settings.space.start())

    # --- measuring ---

    def _job(self, scene: Path, file: Path, time_limit: float) -> measure.Job:
        short = self._recent.get(str(scene), [{"seconds": 0.0}])[-1]["seconds"] < SHORT
        reference = self._reference(scene)
        return measure.Job(
            scenes=[scene],
            options_file=file,
            ranks=self.settings.ranks,
            rtols=(self.settings.tolerance,),
            repetitions=self.settings.repetitions,
            warm_up=short,
            errors=reference is not None,
            references={} if reference is None else {str(scene): reference},
            time_limit=time_limit,
            memory_limit=self.settings.memory_limit,
        )

    def _reference(self, scene: Path) -> Path | None:
        """File with the reference solution of a scene, made once; None where it cannot be."""
        from petsc_fs.tools.reference import digest

        target = self.settings.out / "references" / f"{scene.stem}-{digest(scene)[:12]}.npz"
        failed = target.with_suffix(".failed")
        if not target.exists() and not failed.exists():
            self.watch(self, f"reference solution of {scene.name}")
            target.parent.mkdir(exist_ok=True)
            command = [sys.executable, "-m", "petsc_fs.tools.reference", str(scene), str(target)]
            done = subprocess.run(command, capture_output=True, text=True, env=measure.environment(), check=False)
            if done.returncode or not target.exists():
                failed.write_text(done.stderr, encoding="utf-8")
        return target if target.exists() else None

    def _base(self, scene: Path) -> Summary:
        """Measure the base file.

        Raises:
            SolveError: it does not solve the scene.
        """
        started = time.monotonic()
        records = measure.measure(
            self._job(scene, self.settings.space.base, self.settings.time_limit), mpiexec=self.mpiexec
        )
        outcome, message = judge(records, {"error": None})
        if outcome != "solved" and str(scene) in self._recent:
            return self._recent[str(scene)][-1]  # it does solve the scene: the machine is to blame
        if outcome != "solved":
            raise SolveError(
                f"the base file {self.settings.space.base.name} does not solve {scene.name}, so there is nothing to "
                f"compare with: {outcome}: {message}"
            )
        found = summary(records, self.settings.clock)
        self._overhead[str(scene)] = time.monotonic() - started - found["wall_seconds"] * len(records)
        self._recent[str(scene)] = [*self._recent.get(str(scene), []), found][-RECENT:]
        return found

    def _measure_base(self) -> None:
        """Know the base file's time, memory and error on each scene before the first trial of this run."""
        for scene in self.settings.scenes:
            if len(self.attempts) < self.settings.trials:
                self.watch(self, f"base file on {scene.name}")
                self._base(scene)

    def _base_now(self, scene: Path) -> Summary:
        """The base file on a scene about now: the last measurement, with the median time of the recent ones."""
        recent = self._recent[str(scene)]
        return recent[-1] | {key: statistics.median(r[key] for r in recent) for key in ("seconds", "wall_seconds")}

    def _limit(self, scene: Path) -> float:
        """Seconds after which a trial is hopeless on a scene."""
        settings = self.settings
        if not settings.patience:
            return settings.time_limit
        slowest = max((a.scenes[scene.name]["ratios"]["time"] for a in self.front()), default=1.0)
        base = float(self._base_now(scene)["wall_seconds"])
        runs = 2 if base < SHORT else 1
        allowed = self._overhead[str(scene)] + SLACK + settings.patience * min(slowest, 1.0) * base * runs
        return min(allowed, settings.time_limit)

    def _trial(self) -> None:
        """Ask for values, measure, and store what came of it."""
        started = time.monotonic()
        trial = self.study.ask()
        values = self.settings.space.suggest(trial)
        changes = json.dumps(self.settings.space.changes(values), sort_keys=True)
        earlier = self._tried.setdefault(changes, trial.number)
        if earlier != trial.number:
            same = self.attempts[earlier]
            outcome, message, scenes = same.outcome, same.message, same.scenes
        else:
            file = self._file(trial.number)
            write_text(file, self._text(values, trial.number))
            outcome, message, scenes = self._try(file)
        attempt = Attempt(
            number=trial.number,
            values=values,
            outcome=outcome,
            message=message,
            scenes=scenes,
            same_as=earlier if earlier != trial.number else None,
            seconds=time.monotonic() - started,
        )
        stored = {k: v for k, v in vars(attempt).items() if k not in ("number", "values")}
        trial.set_user_attr("result", stored)  # from here on, the trial needs no repetition
        self._tell(attempt)
        self.attempts[trial.number] = attempt
        self.watch(self, "")

    def _tell(self, attempt: Attempt) -> None:
        """End a trial; what was not solved is pruned for optuna, whose samplers then avoid it."""
        from optuna.trial import TrialState

        if attempt.outcome == "solved":
            settings = self.settings
            self.study.tell(attempt.number, [attempt.total(o, settings.aggregate) for o in settings.objectives])
        else:
            self.study.tell(attempt.number, state=TrialState.PRUNED)

    def _try(self, file: Path) -> tuple[str, str, dict[str, Summary]]:
        """Outcome, message and measurements of an options file on all scenes, until it turns out hopeless."""
        settings = self.settings
        fresh = self._trials_since_base >= settings.base_every - 1
        self._trials_since_base = 0 if fresh else self._trials_since_base + 1
        found: dict[str, Summary] = {}
        for scene in settings.scenes:
            if fresh and self.attempts:
                self._base(scene)
            base = self._base_now(scene)
            limit = self._limit(scene)
            records = measure.measure(self._job(scene, file, limit), mpiexec=self.mpiexec)
            outcome, message = judge(records, base)
            if outcome == "hang" and limit < settings.time_limit:
                allowed = f"{settings.patience:g} times what the front or the base file takes"
                outcome, message = "pruned", f"{message}, that is {allowed}"
            if outcome != "solved":
                where = f"{scene.name}: " if len(settings.scenes) > 1 else ""
                return outcome, where + message, found
            mine = summary(records, settings.clock)
            found[scene.name] = mine | {"ratios": ratios(mine, base), "base_seconds": base["seconds"]}
        return "solved", "", found

    # --- the best file ---

    def solved(self) -> list[Attempt]:
        """Trials that were solved, each set of options once."""
        return [a for a in self.attempts.values() if a.outcome == "solved" and a.same_as is None]

    def front_objectives(self) -> tuple[str, ...]:
        """Objectives of the front: those of the search, with memory where time is the only one."""
        named = self.settings.objectives
        return named if len(named) > 1 else (*named, "memory" if named[0] == "time" else "time")

    def front(self) -> list[Attempt]:
        """Trials of which none is better in everything, best in the first objective first."""
        solved = self.solved()
        points = [[a.total(o, self.settings.aggregate) for o in self.front_objectives()] for a in solved]
        chosen = sorted(front(points), key=lambda k: points[k])
        return [solved[k] for k in chosen]

    def _choose(self) -> None:
        """Measure the finalists again, choose the best, and measure it and the base file on what was held out."""
        settings = self.settings
        first = settings.objectives[0]
        candidates = sorted(self.solved(), key=lambda a: a.total(first, settings.aggregate))[: settings.finalists]
        wanted = [[a.number for a in candidates], [p.name for p in settings.hold_out], settings.confirm]
        if not candidates or self.study.user_attrs.get("final", {}).get("wanted") == wanted:
            return
        confirmed = self._compare([a.number for a in candidates], settings.scenes)
        standing = {n: f for n, f in confirmed.items() if all(s["outcome"] == "solved" for s in f.values())}
        if not standing:
            raise SolveError("none of the best files could be confirmed; take more --finalists")
        best = min(
            standing, key=lambda n: aggregate([s["ratios"][first] for s in standing[n].values()], settings.aggregate)
        )
        held_out = self._compare([best], settings.hold_out)[best] if settings.hold_out else {}
        self.study.set_user_attr(
            "final",
            {
                "wanted": wanted,
                "best": best,
                "finalists": {str(n): found for n, found in confirmed.items()},
                "hold_out": held_out,
            },
        )

    def _compare(self, numbers: Sequence[int], scenes: Sequence[Path]) -> dict[int, dict[str, Summary]]:
        """Files of trials against the base file, measured in turns: medians of time ratios, by trial and scene."""
        found: dict[int, dict[str, Summary]] = {n: {} for n in numbers}
        for scene in scenes:
            base: list[Summary] = []
            mine: dict[int, list[Summary]] = {n: [] for n in numbers}
            wrong: dict[int, tuple[str, str]] = {}
            for k in range(self.settings.confirm):
                self.watch(self, f"base file against the best on {scene.name}, {k + 1} of {self.settings.confirm}")
                base.append(self._base(scene))
                for n in numbers:
                    job = self._job(scene, self._file(n), self.settings.time_limit)
                    records = measure.measure(job, mpiexec=self.mpiexec)
                    outcome, message = judge(records, base[0])
                    if outcome == "solved":
                        mine[n].append(summary(records, self.settings.clock))
                    else:
                        wrong[n] = outcome, message
            for n in numbers:
                entry: Summary = {"outcome": "solved", "message": "", "base": _median(base)}
                if n in wrong:
                    entry |= {"outcome": wrong[n][0], "message": wrong[n][1]}
                else:
                    pairs = [m["seconds"] / b["seconds"] for m, b in zip(mine[n], base, strict=True)]
                    entry |= _median(mine[n])
                    entry["ratios"] = ratios(entry, entry["base"]) | {"time": statistics.median(pairs)}
                    entry["spread"] = [min(pairs), max(pairs)]
                found[n][scene.name] = entry
        return found

    def _file(self, number: int) -> Path:
        """The options file of a trial."""
        return self.settings.out / "trials" / f"{number:04}.opts"

    def _text(self, values: Mapping[str, Value], number: int) -> str:
        """The options file of a trial, with a header of its own."""
        settings = self.settings
        base = settings.space.base
        lines = base.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if line.startswith(("# fields:", "# not_for:"))]
        scenes = ", ".join(path.name for path in settings.scenes)
        header = [
            f"# {base.name} tuned for {scenes}",
            "#",
            f"# source: petsc-fs sweep, space {settings.space.path.name}, trial {number}",
            *kept,
        ]
        body = settings.space.text(values).splitlines()
        start = next((k for k, line in enumerate(body) if not line.startswith("#")), 0)
        return "\n".join([*header, *body[start:]]) + "\n"

    def results(self) -> dict[str, Any]:
        """Everything that came out, as JSON can hold it."""
        settings = self.settings
        final = self.study.user_attrs.get("final")
        outcomes = Counter(a.outcome for a in self.attempts.values())
        outcomes.update({"interrupted": self.interrupted} if self.interrupted else {})
        return {
            "space": settings.space.path.name,
            "description": settings.space.description,
            "base": settings.space.base.name,
            "scenes": [p.name for p in settings.scenes],
            "hold_out": [p.name for p in settings.hold_out],
            "sampler": settings.sampler,
            "objectives": list(settings.objectives),
            "front_objectives": list(self.front_objectives()),
            "aggregate": settings.aggregate,
            "ranks": settings.ranks,
            "tolerance": settings.tolerance,
            "repetitions": settings.repetitions,
            "patience": settings.patience,
            "time_limit": settings.time_limit,
            "memory_limit": settings.memory_limit,
            "confirm": settings.confirm,
            "clock": settings.clock,
            "versions": hdf5.versions() | {name: import_module(name).__version__ for name in ("petsc4py", "optuna")},
            "outcomes": dict(outcomes),
            "errors_known": all(s["error"] is not None for a in self.attempts.values() for s in a.scenes.values()),
            "trials": [self._row(a) for a in sorted(self.attempts.values(), key=lambda a: a.number)],
            "front": [a.number for a in self.front()],
            "importance": self._importance(),
            "final": final,
            "changes": self._changes(final["best"]) if final else {},
            "at_edge": self._at_edge(final["best"]) if final else [],
            "command": settings.command(),
        }

    def _row(self, attempt: Attempt) -> dict[str, Any]:
        totals = {}
        if attempt.outcome == "solved":
            totals = {o: {how: attempt.total(o, how) for how in AGGREGATES} for o in OBJECTIVES}
        return vars(attempt) | {"totals": totals}

    def _changes(self, number: int) -> dict[str, list[str | None]]:
        """By option, its value in the base file and in that of a trial."""
        base = options.parse(self.settings.space.base)
        changes = self.settings.space.changes(self.attempts[number].values)
        return {name: [base.get(name), value] for name, value in changes.items()}

    def _at_edge(self, number: int) -> list[str]:
        """Parameters for which a trial went to the end of what the space allows, away from the start."""
        found = []
        for p in self.settings.space.parameters:
            value = self.attempts[number].values.get(p.name)
            low, high = p.bounds
            if isinstance(value, int | float) and value != p.start:
                near = (value - low, high - value)
                if min(near) <= EDGE * (high - low) and (p.kind != "integer" or min(near) == 0):
                    found.append(p.name)
        return found

    def _importance(self) -> dict[str, dict[str, dict[str, float]]]:
        """By evaluator and objective, how much each parameter matters for it; empty with too few trials."""
        import optuna

        importance = optuna.importance
        found: dict[str, dict[str, dict[str, float]]] = {}
        if len(self.solved()) < 2 * STARTUP_TRIALS:
            return found
        # of the whole space: among its own trials, a sampler has settled what matters most before long
        evaluators: dict[str, Any] = {"PED-ANOVA": importance.PedAnovaImportanceEvaluator(evaluate_on_local=False)}
        with contextlib.suppress(ImportError):  # which wants scikit-learn
            evaluators["fANOVA"] = importance.FanovaImportanceEvaluator(seed=0)
        for name, evaluator in evaluators.items():
            for k, objective in enumerate(self.settings.objectives):
                with warnings.catch_warnings(), contextlib.suppress(ImportError, ValueError, RuntimeError):
                    warnings.simplefilter("ignore")
                    values = importance.get_param_importances(
                        self.study, evaluator=evaluator, target=lambda t, k=k: t.values[k]
                    )
                    found.setdefault(name, {})[objective] = {p: float(v) for p, v in values.items()}
        return found


def judge(records: Sequence[measure.Record], base: Summary) -> tuple[str, str]:
    """Outcome and message of the solves of one scene; the error must not be far above the base file's."""
    bad = next((r for r in records if r["kind"] != "converged"), None)
    if bad is not None:
        return bad["kind"], bad["message"] or f"{bad['reason']}, true residual {bad['true_residual']:.1e}"
    errors = [r["forward_error"] for r in records if r["forward_error"] is not None]
    if errors and base["error"] is not None and max(errors) > ERROR_FACTOR * base["error"]:
        return "inaccurate", f"error {max(errors):.1e}, with the base file {base['error']:.1e}"
    return "solved", ""


def _median(summaries: Sequence[Summary]) -> Summary:
    """Median of each number in several summaries."""
    return {
        key: statistics.median(s[key] for s in summaries) if value is not None else None
        for key, value in summaries[0].items()
    }


def _attempt(trial: Any) -> Attempt:
    """A finished trial out of optuna's storage."""
    return Attempt(number=trial.number, values=dict(trial.params), **trial.user_attrs["result"])


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the system lets go of it however the process ends."""
    with (folder / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            raise UsageError(f"--out {folder}: another sweep is running in it; name another folder") from e
        yield


# --- the command line ---


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs sweep`."""
    add = parser.add_argument
    parser.epilog = EPILOG
    add("scenes", metavar="SCENE", nargs="+", help="scenes that every trial solves")
    add("--space", required=True, metavar="FILE.yaml", help="what may change: a space, or the name of a shipped one")
    add("--trials", type=int, default=200, metavar="N", help="trials, finished ones included (default 200)")
    add("--sampler", choices=SAMPLERS, default="tpe", help="how values are chosen (default tpe)")
    add(
        "--objective",
        nargs="+",
        choices=OBJECTIVES,
        default=["time", "memory"],
        help="what to make small; the first one chooses the best file (default time memory)",
    )
    add("--aggregate", choices=AGGREGATES, default="mean", help="of several scenes, as ratio to the base file")
    add("--hold-out", nargs="+", default=[], metavar="SCENE", help="scenes measured at the end only, reported apart")
    add("--ranks", type=int, default=1, metavar="N", help="MPI ranks of each solve (default 1)")
    add("--rtol", type=float, metavar="R", help="relative tolerance (default that of the base file)")
    add("--repetitions", type=int, default=1, metavar="N", help="solves of each scene in a trial (default 1)")
    add("--base-every", type=int, default=1, metavar="N", help="trials per measurement of the base file (default 1)")
    add("--time-limit", type=float, default=300.0, metavar="S", help="seconds for one solve, start included")
    add("--memory-limit", type=float, metavar="GB", help="address space of each rank")
    add(
        "--patience",
        type=float,
        default=3.0,
        metavar="X",
        help="give up a trial at X times what the front or the base file takes (default 3; 0: never)",
    )
    add("--finalists", type=int, default=3, metavar="N", help="files measured again at the end (default 3)")
    add("--confirm", type=int, default=3, metavar="N", help="measurements of each of them (default 3)")
    add("--clock", choices=CLOCKS, default="wall", help="cpu: processor time, for a machine where others compute")
    add("--seed", type=int, default=0, metavar="N", help="of the sampler")
    add("--out", type=Path, metavar="DIR", help="folder of the sweep (default sweep-SPACE)")
    add("--page", type=Path, metavar="FILE.md", help="write the report here, too, with its picture beside it")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs sweep` on one rank."""
    from petsc_fs.tools.sweep_report import screen_text, write

    if comm.size > 1:
        raise UsageError("sweep starts its own ranks; start it without mpiexec, with --ranks")
    settings = _settings(args)
    with _Screen(settings) as screen:
        sweep = Sweep(settings, screen.update)
        results = sweep.run()
    written = write(results, settings.out, args.page)
    print(screen_text(results))
    print(f"written: {', '.join(str(p) for p in written)}", flush=True)
    if results["final"] is None:
        counts = _counts(results["outcomes"])
        raise SolveError(f"no trial was solved accurately: {counts}; see {settings.out}/report.md")
    return 0


def _settings(args: argparse.Namespace) -> Settings:
    """The settings that arguments stand for.

    Raises:
        UsageError: they make no sense together, or a package is missing.
    """
    from petsc_fs.io.bundled import find_scene

    try:
        import optuna  # noqa: F401
        import yaml  # noqa: F401
    except ImportError as e:
        raise UsageError(f"sweep needs optuna and PyYAML ({e}); pip install 'petsc_fs[tune]'") from e
    for name in ("trials", "ranks", "repetitions", "base_every", "time_limit", "finalists", "confirm"):
        if getattr(args, name) <= 0:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(args, name):g}: expected a positive number")
    if args.rtol is not None and not 0 < args.rtol < 1:
        raise UsageError(f"--rtol {args.rtol:g}: expected a number between 0 and 1")
    if args.patience and args.patience < 1:
        raise UsageError(f"--patience {args.patience:g}: expected at least 1, or 0 for never")
    space = read(find_space(args.space))
    scenes, hold_out = ([find_scene(name) for name in names] for names in (args.scenes, args.hold_out))
    header = options.read_header(space.base)
    for path in (*scenes, *hold_out):
        fields = hdf5.read_sizes(path)[1]
        if not header.fits(fields):
            raise UsageError(f"{path.name}: {space.base.name} is for scenes with the fields {', '.join(header.fields)}")
    names = [path.name for path in (*scenes, *hold_out)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"{twice}: named twice; scenes, held out or not, need different names")
    return Settings(
        scenes=tuple(scenes),
        hold_out=tuple(hold_out),
        space=space,
        out=args.out or Path(f"sweep-{space.path.stem}"),
        trials=args.trials,
        sampler=args.sampler,
        objectives=tuple(dict.fromkeys(args.objective)),
        aggregate=args.aggregate,
        ranks=args.ranks,
        rtol=args.rtol,
        repetitions=args.repetitions,
        base_every=args.base_every,
        time_limit=args.time_limit,
        memory_limit=int(args.memory_limit * 1e9) if args.memory_limit else None,
        patience=args.patience,
        finalists=args.finalists,
        confirm=args.confirm,
        clock=args.clock,
        seed=args.seed,
    )


def _counts(outcomes: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {kind}" for kind, n in sorted(outcomes.items(), key=lambda item: -item[1]))


class _Screen:
    """Live progress: a bar with the best so far on a terminal, a line a trial elsewhere."""

    def __init__(self, settings: Settings) -> None:
        from rich.console import Console
        from rich.live import Live

        self.settings = settings
        self.console = Console(stderr=True)
        self.live = Live(console=self.console, refresh_per_second=2) if self.console.is_terminal else None
        self.started = time.monotonic()
        self.before: int | None = None

    def __enter__(self) -> _Screen:
        if self.live is not None:
            self.live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if self.live is not None:
            self.live.stop()
        if kind is KeyboardInterrupt:
            self.console.print(f"the same command goes on with the sweep in {self.settings.out}", highlight=False)

    def update(self, sweep: Sweep, text: str) -> None:
        """Show what is being done, or a trial that ended."""
        if self.live is not None:
            self.live.update(self._panel(sweep, text))
        elif text:
            self.console.print(text, highlight=False, soft_wrap=True)
        else:
            attempt = sweep.attempts[max(sweep.attempts)]
            line = f"trial {attempt.number}: {attempt.outcome}"
            if attempt.outcome == "solved":
                totals = [(o, attempt.total(o, self.settings.aggregate)) for o in OBJECTIVES]
                line += ": " + ", ".join(f"{o} {value:.2f}" for o, value in totals)
            elif attempt.message:
                line += f": {attempt.message}"
            self.console.print(line, highlight=False, soft_wrap=True, markup=False)

    def _panel(self, sweep: Sweep, text: str) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        done, total = len(sweep.attempts), self.settings.trials
        self.before = done if self.before is None else self.before
        passed = time.monotonic() - self.started
        left = passed / (done - self.before) * (total - done) if done > self.before else None
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            ProgressBar(total=total, completed=done, width=40),
            f"{done} of {total} trials",
            f"about {left / 60:.0f} min left" if left is not None else "",
        )
        table = Table(title="trials, best first; ratios to the base file", title_justify="left")
        for heading in ("trial", *OBJECTIVES):
            table.add_column(heading, justify="right")
        first = self.settings.objectives[0]
        for a in sorted(sweep.solved(), key=lambda a: a.total(first, self.settings.aggregate))[:5]:
            table.add_row(str(a.number), *(f"{a.total(o, self.settings.aggregate):.2f}" for o in OBJECTIVES))
        counts = _counts(Counter(a.outcome for a in sweep.attempts.values()))
        return Group(bar, table, counts, text)
