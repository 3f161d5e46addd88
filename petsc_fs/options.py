"""Options files and PETSc's options database: which file for which fields, files checked, unused options named."""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import fnmatch
import itertools
import math
import os
import re
import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from petsc_fs.errors import UsageError, together
from petsc_fs.fields import FIELD_NAMES, FLOW, FLUXES, MECHANICS, POTENTIALS, in_order

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.scene import Scene

Number = TypeVar("Number", int, float)
Options = dict[str, str | None]
"""Values by full name, without the dash; None where an option has no value."""

SPLIT = rf"(?<!pc_)fieldsplit_(?:{'|'.join(FIELD_NAMES)}|[A-Za-z]+|\d+)_"
"""The prefix of one split in an option name, but not PCFIELDSPLIT's own `pc_fieldsplit_0_fields`."""
AT_THE_END = ("options_left", "options_view", "get_total_flops", "objects_view", "mpidump", "citations", "skip_petscrc")
"""Options that PETSc asks for only in PetscFinalize, or before anybody can see it."""
ALLOW_UNUSED = "petsc_fs_allow_unused"
"""Option with patterns, such as `my_*`, of options that may do nothing, separated by commas."""
OWN = (
    *(f"petsc_fs_{name}" for name in ("partition", "ordering", "retry", "on_failure", "forcing")),
    *(ALLOW_UNUSED, "qr_side", "ksp_monitor", "ksp_monitor_true_residual", "ksp_view", "ksp_converged_reason"),
)
"""Options that somebody may mean at the outermost level although no shipped file has them."""
FIXED_STRESS = ("fs_type", "fs_damping", "fs_fractures", "fs_drop")
"""Options of a FixedStress."""
AT_ANY_LEVEL = (
    *(f"ksp_{name}" for name in ("type", "rtol", "atol", "max_it", "gmres_restart")),
    *(f"pc_{name}" for name in ("type", "fieldsplit_type", "hypre_type", "hypre_boomeramg_strong_threshold")),
    *FIXED_STRESS,
)
"""The same at any level."""
NUMBERS: dict[str, tuple[float, float, bool]] = {
    "ksp_rtol": (0.0, 1.0, False),
    "ksp_atol": (0.0, math.inf, False),
    "ksp_divtol": (0.0, math.inf, False),
    "ksp_max_it": (0, math.inf, True),
    "ksp_gmres_restart": (1, math.inf, True),
    "component_drop": (0.0, 1.0, False),
    "fs_drop": (0.0, 1.0, False),
    "fs_fractures": (0.0, math.inf, False),
}
"""Least value, value that is too large, and whether it is a whole number, of options that end in these names."""
NO_OPTION = "is not an option; options start with '-'"
TAKE_FILES = ("options_file", "petsc_fs_retry", "petsc_fs_retry_file")


# Files


def shipped_folder() -> Path:
    """Folder of the options files that come with this package."""
    home = Path(__file__).resolve().parent
    inside = home / "options_files"
    return inside if inside.is_dir() else home.parent / "options"  # in a checkout


def find_options_file(name: str) -> Path:
    """Path of an options file: as given, or else one that is shipped under this name.

    Raises:
        UsageError: there is none, or it cannot be read.
    """
    path = Path(name)
    here = path.parent in (Path(), Path("options"))
    if here and not os.path.exists(path) and os.path.exists(shipped_folder() / path.name):
        path = shipped_folder() / path.name
    if not os.path.isfile(path):
        names = ", ".join(sorted(p.name for p in shipped_folder().glob("*.opts")))
        raise UsageError(f"options file {name}: no such file; shipped are {names}")
    if not os.access(path, os.R_OK):
        raise UsageError(f"options file {name}: no permission to read it")
    return path


@dataclass(frozen=True)
class OptionsFile:
    """What the header of a shipped options file says."""

    path: Path
    purpose: str  # first line
    fields: tuple[str, ...]  # that a scene must have, no more and no fewer; empty if any will do
    default: bool  # whether `choose` takes it for these fields
    not_for: tuple[str, ...]  # bundled scenes it is known to fail on

    def fits(self, fields: Iterable[str]) -> bool:
        """Whether a scene with these fields can be solved by the file."""
        return not self.fields or self.fields == in_order(fields)


def read_header(path: Path) -> OptionsFile:
    """Header of an options file: comment lines `# fields:`, `# default: yes` and `# not_for:`."""
    comments = [line[1:].strip() for line in _text(path).split("\n") if line.startswith("#")]
    entries = {m[1]: m[2] for m in (re.match(r"(\w+): *(.*)", c) for c in comments) if m}
    names, not_for = (re.findall(r"\w+", entries.get(key, "")) for key in ("fields", "not_for"))
    purpose = comments[0] if comments else ""
    return OptionsFile(path, purpose, in_order(names), entries.get("default") == "yes", tuple(not_for))


def fitting_file(name: str, fields: Iterable[str]) -> Path:
    """An options file, see `find_options_file`, that is for scenes with these fields.

    Raises:
        UsageError: there is no such file, or it is for others.
    """
    header = read_header(find_options_file(name))
    if not header.fits(fields):
        raise UsageError(
            f"{header.path.name} is for scenes with the fields {', '.join(header.fields)}; "
            f"this one has {', '.join(in_order(fields))}"
        )
    return header.path


def shipped() -> list[OptionsFile]:
    """All shipped options files, by name."""
    return [read_header(path) for path in sorted(shipped_folder().glob("*.opts"))]


def is_option(word: str) -> bool:
    """Whether PETSc takes a word for an option, and not for a value such as -1e-3."""
    try:
        float(word)
    except ValueError:
        return re.match("--?[A-Za-z]", word) is not None
    return False


def parse(path: Path) -> Options:
    """Options of a file, and of those that it names by -options_file in their place.

    A file may come from any editor: with a byte order mark, with any line ends.

    Raises:
        UsageError: it cannot be read, or PETSc would stop at a line or understand something else.
    """
    return _parse(path.absolute(), ())


def _parse(path: Path, above: tuple[Path, ...]) -> Options:
    if path.resolve() in above:
        raise UsageError(f"options file {path} includes itself")
    lines = []
    for number, line in enumerate(_text(path).split("\n"), start=1):
        words = re.findall(r"""["'][^"']*["']|\S+""", line.split("#")[0], re.ASCII)
        if words and words[0].startswith("--"):
            raise UsageError(f"{path}:{number}: {words[0]!r} {NO_OPTION}")
        lines.append((f"{path}:{number}: ", [word.strip("\"'") for word in words]))
    return _collect(lines, f"{path}: ", (*above, path.resolve()))


def _collect(lines: Iterable[tuple[str, Sequence[str]]], name: str, above: tuple[Path, ...] = ()) -> Options:
    """Options in lines of words, each with where it stands."""
    found: Options = {}
    prefixes = [""]
    for where, line in lines:
        words, before = list(line), ""
        while words:
            word = words.pop(0)
            if not is_option(word):
                why = f"belongs to no option: -{before} has its value already" if before else NO_OPTION
                raise UsageError(f"{where}{word!r} {why}")
            value = words.pop(0) if words and not is_option(words[0]) else None
            option = before = word.lstrip("-")
            _refuse_unclear(option, value, where)
            if option == "prefix_push":
                prefixes.append(f"{prefixes[-1]}{value}")
            elif option == "prefix_pop":
                prefixes.pop()
                if not prefixes:
                    raise UsageError(f"{where}-prefix_pop without a -prefix_push before it")
            elif option == "options_file":
                try:
                    inner = _parse(find_options_file(f"{value}"), above)
                except UsageError as e:
                    raise UsageError(f"{where}{e}") from e
                found |= _put(prefixes[-1], inner)
            else:
                found[prefixes[-1] + option] = value
    if len(prefixes) > 1:
        raise UsageError(f"{name}{len(prefixes) - 1} -prefix_push without a -prefix_pop")
    return found


def _refuse_unclear(option: str, value: str | None, where: str) -> None:
    """Raise a UsageError if PETSc would take an option for something else than is meant."""
    if "=" in option:
        raise UsageError(f"{where}-{option}: a space, no '=', goes between an option and its value")
    strange = next((c for c in f"{option}{value}" if not c.isprintable()), None)
    if strange is not None and option != "options_file":
        raise UsageError(f"{where}-{option}: PETSc cannot take the character U+{ord(strange):04X}")
    needed = {"prefix_push": "a prefix", "options_file": "the name of the file"}.get(option)
    if needed and not value:
        raise UsageError(f"{where}-{option} without {needed}")


def _text(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"options file {path}: not readable as text: {e}") from e
    if "\0" in text:
        raise UsageError(f"options file {path}: not readable as text: it has a NUL character")
    return text


def check(values: Mapping[str, str | None]) -> None:
    """Look at the numbers that decide when a solver stops: PETSc takes nan, and where none is given its default.

    Raises:
        UsageError: one is missing or impossible.
    """
    for name, value in values.items():
        known = next((n for n in NUMBERS if re.search(f"(^|_){n}$", name)), None)
        if known is None or (value or "").upper().removeprefix("PETSC_") in ("DEFAULT", "DECIDE"):
            continue
        least, end, whole = NUMBERS[known]
        try:
            found = int(value or "") if whole else float(value or "")
        except ValueError:
            found = math.nan
        if not least <= found < end:
            kind = "a whole number" if whole else "a number"
            size = f"from {least:g} on" if end == math.inf else f"from {least:g} to below {end:g}"
            raise UsageError(f"-{name} {value or 'without a value'}: expected {kind} {size}")


# Which file for which fields

CANONICAL = "contact_poromechanics_fast.opts"
"""Options file with all levels."""
HOT = "contact_thermoporomechanics_fast.opts"
"""The same for scenes with heat or wells."""
WITHOUT_HYPRE = {CANONICAL: "contact_poromechanics_gamg.opts", HOT: "contact_thermoporomechanics_gamg.opts"}
"""The same for a PETSc that lacks hypre."""
ISOTHERMAL = {"contact", *MECHANICS, "intf_flow", "mass"}
REST = "qr_fieldsplit_1_"
STRESS = tuple(f"{REST}fieldsplit_1_{name}" for name in (*FIXED_STRESS, "pc_python_type"))
LEFT_OUT: dict[str, tuple[str, ...]] = {
    "no contact: Q_r and the first Schur level left out": (
        *("qr_side", "qr_mechanics_", "qr_fieldsplit_contact_"),
        f"{REST}fieldsplit_1_fs_fractures",
    ),
    "no mechanics: the second Schur level with fixed stress left out": (f"{REST}fieldsplit_mechanics_", *STRESS),
    "no flow: the second and third Schur levels left out": (f"{REST}fieldsplit_1_",),
    "mechanics and flow decoupled: fixed stress left out": STRESS,
    "mechanics and flow act one way only: fixed stress left out": STRESS,
    "no interface flow: the third Schur level left out": (
        f"{REST}fieldsplit_1_fs_fieldsplit_intf_flow_",
        f"{REST}fieldsplit_1_fs_joined_fieldsplit_fluxes_",
    ),
}
"""What a scene may make superfluous of the canonical solver, with the beginnings of its options there."""
NO_CONTACT, NO_MECHANICS, NO_FLOW, DECOUPLED, ONE_WAY, NO_INTERFACE_FLOW = LEFT_OUT


@dataclass(frozen=True)
class Facts:
    """What decides which levels a scene needs; the same on all ranks.

    Contact always has its transformation Q_r: fracture cells open and close, and where J_11 is invertible multigrid
    still needs it.
    """

    fields: tuple[str, ...]  # those with unknowns
    flow_moves_rock: bool  # pressure acts on the mechanics
    rock_moves_flow: bool  # displacements act on the flow

    @classmethod
    def of(cls, scene: Scene, comm: MPI.Intracomm) -> Facts:
        """Look at a scene, or at the rows of it that each rank has. Collective."""

        def acts(rows: tuple[str, ...], columns: tuple[str, ...]) -> bool:
            return any(scene.blocks[rc].data.any() for rc in scene.blocks if rc[0] in rows and rc[1] in columns)

        found = comm.allgather((acts(MECHANICS, FLOW), acts(FLOW, MECHANICS)))
        return cls(tuple(f for f in scene.fields if scene.sizes[f]), *map(any, zip(*found, strict=True)))

    def or_either(self, other: Facts) -> Facts:
        """What is true here or there, so that a level that was needed once is kept."""
        rock = self.flow_moves_rock or other.flow_moves_rock
        return Facts(self.fields, rock, self.rock_moves_flow or other.rock_moves_flow)

    def left_out(self) -> Iterator[str]:
        """What of the canonical solver such a scene does not need, from the outermost level inwards."""
        mechanics, flow = (any(f in self.fields for f in part) for part in (MECHANICS, FLOW))
        if "contact" not in self.fields:
            yield NO_CONTACT
        if not mechanics:
            yield NO_MECHANICS
        if not flow:
            yield NO_FLOW
        elif mechanics and not (self.flow_moves_rock and self.rock_moves_flow):
            yield ONE_WAY if self.flow_moves_rock or self.rock_moves_flow else DECOUPLED
        if flow and not any(f in self.fields for f in FLUXES):
            yield NO_INTERFACE_FLOW
        if others := ", ".join(f for f in self.fields if f not in FIELD_NAMES):
            yield f"no file has a place for {others}: solved after all others, by ILU"


@dataclass(frozen=True)
class Choice:
    """The options of the smallest solver for a scene."""

    values: Options = field(default_factory=dict)  # by full name, in the order of elimination
    file: Path | None = None  # shipped file that they are those of; None if they are cut from the canonical one
    left_out: tuple[str, ...] = ()  # what of the canonical solver is not there, a line each

    def text(self, title: str) -> str:
        """An options file, with a comment for each part left out."""
        lines = [f"-{name}" if value is None else f"-{name} {value}" for name, value in self.values.items()]
        body = "\n".join(lines) + "\n" if self.file is None else _text(self.file)
        return "".join(f"# {line}\n" for line in (title, *self.left_out)) + "#\n" + body


def choose(facts: Facts) -> Choice:
    """The shipped file for a usual set of fields; for others, what is left of the canonical one. Local.

    Raises:
        UsageError: the scene has no unknowns.
    """
    from petsc4py import PETSc

    if not facts.fields:
        raise UsageError("the scene has no unknowns, there is nothing to solve")
    name = CANONICAL if set(facts.fields) <= ISOTHERMAL else HOT
    canonical = shipped_folder() / name
    files = [file.path for file in shipped() if file.default and file.fields == facts.fields]
    if not PETSc.Sys.hasExternalPackage("hypre"):
        canonical = shipped_folder() / WITHOUT_HYPRE[name]
        files = [canonical] if read_header(canonical).fields == facts.fields else []
    left_out = tuple(facts.left_out())
    if files and not {DECOUPLED, ONE_WAY} & set(left_out):
        return Choice(parse(files[0]), files[0], left_out)
    return Choice(cut(parse(canonical), facts), None, left_out)


def cut(canonical: Mapping[str, str | None], facts: Facts) -> Options:
    """What is left of the options of the file with all levels where some have nothing to do: those inside move up."""
    level_1 = _under(canonical, "qr_")
    level_2 = _under(level_1, "fieldsplit_1_")
    stress = _under(level_2, "fieldsplit_1_")
    mechanics, flow = (tuple(f for f in part if f in facts.fields) for part in (MECHANICS, FLOW))
    outer = {name: value for name, value in canonical.items() if name.startswith("ksp_")}
    transform = {"contact", "intf_force"} <= set(facts.fields)

    inner = {name: value for name, value in _under(stress, "fs_").items() if f"fs_{name}" not in FIXED_STRESS}
    node = _flow(inner, flow) if flow else {}
    if mechanics and "mass" in flow and facts.flow_moves_rock and facts.rock_moves_flow:
        own = {k: v for k, v in stress.items() if not k.startswith("fs_") or k in FIXED_STRESS}
        if "contact" not in facts.fields:
            own.pop("fs_fractures", None)
        node = own | _put("fs_", node)
    members = list(flow)
    if mechanics:
        leaf = _under(level_2, "fieldsplit_mechanics_")
        names = ["mechanics"] if transform else list(mechanics)
        if len(names) > 1 and leaf.get("pc_type") != "python":
            leaf = _wrapped("Assembled", leaf)
        exact = not (facts.flow_moves_rock or facts.rock_moves_flow)
        node = _split(level_2, names, leaf, node, members, additive=exact) if members else leaf
        members = [*names, *members]
    if "contact" in facts.fields:
        leaf = _under(level_1, "fieldsplit_contact_")
        node = _split(level_1, ["contact"], leaf, node, members) if members else leaf
    node.pop("ksp_type", None)
    if transform:
        node = {k: v for k, v in canonical.items() if k.startswith(("pc_", "qr_side", "qr_mech"))} | _put("qr_", node)
    known, others = ([f for f in facts.fields if (f in FIELD_NAMES) == there] for there in (True, False))
    if others:
        ilu: Options = {"pc_type": "asm", "pc_asm_overlap": "1", "sub_ksp_type": "preonly", "sub_pc_type": "ilu"}
        leaf = ilu if len(others) == 1 else _wrapped("Assembled", ilu)
        level: Options = {"pc_type": "fieldsplit", "pc_fieldsplit_type": "multiplicative"}
        node = _split(level, known, node, leaf, others) if known else leaf
    return outer | node


def _flow(inner: Options, flow: tuple[str, ...]) -> Options:
    """Fluxes between subdomains, and pressure and temperature: those that there are, several of a kind as one."""
    joined = _under(inner, "joined_") or inner
    fluxes, potentials = ([f for f in part if f in flow] for part in (FLUXES, POTENTIALS))
    first = _under(joined, "fieldsplit_fluxes_") or _under(joined, "fieldsplit_intf_flow_")
    last = _under(joined, "fieldsplit_potentials_") or _under(joined, "fieldsplit_mass_")
    if len(potentials) == 1:
        last = _under(last, f"fieldsplit_{potentials[0]}_") or last
    names = [part[:1] if len(part) == 1 else [name] for part, name in ((fluxes, "fluxes"), (potentials, "potentials"))]
    node = first if fluxes else last
    if fluxes and potentials:
        node = _split(joined, names[0], first, last, names[1])
    node = {name: value for name, value in node.items() if name != "ksp_type"}
    return _wrapped("Joined", node) if max(len(fluxes), len(potentials)) > 1 else node


def _wrapped(name: str, node: Options) -> Options:
    """A node inside a Python PC of this package."""
    return {"pc_type": "python", "pc_python_type": f"petsc_fs.pc.{name}", **_put(f"{name.lower()}_", node)}


def _split(
    level: Options, first: list[str], leaf: Options, rest: Options, members: list[str], *, additive: bool = False
) -> Options:
    """A level that takes the first fields apart from the others, block-diagonal where that is exact."""
    own = {name: value for name, value in level.items() if name.startswith("pc_")}
    if additive:
        own = {name: value for name, value in own.items() if not name.startswith("pc_fieldsplit_schur")}
        own["pc_fieldsplit_type"] = "additive"
    parts = (first, members)
    numbers = [str(i) for i in range(len(first) + len(members))]
    for k, chosen in enumerate((numbers[: len(first)], numbers[len(first) :])):
        own[f"pc_fieldsplit_{k}_fields"] = ",".join(chosen)
    names = [part[0] if len(part) == 1 else str(k) for k, part in enumerate(parts)]
    for split, node in zip(names, (leaf, rest), strict=True):
        own |= _put(f"fieldsplit_{split}_", {"ksp_type": "preonly", **node})
    return own


def _under(options: Mapping[str, str | None], prefix: str) -> Options:
    """Options with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in options.items() if name.startswith(prefix)}


def _put(prefix: str, options: Options) -> Options:
    return {prefix + name: value for name, value in options.items()}


# PETSc's database


def insert(path: Path, prefix: str = "") -> tuple[str, ...]:
    """Put the options of a file into PETSc's database, see `parse` and `insert_all`. Local."""
    return insert_all(parse(path), prefix)


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


def database() -> Options:
    """The options in PETSc's database, but those that this package put there for its own sake. Local."""
    from petsc4py import PETSc

    found: Options = {**PETSc.Options().getAll()}
    return {k: v for k, v in found.items() if k not in ("options_left", "skip_petscrc")}


def delete_all(names: Iterable[str]) -> None:
    """Take options out of PETSc's database. Local."""
    from petsc4py import PETSc

    for name in names:
        PETSc.Options().delValue(name)


@contextlib.contextmanager
def inserted(values: Path | Mapping[str, str | None], prefix: str = "") -> Iterator[None]:
    """Have options in PETSc's database within a block; what is set there already stays. Local.

    Raises:
        UsageError: it is a file, see `parse`.
    """
    new = insert_all(parse(values) if isinstance(values, Path) else values, prefix)
    try:
        yield
    finally:
        delete_all(new)


def number(name: str, default: Number, prefix: str = "") -> Number:
    """An option of this package as a number, a whole one where the default is, or a UsageError. Local."""
    from petsc4py import PETSc

    given = PETSc.Options(prefix)
    read, expected = (given.getInt, "a whole number") if isinstance(default, int) else (given.getReal, "a number")
    try:
        found: Number = read(name, default)
        return found
    except PETSc.Error:
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


def refused(names: Iterable[str]) -> list[str]:
    """Those of some unused options that -petsc_fs_allow_unused does not let pass. Local."""
    from petsc4py import PETSc

    patterns = PETSc.Options().getString(ALLOW_UNUSED, "").split(",")
    passed = (ALLOW_UNUSED, *AT_THE_END)
    return [n for n in names if n not in passed and not any(fnmatch.fnmatchcase(n, p) for p in patterns)]


def closest(name: str, valid: Iterable[str]) -> list[str]:
    """Up to three valid names that look most like a misspelt one, or that say the same of another split."""
    others = sorted(set(valid) - {name})
    tail = re.split(SPLIT, name)[-1]
    return difflib.get_close_matches(name, others, n=3, cutoff=0.8) or [v for v in others if v.endswith(tail)][:3]


@cache
def shipped_names() -> frozenset[str]:
    """Names of the options in all shipped files."""
    return frozenset(name for file in shipped() for name in parse(file.path))


def explain(
    useless: Sequence[str], typed: Iterable[str] = (), file: Path | None = None, left_out: Iterable[str] = ()
) -> str:
    """Say of each option that did nothing where it came from, why it did nothing, and what it might have meant. Local.

    It might have meant what is in a shipped file, at a level of the solver in PETSc's database if there is one there.

    Args:
        useless: names without the dash.
        typed: names on the command line.
        file: the options file.
        left_out: see `Choice`.
    """
    from petsc4py import PETSc

    in_file = parse(file) if file is not None else {}
    used = {*PETSc.Options().getAll(), *OWN} - set(useless)
    levels = [{n.removesuffix("pc_type") for n in names if n.endswith("pc_type")} for names in (used, shipped_names())]
    tails = {n.removeprefix(_level(n, levels[1])) for n in shipped_names()} | set(AT_ANY_LEVEL)
    lines = []
    for name in useless:
        origin = "the command line" if name in typed else file.name if file and name in in_file else "PETSC_OPTIONS"
        reason = next((line for line in left_out if name.startswith(LEFT_OUT.get(line, ()))), "")
        there = levels[0] or levels[1]
        valid = used | {_level(name, there) + tail for tail in tails} | {level + "pc_type" for level in there}
        similar = closest(name, valid - set(useless)) if not reason else []
        why = f": its level is not there ({reason})" if reason else ""
        hint = f"; did you mean {' or '.join('-' + s for s in similar)}?" if similar else ""
        lines.append(f"option -{name} from {origin} was not used{why}{hint}")
    return lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} options were not used:", *lines])


def _level(name: str, levels: Iterable[str]) -> str:
    """The longest of some prefixes that a name starts with."""
    return max((level for level in levels if name.startswith(level)), key=len, default="")


@dataclass(frozen=True)
class Given:
    """PETSc options of a call, which must not go unused.

    Options:
        -petsc_fs_allow_unused <none> (patterns, separated by commas): options that may do nothing, such as my_*.
    """

    typed: frozenset[str]  # names on the command line
    values: Options  # all of them, those of options files included, in the order in which they count
    files: tuple[Path, ...]  # the options files

    @classmethod
    def of(cls, words: Sequence[str]) -> Given:
        """Options in words of the command line. Local.

        Raises:
            UsageError: PETSc would stumble over one, or over a line of a file.
        """
        values = _collect([("", words)], "the command line: ")
        check(values)
        files = [find_options_file(b) for a, b in itertools.pairwise(words) if a.lstrip("-") == "options_file"]
        return cls(frozenset(word.lstrip("-") for word in words if is_option(word)), values, tuple(files))

    def start(self, *, files: bool = True, petscrc: bool = False) -> None:
        """Initialise PETSc with these options, if it is not yet; else put them into its database. Collective.

        Args:
            files: with those of options files.
            petscrc: read .petscrc of the working directory and of the home; they may load code.
        """
        import petsc4py

        before = signal.getsignal(signal.SIGPIPE)
        values = {name: value for name, value in self.values.items() if files or name in self.typed}
        words = [word for name, value in values.items() for word in (f"-{name}", value) if word is not None]
        petsc4py.init(["petsc-fs", *([] if petscrc else ["-skip_petscrc"]), *words])
        signal.signal(signal.SIGPIPE, before)  # PETSc would end the program where its output is no longer read
        insert_all(values | {"options_left": "no"})  # newer PETSc would repeat at its end what `judge` says
        from petsc4py import PETSc

        from petsc_fs.petsc_errors import check_build

        check_build()
        check(PETSc.Options().getAll())

    def judge(self, comm: MPI.Intracomm, left_out: Iterable[str] = ()) -> str:
        """Complain about options that nothing on any rank has asked for, after a solve. Collective.

        Returns a warning about those of PETSC_OPTIONS, which may be meant for other programs; "" if there are none.

        Raises:
            UsageError: there are others, on all ranks.
        """
        idle = set.intersection(*map(set, comm.allgather(unused())))
        foreign = ""
        with together(comm):
            if comm.rank == 0:
                names = refused(sorted(idle))
                elsewhere = {w.lstrip("-") for w in os.environ.get("PETSC_OPTIONS", "").split() if is_option(w)}
                file = self.files[0] if self.files else None
                if found := [name for name in names if name in self.values]:
                    raise UsageError(explain(found, self.typed, file, left_out))
                if found := [name for name in names if name in elsewhere]:
                    foreign = explain(found, (), None, left_out)
        return foreign
