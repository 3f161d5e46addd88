"""Sweeps: searches of a space of PETSc options for files that are faster, smaller or more accurate than the base file.

A trial writes the base file with some options changed, and solves each scene with it in a process of its own
(`petsc_fs.tools.measure`), so that whatever goes wrong is an outcome of the trial. It counts only if the verdict of the
solver, which a trial cannot change, is that it converged, and the forward error stays near that of the base file. The
base file is measured again before each trial; what is compared are ratios to it, on the same scene at the same time.

Everything a sweep knows is in its folder, in optuna's SQLite storage: the same command again goes on where a sweep
was interrupted or killed. The only module that imports optuna.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import itertools
import json
import os
import re
import statistics
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.files import write_text
from petsc_fs.tools import measure, reference
from petsc_fs.tools.measure import make_folder, positive, say
from petsc_fs.tools.pages import markdown
from petsc_fs.tools.space import Space, Value, find_space, label, read

if TYPE_CHECKING:
    from mpi4py import MPI

Summary = dict[str, Any]
"""What was measured on one scene: seconds, iterations, memory (bytes), error, residual."""
Attempt = dict[str, Any]
"""One finished trial: its `number`; `values` of its parameters; `outcome`, one of OUTCOMES; `message`, one line on what
went wrong; `scenes`, by name what was measured, with `ratios` to the base file; `totals` of these by objective,
aggregated over scenes, if it was solved; `same_as`, the number of an earlier trial of the same options, for which this
one was not measured again, or None."""
Results = dict[str, Any]

SAMPLERS = ("tpe", "random", "grid")
OBJECTIVES = ("time", "memory", "error")
AGGREGATES = ("mean", "worst")

OUTCOMES = {
    "solved": "the verdict is that the solver converged, and the error is good enough, on all scenes",
    "inaccurate": "the solver converged, but the error is far above that of the base file",
    "pruned": "far slower than the base file: given up",
    **{kind: text for kind, text in measure.KINDS.items() if kind != "converged"},
    "interrupted": "the sweep was interrupted or killed meanwhile; the same options were tried again",
}
"""How trials end, and what each means."""

NOTHING: Summary = {"error": None}
"""Of a base file whose error is not known."""
ERROR_FACTOR = 10.0
"""A trial may have this many times the error of the base file."""
SLACK = 3.0
"""Seconds that any trial has more than `Settings.patience` says."""
SHORT = 5.0
"""Seconds of a process below which one more solve, unrecorded, goes before in the next ones."""
RECENT = 3
"""Measurements of the base file, the last ones, whose median a trial is compared with."""
STARTUP_TRIALS = 20
"""Random trials before TPE has a model to go by."""


def _option(default: Any, said: str, **how: Any) -> Any:
    """A setting that is an option of the command line, too: its default, what it is, and argparse's words for it."""
    shown = "" if default is None or isinstance(default, tuple) else f" (default {default})"
    return field(default=default, metadata={"help": said + shown, **how})


def _bytes(text: str) -> int:
    return int(float(text) * 1e9)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a sweep is asked to do."""

    scenes: tuple[Path, ...]  # that every trial solves
    space: Space
    out: Path  # folder of the sweep
    hold_out: tuple[Path, ...] = ()  # scenes that only the base file and the best one solve, at the end
    # fmt: off
    trials: int = _option(200, "trials, finished ones included", type=positive(int), metavar="N")
    sampler: str = _option("tpe", "how values are chosen", choices=SAMPLERS)
    objective: tuple[str, ...] = _option(("time", "memory"), "what to make small; the first one chooses the best file "
        "(default time memory)", choices=OBJECTIVES, nargs="+")
    aggregate: str = _option("mean", "of several scenes, as ratio to the base file", choices=AGGREGATES)
    ranks: int = _option(1, "MPI ranks of each solve", type=positive(int), metavar="N")
    rtol: float | None = _option(None, "relative tolerance (default that of the base file)", type=float, metavar="R")
    repetitions: int = _option(1, "solves of each scene in a trial, of which the median counts", type=positive(int),
        metavar="N")
    time_limit: float = _option(300.0, "seconds for one solve, start included", type=positive(float), metavar="S")
    memory_limit: int | None = _option(None, "address space of each rank", type=_bytes, metavar="GB")
    patience: float = _option(3.0, "give up a trial at X times what the base file takes; 0: never", type=float,
        metavar="X")
    finalists: int = _option(3, "files measured again at the end, to choose the best", type=positive(int), metavar="N")
    confirm: int = _option(3, "measurements of each of them, and on scenes held out", type=positive(int), metavar="N")
    clock: str = _option("wall", "cpu: processor time, where others compute, too", choices=measure.CLOCKS)
    seed: int = _option(0, "of the sampler", type=int, metavar="N")
    # fmt: on

    @property
    def tolerance(self) -> float:
        """Relative tolerance of all solves."""
        return self.rtol or float(options.parse(self.space.base).get("ksp_rtol") or 1e-5)

    def identity(self) -> dict[str, str]:
        """What may not change when a sweep goes on."""
        return {
            "format": "2",  # of what is stored of a trial
            "scenes": " ".join(f"{path.name} ({reference.digest(path)[:12]})" for path in self.scenes),
            "space": json.dumps([repr(p) for p in self.space.parameters]),
            "base file": self.space.base.read_text(encoding="utf-8"),
            **{name: str(getattr(self, name)) for name in ("objective", "aggregate", "ranks", "tolerance", "clock")},
        }


def aggregate(ratios: Sequence[float], how: str) -> float:
    """Geometric mean or worst of ratios.

    >>> aggregate([0.5, 2.0], "mean"), aggregate([0.5, 2.0], "worst")
    (1.0, 2.0)
    """
    return max(ratios) if how == "worst" else statistics.geometric_mean(ratios)


def summary(records: Sequence[measure.Record], clock: str = "wall") -> Summary:
    """What the repetitions of a solve of one scene say: medians, and the most of the memory."""
    known = [r["forward_error"] for r in records if r["forward_error"] is not None]
    return {
        "seconds": statistics.median(measure.seconds_of(r, clock)["total"] for r in records),
        "iterations": records[-1]["iterations"],
        "memory": max(map(measure.grown, records)),
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


def judge(records: Sequence[measure.Record], base: Summary = NOTHING) -> tuple[str, str]:
    """Outcome and message of the solves of one scene; the error must not be far above the base file's."""
    bad = next((r for r in records if r["kind"] != "converged"), None)
    if bad is not None:
        return bad["kind"], bad["message"] or f"{bad['reason']}, true residual {bad['true_residual']:.1e}"
    errors = [r["forward_error"] for r in records if r["forward_error"] is not None]
    if errors and base["error"] is not None and max(errors) > ERROR_FACTOR * base["error"]:
        return "inaccurate", f"error {max(errors):.1e}, with the base file {base['error']:.1e}"
    return "solved", ""


def front(points: Sequence[Sequence[float]]) -> list[int]:
    """Numbers of the points of which none is better in everything.

    >>> front([(1, 3), (2, 2), (3, 3), (1, 3)])
    [0, 1, 3]
    """
    values = np.array(points)
    return [k for k, p in enumerate(values) if not ((values <= p).all(axis=1) & (values < p).any(axis=1)).any()]


class Sweep:
    """A search in a folder. One process at a time works in it; it says on stderr what takes long."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.study: Any = None
        self.attempts: dict[int, Attempt] = {}
        self.interrupted = 0
        self._tried: dict[str, int] = {}  # what was changed: number of the trial
        self._recent: dict[Path, list[Summary]] = {}
        self._elapsed: dict[Path, float] = {}  # seconds of a process with the base file
        self._references: dict[Path, Path | None] = {}

    def run(self) -> Results:
        """Search, or go on with it, choose the best file and measure it on the scenes held out; see `results`.

        Raises:
            UsageError: the folder holds another sweep, or a scene does not fit the base file.
            SolveError: the base file does not solve a scene.
        """
        make_folder(self.settings.out / "trials")
        with _alone(self.settings.out):
            self.study = self._open()
            self._recover()
            for scene in self.settings.scenes if len(self.attempts) < self.settings.trials else ():
                self._base(scene)
            self._queue()
            while len(self.attempts) < self.settings.trials:
                waiting = any(trial.state.name == "WAITING" for trial in self.study.get_trials(deepcopy=False))
                if self.settings.sampler == "grid" and not waiting:
                    break
                self._trial()
            self._choose()
            return self.results()

    # --- storage

    def _open(self) -> Any:
        """The study in the folder, made if there is none."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        settings, identity = self.settings, self.settings.identity()
        how = {"directions": ["minimize"] * len(settings.objective), "load_if_exists": True}
        study = optuna.create_study(storage=self._storage(), study_name="sweep", **how)
        there = study.user_attrs.get("identity", identity)
        other = next((key for key in identity if there.get(key) != identity[key]), None)
        if other is not None:
            raise UsageError(f"--out {settings.out}: the sweep in it has another {other}; name another folder")
        study.set_user_attr("identity", identity)
        seed = settings.seed + len(study.trials)  # one that goes on must not draw the same numbers again
        study.sampler = optuna.samplers.RandomSampler(seed=seed)
        if settings.sampler == "tpe":
            startup = {"n_startup_trials": STARTUP_TRIALS, "multivariate": True, "group": True}
            study.sampler = optuna.samplers.TPESampler(seed=seed, **startup)
        return study

    def _storage(self) -> Any:
        """Where optuna keeps the study; SQLite's transactions survive a kill at any moment."""
        from optuna.storages import RDBStorage

        return RDBStorage(f"sqlite:///{self.settings.out.resolve() / 'study.db'}")

    def _recover(self) -> None:
        """Take finished trials over; finish one that was measured, and repeat one that was not, when the end came."""
        for trial in self.study.get_trials(deepcopy=False):
            if trial.state.is_finished() or trial.state.name == "WAITING":
                continue
            if "result" in trial.user_attrs:
                self._tell(trial.user_attrs["result"])
            else:
                self.study.enqueue_trial(trial.system_attrs.get("fixed_params", {}) | trial.params)
                self.study.tell(trial.number, state=_state("FAIL"))
        for trial in self.study.get_trials(deepcopy=False):
            if trial.state.name == "FAIL":
                self.interrupted += 1
            elif trial.state.is_finished():
                self.attempts[trial.number] = trial.user_attrs["result"]
                self._tried.setdefault(self._key(trial.params), trial.number)

    def _key(self, values: Mapping[str, Value]) -> str:
        return json.dumps(self.settings.space.changes(values), sort_keys=True)

    def _queue(self) -> None:
        """Put into line what does not come from the sampler: all of a grid, or else the base file itself."""
        settings = self.settings
        if settings.sampler == "grid":
            grid = settings.space.grid()
            if len(grid) > settings.trials:
                raise UsageError(
                    f"the grid of {settings.space.path} has {len(grid):,} points, more than --trials {settings.trials};"
                    " declare coarser steps or fewer points, allow more trials, or take --sampler random"
                )
            for values in grid:
                self.study.enqueue_trial(values, skip_if_exists=True)
        elif not self.study.trials:
            self.study.enqueue_trial(settings.space.start())

    # --- measuring

    def _job(self, scene: Path, file: Path | None = None, time_limit: float | None = None) -> measure.Job:
        settings, exact = self.settings, self._reference(scene)
        how: dict[str, Any] = {name: getattr(settings, name) for name in ("ranks", "repetitions", "memory_limit")}
        how |= {"rtols": (settings.tolerance,), "time_limit": time_limit or settings.time_limit}
        how |= {"warm_up": self._elapsed.get(scene, 0.0) < SHORT, "errors": exact is not None}
        return measure.Job(scenes=[scene], options_file=file, references={str(scene): exact} if exact else {}, **how)

    def _reference(self, scene: Path) -> Path | None:
        """File with the reference solution of a scene, made once; None where it cannot be."""
        target = self.settings.out / "references" / f"{scene.stem}-{reference.digest(scene)[:12]}.npz"
        if scene not in self._references:
            with contextlib.suppress(SolveError):
                if not target.exists():
                    say(f"reference solution of {scene.name}")
                    reference.made(scene, target)
            self._references[scene] = target if target.exists() else None
        return self._references[scene]

    def _base(self, scene: Path) -> None:
        """Measure the base file; a SolveError where it does not solve the scene."""
        started = time.monotonic()
        records = measure.measure(self._job(scene, self.settings.space.base))
        outcome, message = judge(records)
        if outcome != "solved":
            if scene in self._recent:
                return  # it does solve the scene: the machine is to blame
            name = self.settings.space.base.name
            raise SolveError(f"the base file {name} does not solve {scene.name}, to compare with: {outcome}: {message}")
        found = summary(records, self.settings.clock)
        self._elapsed[scene] = time.monotonic() - started
        self._recent[scene] = [*self._recent.get(scene, []), found][-RECENT:]

    def _trial(self) -> None:
        """Ask for values, measure, and store what came of it."""
        trial = self.study.ask()
        values = self.settings.space.suggest(trial)
        earlier = self._tried.setdefault(self._key(values), trial.number)
        if earlier != trial.number:
            attempt = self.attempts[earlier] | {"same_as": earlier}
        else:
            write_text(self._file(trial.number), self._text(values, trial.number))
            attempt = self._try(self._file(trial.number)) | {"same_as": None}
        attempt |= {"number": trial.number, "values": values}
        trial.set_user_attr("result", attempt)  # from here on, the trial needs no repetition
        self._tell(attempt)
        self.attempts[trial.number] = attempt
        said = ", ".join(f"{o} {total:.2f}" for o, total in attempt["totals"].items()) or attempt["message"]
        say(f"trial {trial.number}: {attempt['outcome']}: {said}")

    def _tell(self, attempt: Attempt) -> None:
        """End a trial; what was not solved is pruned for optuna, whose samplers then avoid it."""
        if attempt["outcome"] == "solved":
            self.study.tell(attempt["number"], [attempt["totals"][o] for o in self.settings.objective])
        else:
            self.study.tell(attempt["number"], state=_state("PRUNED"))

    def _try(self, file: Path) -> Attempt:
        """Measure an options file on all scenes, until it turns out hopeless."""
        settings, how = self.settings, self.settings.aggregate
        found: dict[str, Summary] = {}
        for scene in settings.scenes:
            if self.attempts:
                self._base(scene)
            recent = self._recent[scene]
            base = recent[-1] | {"seconds": statistics.median(r["seconds"] for r in recent)}
            limit = settings.time_limit
            if settings.patience:
                limit = min(SLACK + settings.patience * self._elapsed[scene], limit)
            records = measure.measure(self._job(scene, file, limit))
            outcome, message = judge(records, base)
            if outcome == "hang" and limit < settings.time_limit:
                allowed = f"{settings.patience:g} times what the base file takes"
                outcome, message = "pruned", f"{message}, that is {allowed}"
            if outcome != "solved":
                where = f"{scene.name}: " if len(settings.scenes) > 1 else ""
                return {"outcome": outcome, "message": where + message, "scenes": found, "totals": {}}
            mine = summary(records, settings.clock)
            found[scene.name] = mine | {"ratios": ratios(mine, base), "base_seconds": base["seconds"]}
        totals = {o: aggregate([s["ratios"][o] for s in found.values()], how) for o in OBJECTIVES}
        return {"outcome": "solved", "message": "", "scenes": found, "totals": totals}

    # --- the best file

    def solved(self) -> list[Attempt]:
        """Trials that were solved, each set of options once."""
        return [a for a in self.attempts.values() if a["outcome"] == "solved" and a["same_as"] is None]

    def front_objectives(self) -> tuple[str, ...]:
        """Objectives of the front: those of the search, with memory where time is the only one."""
        named = self.settings.objective
        return named if len(named) > 1 else (*named, "memory" if named[0] == "time" else "time")

    def front(self) -> list[int]:
        """Numbers of the trials of which none is better in everything, best in the first objective first."""
        solved = self.solved()
        points = [[a["totals"][o] for o in self.front_objectives()] for a in solved]
        return [solved[k]["number"] for k in sorted(front(points), key=lambda k: points[k])]

    def _choose(self) -> None:
        """Measure the finalists again, choose the best, and measure it and the base file on what was held out."""
        settings, first = self.settings, self.settings.objective[0]
        candidates = sorted(self.solved(), key=lambda a: a["totals"][first])[: settings.finalists]
        numbers = [a["number"] for a in candidates]
        wanted = [numbers, [p.name for p in settings.hold_out], settings.confirm]
        if not candidates or self.study.user_attrs.get("final", {}).get("wanted") == wanted:
            return
        confirmed = self._compare(numbers, settings.scenes)
        totals = {
            n: aggregate([s["ratios"][first] for s in found.values()], settings.aggregate)
            for n, found in confirmed.items()
            if all(s["outcome"] == "solved" for s in found.values())
        }
        if not totals:
            raise SolveError("none of the best files could be confirmed; take more --finalists")
        best = min(totals, key=lambda n: totals[n])
        final = {"wanted": wanted, "best": best, "finalists": {str(n): found for n, found in confirmed.items()}}
        self.study.set_user_attr("final", final | {"hold_out": self._compare([best], settings.hold_out)[best]})

    def _compare(self, numbers: Sequence[int], scenes: Sequence[Path]) -> dict[int, dict[str, Summary]]:
        """Files of trials against the base file, measured in turns: medians of time ratios, by trial and scene."""
        settings, found = self.settings, {n: dict[str, Summary]() for n in numbers}
        variants = [measure.Variant(str(n), str(self._file(n))) for n in numbers]
        variants.insert(0, measure.Variant("", str(settings.space.base)))
        for scene in scenes:
            say(f"base file against the best on {scene.name}, {settings.confirm} times")
            rounds: dict[str, dict[int, list[measure.Record]]] = {v.label: {} for v in variants}
            for records in measure.measure_all(
                [scene], variants, self._job(scene), ranks=(settings.ranks,), repeat=settings.confirm
            ):
                rounds[records[0]["variant"]][records[0]["round"]] = records
            base = {k: summary(r, settings.clock) for k, r in rounds[""].items() if judge(r)[0] == "solved"}
            if not base:
                raise SolveError(f"the base file does not solve {scene.name} any more")
            for n in numbers:
                mine = {k: rounds[str(n)][k] for k in base if k in rounds[str(n)]}
                found[n][scene.name] = {"base": _median(list(base.values())), **self._confirmed(mine, base)}
        return found

    def _confirmed(self, mine: Mapping[int, list[measure.Record]], base: Mapping[int, Summary]) -> Summary:
        """A file's records by round, against what the base file did in the same one."""
        judged = [judge(records, base[k]) for k, records in mine.items()]
        judged = judged or [("hang", "no result in any round that the base file solved")]
        outcome, message = next((j for j in judged if j[0] != "solved"), judged[0])
        if outcome != "solved":
            return {"outcome": outcome, "message": message}
        good = {k: summary(records, self.settings.clock) for k, records in mine.items()}
        pairs = [s["seconds"] / base[k]["seconds"] for k, s in good.items()]
        middle = _median(list(good.values()))
        against = ratios(middle, _median(list(base.values()))) | {"time": statistics.median(pairs)}
        return {"outcome": "solved", "message": "", **middle, "spread": [min(pairs), max(pairs)], "ratios": against}

    def _file(self, number: int) -> Path:
        """The options file of a trial."""
        return self.settings.out / "trials" / f"{number:04}.opts"

    def _text(self, values: Mapping[str, Value], number: int) -> str:
        """The options file of a trial, with a header of its own."""
        space = self.settings.space
        known = [line for line in space.base.read_text("utf-8").splitlines() if re.match("# (fields|not_for):", line)]
        header = [
            f"# {space.base.name} tuned for {', '.join(path.name for path in self.settings.scenes)}",
            "#",
            f"# source: petsc-fs sweep, space {space.path.name}, trial {number}",
        ]
        body = itertools.dropwhile(lambda line: line.startswith("#"), space.text(values).splitlines())
        return "\n".join([*header, *known, *body]) + "\n"

    def results(self) -> Results:
        """Everything that came out, as JSON can hold it."""
        settings, final = self.settings, self.study.user_attrs.get("final")
        outcomes = Counter(a["outcome"] for a in self.attempts.values())
        outcomes.update({"interrupted": self.interrupted} if self.interrupted else {})
        asked = asdict(settings)
        asked["objectives"] = asked.pop("objective")
        return asked | {
            "space": settings.space.path.name,
            "scenes": [p.name for p in settings.scenes],
            "hold_out": [p.name for p in settings.hold_out],
            "out": settings.out.name,
            "command": " ".join(["petsc-fs", *sys.argv[1:]]),
            "description": settings.space.description,
            "base": settings.space.base.name,
            "tolerance": settings.tolerance,
            "front_objectives": list(self.front_objectives()),
            "machine": measure.describe_machine(),
            "outcomes": dict(outcomes),
            "trials": [self.attempts[n] for n in sorted(self.attempts)],
            "front": self.front(),
            "final": final,
            "changes": self._changes(final["best"]) if final else {},
        }

    def _changes(self, number: int) -> dict[str, list[str | None]]:
        """By option, its value in the base file and in that of a trial."""
        base = options.parse(self.settings.space.base)
        changes = self.settings.space.changes(self.attempts[number]["values"])
        return {name: [base.get(name), value] for name, value in changes.items()}


def _state(name: str) -> Any:
    """A state of optuna's trials."""
    from optuna.trial import TrialState

    return TrialState[name]


def _median(summaries: Sequence[Summary]) -> Summary:
    """Median of each number in several summaries."""
    return {
        key: statistics.median(s[key] for s in summaries) if value is not None else None
        for key, value in summaries[0].items()
    }


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the system lets go of it however the process ends."""
    with (folder / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            raise UsageError(f"--out {folder}: another sweep is running in it; name another folder") from e
        yield


# --- what people read


def write(results: Results, folder: Path, page: Path | None = None) -> list[Path]:
    """Write best.opts, sweep.json, front.png and report.md into the folder of a sweep; the files written.

    The report goes to `page` as well, with its picture beside it.
    """
    written = [folder / "sweep.json"]
    write_text(written[0], json.dumps(results, indent=2) + "\n")
    if results["final"] is not None:
        trial = folder / "trials" / f"{results['final']['best']:04}.opts"
        write_text(folder / "best.opts", trial.read_text(encoding="utf-8"))
        written.append(folder / "best.opts")
    for target, picture in ((folder / "report.md", folder / "front.png"), (page, page and page.with_suffix(".png"))):
        if target is not None and picture is not None:
            if results["front"]:
                written.append(_draw(results, picture))
            write_text(target, "\n".join(report(results, picture.name)) + "\n")
            written.append(target)
    return written


def _draw(results: Results, target: Path) -> Path:
    from petsc_fs.tools.plots import plot_front

    x, y = results["front_objectives"][:2]
    totals = {t["number"]: t["totals"] for t in results["trials"] if t["totals"] and t["same_as"] is None}
    best = [] if results["final"] is None else [results["final"]["best"]]
    groups = {"solved": list(totals), "Pareto front": results["front"], "best.opts": best}
    points = {name: [(totals[n][x], totals[n][y]) for n in numbers] for name, numbers in groups.items()}
    return plot_front(points | {"base file": [(1, 1)]}, (x, y), f"{len(results['trials'])} trials", target)


def report(results: Results, picture: str) -> Iterator[str]:
    """The report's lines, in Markdown."""
    trials = {t["number"]: t for t in results["trials"]}
    yield from (f"# Sweep: {results['description']}", "", f"Written by `{results['command']}`.", "")
    yield f"- space `{results['space']}`, base file `{results['base']}`"
    yield f"- each trial: {', '.join(results['scenes'])} on {results['ranks']} rank(s) to {results['tolerance']:g}"
    yield f"- to make small: {', '.join(results['objectives'])}, as ratios to the base file"
    yield f"- time is that of set-up and solve ({measure.CLOCKS[results['clock']]}); memory what processes grew by"
    yield from (f"- {name}: {value}" for name, value in results["machine"].items())
    if results["final"] is not None:
        yield from _about_best(results)
    yield from ("", f"## How the {len(trials)} trials ended", "")
    rows = []
    for kind, count in sorted(results["outcomes"].items(), key=lambda item: -item[1]):
        message = next((t["message"] for t in trials.values() if t["outcome"] == kind), "")
        rows.append([kind, count, OUTCOMES[kind], message[:160]])
    yield from markdown(["outcome", "trials", "meaning", "for example"], rows)
    if results["front"]:
        yield from ("", "## Pareto front", "", f"![Trials by what was to be made small]({picture})", "")
        values = {n: trials[n]["values"] for n in results["front"]}
        differ = sorted({k for v in values.values() for k in v if len({str(w.get(k)) for w in values.values()}) > 1})
        rows = []
        for n, v in values.items():
            words = ", ".join(f"{k} {label(v[k])}" for k in differ if k in v)
            rows.append([n, *(f"{trials[n]['totals'][o]:.2f}" for o in OBJECTIVES), words])
        yield from markdown(["trial", *OBJECTIVES, "what differs on the front"], rows)


def _about_best(results: Results) -> Iterator[str]:
    """What the best file changes, and how it did beside the base file."""
    final = results["final"]
    yield from ("", f"## The best file: trial {final['best']}", "")
    changes = [
        [f"`-{name}`", *("not set" if v is None else f"`{v}`" for v in both)]
        for name, both in results["changes"].items()
    ]
    yield from markdown(["option", results["base"], "best.opts"], changes)
    yield from ("", f"In turns with the base file, {results['confirm']} times; medians, and the range of ratios:", "")
    named = [(f"trial {n}, {scene}", s) for n, by in final["finalists"].items() for scene, s in by.items()]
    named += [(f"trial {final['best']}, {scene}, held out", s) for scene, s in final["hold_out"].items()]
    yield from markdown(COMPARED, [_compared(name, s) for name, s in named])
    worse = [k for k, s in final["hold_out"].items() if s["outcome"] != "solved" or s["ratios"]["time"] > 1]
    if worse:
        yield from ("", f"On {', '.join(worse)} the base file is the better one: best.opts is for scenes like its own.")


COMPARED = "file, scene;base, s;s;ratio;base, iterations;iterations;base, MB;MB;base, error;error".split(";")


def _compared(name: str, s: Summary) -> list[str]:
    """A file against the base file on one scene."""
    base = s["base"]
    if s["outcome"] != "solved":
        return [name, f"{base['seconds']:.3g}", f"{s['outcome']}: {s['message']}", *[""] * 7]
    errors = ["" if e is None else f"{e:.1e}" for e in (base["error"], s["error"])]
    pairs = [("seconds", 1.0, ".3g"), ("iterations", 1.0, ".0f"), ("memory", 1e-6, ".0f")]
    cells = [f"{x[key] * factor:{form}}" for key, factor, form in pairs for x in (base, s)]
    ratio = f"**{s['ratios']['time']:.2f}** ({s['spread'][0]:.2f}–{s['spread'][1]:.2f})"
    return [name, *cells[:2], ratio, *cells[2:], *errors]


# --- the command line

EPILOG = """\
A space is a YAML file that names a base options file and what may change in it; amg.yaml (multigrid of mechanics and
pressure), heat.yaml (that of pressure and temperature) and flow.yaml (small, for a first try) come along, and
petsc_fs/tools/space.py explains the format.

The folder --out holds the sweep: the same command again goes on where it was interrupted or killed, and one with
more --trials goes on from its end. In it are, at the end,
  best.opts    the fastest file that was confirmed, for petsc-fs solve -options_file best.opts
  report.md    what came out, with a picture; sweep.json holds all figures
  trials/      the options file of each trial

exit codes: 0 there is a best file; 1 no trial was solved accurately, or the base file is not; 2 wrong call or space;
130 interrupted"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `petsc-fs sweep`."""
    parser.epilog = EPILOG
    add = parser.add_argument
    add("scenes", metavar="SCENE", nargs="+", help="scenes that every trial solves")
    add("--space", required=True, metavar="FILE.yaml", help="what may change: a space, or the name of a shipped one")
    add("--hold-out", nargs="+", default=[], metavar="SCENE", help="scenes measured at the end only, reported apart")
    for f in fields(Settings):
        if f.metadata:
            add(f"--{f.name.replace('_', '-')}", default=f.default, **f.metadata)
    add("--out", type=Path, metavar="DIR", help="folder of the sweep (default sweep-SPACE)")
    add("--page", type=Path, metavar="FILE.md", help="write the report here, too, with its picture beside it")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Run `petsc-fs sweep` on one rank."""
    if comm.size > 1:
        raise UsageError("sweep starts its own ranks; start it without mpiexec, with --ranks")
    settings = _settings(args)
    try:
        results = Sweep(settings).run()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the same command goes on with the sweep in {settings.out}") from None
    written = write(results, settings.out, args.page)
    final, counts = results["final"], ", ".join(f"{n} {kind}" for kind, n in results["outcomes"].items())
    if final is None:
        raise SolveError(f"no trial was solved accurately: {counts}; see {settings.out}/report.md")
    best = final["best"]
    print(f"{len(results['trials'])} trials: {counts}; best is trial {best}, seconds as ratios to the base file:")
    for where, found in (("", final["finalists"][str(best)]), (" (held out)", final["hold_out"])):
        for scene, s in found.items():
            print(f"  {scene}{where}: " + (f"{s['ratios']['time']:.2f}" if s["outcome"] == "solved" else s["outcome"]))
    print(f"written: {', '.join(map(os.fspath, written))}", flush=True)
    return 0


def _settings(args: argparse.Namespace) -> Settings:
    """The settings that arguments stand for; a UsageError if they make no sense together, or a package is missing."""
    from petsc_fs.io.bundled import find_scene

    try:
        import optuna  # noqa: F401
    except ImportError as e:
        raise UsageError(f"sweep needs optuna and PyYAML ({e}); pip install 'petsc_fs[tune]'") from e
    if args.rtol is not None and not 0 < args.rtol < 1:
        raise UsageError(f"--rtol {args.rtol:g}: expected a number between 0 and 1")
    if args.patience and args.patience < 1:
        raise UsageError(f"--patience {args.patience:g}: expected at least 1, or 0 for never")
    space = read(find_space(args.space))
    scenes, hold_out = (tuple(find_scene(name) for name in names) for names in (args.scenes, args.hold_out))
    header = options.read_header(space.base)
    for path in (*scenes, *hold_out):
        if not header.fits(hdf5.read_sizes(path)[1]):
            raise UsageError(f"{path.name}: {space.base.name} is for scenes with the fields {', '.join(header.fields)}")
    measure.refuse_twice("scenes, held out or not,", [path.name for path in (*scenes, *hold_out)])
    asked = {f.name: getattr(args, f.name) for f in fields(Settings) if f.metadata}
    asked |= {"objective": tuple(dict.fromkeys(args.objective)), "out": args.out or Path(f"sweep-{space.path.stem}")}
    return Settings(scenes=scenes, hold_out=hold_out, space=space, **asked)
