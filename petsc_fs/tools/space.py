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
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from petsc_fs import options
from petsc_fs.errors import UsageError

Value = str | int | float
Changes = dict[str, str | None]
"""Options by full name without the dash, None for those that are taken out of the base file."""

ABSENT = "(absent)"
"""Label of the choice not to have an option."""

KINDS = ("choices", "integer", "float", "log")
EXTRAS = {
    "choices": ("option", "start", "when"),
    "integer": ("option", "start", "when", "step"),
    "float": ("option", "start", "when", "step", "points"),
    "log": ("option", "start", "when", "points"),
}
GRID_POINTS = 3


@dataclass(frozen=True)
class Parameter:
    """One thing that may change."""

    name: str  # GROUP.NAME
    option: str  # that it sets, by full name without the dash
    kind: str  # of KINDS
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
        parts = [k / (self.points - 1) for k in range(self.points)]
        if self.kind == "log":
            return [min(max(low * (high / low) ** part, low), high) for part in parts]
        return [min(low + part * (high - low), high) for part in parts]

    def changes(self, value: Value) -> Changes:
        """The options that a value stands for."""
        if self.kind == "choices":
            return dict(self.choices[str(value)])
        return {self.option: label(value)}


@dataclass(frozen=True)
class Space:
    """A base options file and the parameters that change it."""

    path: Path  # of the space's file
    description: str  # one line
    base: Path  # options file
    parameters: tuple[Parameter, ...]  # each after those that its `when` names

    def suggest(self, trial: Any) -> dict[str, Value]:
        """The values that a sampler takes for all parameters that exist together."""
        values: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.active(values):
                values[parameter.name] = parameter.suggest(trial)
        return values

    def start(self) -> dict[str, Value]:
        """The values of the first trial, as far as they are given."""
        values: dict[str, Value] = {}
        for parameter in self.parameters:
            if parameter.start is not None and parameter.active(values):
                values[parameter.name] = parameter.start
        return values

    def grid(self) -> Iterator[dict[str, Value]]:
        """All combinations of values on the grid, each once: parameters that do not exist do not multiply them."""

        def extend(values: dict[str, Value], rest: tuple[Parameter, ...]) -> Iterator[dict[str, Value]]:
            if not rest:
                yield values
            elif rest[0].active(values):
                for value in rest[0].grid():
                    yield from extend(values | {rest[0].name: value}, rest[1:])
            else:
                yield from extend(values, rest[1:])

        return extend({}, self.parameters)

    def changes(self, values: Mapping[str, Value]) -> Changes:
        """What the values of parameters change in the base file."""
        known = {p.name: p for p in self.parameters}
        found: Changes = {}
        for name, value in values.items():
            found.update(known[name].changes(value))
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
    """Path of a space: as given, or else one that is shipped under this name.

    Raises:
        UsageError: there is none.
    """
    path = Path(name)
    if path.is_file():
        return path
    for candidate in shipped():
        if path.name in (candidate.name, candidate.stem) and str(path.parent) in (".", "sweeps", "options/sweeps"):
            return candidate
    raise UsageError(f"space {name}: no such file; shipped are {', '.join(p.name for p in shipped())}")


def read(path: Path) -> Space:
    """Read a space.

    Raises:
        UsageError: the file cannot be read or makes no sense; the message names the parameter and the remedy.
    """
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"space {path}: not readable as text: {e}") from e
    except yaml.YAMLError as e:
        raise UsageError(f"space {path}: not YAML: {' '.join(str(e).split())}") from e
    top = _mapping(content, f"space {path}", ("description", "base", "groups"), required=("base", "groups"))
    beside = path.parent / str(top["base"])
    try:
        base = beside if beside.is_file() else options.find_options_file(str(top["base"]))
        given = options.parse(base)
    except UsageError as e:
        raise UsageError(f"space {path}: base: {e}") from e
    parameters: dict[str, Parameter] = {}
    for group, raw in _mapping(top["groups"], f"space {path}: groups").items():
        where = f"space {path}: group {group}"
        entries = _mapping(raw, where, ("prefix", "parameters"), required=("parameters",))
        prefix = str(entries.get("prefix") or "").removeprefix("-")
        _check_prefix(prefix, given, where, base.name)
        for name, spec in _mapping(entries["parameters"], f"{where}: parameters").items():
            full = f"{group}.{name}"
            place = f"space {path}: parameter {full}"
            parameters[full] = _parameter(full, prefix, spec, before=parameters, given=given, where=place)
    if not parameters:
        raise UsageError(f"space {path}: no parameters; declare some under groups")
    _check_unique(parameters.values(), f"space {path}")
    return Space(path, str(top.get("description") or path.stem), base, tuple(parameters.values()))


def _mapping(
    raw: Any, where: str, allowed: Sequence[str] | None = None, required: Sequence[str] = ()
) -> dict[str, Any]:
    """A mapping with names for keys, of which some are allowed and some required."""
    if not isinstance(raw, dict) or not all(isinstance(key, str) for key in raw):
        raise UsageError(f"{where}: expected a mapping of names, found {_shown(raw)}")
    for key in raw:
        if allowed is not None and key not in allowed:
            similar = difflib.get_close_matches(key, allowed, n=1)
            hint = f"did you mean {similar[0]}?" if similar else f"expected {', '.join(allowed)}"
            raise UsageError(f"{where}: unknown entry {key!r}; {hint}")
    for key in required:
        if key not in raw:
            raise UsageError(f"{where}: {key!r} is missing")
    return raw


def _shown(raw: Any) -> str:
    text = repr(raw)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _check_prefix(prefix: str, given: Iterable[str], where: str, base: str) -> None:
    stem = "".join(re.findall(rf".*{options.SPLIT}", prefix))  # what follows is a part of the options' own names
    if any(name.startswith(stem) for name in given):
        return
    splits = {name[: m.end()] for name in given for m in re.finditer(options.SPLIT, name)}
    similar = difflib.get_close_matches(stem, sorted(splits), n=1, cutoff=0.3)
    hint = f"; did you mean {similar[0]}?" if similar else "; leave it away for the outermost level"
    raise UsageError(f"{where}: no option of {base} has the prefix {stem!r}{hint}")


def _check_unique(parameters: Iterable[Parameter], where: str) -> None:
    """No two parameters that always exist set the same option."""
    setters: dict[str, str] = {}
    for parameter in parameters:
        for option in {parameter.option, *itertools.chain(*parameter.choices.values())} if not parameter.when else ():
            if option in setters:
                raise UsageError(
                    f"{where}: parameters {setters[option]} and {parameter.name} both set -{option}; "
                    "take one away, or tell by 'when' which of them holds"
                )
            setters[option] = parameter.name


def _parameter(
    name: str, prefix: str, raw: Any, *, before: Mapping[str, Parameter], given: Mapping[str, str | None], where: str
) -> Parameter:
    """One parameter from its entry in the file."""
    spec = _mapping(raw, where, (*KINDS, *EXTRAS["float"]))
    kinds = [kind for kind in KINDS if kind in spec]
    if len(kinds) != 1:
        raise UsageError(f"{where}: expected exactly one of {', '.join(KINDS)}, found {', '.join(kinds) or 'none'}")
    kind = kinds[0]
    for key in spec:
        if key != kind and key not in EXTRAS[kind]:
            raise UsageError(f"{where}: {key!r} does not go with {kind!r}; take it away")
    option = prefix + str(spec.get("option", name.partition(".")[2])).removeprefix("-")
    if not re.fullmatch(r"[A-Za-z_]\w*", option):
        raise UsageError(f"{where}: {option!r} is no name of an option; name it with 'option: NAME'")
    choices = _choices(spec[kind], option, prefix, where) if kind == "choices" else {}
    bounds = (0.0, 0.0) if kind == "choices" else _bounds(spec[kind], kind, where)
    step = _positive(spec, "step", kind, where)
    points = _positive(spec, "points", "integer", where)
    if points is not None and points < 2:
        raise UsageError(f"{where}: points {points:g}: a grid needs both ends; take at least 2")
    parameter = Parameter(
        name=name,
        option=option,
        kind=kind,
        choices=choices,
        bounds=bounds,
        step=step,
        points=int(points or GRID_POINTS),
        start=None,
        when=_conditions(spec.get("when", {}), name, before, where),
    )
    start = _start(spec, parameter, given, where)
    return Parameter(**{**vars(parameter), "start": start})


def _choices(raw: Any, option: str, prefix: str, where: str) -> dict[str, Changes]:
    if isinstance(raw, list) and raw and all(v is None or isinstance(v, str | int | float) for v in raw):
        found: dict[str, Changes] = {_text(v) or ABSENT: {option: _text(v)} for v in raw}
        if len(found) < len(raw):
            raise UsageError(f"{where}: choices: a value occurs twice")
        return found
    if isinstance(raw, dict) and raw:
        return {
            str(name): {
                prefix + key.removeprefix("-"): _text(value)
                for key, value in _mapping(entry or {}, f"{where}: choice {name}").items()
            }
            for name, entry in raw.items()
        }
    raise UsageError(
        f"{where}: choices: expected a list of values, or a mapping from names to options; found {_shown(raw)}"
    )


def _text(value: Any) -> str | None:
    """A value in YAML as an option's value."""
    if value is None:
        return None
    if isinstance(value, bool):
        return "true" if value else "false"
    return label(value) if isinstance(value, float) else str(value)


def _bounds(raw: Any, kind: str, where: str) -> tuple[float, float]:
    numbers = [_number(v) for v in raw] if isinstance(raw, list) else []
    if len(numbers) != 2 or any(v is None for v in numbers):
        hint = "; YAML wants 1.0e-3 for 1e-3" if re.search(r"'\S*\de", repr(raw)) else ""
        raise UsageError(f"{where}: {kind}: expected [least, greatest], found {_shown(raw)}{hint}")
    low, high = (float(v) for v in numbers if v is not None)
    if not low < high:
        raise UsageError(f"{where}: {kind}: the least value {low:g} is not below the greatest, {high:g}")
    if kind == "log" and low <= 0:
        raise UsageError(f"{where}: log: values must be positive, found {low:g}; take 'float'")
    if kind == "integer" and (low != int(low) or high != int(high)):
        raise UsageError(f"{where}: integer: expected whole numbers, found {_shown(raw)}; or take 'float'")
    return low, high


def _number(value: Any) -> float | None:
    """A number as YAML has it; `1e-3`, which YAML 1.1 takes for text, is one, too."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        return None
    try:
        number = float(value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _positive(spec: Mapping[str, Any], key: str, kind: str, where: str) -> float | None:
    if key not in spec:
        return None
    number = _number(spec[key])
    if number is None or number <= 0 or (kind == "integer" and number != int(number)):
        raise UsageError(f"{where}: {key}: expected a positive number, found {_shown(spec[key])}")
    return number


def _conditions(raw: Any, name: str, before: Mapping[str, Parameter], where: str) -> dict[str, tuple[str, ...]]:
    found = {}
    for other, allowed in _mapping(raw, f"{where}: when").items():
        full = other if "." in other else f"{name.partition('.')[0]}.{other}"
        if full not in before:
            similar = difflib.get_close_matches(full, before, n=1)
            hint = f"did you mean {similar[0]}?" if similar else "declare it before this one"
            raise UsageError(f"{where}: when: there is no parameter {full} before this one; {hint}")
        labels = tuple(_text(v) or ABSENT for v in (allowed if isinstance(allowed, list) else [allowed]))
        choices = before[full].choices
        for wanted in labels if choices else ():
            if wanted not in choices:
                raise UsageError(f"{where}: when: {full} is never {wanted!r}; its choices are {', '.join(choices)}")
        found[full] = labels
    return found


def _start(spec: Mapping[str, Any], parameter: Parameter, given: Mapping[str, str | None], where: str) -> Value | None:
    """Value of the first trial: as the space says, or else as the base file has it."""
    if parameter.kind == "choices":
        if "start" in spec:
            start = _text(spec["start"]) or ABSENT
            if start not in parameter.choices:
                raise UsageError(f"{where}: start: {start!r} is none of the choices {', '.join(parameter.choices)}")
            return start
        for name, changes in parameter.choices.items():
            if all(given.get(k) == v for k, v in changes.items()):
                return name
        return None
    number = _number(spec.get("start", given.get(parameter.option)))
    if number is None and "start" in spec:
        raise UsageError(f"{where}: start: expected a number, found {_shown(spec['start'])}")
    if number is None or not parameter.bounds[0] <= number <= parameter.bounds[1]:
        if "start" in spec:
            low, high = parameter.bounds
            raise UsageError(f"{where}: start {number:g} is outside of [{low:g}, {high:g}]")
        return None
    return int(number) if parameter.kind == "integer" else number


def edit(text: str, changes: Mapping[str, str | None]) -> str:
    """An options file with some options changed, and its comments and nesting kept.

    Args:
        text: of the file, as `petsc_fs.options.parse` reads it.
        changes: options by full name without the dash. None takes an option out; one that the file does not have
            comes after the options that are nearest to it, in their prefix.
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
            scope = places[k][0] if k >= 0 else ""
            indent = re.match(r"\s*", lines[k])[0] if k >= 0 else ""  # type: ignore[index]
            after.setdefault(k, []).append(f"{indent}-{full.removeprefix(scope)} {value}".rstrip())
    result = after.get(-1, [])
    for k, (line, (scope, full)) in enumerate(zip(lines, places, strict=True)):
        if full not in changes or not full:
            result.append(line)
        elif changes[full] is not None:
            indent = line[: len(line) - len(line.lstrip())]
            comment = f"  # {line.partition('#')[2].strip()}" if "#" in line else ""
            result.append(f"{indent}-{full.removeprefix(scope)} {changes[full]}".rstrip() + comment)
        result += after.get(k, [])
    return "\n".join(result) + "\n"


def _place(full: str, places: Sequence[tuple[str, str]]) -> int:
    """The line after which a new option comes: in the longest prefix that it has, by the most similar name."""
    best, where = (-1, -1), -1
    for k, (scope, name) in enumerate(places):
        if name and full.startswith(scope):
            common = sum(1 for _ in itertools.takewhile(lambda ab: ab[0] == ab[1], zip(full, name, strict=False)))
            if (len(scope), common) >= best:
                best, where = (len(scope), common), k
    return where
