# mypy: disable-error-code="import-untyped", disallow-subclassing-any=False
"""PorePy models of the problems of `petsc_fs.porepy.analytic`; they work with PorePy 1.10 and 1.11.

Cells are `1 / (CELLS g)` wide at refinement g, and consolidation takes `STEPS g` time steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.analytic import Consolidation, Mandel, Medium, SlidingFracture

require_porepy()

import porepy as pp  # noqa: E402
from porepy.models.derived_models.biot import BiotPoromechanics  # noqa: E402

from petsc_fs.porepy.adapter import evaluate  # noqa: E402
from petsc_fs.porepy.models import CONSTANTS_ARE_METHODS, NoFiles  # noqa: E402

Floats = NDArray[np.float64]

CELLS = 8
"""Cells along an edge of length 1 at refinement 1."""

STEPS = 4
"""Time steps at refinement 1."""

CHARACTERISTIC_DISPLACEMENT = 1e-3
"""Of the contact conditions; the scale of the slip."""


class Consolidating(NoFiles, BiotPoromechanics):
    """A square [0, 1]^2 with rollers on three sides, from an undrained state at t = 0."""

    exact: Consolidation | Mandel
    grid: str

    def set_domain(self) -> None:
        """The unit square."""
        self._domain = pp.Domain({"xmin": 0.0, "xmax": 1.0, "ymin": 0.0, "ymax": 1.0})

    def grid_type(self) -> str:
        """Of the model."""
        return self.grid

    def bc_type_darcy_flux(self, sd: Any) -> Any:
        """Pressure is given on the drained side, flux elsewhere."""
        return pp.BoundaryCondition(sd, getattr(self.domain_boundary_sides(sd), self.drained), "dir")

    bc_type_fluid_flux = bc_type_darcy_flux

    drained: str

    def bc_type_mechanics(self, sd: Any) -> Any:
        """Displacement in the directions `held` of a side, traction in the others."""
        sides = self.domain_boundary_sides(sd)
        bc = pp.BoundaryConditionVectorial(sd, sides.all_bf, "dir")
        for side in ("west", "east", "south", "north"):
            for component in {0, 1} - set(self.held.get(side, ())):
                bc.is_dir[component, getattr(sides, side)] = False
                bc.is_neu[component, getattr(sides, side)] = True
        return bc

    held: dict[str, tuple[int, ...]]

    def initial_condition(self) -> None:
        """Pressure and displacement at t = 0."""
        super().initial_condition()
        (sd,) = self.mdg.subdomains()
        values = {
            self.pressure_variable: self.exact_pressure(sd.cell_centers, 0.0),
            self.displacement_variable: self.exact_displacement(sd.cell_centers, 0.0).ravel("F"),
        }
        for name, value in values.items():
            for which, indices in (("time_step", self.time_step_indices), ("iterate", self.iterate_indices)):
                for i in indices:
                    self.equation_system.set_variable_values(value, variables=[name], **{f"{which}_index": i})

    def _is_nonlinear_problem(self) -> bool:
        return False

    def exact_pressure(self, points: Floats, t: float) -> Floats:
        """At (3, n) points."""
        raise NotImplementedError

    def exact_displacement(self, points: Floats, t: float) -> Floats:
        """(2, n) at (3, n) points."""
        raise NotImplementedError

    def errors(self) -> dict[str, float]:
        """Relative errors of pressure and displacement at this time, in L2."""
        (sd,) = self.mdg.subdomains()
        t, cells = self.time_manager.time, sd.cell_centers
        p = np.asarray(evaluate(self, self.pressure([sd])))
        u = np.asarray(evaluate(self, self.displacement([sd]))).reshape(2, -1, order="F")
        return {
            "pressure": _relative(p, self.exact_pressure(cells, t), sd.cell_volumes),
            "displacement": _relative(u, self.exact_displacement(cells, t), sd.cell_volumes),
        }


class ConsolidationModel(Consolidating):
    """`Consolidation`: the load on the north side, which is drained."""

    exact: Consolidation
    grid = "cartesian"
    drained = "north"
    held = {"west": (0,), "east": (0,), "south": (0, 1)}  # noqa: RUF012

    def bc_values_stress(self, bg: Any) -> Floats:
        """The load in the north."""
        values = np.zeros((2, bg.num_cells))
        north = self.domain_boundary_sides(bg).north
        values[1, north] = -self.exact.load * bg.cell_volumes[north]
        return values.ravel("F")

    def exact_pressure(self, points: Floats, t: float) -> Floats:
        """See `Consolidating`."""
        return self.exact.pressure(points[1], t)

    def exact_displacement(self, points: Floats, t: float) -> Floats:
        """See `Consolidating`."""
        return np.stack([np.zeros(points.shape[1]), self.exact.displacement(points[1], t)])


class MandelModel(Consolidating):
    """`Mandel`: one quarter of the slab; the plate moves as in the exact solution."""

    exact: Mandel
    grid = "simplex"
    drained = "east"
    held = {"west": (0,), "south": (1,), "north": (1,)}  # noqa: RUF012

    def bc_values_displacement(self, bg: Any) -> Floats:
        """Of the plate in the north."""
        values = np.zeros((2, bg.num_cells))
        north = self.domain_boundary_sides(bg).north
        values[1, north] = self.exact.displacement_y(bg.cell_centers[1, north], self.time_manager.time)
        return values.ravel("F")

    def exact_pressure(self, points: Floats, t: float) -> Floats:
        """See `Consolidating`."""
        return self.exact.pressure(points[0], t)

    def exact_displacement(self, points: Floats, t: float) -> Floats:
        """See `Consolidating`."""
        return np.stack([self.exact.displacement_x(points[0], t), self.exact.displacement_y(points[1], t)])


class SlidingFractureModel(NoFiles, pp.momentum_balance.MomentumBalance):
    """`SlidingFracture` in the middle of a square [-1, 1]^2 whose sides are moved as in the exact solution."""

    exact: SlidingFracture

    def set_domain(self) -> None:
        """A square of edge 2."""
        self._domain = pp.Domain({"xmin": -1.0, "xmax": 1.0, "ymin": -1.0, "ymax": 1.0})

    def set_fractures(self) -> None:
        """One line."""
        end = self.exact.half_length * np.array([np.cos(self.exact.angle), np.sin(self.exact.angle)])
        self._fractures = [pp.LineFracture(np.stack([-end, end], axis=1))]

    def grid_type(self) -> str:
        """Triangles."""
        return "simplex"

    def bc_values_displacement(self, bg: Any) -> Floats:
        """The exact displacement of all sides; zero on the fracture, where it is an unknown."""
        values = np.zeros((2, bg.num_cells))
        sides = self.domain_boundary_sides(bg).all_bf
        values[:, sides] = self.exact.displacement(*bg.cell_centers[:2, sides])
        return values.ravel("F")

    def errors(self) -> dict[str, float]:
        """Relative errors of slip and displacement, in L2."""
        (rock,) = self.mdg.subdomains(dim=2)
        fractures = self.mdg.subdomains(dim=1)
        slip = np.abs(evaluate(self, self.tangential_component(fractures) @ self.displacement_jump(fractures)))
        centers = np.concatenate([sd.cell_centers for sd in fractures], axis=1)
        lengths = np.concatenate([sd.cell_volumes for sd in fractures])
        u = np.asarray(evaluate(self, self.displacement([rock]))).reshape(2, -1, order="F")
        exact_slip = self.exact.slip(np.hypot(centers[0], centers[1]))
        return {
            "slip": _relative(slip, exact_slip, lengths),
            "displacement": _relative(u, self.exact.displacement(*rock.cell_centers[:2]), rock.cell_volumes),
        }


def make_consolidation(cls: type, exact: Consolidation | Mandel, end: float, refinement: float, **params: Any) -> Any:
    """A consolidation model that runs to the time `end`, ready for `prepare_simulation`."""
    steps = max(1, round(STEPS * refinement))
    constants = {"biot_coefficient": exact.medium.biot_coefficient, "specific_storage": exact.medium.storage}
    model = cls(
        {
            "material_constants": _materials(exact.medium, **constants, permeability=exact.medium.mobility),
            "meshing_arguments": {"cell_size": 1 / (CELLS * refinement)},
            "grid_type": cls.grid,  # type: ignore[attr-defined]
            "time_manager": pp.TimeManager(schedule=[0, end], dt_init=end / steps, constant_dt=True),
        }
        | params
    )
    model.exact = exact
    return model


def make_sliding(cls: type, exact: SlidingFracture, refinement: float, **params: Any) -> Any:
    """The model of a sliding fracture, one step, ready for `prepare_simulation`."""
    model = cls(
        {
            "material_constants": _materials(exact.medium, friction_coefficient=exact.friction),
            "meshing_arguments": {"cell_size": 1 / (CELLS * refinement)},
            "grid_type": "simplex",
            "time_manager": pp.TimeManager(schedule=[0, 1], dt_init=1, constant_dt=True),
        }
        | params
    )
    model.exact = exact
    return model


def _materials(medium: Medium, **more: float) -> dict[str, Any]:
    """PorePy's `material_constants`: all lengths, masses and times are numbers."""
    none = {"dilation_angle": 0.0, "fracture_gap": 0.0, "maximum_elastic_fracture_opening": 0.0}
    solid = {"shear_modulus": medium.shear_modulus, "lame_lambda": medium.lame_lambda, **none, **more}
    fluid = {"compressibility": 0.0, "density": 1.0, "viscosity": 1.0}
    if CONSTANTS_ARE_METHODS:
        contact = {"open_state_tolerance": 1e-10, "characteristic_displacement": CHARACTERISTIC_DISPLACEMENT}
        return {"solid": pp.SolidConstants(solid | contact), "fluid": pp.FluidConstants(fluid)}
    return {
        "solid": pp.SolidConstants(**solid),
        "fluid": pp.FluidComponent(**fluid),
        "numerical": pp.NumericalConstants(characteristic_displacement=CHARACTERISTIC_DISPLACEMENT),
    }


def _relative(values: Floats, exact: Floats, weights: Floats) -> float:
    return float(np.sqrt(np.sum(weights * (values - exact) ** 2) / np.sum(weights * exact**2)))
