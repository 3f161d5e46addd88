"""The catalogue of extreme cases: how each scene is made, what makes it hard, and where it comes from.

Two kinds of scenes: those that PorePy exports by a `Recipe` (bundled in one file, `COLLECTION`, and made anew by
`scripts/stress_scenes`), and those that a function here makes of another one, as `transformed.json` says.

Some cases are held out: drawn at random, by number, after all thresholds had been chosen on the others, so that nobody
has picked them, and none is left out. Models with random parameters, all at once, around random fractures; and scenes
under random transformations.
"""

from __future__ import annotations

import json
import lzma
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Scene, gather_rows
from petsc_fs.tools.reference import rows_of

COLLECTION = Path(__file__).resolve().parent.parent / "scenes" / "stress" / "scenes.h5.xz"
"""Compressed HDF5 file of the exported scenes: a group for each, equal arrays stored once."""
HELD_OUT_COLLECTION = COLLECTION.with_name("held_out.h5.xz")
"""The same for the recipes of `HELD_OUT`."""
HELD = "held out"
"""Group of the cases that no threshold was chosen on."""

Change = Callable[[Scene], Scene]
Factors = Mapping[str, float | NDArray[np.float64]]
"""Per field a number, or one for each row."""


@dataclass(frozen=True)
class Recipe:
    """A linear system of a PorePy model with changed parameters, see `petsc_fs.porepy.cases`."""

    group: str  # heading under which it is listed
    hard: str  # what makes it hard, in a line
    model: str = "model2"
    refinement: float = 0.3  # cells are 100 m / refinement wide
    step: tuple[int, int] = (1, 1)  # time step, from 1, and Newton step, from 0, or the last one before it
    parameters: Mapping[str, Any] = field(default_factory=dict)  # of `ModelParameters`
    rock: Mapping[str, Any] = field(default_factory=dict)  # of the model's `Rock`; also `storage`, 1/M in 1/Pa
    case: Mapping[str, Any] = field(default_factory=dict)  # changes of `Case`
    twist: Mapping[str, Any] = field(default_factory=dict)  # what no parameter says, see `scripts/stress_scenes`
    quick: bool = False  # see `StressCase`


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _table(name: str) -> dict[str, dict[str, Any]]:
    """A JSON file beside the scenes, with tuples for lists."""
    text = COLLECTION.with_name(name).read_text(encoding="utf-8")
    found: dict[str, dict[str, Any]] = json.loads(
        text, object_hook=lambda entry: {k: _frozen(v) for k, v in entry.items()}
    )
    return found


ALL_RECIPES = {name: Recipe(**known) for name, known in _table("recipes.json").items()}
RECIPES = {name: recipe for name, recipe in ALL_RECIPES.items() if recipe.group != HELD}
"""Name of an exported scene to what it is made by."""
HELD_OUT = {name: recipe for name, recipe in ALL_RECIPES.items() if recipe.group == HELD}
"""The same of those held out: drawn at random, all parameters at once, by code that commit d380ed0 has."""


@cache
def _unpacked(path: Path) -> Any:
    """The exported scenes, in a temporary file."""
    try:
        found = tempfile.NamedTemporaryFile(suffix=".h5")
        found.write(lzma.decompress(path.read_bytes()))
        found.flush()
    except (OSError, lzma.LZMAError) as e:
        raise SceneError(f"{path}: cannot be read ({e}); make it anew with scripts/stress_scenes") from e
    return found


def load(name: str) -> Scene:
    """A scene by name: of a recipe, or of a bundled file such as `model1.h5`; a SceneError where there is none."""
    if name.endswith(".h5"):
        return hdf5.read(COLLECTION.parent.parent / name)
    path = COLLECTION if name in RECIPES else HELD_OUT_COLLECTION
    with hdf5.open_file(Path(_unpacked(path).name)) as file:
        if name not in file:
            raise SceneError(f"{path}: has no scene {name!r}; make it anew with scripts/stress_scenes")
        return hdf5.read_group(file[name])


# --- changes of scenes, which transformed.json calls by name


def scaled(scene: Scene, rows: Factors | None = None, columns: Factors | None = None) -> Scene:
    """Equations multiplied by `rows` and unknowns by `columns`."""
    left, right = dict(rows or {}), dict(columns or {})
    blocks = {}
    for (r, c), block in scene.blocks.items():
        factor = np.broadcast_to(left.get(r, 1.0), scene.sizes[r])[rows_of(block)]
        below = np.broadcast_to(right.get(c, 1.0), scene.sizes[c])[block.indices]
        blocks[r, c] = block._replace(data=block.data * factor / below)
    rhs = {f: v * left.get(f, 1.0) for f, v in scene.rhs.items()}
    return replace(scene, blocks=blocks, rhs=rhs, reference={})


def base_units(scene: Scene, kg: float, m: float, s: float) -> tuple[float, float, float]:
    """The scene's units of mass, length and time, counted in others."""
    old = scene.metadata.units
    return old.get("kg", 1.0) / kg, old.get("m", 1.0) / m, old.get("s", 1.0) / s


def unknowns_in_units(scene: Scene, *, kg: float = 1.0, m: float = 1.0, s: float = 1.0) -> dict[str, float]:
    """What the unknowns of each field are multiplied by in other units; tractions are relative ones."""
    mass, length, time = base_units(scene, kg, m, s)
    known = {"intf_force": length, "momentum": length, "mass": mass / length / time**2} | _fluxes(mass, length, time)
    return {f: known.get(f, 1.0) for f in scene.fields}


def _fluxes(mass: float, length: float, time: float) -> dict[str, float]:
    flow, power = length**3 / time, mass * length**2 / time**3
    heat = dict.fromkeys(("intf_fourier", "intf_enthalpy", "well_enthalpy"), power)
    return {"intf_flow": flow, "well_flow": flow} | heat


def in_units(scene: Scene, *, kg: float = 1.0, m: float = 1.0, s: float = 1.0) -> Scene:
    """The same scene with mass, length and time counted in other units.

    Exact but for rounding: every equation and unknown is multiplied by a number, and so are all data.
    """
    mass, length, time = base_units(scene, kg, m, s)
    force, pressure = mass * length / time**2, mass / length / time**2
    rows = {"intf_force": force, "momentum": force, "mass": mass / time, "energy": force * length / time}
    rows |= _fluxes(mass, length, time)
    found = with_material(
        scaled(scene, rows, unknowns_in_units(scene, kg=kg, m=m, s=s)),
        shear_modulus=pressure,
        lame_lambda=pressure,
        fluid_compressibility=1 / pressure,
        fluid_density=mass / length**3,
        normal_jump=length,
        time_step=time,
    )
    return replace(
        found,
        cell_volumes={f: v * length**3 for f, v in scene.cell_volumes.items()},
        cell_centers={f: v * length for f, v in scene.cell_centers.items()},
        metadata=replace(scene.metadata, units={"kg": kg, "m": m, "s": s}),
    )


def with_material(scene: Scene, **factors: float) -> Scene:
    """Material data multiplied by factors, where there are any; only the fixed-stress diagonal looks at them."""
    if scene.material is None:
        return scene
    values: dict[str, Any] = {k: np.asarray(getattr(scene.material, k)) * v for k, v in factors.items()}
    if "time_step" in values:
        values["time_step"] = float(values["time_step"])
    return replace(scene, material=replace(scene.material, **values), reference={})


def scattered(
    scene: Scene, name: str, decades: float, seed: int | np.random.Generator = 3, *, unknowns: bool = False
) -> Scene:
    """The equations, or the unknowns, of a field multiplied cell by cell by numbers over so many decades."""
    cells = scene.sizes[name] // scene.block_size(name)
    factors = 10.0 ** (decades * (np.random.default_rng(seed).random(cells) - 0.5))
    by_row = {name: np.repeat(factors, scene.block_size(name))}
    return scaled(scene, columns=by_row) if unknowns else scaled(scene, by_row)


def with_rhs(scene: Scene, fields: Sequence[str] = ()) -> Scene:
    """A right-hand side that is zero but for some fields, where it is random if it was zero."""
    random = np.random.default_rng(5)
    rhs = {}
    for f, v in scene.rhs.items():
        own = v if np.any(v) else random.standard_normal(v.size)
        rhs[f] = own if f in fields else np.zeros_like(v)
    return replace(scene, rhs=rhs, reference={})


def with_rhs_scaled(scene: Scene, factor: float) -> Scene:
    """A right-hand side times a number."""
    return replace(scene, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


def taken(block: CSR, rows: NDArray[np.int64]) -> CSR:
    """Some rows of a block, in the order given."""
    at, counts = gather_rows(block.indptr, rows)
    return CSR(np.concatenate([[0], np.cumsum(counts)]), block.indices[at], block.data[at])


def with_cells_of(scene: Scene, other: str, cells: Sequence[int]) -> Scene:
    """The contact conditions of some fracture cells taken from another scene, by name, on the same grid."""
    there, n = load(other), scene.sizes["contact"]
    blocks, rhs = dict(scene.blocks), {f: v.copy() for f, v in scene.rhs.items()}
    swapped = np.isin(np.arange(n) // scene.dimension, cells)
    nothing = CSR(np.zeros(n + 1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
    for f in scene.fields:
        mine, theirs = (s.blocks.get(("contact", f), nothing) for s in (scene, there))
        indptr = np.concatenate([mine.indptr, mine.indptr[-1] + theirs.indptr[1:]])
        indices, data = (np.concatenate([getattr(b, part) for b in (mine, theirs)]) for part in ("indices", "data"))
        both = CSR(indptr, indices, data)
        if both.data.size:
            blocks["contact", f] = taken(both, np.arange(n) + n * swapped)
    rhs["contact"][swapped] = there.rhs["contact"][swapped]
    assert scene.contact_state is not None and there.contact_state is not None
    state = np.where(np.isin(np.arange(n // scene.dimension), cells), there.contact_state, scene.contact_state)
    return replace(scene, blocks=blocks, rhs=rhs, contact_state=state, reference={})


def with_block_of_cell(scene: Scene, name: str, cell: int, factor: float) -> Scene:
    """The diagonal block of one cell multiplied by a factor."""
    block, bs = scene.blocks[name, name], scene.block_size(name)
    inside = (rows_of(block) // bs == cell) & (np.asarray(block.indices) // bs == cell)
    data = np.where(inside, factor * block.data, block.data)
    return replace(scene, blocks={**scene.blocks, (name, name): block._replace(data=data)}, reference={})


def without_row(scene: Scene, name: str, row: int) -> Scene:
    """One equation lost: its row is zero, which leaves the matrix singular."""
    keep = np.ones(scene.sizes[name])
    keep[row] = 0.0
    return scaled(scene, {name: keep})


def with_row_twice(scene: Scene, name: str, *, consistent: bool) -> Scene:
    """The first equation of a field in place of its second too; the right-hand sides agree or do not."""
    source = np.arange(scene.sizes[name])
    source[1] = 0
    blocks = {rc: taken(block, source) if rc[0] == name else block for rc, block in scene.blocks.items()}
    rhs = {f: v.copy() for f, v in scene.rhs.items()}
    rhs[name][1] = rhs[name][0] + (0.0 if consistent else max(1.0, float(np.abs(rhs[name]).max())))
    return replace(scene, blocks=blocks, rhs=rhs, reference={})


def without_data(scene: Scene) -> Scene:
    """Matrix and right-hand side alone."""
    return replace(scene, material=None, cell_volumes={}, cell_centers={}, cell_dimension=None, reference={})


NAMED: dict[str, Callable[..., Scene]] = {
    change.__name__: change
    for change in (
        *(scaled, in_units, with_material, scattered, with_rhs, with_rhs_scaled, with_cells_of),
        *(with_block_of_cell, without_row, with_row_twice, without_data),
    )
}
"""Changes by name."""


# --- cases


@dataclass(frozen=True, kw_only=True)
class StressCase:
    """One extreme scene."""

    name: str
    group: str  # heading under which it is listed
    hard: str  # what makes it hard, in a line
    source: str  # where it comes from, in words
    make: Callable[[], Scene]
    quick: bool = False  # whether `--suite quick` has it
    singular: bool = False  # whether the matrix is singular, so that no solution or no single one exists
    solvable: bool = True  # whether there is a solution, so that one that is handed on can be right

    @property
    def held_out(self) -> bool:
        """Whether no threshold was chosen on it."""
        return self.group == HELD

    @classmethod
    def exported(cls, name: str, recipe: Recipe) -> StressCase:
        """A case that a PorePy model was exported for."""
        source = f"PorePy, {recipe.model}, step {recipe.step[0]}:{recipe.step[1]}"
        known: dict[str, Any] = {"group": recipe.group, "hard": recipe.hard, "source": source}
        return cls(name=name, make=partial(load, name), quick=recipe.quick, **known)

    @classmethod
    def transformed(cls, name: str, base: str, change: str, **known: Any) -> StressCase:
        """A case made of another scene by one of `NAMED`, with the arguments in `with`."""
        make = partial(_changed, base, partial(NAMED[change], **known.pop("with", {})))
        return cls(name=name, source=f"{base}, {change}", make=make, **known)


def _changed(base: str, change: Change) -> Scene:
    return change(load(base))


def catalogue() -> list[StressCase]:
    """All cases but those held out, exported scenes first."""
    exported = [StressCase.exported(name, recipe) for name, recipe in RECIPES.items()]
    return exported + [StressCase.transformed(name, **known) for name, known in _table("transformed.json").items()]


SEED = 20250131
TRANSFORMED = 14
BASES = (
    "model1.h5", "model2.h5", "model3.h5", "biot.h5", "flow.h5", "contact.h5", "three_planes", "thirty_fractures",
    "acute_crossing", "lognormal", "near_touching", "friction_0.1", "cubic_law",
)  # fmt: skip
"""What is transformed: bundled scenes and exported ones."""


def held_out() -> list[StressCase]:
    """All held-out cases."""
    found = [StressCase.exported(name, recipe) for name, recipe in HELD_OUT.items()]
    for k in range(TRANSFORMED):
        base = BASES[k % len(BASES)]
        known: dict[str, Any] = {"name": f"held_out_{base.removesuffix('.h5')}_{k:02}", "hard": "; ".join(_drawn(k)[0])}
        make = partial(_changed, base, partial(_drawn_change, number=k))
        found.append(StressCase(group=HELD, source=f"{base}, random changes", make=make, **known))
    return found


def _drawn(number: int) -> tuple[list[str], np.random.Generator]:
    """The two or three random changes of a held-out case, of `CHANGES`, and what draws their numbers."""
    random = np.random.default_rng([SEED, 1000 + number])
    shuffled = [str(change) for change in random.permutation(list(CHANGES))]
    return shuffled[: int(random.integers(2, 4))], random


def _drawn_change(scene: Scene, number: int) -> Scene:
    names, random = _drawn(number)
    for name in names:
        scene = CHANGES[name](scene, random)
    return scene


def _units(scene: Scene, random: np.random.Generator) -> Scene:
    kg, m, s = 10.0 ** random.uniform((0, -3, 0), (10, 3, 7))
    return in_units(scene, kg=float(kg), m=float(m), s=float(s))


def _powers(scene: Scene, random: np.random.Generator, decades: float) -> dict[str, float]:
    """A number for each field."""
    return {f: float(10.0 ** random.uniform(-decades, decades)) for f in scene.fields}


def _scattered_rows(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    return scattered(scene, name, decades=float(random.uniform(1, 5)), seed=int(random.integers(2**31)))


def _scattered_columns(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    return scattered(scene, name, decades=float(random.uniform(1, 3)), seed=random, unknowns=True)


def _rhs(scene: Scene, random: np.random.Generator) -> Scene:
    rhs = {f: random.standard_normal(v.size) * (np.linalg.norm(v) or 1.0) for f, v in scene.rhs.items()}
    return replace(scene, rhs=rhs, reference={})


def _material(scene: Scene, random: np.random.Generator) -> Scene:
    if scene.material is None:
        return scene
    factor = float(10.0 ** random.uniform(-1, 1))
    return with_material(scene, shear_modulus=factor, lame_lambda=factor)


CHANGES: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "random units": _units,
    "equations of each field times a number over 8 decades": lambda s, r: scaled(s, rows=_powers(s, r, 4)),
    "unknowns of each field times a number over 12 decades": lambda s, r: scaled(s, columns=_powers(s, r, 6)),
    "equations of one field scattered over 1 to 5 decades": _scattered_rows,
    "unknowns of one field scattered over 1 to 3 decades": _scattered_columns,
    "random right-hand side": _rhs,
    "right-hand side times a number over 120 decades": lambda s, r: with_rhs_scaled(
        s, float(10.0 ** r.uniform(-60, 60))
    ),
    "stiffness that fixed stress is told off by up to 10": _material,
}
