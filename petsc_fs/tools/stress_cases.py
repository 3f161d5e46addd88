"""The catalogue of extreme cases: how each scene is made, what makes it hard, and where it comes from.

Two kinds of scenes: those that PorePy exports by a `Recipe` (bundled in one file, `COLLECTION`, and made anew by
`scripts/stress_scenes`), and those that a function here makes of another one. A case names the one or the other.

Some cases are held out: drawn at random, by number, after all thresholds had been chosen on the others, so that nobody
has picked them, and none is left out. Models with random parameters, all at once, around random fractures; and scenes
under random transformations.
"""

from __future__ import annotations

import json
import lzma
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Scene
from petsc_fs.tools.reference import rows_of

COLLECTION = Path(__file__).resolve().parent.parent / "scenes" / "stress" / "scenes.h5.xz"
"""Compressed HDF5 file of the exported scenes: a group for each, equal arrays stored once."""
HELD_OUT_COLLECTION = COLLECTION.with_name("held_out.h5.xz")
"""The same for the recipes of `HELD_OUT`."""


@dataclass(frozen=True)
class Recipe:
    """A linear system of a PorePy model with changed parameters.

    Attributes:
        group: heading under which it is listed.
        hard: what makes it hard, in a line.
        model: name in `petsc_fs.porepy.cases.CASES`.
        refinement: cells are 100 m / refinement wide.
        step: time step, from 1, and Newton step, from 0; the last one before it where Newton's method ends earlier.
        parameters: of `petsc_fs.porepy.cases.ModelParameters`.
        rock: of `petsc_fs.porepy.cases.Rock`; also `storage`, 1/M in 1/Pa.
        case: changes of `petsc_fs.porepy.cases.Case`.
        twist: changes that no parameter makes, see `scripts/stress_scenes`.
    """

    group: str
    hard: str
    model: str = "model2"
    refinement: float = 0.3
    step: tuple[int, int] = (1, 1)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    rock: Mapping[str, Any] = field(default_factory=dict)
    case: Mapping[str, Any] = field(default_factory=dict)
    twist: Mapping[str, Any] = field(default_factory=dict)


CONTACT, FLOW, UNITS, ALGEBRA, HELD = "contact", "flow", "units", "algebra", "held out"


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _read_recipes() -> dict[str, Recipe]:
    text = COLLECTION.with_name("recipes.json").read_text(encoding="utf-8")
    frozen = json.loads(text, object_hook=lambda found: {k: _frozen(v) for k, v in found.items()})
    return {name: Recipe(**known) for name, known in frozen.items()}


ALL_RECIPES = _read_recipes()
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
    """A scene by name: of a recipe, or of a bundled file such as `model1.h5`.

    Raises:
        SceneError: there is none.
    """
    if name.endswith(".h5"):
        return hdf5.read(COLLECTION.parent.parent / name)
    path = COLLECTION if name in RECIPES else HELD_OUT_COLLECTION
    with hdf5.open_file(Path(_unpacked(path).name)) as file:
        if name not in file:
            raise SceneError(f"{path}: has no scene {name!r}; make it anew with scripts/stress_scenes")
        return hdf5.read_group(file[name])


Rows = Mapping[str, float | NDArray[np.float64]]


def scaled(scene: Scene, rows: Rows | None = None, columns: Rows | None = None) -> Scene:
    """Equations multiplied by `rows` and unknowns by `columns`, each a number or an array per field."""
    left, right = dict(rows or {}), dict(columns or {})
    blocks = {}
    for (r, c), block in scene.blocks.items():
        factor = np.repeat(np.broadcast_to(left.get(r, 1.0), scene.sizes[r]), np.diff(block.indptr))
        below = np.broadcast_to(right.get(c, 1.0), scene.sizes[c])[block.indices]
        blocks[r, c] = CSR(block.indptr, block.indices, block.data * factor / below)
    rhs = {f: v * left.get(f, 1.0) for f, v in scene.rhs.items()}
    return replace(scene, blocks=blocks, rhs=rhs, reference={})


def base_units(scene: Scene, kg: float, m: float, s: float) -> tuple[float, float, float]:
    """The scene's units of mass, length and time, counted in others."""
    old = scene.metadata.units
    return old.get("kg", 1.0) / kg, old.get("m", 1.0) / m, old.get("s", 1.0) / s


def unknowns_in_units(scene: Scene, *, kg: float = 1.0, m: float = 1.0, s: float = 1.0) -> dict[str, float]:
    """What the unknowns of each field are multiplied by in other units; tractions are relative ones."""
    mass, length, time = base_units(scene, kg, m, s)
    known = {"intf_force": length, "momentum": length, "intf_flow": length**3 / time, "mass": mass / length / time**2}
    return {f: known.get(f, 1.0) for f in scene.fields}


def in_units(scene: Scene, *, kg: float = 1.0, m: float = 1.0, s: float = 1.0) -> Scene:
    """The same scene with mass, length and time counted in other units.

    Exact but for rounding: every equation and unknown is multiplied by a number, and so are all data.
    """
    mass, length, time = base_units(scene, kg, m, s)
    force, pressure = mass * length / time**2, mass / length / time**2
    rows = {"intf_force": force, "momentum": force, "intf_flow": length**3 / time, "mass": mass / time}
    found = scaled(scene, rows, unknowns_in_units(scene, kg=kg, m=m, s=s))
    if found.material is not None:
        old = found.material
        found.material = replace(
            old,
            shear_modulus=np.asarray(old.shear_modulus) * pressure,
            lame_lambda=np.asarray(old.lame_lambda) * pressure,
            fluid_compressibility=np.asarray(old.fluid_compressibility) / pressure,
            fluid_density=np.asarray(old.fluid_density) * mass / length**3,
            normal_jump=np.asarray(old.normal_jump) * length,
            time_step=old.time_step * time,
        )
    found.cell_volumes = {f: v * length**3 for f, v in found.cell_volumes.items()}
    found.cell_centers = {f: v * length for f, v in found.cell_centers.items()}
    found.metadata = replace(found.metadata, units={"kg": kg, "m": m, "s": s})
    return found


def scattered(scene: Scene, field_name: str, decades: float, seed: int = 3) -> Scene:
    """The equations of a field multiplied cell by cell by numbers over so many decades."""
    cells = scene.sizes[field_name] // scene.block_size(field_name)
    factors = 10.0 ** (decades * (np.random.default_rng(seed).random(cells) - 0.5))
    return scaled(scene, {field_name: np.repeat(factors, scene.block_size(field_name))})


def with_rhs(scene: Scene, fields: tuple[str, ...] = ()) -> Scene:
    """A right-hand side that is zero but for some fields, where it is random if it was zero."""
    random = np.random.default_rng(5)
    rhs = {}
    for f, v in scene.rhs.items():
        own = v if np.any(v) else random.standard_normal(v.size)
        rhs[f] = own if f in fields else np.zeros_like(v)
    return replace(scene, rhs=rhs, reference={})


def with_rows_of(scene: Scene, other: Scene, cells: list[int]) -> Scene:
    """The contact conditions of some fracture cells taken from another scene on the same grid."""
    D, blocks, rhs = scene.dimension, dict(scene.blocks), {f: v.copy() for f, v in scene.rhs.items()}
    rows = np.concatenate([np.arange(D * k, D * k + D) for k in cells])
    taken = np.zeros(scene.sizes["contact"], dtype=bool)
    taken[rows] = True
    for f in scene.fields:
        mine, theirs = (s.blocks.get(("contact", f)) for s in (scene, other))
        parts: list[tuple[CSR, NDArray[np.bool_]]] = [
            (b, keep) for b, keep in ((mine, ~taken), (theirs, taken)) if b is not None
        ]
        if parts:
            blocks["contact", f] = _rows_together(parts, taken.size)
    rhs["contact"][taken] = other.rhs["contact"][taken]
    assert scene.contact_state is not None and other.contact_state is not None
    state = np.array(scene.contact_state)
    state[cells] = np.asarray(other.contact_state)[cells]
    return replace(scene, blocks=blocks, rhs=rhs, contact_state=state, reference={})


def _rows_together(parts: list[tuple[CSR, NDArray[np.bool_]]], n: int) -> CSR:
    """Rows of several blocks, each with the rows that it gives."""
    rows, columns, data = [], [], []
    for block, keep in parts:
        row = rows_of(block)
        chosen = keep[row]
        rows.append(row[chosen])
        columns.append(np.asarray(block.indices)[chosen])
        data.append(block.data[chosen])
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    indptr = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=n))])
    return CSR(indptr, np.concatenate(columns)[order], np.concatenate(data)[order])


def with_block_of_cell(scene: Scene, name: str, cell: int, factor: float) -> Scene:
    """The diagonal block of one cell multiplied by a factor."""
    block, bs = scene.blocks[name, name], scene.block_size(name)
    row = rows_of(block)
    inside = (row // bs == cell) & (np.asarray(block.indices) // bs == cell)
    data = np.where(inside, factor * block.data, block.data)
    return replace(scene, blocks={**scene.blocks, (name, name): block._replace(data=data)}, reference={})


def without_row(scene: Scene, name: str, row: int) -> Scene:
    """One equation lost: its row is zero, which leaves the matrix singular."""
    keep = np.ones(scene.sizes[name])
    keep[row] = 0.0
    return scaled(scene, {name: keep})


def with_row_twice(scene: Scene, name: str, *, consistent: bool) -> Scene:
    """The first equation of a field in place of its second too; the right-hand sides agree or do not."""
    blocks = dict(scene.blocks)
    for (r, c), block in scene.blocks.items():
        if r == name:
            source = np.arange(scene.sizes[name])
            source[1] = 0
            counts = np.diff(block.indptr)[source]
            take = np.concatenate([np.arange(block.indptr[k], block.indptr[k + 1]) for k in source])
            indptr = np.concatenate([[0], np.cumsum(counts)])
            blocks[r, c] = CSR(indptr, np.asarray(block.indices)[take], block.data[take])
    rhs = {f: v.copy() for f, v in scene.rhs.items()}
    rhs[name][1] = rhs[name][0] + (0.0 if consistent else max(1.0, float(np.abs(rhs[name]).max())))
    return replace(scene, blocks=blocks, rhs=rhs, reference={})


def with_material(scene: Scene, **changed: Any) -> Scene:
    """Other material data, which only the fixed-stress diagonal looks at."""
    assert scene.material is not None
    values = {k: np.asarray(getattr(scene.material, k)) * v if k != "time_step" else v for k, v in changed.items()}
    return replace(scene, material=replace(scene.material, **values), reference={})


def without_data(scene: Scene) -> Scene:
    """Matrix and right-hand side alone."""
    return replace(scene, material=None, cell_volumes={}, cell_centers={}, cell_dimension=None, reference={})


def with_rhs_scaled(scene: Scene, factor: float) -> Scene:
    """A right-hand side times a number."""
    return replace(scene, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


def with_cells_of(scene: Scene, other: str, cells: list[int]) -> Scene:
    """See `with_rows_of`; the other scene by name."""
    return with_rows_of(scene, load(other), cells)


@dataclass(frozen=True, kw_only=True)
class StressCase:
    """One extreme scene.

    Attributes:
        name: of the case.
        group: heading under which it is listed.
        hard: what makes it hard, in a line.
        source: where it comes from, in words.
        make: the scene.
        singular: whether the matrix is singular, so that no solution or no single one exists.
        solvable: whether there is a solution, so that one that is handed on can be right.
    """

    name: str
    group: str
    hard: str
    source: str
    make: Callable[[], Scene]
    singular: bool = False
    solvable: bool = True

    @property
    def quick(self) -> bool:
        """Whether `--suite quick` has it."""
        return self.name in QUICK

    @property
    def held_out(self) -> bool:
        """Whether no threshold was chosen on it."""
        return self.group == HELD

    @classmethod
    def exported(cls, name: str, recipe: Recipe) -> StressCase:
        """A case that a PorePy model was exported for."""
        source = f"PorePy, {recipe.model}, step {recipe.step[0]}:{recipe.step[1]}"
        return cls(name=name, group=recipe.group, hard=recipe.hard, source=source, make=partial(load, name))


QUICK = (
    "base", "friction_0", "kn_1.2e20", "open", "sliding", "contact_constant_1e6", "permeability_1e-22", "lognormal",
    "poisson_0.4999", "stiffness_1e6", "biot_0", "no_storage", "undrained_saddle", "time_step_1e10", "slivers",
    "cut_through", "units_SI_base", "units_mm_h_base", "units_SI_flow", "zero_equation", "contradiction", "zero_rhs",
)  # fmt: skip


Change = Callable[[Scene], Scene]


def _transformed() -> list[StressCase]:
    """Cases made of other scenes."""
    rows: list[tuple[str, str, str, str, Change]] = []  # name, group, what is hard, scene, change

    systems: dict[str, dict[str, Any]] = {
        "SI": {}, "mm": {"m": 1e-3}, "h": {"s": 3600.0}, "mm_h": {"kg": 1e10, "m": 1e-3, "s": 3600.0},
        "km_year": {"kg": 1e10, "m": 1e3, "s": 3.156e7},
    }  # fmt: skip
    for label, units in systems.items():
        hard = f"units {', '.join(f'{k} = {v:g}' for k, v in ({'kg': 1.0, 'm': 1.0, 's': 1.0} | units).items())}"
        for base in ("base", "model1.h5", "model2.h5"):
            if base != "model2.h5" or label in ("mm", "h"):
                rows.append(
                    (f"units_{label}_{base.removesuffix('.h5')}", UNITS, hard, base, partial(in_units, **units))
                )
    # fmt: off
    for base in ("biot.h5", "flow.h5", "contact.h5", "three_planes"):
        rows.append((f"units_SI_{base.removesuffix('.h5')}", UNITS, "SI units", base, partial(in_units)))
    for base in ("flow", "biot"):
        change = partial(in_units, m=1e-3, s=3600.0)
        rows.append((f"units_mm_h_{base}", UNITS, "mm and hours", f"{base}.h5", change))
    for power in (-8, 8):
        factor = 10.0**power
        hides = "is all there is" if power > 0 else "hides behind the others"
        rows += [
            (f"traction_1e{power}", CONTACT, f"traction counted in units of 1e{-power}", "base",
             partial(scaled, columns={"contact": factor})),
            (f"contact_rows_1e{power}", ALGEBRA, f"contact conditions multiplied by 1e{power}", "base",
             partial(scaled, rows={"contact": factor})),
            (f"mass_rows_1e{power}", ALGEBRA, f"mass balance multiplied by 1e{power}: its residual {hides}", "base",
             partial(scaled, rows={"mass": factor})),
        ]
    rows += [
        ("force_rows_1e12", ALGEBRA, "balance of forces multiplied by 1e12: all other residuals hide", "base",
         partial(scaled, rows={"intf_force": 1e12, "momentum": 1e12})),
        ("flow_rows_scattered", ALGEBRA, "Darcy's law of each cell multiplied by a number, over 6 decades", "flow.h5",
         partial(scattered, field_name="intf_flow", decades=6)),
        ("mass_rows_scattered", ALGEBRA, "mass balance of each cell multiplied by a number, over 6 decades", "base",
         partial(scattered, field_name="mass", decades=6)),
        ("contact_rows_scattered", ALGEBRA, "contact conditions of each cell times a number, over 12 decades", "base",
         partial(scattered, field_name="contact", decades=12)),
        ("one_cell_slides", CONTACT, "all cells stick but one, which slides", "sticking",
         partial(with_cells_of, other="sliding", cells=[7])),
        ("one_cell_opens", CONTACT, "all cells stick but one, which is open", "sticking",
         partial(with_cells_of, other="open", cells=[7])),
        ("every_second_slides", CONTACT, "cells stick and slide in turn", "sticking",
         partial(with_cells_of, other="sliding", cells=list(range(0, 22, 2)))),
        ("nearly_singular_d22", CONTACT, "the interface block D_22 of one cell is 1e-13 of the others", "base",
         partial(with_block_of_cell, name="intf_force", cell=3, factor=1e-13)),
        ("nearly_zero_j44", FLOW, "one diagonal entry of J_44 is 1e-13 of the others", "base",
         partial(with_block_of_cell, name="intf_flow", cell=3, factor=1e-13)),
        ("zero_j44", FLOW, "one diagonal entry of J_44 is zero, the matrix is not singular", "base",
         partial(with_block_of_cell, name="intf_flow", cell=3, factor=0.0)),
        ("wrong_time_step", ALGEBRA, "material data with a time step 1e6 too long: fixed stress hardly acts", "base",
         partial(with_material, time_step=900.0 * 1e6)),
        ("wrong_stiffness", ALGEBRA, "material data with a stiffness 1e6 too small: fixed stress overwhelms", "base",
         partial(with_material, shear_modulus=1e-6, lame_lambda=1e-6)),
        ("without_data", ALGEBRA, "no material data, no geometry", "base", without_data),
        ("zero_rhs", ALGEBRA, "right-hand side zero", "base", partial(with_rhs)),
        ("only_mass_driven", ALGEBRA, "only the mass balance has a right-hand side", "base",
         partial(with_rhs, fields=("mass",))),
        ("only_contact_driven", ALGEBRA, "only the contact conditions have a right-hand side", "base",
         partial(with_rhs, fields=("contact",))),
        ("tiny_rhs", ALGEBRA, "right-hand side of 1e-150: absolute tolerances are met at once", "base",
         partial(with_rhs_scaled, factor=1e-150)),
        ("huge_rhs", ALGEBRA, "right-hand side of 1e160: squares overflow", "base",
         partial(with_rhs_scaled, factor=1e160)),
        ("small_rhs", ALGEBRA, "a late Newton step: right-hand side 1e-12 of the first", "base",
         partial(with_rhs_scaled, factor=1e-12)),
        ("zero_equation", ALGEBRA, "one equation is lost: singular", "base", partial(without_row, name="mass", row=5)),
        ("contradiction", ALGEBRA, "the same equation twice with different right-hand sides: no solution", "base",
         partial(with_row_twice, name="mass", consistent=False)),
        ("repetition", ALGEBRA, "the same equation twice: many solutions", "base",
         partial(with_row_twice, name="mass", consistent=True)),
    ]
    # fmt: on
    return [
        StressCase(
            name=name,
            group=group,
            hard=hard,
            source=f"{base}, {(change.func if isinstance(change, partial) else change).__name__}",
            make=partial(_changed, base, change),
            singular=name in ("zero_equation", "contradiction", "repetition"),
            solvable=name != "contradiction",
        )
        for name, group, hard, base, change in rows
    ]


def _changed(base: str, change: Change) -> Scene:
    return change(load(base))


SEED = 20250131
TRANSFORMED = 14
BASES = (
    "model1.h5", "model2.h5", "model3.h5", "biot.h5", "flow.h5", "contact.h5", "three_planes", "thirty_fractures",
    "acute_crossing", "lognormal", "near_touching", "friction_0.1", "cubic_law",
)  # fmt: skip
"""What is transformed: bundled scenes and exported ones."""


def drawn_changes(number: int) -> tuple[list[str], Change]:
    """The two or three random changes of a held-out case: in words, and what makes them."""

    def change(scene: Scene) -> Scene:
        random = np.random.default_rng([SEED, 1000 + number])
        for name in names(random):
            scene = CHANGES[name](scene, random)
        return scene

    def names(random: np.random.Generator) -> list[str]:
        shuffled = map(str, random.permutation(list(CHANGES)))
        return list(shuffled)[: int(random.integers(2, 4))]

    return names(np.random.default_rng([SEED, 1000 + number])), change


def _units(scene: Scene, random: np.random.Generator) -> Scene:
    kg, m, s = 10.0 ** random.uniform((0, -3, 0), (10, 3, 7))
    return in_units(scene, kg=float(kg), m=float(m), s=float(s))


def _rows(scene: Scene, random: np.random.Generator) -> Scene:
    return scaled(scene, rows={f: float(10.0 ** random.uniform(-4, 4)) for f in scene.fields})


def _columns(scene: Scene, random: np.random.Generator) -> Scene:
    return scaled(scene, columns={f: float(10.0 ** random.uniform(-6, 6)) for f in scene.fields})


def _scattered_rows(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    return scattered(scene, name, decades=float(random.uniform(1, 5)), seed=int(random.integers(2**31)))


def _scattered_columns(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    cells = scene.sizes[name] // scene.block_size(name)
    factors = 10.0 ** (random.uniform(1, 3) * (random.random(cells) - 0.5))
    return scaled(scene, columns={name: np.repeat(factors, scene.block_size(name))})


def _rhs(scene: Scene, random: np.random.Generator) -> Scene:
    rhs = {f: random.standard_normal(v.size) * (np.linalg.norm(v) or 1.0) for f, v in scene.rhs.items()}
    return replace(scene, rhs=rhs, reference={})


def _rhs_scaled(scene: Scene, random: np.random.Generator) -> Scene:
    factor = float(10.0 ** random.uniform(-60, 60))
    return with_rhs_scaled(scene, factor)


def _material(scene: Scene, random: np.random.Generator) -> Scene:
    if scene.material is None:
        return scene
    factor = float(10.0 ** random.uniform(-1, 1))
    return with_material(scene, shear_modulus=factor, lame_lambda=factor)


CHANGES: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "random units": _units,
    "equations of each field times a number over 8 decades": _rows,
    "unknowns of each field times a number over 12 decades": _columns,
    "equations of one field scattered over 1 to 5 decades": _scattered_rows,
    "unknowns of one field scattered over 1 to 3 decades": _scattered_columns,
    "random right-hand side": _rhs,
    "right-hand side times a number over 120 decades": _rhs_scaled,
    "stiffness that fixed stress is told off by up to 10": _material,
}


def held_out() -> list[StressCase]:
    """All held-out cases."""
    found = [StressCase.exported(name, recipe) for name, recipe in HELD_OUT.items()]
    for k in range(TRANSFORMED):
        base = BASES[k % len(BASES)]
        words, change = drawn_changes(k)
        found.append(
            StressCase(
                name=f"held_out_{base.removesuffix('.h5')}_{k:02}",
                group=HELD,
                hard="; ".join(words),
                source=f"{base}, random changes",
                make=partial(_changed, base, change),
            )
        )
    return found


def catalogue() -> list[StressCase]:
    """All cases but those held out, exported scenes first."""
    return [StressCase.exported(name, recipe) for name, recipe in RECIPES.items()] + _transformed()
