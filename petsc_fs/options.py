"""Options files and the options database: files found, checked and described; unused options named."""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import fnmatch
import itertools
import os
import re
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from petsc_fs.errors import UsageError
from petsc_fs.fields import FIELD_NAMES, in_order

if TYPE_CHECKING:
    from petsc_fs.tree import LeftOut

Number = TypeVar("Number", int, float)

OWN = (
    "petsc_fs_mat_type",
    "petsc_fs_restarts",
    "petsc_fs_true_rtol",
    "petsc_fs_error_factor",
    "petsc_fs_scaling",
    "petsc_fs_fallback",
    "petsc_fs_regularize",
    "petsc_fs_stagnation_window",
    "petsc_fs_stagnation_ratio",
    "petsc_fs_reuse",
    "petsc_fs_reuse_changed",
    "petsc_fs_reuse_growth",
    "petsc_fs_reuse_age",
)
"""Options of `petsc_fs.solver.Solver`."""

SPLIT = r"(?<!pc_)fieldsplit_(?:intf_force|intf_flow|[A-Za-z]+|\d+)_"
"""The prefix of one split in an option name, but not PCFIELDSPLIT's own `pc_fieldsplit_0_fields`."""

AT_THE_END = ("options_left", "options_view", "get_total_flops", "objects_view", "mpidump")
"""Options that PETSc asks for only in PetscFinalize."""

ALLOW_UNUSED = "petsc_fs_allow_unused"
"""Option with patterns, such as `my_*`, of options that may do nothing, separated by commas."""


def shipped_folder() -> Path:
    """Folder of the options files that come with this package."""
    beside = Path(__file__).resolve().parent.parent / "options"
    return beside if beside.is_dir() else Path(sysconfig.get_path("data")) / "share" / "petsc_fs"


def find_options_file(name: str) -> Path:
    """Path of an options file: as given, or else one that is shipped under this name.

    Raises:
        UsageError: there is none, or it cannot be read.
    """
    path = Path(name)
    if not path.exists() and (shipped_folder() / path.name).exists() and path.parent in (Path(), Path("options")):
        path = shipped_folder() / path.name
    if not path.is_file():
        names = ", ".join(sorted(p.name for p in shipped_folder().glob("*.opts")))
        raise UsageError(f"options file {name}: no such file; shipped are {names}")
    if not os.access(path, os.R_OK):
        raise UsageError(f"options file {name}: no permission to read it")
    return path


_numbers = itertools.count()


@dataclass(frozen=True)
class OptionsFile:
    """What the header of a shipped options file says.

    Attributes:
        path: of the file.
        purpose: first line.
        fields: fields that a scene must have, no more and no fewer; empty if any will do.
        default: whether `solve` takes it when none is named.
        not_for: bundled scenes it is known to fail on.
    """

    path: Path
    purpose: str
    fields: tuple[str, ...]
    default: bool
    not_for: tuple[str, ...]

    def fits(self, fields: Iterable[str]) -> bool:
        """Whether a scene with these fields can be solved by the file."""
        return not self.fields or self.fields == in_order(fields)


def read_header(path: Path) -> OptionsFile:
    """Header of an options file: comment lines `# fields:`, `# default: yes` and `# not_for:`."""
    comments = [line[1:].strip() for line in _text(path).splitlines() if line.startswith("#")]
    entries = {m[1]: m[2] for m in (re.match(r"(\w+): *(.*)", c) for c in comments) if m}
    fields = in_order(f for f in re.findall(r"\w+", entries.get("fields", "")) if f in FIELD_NAMES)
    return OptionsFile(
        path,
        purpose=comments[0] if comments else "",
        fields=fields,
        default=entries.get("default") == "yes",
        not_for=tuple(re.findall(r"\w+", entries.get("not_for", ""))),
    )


def shipped() -> list[OptionsFile]:
    """All shipped options files, by name."""
    return [read_header(path) for path in sorted(shipped_folder().glob("*.opts"))]


def default_for(fields: Iterable[str]) -> Path:
    """The shipped options file for scenes with these fields.

    Raises:
        UsageError: there is none.
    """
    names = in_order(fields)
    for file in shipped():
        if file.default and file.fits(names):
            return file.path
    raise UsageError(f"no default solver for the fields {', '.join(names)}: name one with -options_file")


def parse(path: Path) -> dict[str, str | None]:
    """Options of a file by full name, without the dash; None where an option has no value.

    Raises:
        UsageError: PETSc would stop at a line (it is no option, or prefixes do not pair up).
    """
    found: dict[str, str | None] = {}
    prefixes = [""]
    for number, raw in enumerate(_text(path).splitlines(), start=1):
        name, *values = raw.split("#")[0].split() or [""]
        if not name:
            continue
        if not re.match(r"-[A-Za-z_]", name):
            raise UsageError(f"{path}:{number}: {name!r} is not an option; options start with '-'")
        if name == "-prefix_push":
            if not values:
                raise UsageError(f"{path}:{number}: -prefix_push without a prefix")
            prefixes.append(prefixes[-1] + values[0])
        elif name == "-prefix_pop":
            prefixes.pop()
            if not prefixes:
                raise UsageError(f"{path}:{number}: -prefix_pop without a -prefix_push before it")
        else:
            found[prefixes[-1] + name[1:]] = " ".join(values) or None
    if len(prefixes) > 1:
        raise UsageError(f"{path}: {len(prefixes) - 1} -prefix_push without a -prefix_pop")
    return found


def insert(path: Path, prefix: str = "") -> None:
    """Put the options of a file into PETSc's database, except those that are set there already. Local.

    Args:
        path: of the options file.
        prefix: put before each name.

    Raises:
        UsageError: see `parse`.
    """
    insert_all(parse(path), prefix)


def insert_all(values: Mapping[str, str | None], prefix: str = "") -> tuple[str, ...]:
    """Put options into PETSc's database, except those that are set there already; the names that are new. Local."""
    from petsc4py import PETSc

    database = PETSc.Options()
    there = database.getAll()  # asking by hasName would count as use
    new = tuple(prefix + name for name in values if prefix + name not in there)
    for name, value in values.items():
        if prefix + name not in there:
            database.setValue(prefix + name, value)
    return new


def delete_all(names: Iterable[str]) -> None:
    """Take options out of PETSc's database. Local."""
    from petsc4py import PETSc

    for name in names:
        PETSc.Options().delValue(name)


@contextlib.contextmanager
def inserted(values: Path | Mapping[str, str | None], prefix: str = "") -> Iterator[None]:
    """Have options in PETSc's database within a block; what is set there already stays. Local.

    Args:
        values: options file, or options by name.
        prefix: put before each name.

    Raises:
        UsageError: see `parse`.
    """
    new = insert_all(parse(values) if isinstance(values, Path) else values, prefix)
    try:
        yield
    finally:
        delete_all(new)


@contextlib.contextmanager
def replaced(values: Mapping[str, str | None]) -> Iterator[None]:
    """Have options in PETSc's database within a block, in place of those that are set there. Local.

    What was there before comes back, with its mark of having been asked for.
    """
    from petsc4py import PETSc

    database = PETSc.Options()
    before = database.getAll()
    for name, value in values.items():
        database.setValue(name, value)
    try:
        yield
    finally:
        for name in values:
            if name in before:
                database.setValue(name, before[name])
            else:
                database.delValue(name)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"options file {path}: not readable as text: {e}") from e


def number(name: str, default: Number, prefix: str = "") -> Number:
    """An option of this package as a number, a whole one where the default is. Local.

    Raises:
        UsageError: it is no such number.
    """
    from petsc4py import PETSc

    given = PETSc.Options(prefix)
    whole = isinstance(default, int)
    try:
        found: Number = given.getInt(name, default) if whole else given.getReal(name, default)
        return found
    except PETSc.Error:
        expected = "a whole number" if whole else "a number"
        raise UsageError(f"-{prefix}{name} {given.getString(name, '')}: expected {expected}") from None


def unused() -> list[str]:
    """Options in PETSc's database that nothing has asked for, without the dash. Local."""
    from petsc4py import PETSc

    library = ctypes.CDLL(PETSc.__file__)
    count = ctypes.c_int64(0)  # wide enough for either PetscInt
    names, values = ctypes.POINTER(ctypes.c_char_p)(), ctypes.POINTER(ctypes.c_char_p)()
    arguments = (None, ctypes.byref(count), ctypes.byref(names), ctypes.byref(values))
    if library.PetscOptionsLeftGet(*arguments):
        raise RuntimeError("PetscOptionsLeftGet failed")
    found = [names[i].decode() for i in range(count.value)]
    library.PetscOptionsLeftRestore(*arguments)
    return sorted(found)


def known_names() -> set[str]:
    """Names of all options of the KSPs and PCs that the database chooses a type for. Local.

    They are as PETSc's own help lists them, which is caught on its way to standard output. Each KSP is
    made for this purpose, under a short prefix: PETSc explains the options of a prefix only once, even
    where nobody listened, and PETSc 3.18 overruns a buffer where a prefix has more than 64 characters.
    """
    from petsc4py import PETSc

    idle = set(unused())
    chosen = {name: value for name, value in PETSc.Options().getAll().items() if name not in idle}
    types = {name: value for name, value in chosen.items() if name.endswith("_type") and value != "python"}
    found = set(chosen)
    for prefix in {m[1] for name in chosen if (m := re.fullmatch("(|.*_)(ksp|pc)_type", name))}:
        below = {name.removeprefix(prefix): value for name, value in types.items() if name.startswith(prefix)}
        found.update(prefix + name for name in _explain(below))
    return found


def _explain(types: Mapping[str, str]) -> set[str]:
    """Options of a KSP and its PC of the given types, by PETSc's help."""
    from petsc4py import PETSc

    prefix = f"h{next(_numbers)}_"
    database = PETSc.Options()
    sys.stdout.flush()
    saved = os.dup(1)
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOptionsPrefix(prefix)
    for name, value in types.items():
        database.setValue(prefix + name, value)
    # petsc4py prints by Python where that has another standard output than C
    with tempfile.TemporaryFile("w+", errors="replace") as capture, contextlib.redirect_stdout(capture):
        os.dup2(capture.fileno(), 1)
        database.setValue("help", None)
        try:
            ksp.setFromOptions()
        except PETSc.Error:
            pass  # an impossible type: what is understood until there will do
        finally:
            database.delValue("help")
            for name in types:
                database.delValue(prefix + name)
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
            os.dup2(saved, 1)
            os.close(saved)
            ksp.destroy()
        capture.flush()
        capture.seek(0)
        text = capture.read()
    return set(re.findall(rf"^\s*-{prefix}([A-Za-z_]\w*)", text, flags=re.MULTILINE))


def closest(name: str, valid: Iterable[str]) -> list[str]:
    """Up to three valid names that look most like a misspelt one, or that say the same of another split."""
    others = sorted(set(valid) - {name})
    tail = re.split(SPLIT, name)[-1]
    return difflib.get_close_matches(name, others, n=3, cutoff=0.8) or [v for v in others if v.endswith(tail)][:3]


def refused(names: Iterable[str]) -> list[str]:
    """Those of some unused options that -petsc_fs_allow_unused does not let pass. Local."""
    from petsc4py import PETSc

    patterns = PETSc.Options().getString(ALLOW_UNUSED, "").split(",")
    passed = (ALLOW_UNUSED, *AT_THE_END)
    return [n for n in names if n not in passed and not any(fnmatch.fnmatchcase(n, p) for p in patterns)]


def explain(
    useless: Sequence[str],
    typed: Iterable[str] = (),
    file: Path | None = None,
    left_out: Iterable[LeftOut] = (),
) -> str:
    """Say of each option that did nothing where it came from, why it did nothing, and what it might have meant.

    Args:
        useless: names without the dash.
        typed: names on the command line.
        file: the options file.
        left_out: levels of the canonical tree that the scene does not need.
    """
    in_file = parse(file) if file is not None else {}
    valid = (known_names() | set(OWN)) - set(useless)
    lines = []
    for name in useless:
        if name in typed:
            origin = "the command line"
        elif name in in_file and file is not None:
            origin = file.name
        elif re.search(rf"(^|\s)-{re.escape(name)}(\s|$)", os.environ.get("PETSC_OPTIONS", "")):
            origin = "PETSC_OPTIONS"
        else:
            origin = "a .petscrc file or the program"
        gone = next((part for part in left_out if name.startswith(part.prefixes)), None) if left_out else None
        reason = f": its level is not there ({gone})" if gone is not None and gone.prefixes else ""
        similar = closest(name, valid)
        hint = f"; did you mean {' or '.join('-' + s for s in similar)}?" if similar else ""
        lines.append(f"option -{name} from {origin} was not used{reason}{hint}")
    return lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} options were not used:", *lines])


class Choice:  # shim
    def __init__(self, values=None, left_out=()):
        self.values, self.left_out = values or {}, left_out


def choose(facts):  # shim
    from petsc_fs.tree import shipped_tree

    tree = shipped_tree(facts)
    return Choice(tree.options, tree.left_out)


class Facts:  # shim
    @staticmethod
    def of(scene, comm):
        from petsc_fs.tree import Facts as F

        return F.of(scene, comm)


def fitting_file(name, fields):  # shim
    return find_options_file(name)
