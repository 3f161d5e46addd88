# mypy: disallow-subclassing-any=False
"""The models as ordinary PorePy models; they work with PorePy 1.10 and 1.11.

    model = make_model("model1", refinement=2)
    run(model, on_newton_step=lambda model, solution: ...)

`model1` to `model3` are those of the paper (Zabegaev et al., arXiv:2501.07441); `biot` is model 1
without its fracture, `flow` and `contact` are the two halves of the physics on the fractures of
model 2. `cold2` and `cold3` inject cold water into the fractures of models 2 and 3.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SolveError, UsageError
from petsc_fs.porepy import require_porepy
from petsc_fs.porepy.cases import (
    CASES,
    CELL,
    CONTACT_SCALING,
    MASS_UNIT,
    ROCK,
    SIDE,
    Case,
    ModelParameters,
    Rock,
    find_case,
)

require_porepy()

import porepy as pp  # noqa: E402
from porepy.models import solution_strategy  # noqa: E402
from porepy.numerics.nonlinear import line_search  # noqa: E402

Floats = NDArray[np.float64]
NewtonHook = Callable[[Any, Floats], None]
LinearSolve = Callable[[Any], Floats]

CONSTANTS_ARE_METHODS = hasattr(pp, "FluidConstants")
"""PorePy 1.10 has its material constants as methods, later releases as attributes."""

NEWTON = {
    "progressbars": False,
    "nl_convergence_tol": float("inf"),
    "nl_divergence_tol": 1e8,
    "Global_line_search": 1,
    "Local_line_search": 1,
}
"""Newton settings of the paper's runs; number of iterations and tolerance are those of the case."""


class StopRun(Exception):
    """Raised by a hook to end a run early."""


class ConstraintLineSearch(
    line_search.ConstraintLineSearch,
    line_search.SplineInterpolationLineSearch,
    line_search.LineSearchNewtonSolver,
):
    """Newton with a line search on the residual and on the contact constraints."""


class NoFiles(pp.SolutionStrategy):
    """Keep PorePy from writing into the working directory."""

    def initialize_data_saving(self) -> None:
        """No exporter."""

    def save_data_time_step(self) -> None:
        """Nothing to save."""

    def set_geometry(self) -> None:
        """Mesh with gmsh, whose files go to a temporary directory."""
        with tempfile.TemporaryDirectory() as directory:
            mesh = Path(directory) / "mesh"  # up to PorePy 1.11 a string
            self.params["meshing_kwargs"] = {"file_name": mesh if hasattr(pp.ad, "ad_utils") else str(mesh)}
            super().set_geometry()


class VtuExport(pp.SolutionStrategy):
    """Write the state after each time step for ParaView, by PorePy's exporter; undoes `NoFiles`.

    In SI units, with the contact state of each fracture cell. The parameters `folder_name` and `file_name` say where.
    """

    def initialize_data_saving(self) -> None:
        """Make the exporter."""
        self.exporter = pp.Exporter(
            self.mdg, self.params["file_name"], folder_name=self.params["folder_name"], length_scale=self.units.m
        )

    def save_data_time_step(self) -> None:
        """Write one file per grid dimension, and the list of times."""
        self.exporter.write_vtu(self.data_to_export(), time_dependent=True)
        self.time_manager.exported_times.append(self.time_manager.time)
        self.exporter.write_pvd(times=np.array(self.time_manager.exported_times))

    def data_to_export(self) -> list[Any]:
        """Data per grid, as PorePy's exporter takes them."""
        data: list[Any] = super().data_to_export()
        if hasattr(self, "contact_traction_variable"):
            from petsc_fs.porepy.adapter import contact_state

            fractures = self.mdg.subdomains(dim=self.nd - 1)
            data += [(sd, "contact_state", contact_state(self, [sd])) for sd in fractures]
        return data


class CaseGeometry(pp.ModelGeometry):
    """Square or cube with the fractures of the case."""

    case: Case

    def set_domain(self) -> None:
        """The domain has edge length `SIDE` and a corner in the origin."""
        axes = "xyz"[: self.case.dimension]
        self._domain = pp.Domain({f"{a}{m}": v for a in axes for m, v in (("min", 0.0), ("max", SIDE))})

    def set_fractures(self) -> None:
        """Lines in 2D, upright rectangles in 3D."""
        low, high = self.case.extent
        self._fractures: list[Any] = []
        for x0, y0, x1, y1 in self.case.fractures:
            if self.case.dimension == 2:
                self._fractures.append(pp.LineFracture(SIDE * np.array([[x0, x1], [y0, y1]])))
            else:
                corners = np.array([[x0, x0, x1, x1], [y0, y0, y1, y1], [low, high, high, low]])
                self._fractures.append(pp.PlaneFracture(SIDE * corners))


class MechanicsLoads(pp.SolutionStrategy):
    """South is held; the other sides carry the traction of the case."""

    case: Case

    def bc_type_mechanics(self, sd: Any) -> Any:
        """Displacement is given on the south side and on fracture faces."""
        sides = self.domain_boundary_sides(sd)
        held = sides.south | sides.north if self.case.opening is not None else sides.south
        bc = pp.BoundaryConditionVectorial(sd, held, "dir")
        bc.internal_to_dirichlet(sd)
        return bc

    def bc_values_stress(self, bg: Any) -> Floats:
        """Traction times face area, all components of a face together."""
        sides = self.domain_boundary_sides(bg)
        pressure = _scaled(self, self.case.traction, "Pa") * bg.cell_volumes
        shear = _scaled(self, self.case.shear, "Pa") * bg.cell_volumes
        values = np.zeros((self.nd, bg.num_cells))
        inward = [(0, sides.west, 1), (0, sides.east, -1), (1, sides.north, -1)]
        if self.nd == 3:
            inward += [(2, sides.bottom, 1), (2, sides.top, -1)]
        for component, side, sign in inward:
            values[component, side] = sign * pressure[side]
        values[0, sides.north] = shear[sides.north]
        return values.ravel("F")

    def bc_values_displacement(self, bg: Any) -> Floats:
        """Zero in the south; a shear and a tilt that grow with time in the north."""
        values = np.zeros((self.nd, bg.num_cells))
        if self.case.opening is not None:
            north = self.domain_boundary_sides(bg).north
            end = self.case.opening * self.time_manager.time / self.time_manager.time_final
            values[0, north] = end
            values[1, north] = end * (bg.cell_centers[0, north] / SIDE - 0.5)
        return values.ravel("F")


class ContactConstant(pp.SolutionStrategy):
    """The numerical constant c of the contact conditions is that of the published runs."""

    def contact_mechanics_numerical_constant(self, subdomains: list[Any]) -> Any:
        """C as an AD operator, per unit of displacement."""
        constant = pp.ad.Scalar(CONTACT_SCALING) / self.characteristic_displacement(subdomains)
        constant.set_name("contact_mechanics_numerical_constant")
        return constant


class FlowLoads(pp.SolutionStrategy):
    """Pressure is given on all sides, higher in the east; it starts at the reference pressure."""

    case: Case
    parameters: ModelParameters
    rock: Rock = ROCK

    def bc_type_fluid_flux(self, sd: Any) -> Any:
        """Pressure, and with it density and mobility, are given on all sides."""
        return pp.BoundaryCondition(sd, self.domain_boundary_sides(sd).all_bf, "dir")

    def bc_values_pressure(self, bg: Any) -> Floats:
        """Reference pressure, in the east times the ratio of the case."""
        values = np.full(bg.num_cells, _scaled(self, self.rock.reference_pressure, "Pa"))
        values[self.domain_boundary_sides(bg).east] *= _pressure_ratio(self.case, self.parameters)
        return values

    def initial_condition(self) -> None:
        """Reference pressure everywhere."""
        super().initial_condition()
        _start_with(self, self.pressure_variable, _scaled(self, self.rock.reference_pressure, "Pa"))


class ColdInjection(pp.SolutionStrategy):
    """Cold water flows into a fracture; the border keeps the temperature that everything starts with."""

    case: Case
    rock: Rock = ROCK

    def bc_type_fourier_flux(self, sd: Any) -> Any:
        """Temperature is given on all sides."""
        return pp.BoundaryCondition(sd, self.domain_boundary_sides(sd).all_bf, "dir")

    def bc_type_enthalpy_flux(self, sd: Any) -> Any:
        """Temperature is given on all sides."""
        return pp.BoundaryCondition(sd, self.domain_boundary_sides(sd).all_bf, "dir")

    def bc_values_temperature(self, bg: Any) -> Floats:
        """Reference temperature."""
        return np.full(bg.num_cells, _scaled(self, self.rock.reference_temperature, "K"))

    def initial_condition(self) -> None:
        """Reference temperature everywhere."""
        super().initial_condition()
        _start_with(self, self.temperature_variable, _scaled(self, self.rock.reference_temperature, "K"))

    def fluid_source(self, subdomains: list[Any]) -> Any:
        """Mass per time and cell."""
        return super().fluid_source(subdomains) + pp.ad.DenseArray(self._injected(subdomains))

    def energy_source(self, subdomains: list[Any]) -> Any:
        """Enthalpy per time and cell, counted from the reference temperature."""
        enthalpy = _scaled(self, -self.rock.fluid_heat_capacity * self.case.cooling, "J * kg^-1")
        return super().energy_source(subdomains) + pp.ad.DenseArray(enthalpy * self._injected(subdomains))

    def _injected(self, subdomains: list[Any]) -> Floats:
        """Mass per time and cell: all into the fracture cell that is nearest to the middle of the first fracture."""
        x0, y0, x1, y1 = self.case.fractures[0]
        middle = SIDE * np.array([(x0 + x1) / 2, (y0 + y1) / 2, sum(self.case.extent) / 2 * (self.nd == 3)])
        far = [
            np.linalg.norm(sd.cell_centers.T - middle, axis=1) + (0 if sd.dim == self.nd - 1 else np.inf)
            for sd in subdomains
        ]
        distance = np.concatenate(far) if far else np.zeros(0)
        found = np.zeros(distance.size)
        if np.isfinite(distance).any():
            found[np.argmin(distance)] = _scaled(self, self.case.injection, "kg * s^-1")
        return found


def _start_with(model: Any, variable: str, value: float) -> None:
    """Give an unknown the same value in all cells, at all times and iterates that are kept."""
    values = np.full(sum(sd.num_cells for sd in model.mdg.subdomains()), value)
    for which, indices in (("time_step", model.time_step_indices), ("iterate", model.iterate_indices)):
        for i in indices:
            model.equation_system.set_variable_values(values, variables=[variable], **{f"{which}_index": i})


class CasePermeability(pp.constitutive_laws.CubicLawPermeability):
    """Permeability of fractures and intersections as the parameters say."""

    case: Case
    parameters: ModelParameters

    def _lower_permeability(self, subdomains: list[Any]) -> Any:
        kind = self.parameters.fracture_permeability or self.case.fracture_permeability
        if kind == "constant" or self.parameters.physics == "restricted":
            return self.matrix_permeability(subdomains)
        if kind == "cubic":
            return self.cubic_law_permeability(subdomains)
        one = pp.wrap_as_dense_ad_array(
            _scaled(self, 1.0, "m^2"), sum(sd.num_cells for sd in subdomains), name="permeability"
        )
        return self.isotropic_second_order_tensor(subdomains, one)

    def fracture_permeability(self, subdomains: list[Any]) -> Any:
        """Cell-wise tensor as an AD operator, nine numbers a cell."""
        return self._lower_permeability(subdomains)

    def intersection_permeability(self, subdomains: list[Any]) -> Any:
        """Cell-wise tensor as an AD operator, nine numbers a cell."""
        return self._lower_permeability(subdomains)


class RestrictedMass(pp.constitutive_laws.SpecificStorage):
    """Fluid mass linearised in pressure and displacement, where the parameters ask for it.

    In the rock rho_0 ((1/M + phi c_f) dp + alpha div u), in fractures rho_0 (a_0 c_f dp + a) with
    aperture a and residual aperture a_0; both per volume of the cell.
    """

    parameters: ModelParameters
    rock: Rock = ROCK

    def fluid_mass(self, subdomains: list[Any]) -> Any:
        """Mass per cell as an AD operator."""
        if self.parameters.physics == "full":
            return super().fluid_mass(subdomains)
        rock = [sd for sd in subdomains if sd.dim == self.nd]
        lower = [sd for sd in subdomains if sd.dim < self.nd]
        storage = (
            self.specific_storage(rock) + self.reference_porosity(rock) * self.fluid_compressibility(rock)
        ) * self.perturbation_from_reference("pressure", rock)
        deformation = self.porosity_change_from_displacement(rock) + self._mpsa_consistency(
            rock, self.darcy_keyword, self.pressure_variable
        )
        residual = self.rock.residual_aperture
        width = [np.full(sd.num_cells, residual ** (self.nd - sd.dim)) for sd in lower]
        compression = (
            pp.ad.DenseArray(np.concatenate(width) if width else np.zeros(0))
            * self.fluid_compressibility(lower)
            * self.perturbation_from_reference("pressure", lower)
        )
        projection = pp.ad.SubdomainProjections(subdomains, dim=1)
        volume = projection.cell_prolongation(rock) @ (storage + deformation)
        if lower:
            volume += projection.cell_prolongation(lower) @ (compression + self.specific_volume(lower))
        density = pp.ad.Scalar(_scaled(self, self.rock.fluid_density, "kg * m^-3"), "reference_fluid_density")
        mass = volume * self.wrap_grid_attribute(subdomains, "cell_volumes", dim=1) * density
        mass.set_name("fluid_mass")
        return mass


class PoromechanicsModel(
    NoFiles,
    CaseGeometry,
    MechanicsLoads,
    ContactConstant,
    FlowLoads,
    CasePermeability,
    RestrictedMass,
    solution_strategy.ContactIndicators,
    pp.poromechanics.Poromechanics,
):
    """Fluid mass, momentum and frictional contact."""


class ThermoporomechanicsModel(
    NoFiles,
    CaseGeometry,
    MechanicsLoads,
    ContactConstant,
    FlowLoads,
    ColdInjection,
    CasePermeability,
    solution_strategy.ContactIndicators,
    pp.thermoporomechanics.Thermoporomechanics,
):
    """Fluid mass, energy, momentum and frictional contact."""


class MechanicsModel(
    NoFiles,
    CaseGeometry,
    MechanicsLoads,
    ContactConstant,
    solution_strategy.ContactIndicators,
    pp.momentum_balance.MomentumBalance,
):
    """Momentum and frictional contact, without fluid."""


class FlowModel(NoFiles, CaseGeometry, FlowLoads, CasePermeability, pp.SinglePhaseFlow):
    """Fluid mass in rock and fractures that do not move."""


CLASSES: dict[str, type] = {
    "poromechanics": PoromechanicsModel,
    "thermoporomechanics": ThermoporomechanicsModel,
    "mechanics": MechanicsModel,
    "flow": FlowModel,
}


def make_model(
    name: str, parameters: ModelParameters | None = None, *, mixins: tuple[type, ...] = (), **changes: Any
) -> Any:
    """A model that is ready for `prepare_simulation`.

    Args:
        name: one of `MODELS`.
        parameters: what to vary; instead of them, keyword arguments of `ModelParameters`.
        mixins: classes to put before the model's own, such as `FieldSplitSolver`.
        changes: see `parameters`.

    Raises:
        UsageError: there is no such model or parameter.
    """
    case = find_case(name)
    if parameters is None:
        unknown = set(changes) - set(ModelParameters.__dataclass_fields__)
        if unknown:
            raise UsageError(
                f"unknown parameter {', '.join(sorted(unknown))}; "
                f"parameters are {', '.join(ModelParameters.__dataclass_fields__)}"
            )
        parameters = ModelParameters(**changes)
    elif changes:
        raise UsageError("make_model: give either `parameters` or keyword arguments")
    rock, own = parameters.rock or case.rock, CLASSES[case.equations]
    cls = type(own.__name__, (*mixins, own), {})
    changed = parameters.changes()
    end = case.time_step * case.time_steps
    model = cls(
        {
            "material_constants": _materials(rock, parameters),
            "grid_type": "simplex",
            "meshing_arguments": {"cell_size": CELL / parameters.refinement},
            "time_manager": pp.TimeManager(schedule=[0, end], dt_init=case.time_step, constant_dt=True, iter_max=25),
            "units": pp.Units(kg=MASS_UNIT),
            "linear_solver": "pypardiso" if find_spec("pypardiso") else "scipy_sparse",
            "adaptive_indicator_scaling": 1,
            "nl_convergence_tol": NEWTON["nl_convergence_tol"],
        }
        | _reference_values(rock)
    )
    model.case = case
    model.parameters, model.rock = parameters, rock
    model.scene_name = f"{name} ({changed})" if changed else name
    return model


MODELS: dict[str, Callable[..., Any]] = {name: partial(make_model, name) for name in CASES}
"""Name of a model to its factory; a factory takes the keyword arguments of `ModelParameters`."""


def run(
    model: Any,
    *,
    on_newton_step: NewtonHook | None = None,
    linear_solve: LinearSolve | None = None,
    **newton: Any,
) -> None:
    """Run a model to its end with the Newton settings of the paper.

    Args:
        model: from `make_model`; prepared here if it is not yet.
        on_newton_step: called after each linear solve with the model, whose `linear_system` is the
            one just solved, and the solution in PorePy's order. It may raise `StopRun`.
        linear_solve: replaces PorePy's direct solver; returns the solution in PorePy's order.
        newton: PorePy solver parameters, over those of `NEWTON`.

    Raises:
        SolveError: Newton did not converge.
    """
    if not hasattr(model, "equation_system"):
        model.prepare_simulation()
    own = {
        "max_iterations": model.case.newton_iterations,
        "nl_convergence_tol_res": model.case.newton_tolerance,
        # Flow has no contact constraints to search along.
        "nonlinear_solver": pp.NewtonSolver if isinstance(model, FlowModel) else ConstraintLineSearch,
        "prepare_simulation": False,
    }
    settings = own | NEWTON | newton
    with _hooked(model, on_newton_step, linear_solve):
        try:
            pp.run_time_dependent_model(model, settings)
        except StopRun:
            pass
        except ValueError as e:
            if "onverge" not in str(e):
                raise
            raise SolveError(
                f"{model.scene_name}: Newton did not converge in time step {model.time_manager.time_index} "
                f"within {settings['max_iterations']} iterations"
            ) from e


@contextmanager
def _hooked(model: Any, hook: NewtonHook | None, linear_solve: LinearSolve | None) -> Iterator[None]:
    """Have a model solve its linear systems in another way, and tell a hook, within a block."""
    solve = linear_solve or type(model).solve_linear_system

    def solve_linear_system() -> Floats:
        update: Floats = solve(model)
        if hook is not None:
            hook(model, update)
        return update

    model.solve_linear_system = solve_linear_system
    try:
        yield
    finally:
        del model.solve_linear_system


def _pressure_ratio(case: Case, parameters: ModelParameters) -> float:
    if parameters.pressure_ratio is not None:
        return parameters.pressure_ratio
    if parameters.physics == "restricted" and case.pressure_ratio_restricted is not None:
        return case.pressure_ratio_restricted
    return case.pressure_ratio


def _scaled(model: Any, value: float, units: str) -> float:
    """A number in SI units in those of the model."""
    converter = model.solid if CONSTANTS_ARE_METHODS else model.units
    return float(converter.convert_units(value, units))


def _materials(rock: Rock, parameters: ModelParameters) -> dict[str, Any]:
    """PorePy's `material_constants`."""
    names = (
        "shear_modulus", "lame_lambda", "biot_coefficient", "porosity", "density", "permeability",
        "normal_permeability", "dilation_angle", "residual_aperture", "fracture_gap", "specific_storage",
    )  # fmt: skip
    solid = {name: getattr(rock, name) for name in names} | {
        "friction_coefficient": parameters.friction,
        "fracture_normal_stiffness": parameters.normal_stiffness,
        "maximum_elastic_fracture_opening": (
            rock.maximum_elastic_fracture_opening if parameters.normal_stiffness else 0.0
        ),
        "specific_heat_capacity": rock.heat_capacity,
        "thermal_conductivity": rock.thermal_conductivity,
        "thermal_expansion": rock.thermal_expansion,
    }
    fluid = {
        "compressibility": rock.fluid_compressibility,
        "density": rock.fluid_density,
        "viscosity": rock.fluid_viscosity,
        "specific_heat_capacity": rock.fluid_heat_capacity,
        "thermal_conductivity": rock.fluid_thermal_conductivity,
        "thermal_expansion": rock.fluid_thermal_expansion,
    }
    if CONSTANTS_ARE_METHODS:
        # The tolerance is what later releases of PorePy have by default.
        contact = {"open_state_tolerance": 1e-10, "characteristic_displacement": rock.characteristic_displacement}
        return {
            "solid": pp.SolidConstants(solid | contact | {"temperature": rock.reference_temperature}),
            "fluid": pp.FluidConstants(
                fluid | {"pressure": rock.reference_pressure, "temperature": rock.reference_temperature}
            ),
        }
    return {
        "solid": pp.SolidConstants(**solid),
        "fluid": pp.FluidComponent(**fluid),
        "numerical": pp.NumericalConstants(characteristic_displacement=rock.characteristic_displacement),
    }


def _reference_values(rock: Rock) -> dict[str, Any]:
    """PorePy's `reference_variable_values`, which 1.10 keeps with the fluid instead."""
    if CONSTANTS_ARE_METHODS:
        return {}
    values = pp.ReferenceVariableValues(pressure=rock.reference_pressure, temperature=rock.reference_temperature)
    return {"reference_variable_values": values}
