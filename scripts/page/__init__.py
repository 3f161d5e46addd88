"""Makers of the pages that hold what was measured: the module NAME makes docs/NAME.md; `scripts/pages` runs them.

The first line of its docstring says what the page shows. Beside that a module has

    INPUTS           globs, relative to the repository, of the options files and the code that the page depends on, but
                     for the module itself
    make(place)      measures, puts pictures into `place.docs` and returns the page in Markdown, without the end that
                     all pages have; importing the module loads neither PETSc nor PorePy
"""

from __future__ import annotations

import hashlib
import importlib
import pkgutil
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from types import ModuleType

from petsc_fs.errors import PetscFsError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.bundled import find_scene
from petsc_fs.tools import measure
from petsc_fs.tools.plots import look, pyplot

ROOT = Path(__file__).resolve().parents[2]
NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)])))
MARK = "made from"
"""Of the comment with the inputs of a page."""
EXPORTED = re.compile(r"(\w+)_g([\d.]+)_t(\d+)_n(\d+)")
"""Model, refinement, time step and Newton step in the name of a scene that `petsc-fs export` wrote."""


@dataclass
class Place:
    """Where a page is made, and what it asked for on the way.

    Attributes:
        docs: folder of the pages and their pictures.
        scratch: folder for whatever else is written; it is not kept.
        scenes: folder of scenes that models were run for; they are kept.
        rounds: how often timed solves are measured.
    """

    docs: Path
    scratch: Path
    scenes: Path
    rounds: int = 3
    commands: list[str] = field(default_factory=list)
    exported: dict[str, Path] = field(default_factory=dict)

    def say(self, line: str) -> None:
        """Tell who waits what is going on."""
        measure.say(line)

    def run(self, *words: str, fine: tuple[int, ...] = (0,)) -> str:
        """What a call of petsc-fs, python or mpiexec prints, run in `scratch`; the call goes into the page.

        Raises:
            PetscFsError: the exit code is none of those that are fine.
        """
        folders = self.scratch, self.scenes, ROOT / "petsc_fs" / "scenes", ROOT
        shown = "|".join(f"{re.escape(str(folder))}/" for folder in folders)
        call = re.sub(shown, "", " ".join(words))
        self.say(call)
        self.commands.append(call)
        python = [sys.executable]
        programs = {"petsc-fs": [*python, "-m", "petsc_fs"], "python": python, "mpiexec": measure.launcher(0)[:1]}
        command = [part for word in words for part in programs.get(word, [word])]
        done = subprocess.run(
            command, cwd=self.scratch, env=measure.environment(), stdout=subprocess.PIPE, text=True, check=False
        )
        if done.returncode not in fine:
            raise PetscFsError(f"{call}: exit code {done.returncode}")
        return done.stdout

    def scene(self, name: str) -> Path:
        """A scene: bundled, as model3.h5, or as `petsc-fs export` names it, as model3_g1_t1_n2, then made if missing.

        Raises:
            PetscFsError: the model could not be run, as where PorePy is missing.
        """
        if (parts := EXPORTED.fullmatch(name)) is None:
            return find_scene(name)
        model, refinement, step, newton = parts.groups()
        recipe = f"petsc-fs export {model} --refine {refinement} --steps {step}:{newton}"
        path = self.scenes / f"{name}.h5"
        if not path.exists():
            self.say(f"{recipe} --out {self.scenes}")
            self.scenes.mkdir(parents=True, exist_ok=True)
            command = [sys.executable, "-m", *recipe.replace("-", "_", 1).split(), "--out", str(self.scenes)]
            if subprocess.run(command, env=measure.environment(), check=False).returncode:
                raise PetscFsError(f"it needs what `{recipe}` writes, in the folder that --scenes names")
        self.exported[recipe] = path
        return path

    def measured(
        self,
        scenes: Sequence[str],
        variants: Sequence[str],
        ranks: Sequence[int] = (1,),
        *,
        batch: bool = False,
        may_fail: bool = False,
    ) -> dict[tuple[str, int, str], list[measure.Record]]:
        """Records of `rounds` rounds, by scene, ranks and variant, measured in turns.

        Each solve has a process of its own; with `batch` a process takes all scenes by a variant, one after the other.

        Raises:
            PetscFsError: a solve has not converged, and may not fail.
        """
        paths = {str(self.scene(name)): name for name in scenes}
        chosen = [replace(measure.Variant.of(words), label=words) for words in variants]
        found: dict[tuple[str, int, str], list[measure.Record]] = {}
        job, how = measure.Job(keep_going=True), {"ranks": ranks, "repeat": self.rounds, "batch": batch}
        for records in measure.measure_all(list(paths), chosen, job, **how):
            for record in records:
                key = paths[record["scene"]], record["ranks"], record["variant"]
                self.say(f"{key}: {record['kind']} {record['iterations']} {record['seconds']} {record['message']}")
                if not may_fail and record["kind"] != "converged":
                    raise PetscFsError(f"{record['variant']} on {key[0]}: {record['kind']} {record['message']}")
                found.setdefault(key, []).append(record)
        return found


def spread(values: Iterable[float]) -> str:
    """Median, and in brackets the least and the greatest."""
    known = sorted(values)
    return f"{median(known):.2f} ({known[0]:.2f}–{known[-1]:.2f})"


def span(values: Iterable[float]) -> str:
    """The least and the greatest, in words that other pages quote."""
    known = sorted(values)
    return f"{known[0]:.1f} to {known[-1]:.1f}"


def short(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{float(f'{value:.2g}'):g}"


def unknowns(path: Path) -> int:
    """Of a scene."""
    return sum(hdf5.read_sizes(path)[1].values())


def draw(
    path: Path, panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], x: Sequence[str], y: Sequence[str]
) -> None:
    """Draw two panels of curves, by their titles and labels, on logarithmic axes.

    In a size to be read on a screen of 420 pixels. With the same y, they share the axis and the legend.
    """
    plt = pyplot()
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 9})
    shared = y[0] == y[1]
    figure, axes = plt.subplots(1, 2, figsize=(6, 3.4), sharey=shared, layout="constrained")
    for k, (panel, (title, curves)) in enumerate(zip(axes, panels.items(), strict=True)):
        for number, (label, points) in enumerate(curves.items()):
            panel.plot(*zip(*points, strict=True), label=label, **look(number))
        panel.set(xscale="log", yscale="log", title=title, xlabel=x[k], ylabel="" if k and shared else y[k])
        panel.grid(color="#DDDDDD")
        low, high = panel.get_xlim()
        if high < 1e4 * low:
            marks = range(1, 10) if high < 4 * low else (1, 2, 5) if high < 50 * low else (1,)
            panel.xaxis.set_major_locator(plt.LogLocator(subs=marks))
            panel.xaxis.set_major_formatter("{x:,g}")
            panel.xaxis.set_minor_formatter("")
        if not shared:
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False)
    if shared:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=200)
    plt.close(figure)


def module_of(name: str) -> ModuleType:
    """The maker of a page, or a UsageError."""
    if name not in NAMES:
        raise UsageError(f"no page {name!r}; there are {', '.join(NAMES)}")
    return importlib.import_module(f"page.{name}")


def digests(name: str) -> dict[str, str]:
    """A digest of each input of a page; comments and blank lines do not count."""
    found = {}
    for glob in (f"scripts/page/{name}.py", *module_of(name).INPUTS):
        files = sorted(ROOT.glob(glob))
        if not files:
            raise UsageError(f"scripts/page/{name}.py: there is no input {glob}")
        for path in files:
            lines = [line for line in path.read_bytes().splitlines() if line.strip() and line.strip()[:1] != b"#"]
            found[str(path.relative_to(ROOT))] = hashlib.sha256(b"\n".join(lines)).hexdigest()[:12]
    return found


def complaints(name: str, docs: Path) -> list[str]:
    """What of a page is not as its inputs are now, a line each."""
    page = docs / f"{name}.md"
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    (said,) = re.findall(f"<!-- {MARK}: (.*) -->", text) or [""]
    then = dict(pair.split(" ") for pair in said.split("; ") if pair)
    now = digests(name)
    again = f"scripts/pages {name} makes it anew"
    if not then:
        return [f"docs/{page.name}: does not say what it was made from; {again}"]
    other = sorted(path for path in then.keys() | now.keys() if then.get(path) != now.get(path))
    return [f"docs/{page.name}: {path} is not what it was made from; {again}" for path in other]


def end(name: str, place: Place) -> str:
    """The end of a page: how, when, with what and on what it was made."""
    about = measure.describe_machine()
    maps = Path("/proc/self/maps")
    hypre = re.search(r"libHYPRE\D*([\d.]+\d)", maps.read_text()) if maps.exists() else None
    versions = re.sub("hypre yes", f"hypre {hypre[1]}" if hypre else "hypre", about["versions"])
    lines = [
        "",
        "---",
        "",
        f"Made by `scripts/pages {name}` {_commit(digests(name))}, {time.strftime('%Y-%m-%d')}; {about['processor']}; "
        f"threads per rank: {about['threads per rank']}; {versions}.",
    ]
    for words, calls in (("It ran", place.commands), (f"Scenes are of {_porepy(place)}:", place.exported)):
        lines += ["", f"{words} {', '.join(f'`{call}`' for call in calls)}."] if calls else []
    inputs = "; ".join(f"{path} {digest}" for path, digest in digests(name).items())
    return "\n".join([*lines, "", f"<!-- {MARK}: {inputs} -->"]) + "\n"


def _porepy(place: Place) -> str:
    """Of what PorePy the scenes are."""
    found = set()
    for path in place.exported.values():
        with hdf5.open_file(path) as file:
            found |= {f"PorePy {file['producers'].attrs['porepy']}"}
    return ", ".join(sorted(found))


def _commit(inputs: Iterable[str]) -> str:
    """The commit that is checked out, and whether code, options or inputs differ from it."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "petsc_fs", "options", *inputs)
    commit = git("rev-parse", "--short", "HEAD")
    return f"at commit {commit}{', with changes' * bool(changed)}" if commit else "outside of git"
