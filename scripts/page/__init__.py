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
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

from petsc_fs.errors import PetscFsError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.bundled import find_scene
from petsc_fs.tools import measure

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
    rounds: int = 5
    commands: list[str] = field(default_factory=list)
    exported: dict[str, Path] = field(default_factory=dict)

    def say(self, line: str) -> None:
        """Tell who waits what is going on."""
        measure.say(line)

    def run(self, *words: str, fine: tuple[int, ...] = (0,)) -> str:
        """What a call of petsc-fs or python prints, run in `scratch`; the call goes into the page.

        Raises:
            PetscFsError: the exit code is none of those that are fine.
        """
        folders = "|".join(f"{re.escape(str(folder))}/" for folder in (self.scratch, self.scenes, ROOT))
        call = re.sub(folders, "", " ".join(words))
        self.say(call)
        self.commands.append(call)
        programs = {"petsc-fs": [sys.executable, "-m", "petsc_fs"], "python": [sys.executable]}
        command = [*programs[words[0]], *words[1:]]
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
        f"Made by `scripts/pages {name}` {_commit()}, {time.strftime('%Y-%m-%d')}; {about['processor']}; "
        f"threads per rank: {about['threads per rank']}; {versions}.",
    ]
    for words, calls in (("It ran", place.commands), ("Scenes are of", place.exported)):
        lines += ["", f"{words} {', '.join(f'`{call}`' for call in calls)}{_porepy(place)}."] if calls else []
    inputs = "; ".join(f"{path} {digest}" for path, digest in digests(name).items())
    return "\n".join([*lines, "", f"<!-- {MARK}: {inputs} -->"]) + "\n"


def _porepy(place: Place) -> str:
    """Of what PorePy the scenes are."""
    found = set()
    for path in place.exported.values():
        with hdf5.open_file(path) as file:
            found |= {f"PorePy {file['producers'].attrs['porepy']}"}
    return f" ({', '.join(sorted(found))})" * bool(found)


def _commit() -> str:
    """The commit that is checked out, and whether code or options differ from it."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "petsc_fs", "options", "scripts", "tests")
    commit = git("rev-parse", "--short", "HEAD")
    return f"at commit {commit}{', with changes' * bool(changed)}" if commit else "outside of git"
