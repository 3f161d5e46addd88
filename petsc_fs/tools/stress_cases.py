"""The catalogue of extreme cases: how each scene is made, what makes it hard, and where it comes from.

Two kinds of scenes: those that PorePy exports by a `Recipe` (bundled in one file, `COLLECTION`, and made anew by
`scripts/stress_scenes`), and those that a function here makes of another one. A case names the one or the other.
"""

from __future__ import annotations

import io
import lzma
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

COLLECTION = Path(__file__).resolve().parent.parent / "scenes" / "stress" / "scenes.h5.xz"
"""Compressed HDF5 file of the exported scenes: a group for each, equal arrays stored once."""
HELD_OUT_COLLECTION = COLLECTION.with_name("held_out.h5.xz")
"""The same for the recipes of `petsc_fs.tools.stress_held_out`."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A linear system of a PorePy model with changed parameters.

    Attributes:
        hard: what makes it hard, in a line.
        group: heading under which it is listed.
        model: name in `petsc_fs.porepy.cases.CASES`.
        refinement: cells are 100 m / refinement wide.
        step: time step, from 1, and Newton step, from 0; the last one before it where Newton's method ends earlier.
        parameters: of `petsc_fs.porepy.cases.ModelParameters`.
        rock: of `petsc_fs.porepy.cases.Rock`; also `storage`, 1/M in 1/Pa.
        case: changes of `petsc_fs.porepy.cases.Case`.
        twist: changes that no parameter makes, see `petsc_fs.porepy.stress_export`.
    """

    hard: str
    group: str
    model: str = "model2"
    refinement: float = 0.3
    step: tuple[int, int] = (1, 1)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    rock: Mapping[str, Any] = field(default_factory=dict)
    case: Mapping[str, Any] = field(default_factory=dict)
    twist: Mapping[str, Any] = field(default_factory=dict)


def lame(ratio: float, shear_modulus: float = 1.2e10) -> dict[str, float]:
    """Lamé coefficients for a Poisson's ratio and a shear modulus, by default the model's."""
    return {"shear_modulus": shear_modulus, "lame_lambda": 2 * shear_modulus * ratio / (1 - 2 * ratio)}


def _stiffness(factor: float) -> dict[str, float]:
    return {"shear_modulus": 1.2e10 * factor, "lame_lambda": 1.2e10 * factor}


def opening(width: float) -> dict[str, float]:
    """Rock data for fractures of a width in m."""
    return {"residual_aperture": width, "fracture_gap": width, "maximum_elastic_fracture_opening": width / 2}


def _crosses(number: int) -> tuple[tuple[float, float, float, float], ...]:
    """Fractures along lines of a 10 by 10 grid that cross each other two by two."""
    found = []
    for k in range(number // 2):
        x, y = 0.1 + 0.2 * (k % 5), 0.2 + 0.3 * (k // 5)
        found += [(max(x - 0.1, 0.0), y, x + 0.1, y), (x, y - 0.1, x, y + 0.1)]
    return tuple(tuple(round(v, 1) for v in line) for line in found)  # type: ignore[misc]


CONTACT, FLOW, ROCK, TIME, SHAPE, UNITS, ALGEBRA = (
    "contact", "flow", "rock and coupling", "time", "geometry", "units", "algebra",
)  # fmt: skip

RECIPES: dict[str, Recipe] = {
    "base": Recipe(group=CONTACT, hard="nothing: the second Newton step of model 2, which the others vary"),
    "friction_0": Recipe(
        group=CONTACT, hard="no friction: tangential rows lose all traction of their own", parameters={"friction": 0.0}
    ),
    "friction_0.01": Recipe(
        group=CONTACT, hard="tangential rows nearly without traction", parameters={"friction": 0.01}
    ),
    "friction_0.1": Recipe(group=CONTACT, hard="most cells slide", parameters={"friction": 0.1}),
    "friction_0.8": Recipe(
        group=CONTACT, hard="high friction couples normal and tangential", parameters={"friction": 0.8}
    ),
    "friction_1.5": Recipe(
        group=CONTACT,
        hard="friction above 1: the tangential rows are dominated by normal traction",
        parameters={"friction": 1.5},
    ),
    "kn_0": Recipe(
        group=CONTACT, hard="rigid fracture walls: no elastic opening", parameters={"normal_stiffness": 0.0}
    ),
    "kn_1.2e5": Recipe(group=CONTACT, hard="walls 1e4 times softer", parameters={"normal_stiffness": 1.2e5}),
    "kn_1.2e12": Recipe(group=CONTACT, hard="walls 1e3 times stiffer", parameters={"normal_stiffness": 1.2e12}),
    "kn_1.2e16": Recipe(group=CONTACT, hard="walls 1e7 times stiffer", parameters={"normal_stiffness": 1.2e16}),
    "kn_1.2e20": Recipe(group=CONTACT, hard="walls 1e11 times stiffer", parameters={"normal_stiffness": 1.2e20}),
    "first_step": Recipe(group=CONTACT, step=(1, 0), hard="first Newton step: traction and jump are zero everywhere"),
    "flip_2": Recipe(group=CONTACT, step=(1, 2), hard="states flipped since the Newton step before"),
    "flip_3": Recipe(group=CONTACT, step=(2, 1), hard="second time step, second Newton step: states flipped once more"),
    "sticking": Recipe(
        group=CONTACT,
        hard="all cells stick: the contact block is singular everywhere",
        parameters={"friction": 100.0},
        case={"traction": 3e7},
    ),
    "sliding": Recipe(
        group=CONTACT, hard="all cells slide", parameters={"friction": 1e-4}, case={"traction": 3e6, "shear": 3e6}
    ),
    "open": Recipe(
        group=CONTACT,
        hard="all cells open: fractures carry no traction",
        case={"traction": -3e7, "pressure_ratio": 1.0},
    ),
    "contact_constant_1e-6": Recipe(
        group=CONTACT, hard="constant c of the contact conditions 1e6 times smaller", twist={"contact_constant": 1e-6}
    ),
    "contact_constant_1e6": Recipe(group=CONTACT, hard="constant c 1e6 times larger", twist={"contact_constant": 1e6}),
    "characteristic_displacement_1e-7": Recipe(
        group=CONTACT,
        hard="traction scaled 1e6 times smaller: its unknowns are 1e6 times larger",
        rock={"characteristic_displacement": 1e-7},
    ),
    "characteristic_displacement_1e5": Recipe(
        group=CONTACT,
        step=(1, 0),
        hard="traction scaled 1e6 times larger: its unknowns are 1e6 times smaller",
        rock={"characteristic_displacement": 1e5},
    ),
    "permeability_1e-22": Recipe(
        group=FLOW,
        model="model1",
        hard="rock all but impermeable: contrast to fractures 1e22",
        rock={"permeability": 1e-22},
    ),
    "permeability_1e-18": Recipe(
        group=FLOW, model="model1", hard="contrast of rock and fractures 1e18", rock={"permeability": 1e-18}
    ),
    "permeability_1e-8": Recipe(
        group=FLOW, model="model1", hard="rock like gravel: flow dominates storage", rock={"permeability": 1e-8}
    ),
    "uniform_permeability": Recipe(
        group=FLOW,
        model="model1",
        hard="fractures no better than rock",
        parameters={"fracture_permeability": "constant"},
    ),
    "cubic_law": Recipe(
        group=FLOW,
        model="model1",
        hard="fracture permeability follows the opening",
        parameters={"fracture_permeability": "cubic"},
    ),
    "normal_permeability_1e-18": Recipe(
        group=FLOW, model="model1", hard="fracture walls all but tight", rock={"normal_permeability": 1e-18}
    ),
    "normal_permeability_1e6": Recipe(
        group=FLOW, model="model1", hard="fracture walls without resistance", rock={"normal_permeability": 1e6}
    ),
    "lognormal": Recipe(
        group=FLOW,
        model="model1",
        hard="permeability scattered over 6 decades from cell to cell",
        twist={"lognormal": 6.0},
    ),
    "lognormal_12": Recipe(
        group=FLOW,
        model="model1",
        hard="permeability scattered over 12 decades from cell to cell",
        twist={"lognormal": 12.0},
    ),
    "aperture_1e-8": Recipe(
        group=FLOW,
        model="model1",
        hard="hairline fractures: cells of the fracture with a volume of 1e-8",
        parameters={"fracture_permeability": "cubic"},
        rock=opening(1e-8),
    ),
    "aperture_1e-1": Recipe(
        group=FLOW,
        model="model1",
        hard="wide fractures by the cubic law",
        parameters={"fracture_permeability": "cubic"},
        rock=opening(1e-1),
    ),
    "poisson_0.49": Recipe(
        group=ROCK,
        model="model1",
        step=(1, 0),
        hard="nearly incompressible rock, Poisson's ratio 0.49",
        rock=lame(0.49),
    ),
    "poisson_0.4999": Recipe(
        group=ROCK,
        model="model1",
        step=(1, 0),
        hard="nearly incompressible rock, Poisson's ratio 0.4999",
        rock=lame(0.4999),
    ),
    "stiffness_1e-6": Recipe(
        group=ROCK, model="model1", hard="rock like mud: E 1e6 times smaller", rock=_stiffness(1e-6)
    ),
    "stiffness_1e6": Recipe(group=ROCK, model="model1", step=(1, 0), hard="E 1e6 times larger", rock=_stiffness(1e6)),
    "biot_0": Recipe(
        group=ROCK,
        model="model1",
        step=(1, 0),
        hard="Biot coefficient 0: rock and flow act one way only, through fractures",
        rock={"biot_coefficient": 0.0, "storage": 1e-11},
    ),
    "biot_1e-3": Recipe(
        group=ROCK,
        model="model1",
        step=(1, 0),
        hard="Biot coefficient 1e-3, less than the porosity: 1/M by the usual formula is negative",
        rock={"biot_coefficient": 1e-3, "storage": 1e-11},
    ),
    "biot_1": Recipe(
        group=ROCK, model="model1", hard="Biot coefficient 1: 1/M vanishes", rock={"biot_coefficient": 1.0}
    ),
    "incompressible_fluid": Recipe(
        group=ROCK, model="model1", hard="incompressible fluid, c_f = 0", rock={"fluid_compressibility": 0.0}
    ),
    "no_storage_of_rock": Recipe(group=ROCK, model="model1", hard="1/M = 0", rock={"storage": 0.0}),
    "no_storage": Recipe(
        group=ROCK,
        model="model1",
        hard="c_f = 0 and 1/M = 0: the pressure block loses its storage",
        rock={"biot_coefficient": 1.0, "fluid_compressibility": 0.0},
    ),
    "no_storage_tight": Recipe(
        group=ROCK,
        model="model1",
        hard="no storage and no permeability: a saddle point",
        rock={"biot_coefficient": 1.0, "fluid_compressibility": 0.0, "permeability": 1e-22},
    ),
    "time_step_1e-6": Recipe(
        group=TIME, model="model1", hard="time step of 1e-6 s: undrained", case={"time_step": 1e-6}
    ),
    "time_step_1": Recipe(group=TIME, model="model1", hard="time step of 1 s", case={"time_step": 1.0}),
    "time_step_1e6": Recipe(group=TIME, model="model1", hard="time step of 1e6 s", case={"time_step": 1e6}),
    "time_step_1e10": Recipe(
        group=TIME, model="model1", hard="time step of 1e10 s: steady flow", case={"time_step": 1e10}
    ),
    "undrained_saddle": Recipe(
        group=TIME,
        model="model1",
        hard="time step of 1e-6 s without storage: the pressure block nearly vanishes",
        case={"time_step": 1e-6},
        rock={"biot_coefficient": 1.0, "fluid_compressibility": 0.0},
    ),
    "slivers": Recipe(
        group=SHAPE,
        step=(1, 0),
        model="model1",
        hard="domain 1 km by 1 m: cells of aspect ratio 1e3",
        twist={"squeezed": 1e-3},
    ),
    "near_parallel": Recipe(
        group=SHAPE,
        hard="two fractures half a degree and 10 m apart",
        case={"fractures": ((0.4, 0.5, 0.6, 0.5), (0.4, 0.51, 0.6, 0.512))},
    ),
    "near_touching": Recipe(
        group=SHAPE,
        hard="a gap of 2 m between two fractures",
        case={"fractures": ((0.2, 0.5, 0.5, 0.5), (0.502, 0.5, 0.8, 0.6))},
    ),
    "acute_crossing": Recipe(
        group=SHAPE,
        hard="two fractures crossing at less than two degrees",
        case={"fractures": ((0.46, 0.5, 0.54, 0.5), (0.46, 0.4985, 0.54, 0.5015))},
    ),
    "one_cell": Recipe(group=SHAPE, hard="a fracture of one cell", case={"fractures": ((0.5, 0.5, 0.53, 0.5),)}),
    "at_boundary": Recipe(
        group=SHAPE,
        step=(1, 0),
        hard="a fracture that ends on the boundary",
        case={"fractures": ((0.0, 0.5, 0.5, 0.5),)},
    ),
    "cut_through": Recipe(
        group=SHAPE,
        hard="a fracture through the whole domain: one half is held by contact alone",
        case={"fractures": ((0.0, 0.5, 1.0, 0.5),)},
    ),
    "thirty_fractures": Recipe(
        group=SHAPE,
        refinement=1.0,
        twist={"cartesian": True},
        hard="30 fractures with 15 intersections",
        case={"fractures": _crosses(30)},
    ),
    "three_planes": Recipe(
        group=SHAPE,
        model="model3",
        refinement=0.2,
        step=(1, 1),
        twist={"planes": True},
        hard="3D, three lines of intersection that meet in a point",
    ),
}
"""Name of an exported scene to what it is made by."""


@cache
def _collection(path: Path) -> Any:
    """The exported scenes, as an open HDF5 file in memory."""
    import h5py

    try:
        return h5py.File(io.BytesIO(lzma.decompress(path.read_bytes())), "r")
    except (OSError, lzma.LZMAError) as e:
        raise SceneError(f"{path}: cannot be read ({e}); make it anew with scripts/stress_scenes") from e


def load(name: str) -> Scene:
    """A scene by name: of a recipe, or of a bundled file such as `model1.h5`.

    Raises:
        SceneError: there is none.
    """
    if name.endswith(".h5"):
        return hdf5.read(COLLECTION.parent.parent / name)
    path = COLLECTION if name in RECIPES else HELD_OUT_COLLECTION
    file = _collection(path)
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
        parts = [(b, keep) for b, keep in ((mine, ~taken), (theirs, taken)) if b is not None]
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
        row = np.repeat(np.arange(n), np.diff(block.indptr))
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
    row = np.repeat(np.arange(scene.sizes[name]), np.diff(block.indptr))
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


@dataclass(frozen=True, kw_only=True)
class StressCase:
    """One extreme scene.

    Attributes:
        name: of the case.
        group: heading under which it is listed.
        hard: what makes it hard, in a line.
        source: where it comes from, in words.
        make: the scene.
        quick: whether `--suite quick` has it.
        singular: whether the matrix is singular, so that no solution or no single one exists.
        solvable: whether there is a solution, so that one that is handed on can be right.
        held_out: whether no threshold was chosen on it, see `petsc_fs.tools.stress_held_out`.
    """

    name: str
    group: str
    hard: str
    source: str
    make: Callable[[], Scene]
    quick: bool = False
    singular: bool = False
    solvable: bool = True
    held_out: bool = False


QUICK = (
    "base", "friction_0", "kn_1.2e20", "open", "sliding", "contact_constant_1e6", "permeability_1e-22", "lognormal",
    "poisson_0.4999", "stiffness_1e6", "biot_0", "no_storage", "undrained_saddle", "time_step_1e10", "slivers",
    "cut_through", "units_SI_base", "units_mm_h_base", "units_SI_flow", "zero_equation", "contradiction", "zero_rhs",
)  # fmt: skip


def _transformed() -> list[StressCase]:
    """Cases made of other scenes."""
    found: list[StressCase] = []

    def add(  # noqa: PLR0917
        name: str,
        group: str,
        hard: str,
        base: str,
        change: Callable[[Scene], Scene],
        singular: bool = False,
        solvable: bool = True,
    ) -> None:
        words = f"{base}, {(change.func if isinstance(change, partial) else change).__name__.strip('<>')}"
        found.append(
            StressCase(
                name=name, group=group, hard=hard, source=words, make=lambda: change(load(base)), quick=name in QUICK,
                singular=singular, solvable=solvable,
            )
        )  # fmt: skip

    systems: dict[str, dict[str, float]] = {
        "SI": {}, "mm": {"m": 1e-3}, "h": {"s": 3600.0}, "mm_h": {"kg": 1e10, "m": 1e-3, "s": 3600.0},
        "km_year": {"kg": 1e10, "m": 1e3, "s": 3.156e7},
    }  # fmt: skip
    for label, units in systems.items():
        hard = f"units {', '.join(f'{k} = {v:g}' for k, v in ({'kg': 1.0, 'm': 1.0, 's': 1.0} | units).items())}"
        for base in ("base", "model1.h5", "model2.h5"):
            if base != "model2.h5" or label in ("mm", "h"):
                add(f"units_{label}_{base.removesuffix('.h5')}", UNITS, hard, base, partial(in_units, **units))  # type: ignore[arg-type]
    for base in ("biot.h5", "flow.h5", "contact.h5", "three_planes"):
        add(f"units_SI_{base.removesuffix('.h5')}", UNITS, "SI units", base, partial(in_units))
    add("units_mm_h_flow", UNITS, "mm and hours", "flow.h5", partial(in_units, m=1e-3, s=3600.0))
    add("units_mm_h_biot", UNITS, "mm and hours", "biot.h5", partial(in_units, m=1e-3, s=3600.0))
    for power in (-8, 8):
        add(
            f"traction_1e{power}", CONTACT, f"traction counted in units of 1e{-power}", "base",
            partial(scaled, columns={"contact": 10.0**power}),
        )  # fmt: skip
        add(
            f"contact_rows_1e{power}", ALGEBRA, f"contact conditions multiplied by 1e{power}", "base",
            partial(scaled, rows={"contact": 10.0**power}),
        )  # fmt: skip
        add(
            f"mass_rows_1e{power}", ALGEBRA, f"mass balance multiplied by 1e{power}: its residual "
            + ("is all there is" if power > 0 else "hides behind the others"), "base",
            partial(scaled, rows={"mass": 10.0**power}),
        )  # fmt: skip
    add("force_rows_1e12", ALGEBRA, "balance of forces multiplied by 1e12: all other residuals hide", "base",
        partial(scaled, rows={"intf_force": 1e12, "momentum": 1e12}))  # fmt: skip
    add("flow_rows_scattered", ALGEBRA, "Darcy's law of each cell multiplied by a number, over 6 decades", "flow.h5",
        partial(scattered, field_name="intf_flow", decades=6))  # fmt: skip
    add("mass_rows_scattered", ALGEBRA, "mass balance of each cell multiplied by a number, over 6 decades", "base",
        partial(scattered, field_name="mass", decades=6))  # fmt: skip
    add("contact_rows_scattered", ALGEBRA, "contact conditions of each cell multiplied by a number, over 12 decades",
        "base", partial(scattered, field_name="contact", decades=12))  # fmt: skip
    for name, other, hard in (
        ("one_cell_slides", "sliding", "all cells stick but one, which slides"),
        ("one_cell_opens", "open", "all cells stick but one, which is open"),
    ):
        add(name, CONTACT, hard, "sticking",
            partial(_one_from, other=other, cells=[7]))  # fmt: skip
    add("every_second_slides", CONTACT, "cells stick and slide in turn", "sticking",
        partial(_one_from, other="sliding", cells=list(range(0, 22, 2))))  # fmt: skip
    add("nearly_singular_d22", CONTACT, "the interface block D_22 of one cell is 1e-13 of the others", "base",
        partial(with_block_of_cell, name="intf_force", cell=3, factor=1e-13))  # fmt: skip
    add("nearly_zero_j44", FLOW, "one diagonal entry of J_44 is 1e-13 of the others", "base",
        partial(with_block_of_cell, name="intf_flow", cell=3, factor=1e-13))  # fmt: skip
    add("zero_j44", FLOW, "one diagonal entry of J_44 is zero, the matrix is not singular", "base",
        partial(with_block_of_cell, name="intf_flow", cell=3, factor=0.0))  # fmt: skip
    add("wrong_time_step", ALGEBRA, "material data with a time step 1e6 too long: fixed stress hardly acts", "base",
        partial(with_material, time_step=900.0 * 1e6))  # fmt: skip
    add("wrong_stiffness", ALGEBRA, "material data with a stiffness 1e6 too small: fixed stress overwhelms", "base",
        partial(with_material, shear_modulus=1e-6, lame_lambda=1e-6))  # fmt: skip
    add("without_data", ALGEBRA, "no material data, no geometry", "base", without_data)
    add("zero_rhs", ALGEBRA, "right-hand side zero", "base", partial(with_rhs))
    add(
        "only_mass_driven",
        ALGEBRA,
        "only the mass balance has a right-hand side",
        "base",
        partial(with_rhs, fields=("mass",)),
    )
    add("only_contact_driven", ALGEBRA, "only the contact conditions have a right-hand side", "base",
        partial(with_rhs, fields=("contact",)))  # fmt: skip
    add("tiny_rhs", ALGEBRA, "right-hand side of 1e-150: absolute tolerances are met at once", "base",
        partial(_all_rhs, factor=1e-150))  # fmt: skip
    add("huge_rhs", ALGEBRA, "right-hand side of 1e150: squares overflow", "base", partial(_all_rhs, factor=1e160))
    add("small_rhs", ALGEBRA, "a late Newton step: right-hand side 1e-12 of the first, near the absolute tolerance",
        "base", partial(_all_rhs, factor=1e-12))  # fmt: skip
    add("zero_equation", ALGEBRA, "one equation is lost: singular", "base",
        partial(without_row, name="mass", row=5), singular=True)  # fmt: skip
    add("contradiction", ALGEBRA, "the same equation twice with different right-hand sides: no solution", "base",
        partial(with_row_twice, name="mass", consistent=False), singular=True, solvable=False)  # fmt: skip
    add("repetition", ALGEBRA, "the same equation twice: many solutions", "base",
        partial(with_row_twice, name="mass", consistent=True), singular=True)  # fmt: skip
    return found


def _one_from(scene: Scene, other: str, cells: list[int]) -> Scene:
    return with_rows_of(scene, load(other), cells)


def _all_rhs(scene: Scene, factor: float) -> Scene:
    return replace(scene, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


def exported(name: str, recipe: Recipe, *, quick: bool = False, held_out: bool = False) -> StressCase:
    """A case that a PorePy model was exported for."""
    source = f"PorePy, {recipe.model}, step {recipe.step[0]}:{recipe.step[1]}"
    return StressCase(
        name=name,
        group=recipe.group,
        hard=recipe.hard,
        source=source,
        make=partial(load, name),
        quick=quick,
        held_out=held_out,
    )


def catalogue() -> list[StressCase]:
    """All cases, exported scenes first."""
    return [exported(name, recipe, quick=name in QUICK) for name, recipe in RECIPES.items()] + _transformed()
