"""Spaces of PETSc options to search: a base options file, and what may change in it.

A space is a YAML file:

```yaml
description: what the space is about, one line
base: flow.opts              # options file, beside this file or shipped
groups:
  mass:                      # any name; parameters are called mass.NAME
    prefix: fieldsplit_mass_ # written once, put before the name of each option
    parameters:
      pc_type:
        choices:             # by name, with the options that each sets; ~ takes an option out of the base file
          hypre: {}
          gamg: {pc_type: gamg, pc_hypre_type: ~}
      pc_hypre_boomeramg_coarsen_type: {choices: [~, PMIS, HMIS], when: {pc_type: hypre}}
      pc_hypre_boomeramg_P_max: {integer: [0, 8], step: 2, when: {pc_type: hypre}}
      pc_hypre_boomeramg_strong_threshold: {float: [0.1, 0.9], start: 0.25, when: {pc_type: hypre}}
      pc_gamg_threshold: {log: [1e-3, 1e-1], points: 4, when: {pc_type: gamg}}
```

A parameter is named after its option, or has `option: NAME`. `choices` are values of the option, or a mapping as
above. `integer` and `float` take `step`; `float` and `log` (a float searched by its logarithm) take `points`, the
number of values in a grid search (default 3). A parameter with `when` exists only where the parameters named there,
declared before it, have the value given, or one of the list given; `GROUP.NAME` names one of another group. `start`
is the value in the first trial, which should be the base file; the default is the value that the base file has.
"""

from __future__ import annotations

import difflib
import itertools
import math
import os
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs import options
from petsc_fs.errors import UsageError

Value = str | int | float
Changes = dict[str, str | None]
"""Options by full name without the dash, None for those that are taken out of the base file."""

ABSENT = "(absent)"
"""Label of the choice not to have an option."""

EXTRAS = {
    "choices": ("option", "start", "when"),
    "integer": ("option", "start", "when", "step"),
    "float": ("option", "start", "when", "step", "points"),
    "log": ("option", "start", "when", "points"),
}
"""Kinds of parameters, with what else an entry may have."""
GRID_POINTS = 3


@dataclass(frozen=True)
class Parameter:
    """One thing that may change."""

    name: str  # GROUP.NAME
    option: str  # that it sets, by full name without the dash
    kind: str  # of EXTRAS
    choices: Mapping[str, Changes]  # of a categorical one, by label: the options that each sets
    bounds: tuple[float, float]  # of a numeric one, both included
    step: float | None  # between values of a numeric one
    points: int  # values of a float one in a grid
    start: Value | None  # in the first trial; None for whatever the sampler takes
    when: Mapping[str, tuple[str, ...]]  # labels that other parameters must have for this one to exist

    def active(self, values: Mapping[str, Value]) -> bool:
        """Whether the parameter exists where those before it have these values."""
        return all(name in values and label(values[name]) in allowed for name, allowed in self.when.items())

    def suggest(self, trial: Any) -> Value:
        """The value that a sampler takes."""
        low, high = self.bounds
        if self.kind == "choices":
            return str(trial.suggest_categorical(self.name, tuple(self.choices)))
        if self.kind == "integer":
            return int(trial.suggest_int(self.name, int(low), int(high), step=int(self.step or 1)))
        return float(trial.suggest_float(self.name, low, high, step=self.step, log=self.kind == "log"))

    def grid(self) -> list[Value]:
        """All values of a grid search."""
        low, high = self.bounds
        if self.kind == "choices":
            return list(self.choices)
        if self.kind == "integer":
            return list(range(int(low), int(high) + 1, int(self.step or 1)))
        if self.step is not None:
            return [low + k * self.step for k in range(math.floor((high - low) / self.step + 1e-9) + 1)]
        spaced = np.geomspace if self.kind == "log" else np.linspace
        return [float(v) for v in spaced(low, high, self.points)]

    def changes(self, value: Value) -> Changes:
        """The options that a value stands for."""
        return dict(self.choices[str(value)]) if self.kind == "choices" else {self.option: label(value)}


@dataclass(frozen=True)
class Space:
    """A base options file and the parameters that change it."""

    path: Path  # of the space's file
    description: str  # one line
    base: Path  # options file
    parameters: tuple[Parameter, ...]  # each after those that its `when` names

    def values(self, choose: Callable[[Parameter], Value | None]) -> dict[str, Value]:
        """What is chosen for all parameters that exist together; nothing where that is None."""
        found: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.active(found) and (value := choose(parameter)) is not None:
                found[parameter.name] = value
        return found

    def suggest(self, trial: Any) -> dict[str, Value]:
        """The values that a sampler takes."""
        return self.values(lambda parameter: parameter.suggest(trial))

    def start(self) -> dict[str, Value]:
        """The values of the first trial, as far as they are given."""
        return self.values(lambda parameter: parameter.start)

    def grid(self) -> list[dict[str, Value]]:
        """All combinations of values on the grid, each once: parameters that do not exist do not multiply them."""
        found: list[dict[str, Value]] = [{}]
        for p in self.parameters:
            found = [v | more for v in found for more in ([{p.name: x} for x in p.grid()] if p.active(v) else [{}])]
        return found

    def changes(self, values: Mapping[str, Value]) -> Changes:
        """What the values of parameters change in the base file."""
        found: Changes = {}
        for parameter in self.parameters:
            if parameter.name in values:
                found |= parameter.changes(values[parameter.name])
        base = options.parse(self.base)
        return {k: v for k, v in found.items() if (v is None and k in base) or (v is not None and base.get(k) != v)}

    def text(self, values: Mapping[str, Value]) -> str:
        """The base file with the values of parameters put in."""
        return edit(self.base.read_text(encoding="utf-8"), self.changes(values))


def label(value: Value) -> str:
    """A value as it is written into options files: floats with three significant digits."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def shipped() -> list[Path]:
    """The spaces that come with the package."""
    return sorted((options.shipped_folder() / "sweeps").glob("*.yaml"))


def find_space(name: str) -> Path:
    """Path of a space: as given, or else one that is shipped under this name; a UsageError where there is none."""
    path = Path(name)
    if path.is_file():
        return path
    for candidate in shipped():
        if path.name in (candidate.name, candidate.stem) and str(path.parent) in (".", "sweeps", "options/sweeps"):
            return candidate
    raise UsageError(f"space {name}: no such file; shipped are {', '.join(p.name for p in shipped())}")


@contextmanager
def _at(where: str) -> Iterator[None]:
    """Say where an error was made."""
    try:
        yield
    except UsageError as e:
        raise UsageError(f"{where}: {e}") from e


def read(path: Path) -> Space:
    """Read a space; a UsageError names the parameter that makes no sense, and the remedy."""
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"space {path}: not readable as text: {e}") from e
    except yaml.YAMLError as e:
        raise UsageError(f"space {path}: not YAML: {' '.join(str(e).split())}") from e
    parameters: dict[str, Parameter] = {}
    with _at(f"space {path}"):
        top = _mapping(content, ("description", "base", "groups"), required=("base", "groups"))
        base = path.parent / str(top["base"])
        with _at("base"):
            base = base if base.is_file() else options.find_options_file(str(top["base"]))
            given = options.parse(base)
        for group, raw in _mapping(top["groups"]).items():
            with _at(f"group {group}"):
                entries = _mapping(raw, ("prefix", "parameters"), required=("parameters",))
                prefix = str(entries.get("prefix") or "").removeprefix("-")
                _check_prefix(prefix, given, base.name)
                specs = _mapping(entries["parameters"])
            for name, spec in specs.items():
                full = f"{group}.{name}"
                with _at(f"parameter {full}"):
                    parameters[full] = _parameter(full, prefix, spec, parameters, given)
        if not parameters:
            raise UsageError("no parameters; declare some under groups")
        _check_unique(parameters.values())
    return Space(path, str(top.get("description") or path.stem), base, tuple(parameters.values()))


def _mapping(raw: Any, allowed: Sequence[str] | None = None, required: Sequence[str] = ()) -> dict[str, Any]:
    """A mapping with names for keys, of which some are allowed and some required."""
    if not isinstance(raw, dict) or not all(isinstance(key, str) for key in raw):
        raise UsageError(f"expected a mapping of names, found {_shown(raw)}")
    for key in raw:
        if allowed is not None and key not in allowed:
            hint = _similar(key, allowed) or f"expected {', '.join(allowed)}"
            raise UsageError(f"unknown entry {key!r}; {hint}")
    for key in required:
        if key not in raw:
            raise UsageError(f"{key!r} is missing")
    return raw


def _shown(raw: Any) -> str:
    return textwrap.shorten(repr(raw), 60, placeholder="...")


def _similar(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    found = difflib.get_close_matches(name, sorted(known), n=1, cutoff=cutoff)
    return f"did you mean {found[0]}?" if found else ""


def _check_prefix(prefix: str, given: Iterable[str], base: str) -> None:
    stem = "".join(re.findall(rf".*{options.SPLIT}", prefix))  # what follows is a part of the options' own names
    if not any(name.startswith(stem) for name in given):
        splits = {name[: m.end()] for name in given for m in re.finditer(options.SPLIT, name)}
        hint = _similar(stem, splits, cutoff=0.3) or "leave it away for the outermost level"
        raise UsageError(f"no option of {base} has the prefix {stem!r}; {hint}")


def _check_unique(parameters: Iterable[Parameter]) -> None:
    """No two parameters that always exist set the same option."""
    setters: dict[str, str] = {}
    for parameter in parameters:
        for option in {parameter.option, *itertools.chain(*parameter.choices.values())} if not parameter.when else ():
            if option in setters:
                raise UsageError(
                    f"parameters {setters[option]} and {parameter.name} both set -{option}; "
                    "take one away, or tell by 'when' which of them holds"
                )
            setters[option] = parameter.name


def _parameter(
    name: str, prefix: str, raw: Any, before: Mapping[str, Parameter], given: Mapping[str, str | None]
) -> Parameter:
    """One parameter from its entry in the file, after those before it."""
    spec = _mapping(raw, (*EXTRAS, *EXTRAS["float"]))
    kinds = [kind for kind in EXTRAS if kind in spec]
    if len(kinds) != 1:
        raise UsageError(f"expected exactly one of {', '.join(EXTRAS)}, found {', '.join(kinds) or 'none'}")
    (kind,) = kinds
    for key in spec:
        if key != kind and key not in EXTRAS[kind]:
            raise UsageError(f"{key!r} does not go with {kind!r}; take it away")
    option = prefix + str(spec.get("option", name.partition(".")[2])).removeprefix("-")
    if not re.fullmatch(r"[A-Za-z_]\w*", option):
        raise UsageError(f"{option!r} is no name of an option; name it with 'option: NAME'")
    with _at("when"):
        when = _conditions(spec.get("when", {}), name, before)
    points = _positive(spec, "points", "integer") or GRID_POINTS
    if points < 2:
        raise UsageError(f"points {points:g}: a grid needs both ends; take at least 2")
    parameter = Parameter(
        name=name,
        option=option,
        kind=kind,
        choices=_choices(spec[kind], option, prefix) if kind == "choices" else {},
        bounds=(0.0, 0.0) if kind == "choices" else _bounds(spec[kind], kind),
        step=_positive(spec, "step", kind),
        points=int(points),
        start=None,
        when=when,
    )
    return replace(parameter, start=_start(spec, parameter, given))


def _choices(raw: Any, option: str, prefix: str) -> dict[str, Changes]:
    if isinstance(raw, list) and raw and all(v is None or isinstance(v, str | int | float) for v in raw):
        found: dict[str, Changes] = {_text(v) or ABSENT: {option: _text(v)} for v in raw}
        if len(found) < len(raw):
            raise UsageError("choices: a value occurs twice")
        return found
    if not (isinstance(raw, dict) and raw):
        raise UsageError(f"choices: expected a list of values, or a mapping from names to options; found {_shown(raw)}")
    entries = {str(name): _mapping(entry or {}) for name, entry in raw.items()}
    return {
        name: {prefix + key.removeprefix("-"): _text(value) for key, value in entry.items()}
        for name, entry in entries.items()
    }


def _text(value: Any) -> str | None:
    """A value in YAML as an option's value."""
    if value is None:
        return None
    return str(value).lower() if isinstance(value, bool) else label(value)


def _bounds(raw: Any, kind: str) -> tuple[float, float]:
    numbers = [_number(v) for v in raw] if isinstance(raw, list) else []
    if len(numbers) != 2 or numbers[0] is None or numbers[1] is None:
        raise UsageError(f"{kind}: expected [least, greatest], found {_shown(raw)}")
    low, high = numbers[0], numbers[1]
    if not low < high:
        raise UsageError(f"{kind}: the least value {low:g} is not below the greatest, {high:g}")
    if kind == "log" and low <= 0:
        raise UsageError(f"log: values must be positive, found {low:g}; take 'float'")
    if kind == "integer" and not (low.is_integer() and high.is_integer()):
        raise UsageError(f"integer: expected whole numbers, found {_shown(raw)}; or take 'float'")
    return low, high


def _number(value: Any) -> float | None:
    """A finite number as YAML has it; `1e-3`, which YAML 1.1 takes for text, is one, too."""
    try:
        number = float("nan" if isinstance(value, bool) else value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _positive(spec: Mapping[str, Any], key: str, kind: str) -> float | None:
    number = _number(spec.get(key))
    if key in spec and (number is None or number <= 0 or (kind == "integer" and not number.is_integer())):
        raise UsageError(f"{key}: expected a positive number, found {_shown(spec[key])}")
    return number


def _conditions(raw: Any, name: str, before: Mapping[str, Parameter]) -> dict[str, tuple[str, ...]]:
    found = {}
    for other, allowed in _mapping(raw).items():
        full = other if "." in other else f"{name.partition('.')[0]}.{other}"
        if full not in before:
            hint = _similar(full, before) or "declare it before this one"
            raise UsageError(f"there is no parameter {full} before this one; {hint}")
        found[full] = tuple(_text(v) or ABSENT for v in (allowed if isinstance(allowed, list) else [allowed]))
        choices = before[full].choices
        for wanted in found[full] if choices else ():
            if wanted not in choices:
                raise UsageError(f"{full} is never {wanted!r}; its choices are {', '.join(choices)}")
    return found


def _start(spec: Mapping[str, Any], parameter: Parameter, given: Mapping[str, str | None]) -> Value | None:
    """Value of the first trial: as the space says, or else as the base file has it."""
    if parameter.kind == "choices":
        if "start" not in spec:
            as_given = (name for name, c in parameter.choices.items() if all(given.get(k) == v for k, v in c.items()))
            return next(as_given, None)
        start = _text(spec["start"]) or ABSENT
        if start not in parameter.choices:
            raise UsageError(f"start: {start!r} is none of the choices {', '.join(parameter.choices)}")
        return start
    number, (low, high) = _number(spec.get("start", given.get(parameter.option))), parameter.bounds
    if number is None or not low <= number <= high:
        if "start" in spec:
            raise UsageError(f"start {_shown(spec['start'])} is no number in [{low:g}, {high:g}]")
        return None
    return int(number) if parameter.kind == "integer" else number


def edit(text: str, changes: Mapping[str, str | None]) -> str:
    """An options file with some options changed, by full name, and its comments and nesting kept.

    None takes an option out; one that the file does not have comes after those nearest to it, in their prefix.
    """
    lines = text.splitlines()
    places: list[tuple[str, str]] = []  # of each line: prefix in force, full name of its option or nothing
    prefixes = [""]
    for line in lines:
        name, *values = line.split("#")[0].split() or [""]
        if name == "-prefix_push":
            prefixes.append(prefixes[-1] + values[0])
        elif name == "-prefix_pop":
            prefixes.pop()
        is_option = name.startswith("-") and not name.startswith("-prefix_p")
        places.append((prefixes[-1], prefixes[-1] + name[1:] if is_option else ""))
    there = {full for _, full in places}
    after: dict[int, list[str]] = {}
    for full, value in changes.items():
        if full not in there and value is not None:
            k = _place(full, places)
            after.setdefault(k, []).append(
                _line(lines[k] if k >= 0 else "", places[k][0] if k >= 0 else "", full, value)
            )
    result = after.get(-1, [])
    for k, (line, (scope, full)) in enumerate(zip(lines, places, strict=True)):
        value = changes.get(full) if full else None
        if value is not None:
            comment = f"  # {line.partition('#')[2].strip()}" if "#" in line else ""
            result.append(_line(line, scope, full, value) + comment)
        elif not full or full not in changes:
            result.append(line)
        result += after.get(k, [])
    return "\n".join(result) + "\n"


def _line(like: str, scope: str, full: str, value: str) -> str:
    """A line for an option, indented like another one, below a prefix."""
    indent = like[: len(like) - len(like.lstrip())]
    return f"{indent}-{full.removeprefix(scope)} {value}".rstrip()


def _place(full: str, places: Sequence[tuple[str, str]]) -> int:
    """The line after which a new option comes: in the longest prefix that it has, by the most similar name, or -1."""
    near = [
        (len(scope), len(os.path.commonprefix([full, name])), k)  # noqa: RUF071 -- of characters
        for k, (scope, name) in enumerate(places)
        if name and full.startswith(scope)
    ]
    return max(near, default=(0, 0, -1))[-1]
