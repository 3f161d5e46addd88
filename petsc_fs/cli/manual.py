"""The options of this package, out of the docstrings that have a section "Options ...:".

An entry there is `-NAME <DEFAULT> (VALUES): MEANING`, as in PETSc's own -help; default and values may be missing, and
further lines are indented more than the first.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SECTION = re.compile(r"^Options[^\n]*:\n((?: [^\n]*\n?|\n(?= ))+)", re.MULTILINE)
ENTRY = re.compile(r"-(?P<name>[\w*]+)(?: <(?P<default>[^>]*)>)?(?: \((?P<values>[^)]*)\))?: (?P<meaning>.*)")
PC = "petsc_fs.pc."
WIDTH = 80


@dataclass(frozen=True)
class Option:
    """An option of this package.

    Attributes:
        owner: full name of what takes it.
        name: without the dash; of a PC without the prefix of its level.
        default: as text; "" where there is none.
        values: that it takes, in words; "" where the meaning says that.
        meaning: the rest of the entry.
    """

    owner: str
    name: str
    default: str
    values: str
    meaning: str


def own_options() -> list[Option]:
    """All options of this package, by the place in its files.

    Raises:
        ValueError: an entry has another form.
    """
    found = []
    root = Path(__file__).resolve().parents[1]
    for path in sorted(root.rglob("*.py")):
        module = ".".join(path.relative_to(root.parent).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                name = f"{PC}{node.name}" if module.startswith(PC) else f"{module}.{node.name}"
                found += [_option(name, entry) for entry in entries(ast.get_docstring(node) or "")]
    return found


def entries(docstring: str) -> Iterator[str]:
    """The entries of a docstring's options, each on one line."""
    for section in SECTION.findall(docstring):
        lines = inspect.cleandoc("\n" + section)
        yield from (" ".join(entry.split()) for entry in re.split(r"\n(?=\S)", lines))


def _option(owner: str, entry: str) -> Option:
    parts = ENTRY.fullmatch(entry)
    if parts is None:
        raise ValueError(f"{owner}: {entry!r} is not of the form -NAME <DEFAULT> (VALUES): MEANING")
    return Option(owner, **{name: text or "" for name, text in parts.groupdict().items()})


def text() -> str:
    """All of them for a terminal, in the style of PETSc's -help."""
    lines = ["Options of petsc_fs; those of a PC go behind the prefix of its level:"]
    owner = ""
    for option in own_options():
        if option.owner != owner:
            owner = option.owner
            lines.append(f" {owner}")
        default = f" <{option.default}>" if option.default else ""
        values = f" ({option.values})" if option.values else ""
        entry = f"-{option.name}{default}{values}: {option.meaning.replace('`', '')}"
        lines.append(textwrap.fill(entry, WIDTH, initial_indent="  ", subsequent_indent="      "))
    return "\n".join(lines)


def page() -> str:
    """All of them as a page of the documentation."""
    lines = [
        "# Options of this package",
        "",
        "Made by `python -m petsc_fs.cli.manual >docs/options.md` from the docstrings of what takes them;",
        "`petsc-fs solve --help` prints the same. Options of the PCs go behind the prefix of their level, as in",
        "`-qr_fieldsplit_1_fieldsplit_1_fs_damping`. All others are PETSc's.",
    ]
    owner = ""
    for option in own_options():
        if option.owner != owner:
            owner = option.owner
            lines += ["", f"## {owner}", "", "| option | default | values | meaning |", "|---|---|---|---|"]
        default = f"`{option.default}`" if re.fullmatch(r"\S+", option.default) else option.default
        meaning = option.meaning.replace("|", "\\|").replace("**", "\\*\\*")
        lines.append(f"| `-{option.name}` | {default} | {option.values} | {meaning} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    print(page(), end="")
