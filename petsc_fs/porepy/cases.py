"""The set-up of each model as plain numbers, in SI units; porepy is not imported here."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

from petsc_fs.errors import UsageError

HOUR = 3600.0
DAY = 24 * HOUR
WEEK = 7 * DAY

SIDE = 1000.0
"""Edge length of the domain in m."""

CELL = 100.0
"""Cell size in m at refinement 1."""

MASS_UNIT = 1e10
"""Models count mass in this many kg, so that stiffness and permeability come closer to each other."""

CONTACT_SCALING = 0.1
"""Numerical constant c of the contact conditions, times the characteristic displacement.

It decides on which side of a maximum an iterate is, not what the solution is. 0.1 was the default
of the PorePy of the published runs; PorePy 1.11 has 1.
"""

Physics = Literal["full", "restricted"]
FracturePermeability = Literal["unit", "cubic", "constant"]
PHYSICS = get_args(Physics)
FRACTURE_PERMEABILITY = get_args(FracturePermeability)
PERMEABILITY_WORDS = {
    "unit": "1 m^2 as in the published code, not the cubic law",
    "cubic": "the cubic law, aperture^2 / 12",
    "constant": "that of the rock",
}


@dataclass(frozen=True, kw_only=True)
class Rock:
    """Solid, fluid and fracture constants shared by all models."""

    shear_modulus: float = 1.2e10
    lame_lambda: float = 1.2e10
    biot_coefficient: float = 0.47
    porosity: float = 1.3e-2
    density: float = 2683.0
    permeability: float = 1e-14
    normal_permeability: float = 1e-4
    dilation_angle: float = math.radians(5)
    residual_aperture: float = 1e-4
    fracture_gap: float = 1e-4
    maximum_elastic_fracture_opening: float = 5e-5
    characteristic_displacement: float = 0.1
    fluid_compressibility: float = 4.559e-10
    fluid_density: float = 998.2
    fluid_viscosity: float = 1.002e-3
    reference_pressure: float = 1e6
    reference_temperature: float = 393.15
    heat_capacity: float = 720.7
    thermal_conductivity: float = 0.1
    thermal_expansion: float = 9.66e-6
    fluid_heat_capacity: float = 4182.0
    fluid_thermal_conductivity: float = 0.5975
    fluid_thermal_expansion: float = 2.068e-4

    @property
    def specific_storage(self) -> float:
        """(alpha - phi)(1 - alpha) / (lambda + 2 G / 3), in 1/Pa."""
        bulk = self.lame_lambda + 2 / 3 * self.shear_modulus
        return (self.biot_coefficient - self.porosity) * (1 - self.biot_coefficient) / bulk


ROCK = Rock()
PERMEABLE_ROCK = Rock(permeability=1e-13, residual_aperture=1e-3, fracture_gap=1e-3, reference_pressure=5e6)
"""Which takes up water, and with it cold, faster."""

Segment = tuple[float, float, float, float]
"""x and y of the start, then of the end, of a fracture trace, as fractions of the domain."""

ONE_FRACTURE: tuple[Segment, ...] = ((0.2, 0.5, 0.8, 0.5),)
FOUR_FRACTURES: tuple[Segment, ...] = (
    (0.1, 0.5, 0.9, 0.5),
    (0.15, 0.7, 0.4, 0.2),
    (0.45, 0.3, 0.6, 0.8),
    (0.6, 0.2, 0.8, 0.8),
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """Geometry, loads and time of one model.

    Attributes:
        equations: "poromechanics", "thermoporomechanics", "mechanics" or "flow".
        dimension: of the domain, a square or cube of edge `SIDE`.
        fractures: traces in the x-y plane; in 3D they are extruded over `extent` in z.
        extent: lower and upper z of the fractures, as fractions of the domain.
        traction: compression on all sides but south, which is held, in Pa.
        shear: tangential traction on the north side, along x, in Pa.
        pressure_ratio: pressure on the east side over the reference pressure.
        pressure_ratio_restricted: the same with restricted physics.
        fracture_permeability: see `ModelParameters`.
        time_step: in s.
        time_steps: number of them.
        newton_iterations: at most so many a time step.
        newton_tolerance: of the residual, as PorePy measures it.
        opening: displacement of the north side where it is held too, in m at the end: `opening` along
            x and `opening` (x / SIDE - 1/2) along y, in proportion to time. None: north carries `traction`.
        injection: water that flows into the middle of the first fracture, in kg/s (in 2D per metre of depth).
        cooling: by how much it is colder than the rock, in K.
        rock: material constants.
    """

    equations: Literal["poromechanics", "thermoporomechanics", "mechanics", "flow"] = "poromechanics"
    dimension: int = 2
    fractures: tuple[Segment, ...] = ()
    extent: tuple[float, float] = (0.2, 0.8)
    traction: float = 0.0
    shear: float = 0.0
    pressure_ratio: float = 1.0
    pressure_ratio_restricted: float | None = None
    fracture_permeability: FracturePermeability = "unit"
    time_step: float
    time_steps: int = 6
    newton_iterations: int = 100
    newton_tolerance: float = 1e-7
    opening: float | None = None
    injection: float = 0.0
    cooling: float = 80.0
    rock: Rock = ROCK


COLD = Case(
    equations="thermoporomechanics",
    fractures=FOUR_FRACTURES,
    traction=1.2e7,
    fracture_permeability="cubic",
    time_step=HOUR,
    newton_tolerance=1e-10,
    injection=0.03,
    rock=PERMEABLE_ROCK,
)
"""Cold water into a network of fractures."""

CASES: dict[str, Case] = {
    "model1": Case(
        fractures=ONE_FRACTURE,
        traction=5e6,
        shear=5e5,
        pressure_ratio=13,
        pressure_ratio_restricted=10,
        time_step=0.5 * DAY,
        newton_iterations=50,
    ),
    "model2": Case(
        fractures=FOUR_FRACTURES,
        traction=3e6,
        pressure_ratio=10,
        time_step=0.25 * HOUR,
    ),
    "model3": Case(
        dimension=3,
        fractures=FOUR_FRACTURES,
        traction=3e6,
        shear=3e5,
        pressure_ratio=20,
        fracture_permeability="constant",
        time_step=0.25 * WEEK,
    ),
    "biot": Case(traction=5e6, shear=5e5, pressure_ratio=13, time_step=0.5 * DAY),
    "flow": Case(equations="flow", fractures=FOUR_FRACTURES, pressure_ratio=10, time_step=0.25 * HOUR),
    "contact": Case(
        equations="mechanics",
        fractures=FOUR_FRACTURES,
        traction=3e6,
        time_step=DAY,
        opening=0.5,
    ),
    "cold2": COLD,
    "cold3": replace(COLD, dimension=3, injection=20.0),
}
"""Name of a model to its set-up."""


@dataclass(frozen=True, kw_only=True)
class ModelParameters:
    """What can be varied in a model.

    Attributes:
        refinement: cells are `CELL` / refinement wide.
        friction: Coulomb coefficient F.
        normal_stiffness: K_n of the fractures in Pa/m; 0 also turns their elastic opening off.
        pressure_ratio: pressure on the east side over the reference pressure; None for the model's own.
        physics: "full", or "restricted" to a linearised fluid mass and constant permeability.
        fracture_permeability: "unit" (1 m^2, which is what the published runs of models 1 and 2
            solve), "cubic" (cubic law) or "constant" (as the rock); None for the model's own.
        rock: material constants; None for the model's own.
    """

    refinement: float = 1.0
    friction: float = 0.577
    normal_stiffness: float = 1.2e9
    pressure_ratio: float | None = None
    physics: Physics = "full"
    fracture_permeability: FracturePermeability | None = None
    rock: Rock | None = None

    def __post_init__(self) -> None:
        if not self.refinement > 0:
            raise UsageError(f"refinement: must be positive, found {self.refinement}")
        if not self.friction >= 0:
            raise UsageError(f"friction: must not be negative, found {self.friction}")
        if not self.normal_stiffness >= 0:
            raise UsageError(f"normal_stiffness: must not be negative, found {self.normal_stiffness}")
        if self.physics not in PHYSICS:
            raise UsageError(f"physics: expected one of {', '.join(PHYSICS)}, found {self.physics!r}")
        if self.fracture_permeability not in (None, *FRACTURE_PERMEABILITY):
            raise UsageError(
                f"fracture_permeability: expected one of {', '.join(FRACTURE_PERMEABILITY)}, "
                f"found {self.fracture_permeability!r}"
            )

    def changes(self) -> str:
        """The parameters that are not at their default, such as "refinement=2, friction=0.1"."""
        default = ModelParameters()
        names = [n for n in self.__dataclass_fields__ if getattr(self, n) != getattr(default, n)]
        return ", ".join(f"{n}={v:g}" if isinstance(v := getattr(self, n), float | int) else f"{n}={v}" for n in names)


def find_case(name: str) -> Case:
    """The set-up of a model.

    Raises:
        UsageError: there is no such model.
    """
    if name not in CASES:
        raise UsageError(f"unknown model {name!r}; models are {', '.join(CASES)}")
    return CASES[name]


def describe_permeability(scene_name: str) -> str:
    """Permeability of the fractures in a scene of one of the models, by the name that it has; "" for other scenes."""
    name, _, changes = scene_name.partition(" (")
    case = CASES.get(name)
    if case is None or not case.fractures or case.equations == "mechanics":
        return ""
    kinds = [kind for kind in FRACTURE_PERMEABILITY if f"fracture_permeability={kind}" in changes]
    return PERMEABILITY_WORDS["constant" if "restricted" in changes else (*kinds, case.fracture_permeability)[0]]
