"""Models that PorePy comes with, with heat, wells, tracers and damage: the same states as with a direct solver."""

import numpy as np
import pytest

from petsc_fs.options import Facts, choose
from petsc_fs.porepy.direct import solve

pytestmark = pytest.mark.porepy
pp = pytest.importorskip("porepy", reason="PorePy is not installed")

from mpi4py import MPI  # noqa: E402
from porepy.applications.md_grids.model_geometries import (  # noqa: E402
    CubeDomainOrthogonalFractures,
    SquareDomainOrthogonalFractures,
)
from porepy.applications.test_utils import well_models  # noqa: E402

from petsc_fs.porepy import Adapter, FieldSplitSolver  # noqa: E402

TWO_FRACTURES = {"fracture_indices": [0, 1], "meshing_arguments": {"cell_size": 0.25}}


class Warm:
    """Warm and under pressure in the west; pressed in the north."""

    def bc_type_fluid_flux(self, sd):
        return pp.BoundaryCondition(sd, self.domain_boundary_sides(sd).all_bf, "dir")

    bc_type_darcy_flux = bc_type_fourier_flux = bc_type_enthalpy_flux = bc_type_fluid_flux

    def in_the_west(self, bg):
        return self.domain_boundary_sides(bg).west.astype(float)

    bc_values_temperature = bc_values_pressure = in_the_west

    def bc_values_displacement(self, bg):
        values = np.zeros((self.nd, bg.num_cells))
        values[1, self.domain_boundary_sides(bg).north] = -1e-3
        return values.ravel("F")


class Wells(well_models.OneVerticalWell, CubeDomainOrthogonalFractures, well_models.BoundaryConditionsWellSetup):
    """A well through a horizontal fracture."""


def tracer():
    return pytest.importorskip("porepy.examples.tracer_flow", reason="PorePy 1.10 has none").TracerFlowModel


def damage():
    from porepy.examples.fracture_damage import IsotropicFractureDamage

    return type("Damage", (SquareDomainOrthogonalFractures, IsotropicFractureDamage), {})


def damage_parameters():
    example = pytest.importorskip("porepy.examples.fracture_damage", reason="PorePy 1.10 has none")
    from porepy.compositional.materials import FractureDamageSolidConstants

    constants = example.solid_params | {"initial_friction_damage": 1.1, "initial_dilation_damage": 1.1}
    return example.model_params | {
        "exact_solution": example.ExactSolutionIsotropic,
        "material_constants": {"solid": FractureDamageSolidConstants(**constants)},
        "interface_displacement_parameter_values": example.model_params["interface_displacement_parameter_values"][:2],
    }


def mixed(*bases):
    return lambda: type("Mixed", bases, {})


IN_2D = (Warm, SquareDomainOrthogonalFractures)
WELL = {"fracture_indices": [2], "well_flux": -1e-2, "well_enthalpy": 1.0}
MODELS = {
    "heat": (mixed(*IN_2D, pp.MassAndEnergyBalance), TWO_FRACTURES, "intf_flow intf_fourier intf_enthalpy mass energy"),
    "heat_without_fractures": (mixed(*IN_2D, pp.MassAndEnergyBalance), {"fracture_indices": []}, "mass energy"),
    "rock": (mixed(*IN_2D, pp.Thermoporomechanics), {"fracture_indices": []}, "momentum mass energy"),
    "fractured_rock": (
        mixed(*IN_2D, pp.Thermoporomechanics),
        TWO_FRACTURES,
        "contact intf_force momentum intf_flow intf_fourier intf_enthalpy mass energy",
    ),
    "well": (mixed(Wells, pp.SinglePhaseFlow), WELL, "intf_flow well_flow mass"),
    "warm_well": (
        mixed(Wells, pp.MassAndEnergyBalance),
        WELL,
        "intf_flow intf_fourier intf_enthalpy well_flow well_enthalpy mass energy",
    ),
    "tracer": (tracer, TWO_FRACTURES, "intf_flow mass other_z_tracer"),
    "damage": (damage, None, "contact other_damage_history"),
}


def run(cls, parameters, mixin, tolerance):
    """The model, and its state and number of Newton steps at the end of each time step."""
    states = []

    class Watched(mixin, cls):
        def after_nonlinear_convergence(self):
            states.append(
                (
                    self.nonlinear_solver_statistics.num_iteration,
                    self.equation_system.get_variable_values(iterate_index=0),
                )
            )
            super().after_nonlinear_convergence()

    times = np.arange(3.0) * (0.1 if "exact_solution" not in parameters else 1.0)
    own = {"times_to_export": [], "time_manager": pp.TimeManager(times, times[1], constant_dt=True)}
    model = Watched(parameters | own)
    newton = {"nl_convergence_tol": np.inf, "nl_convergence_tol_res": tolerance, "max_iterations": 30}
    pp.run_time_dependent_model(model, {"progressbars": False} | newton)
    return model, states


class Direct:
    def solve_linear_system(self):
        return solve(*self.linear_system)


@pytest.mark.parametrize("name", MODELS)
def test_states_are_those_of_a_direct_solver(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    make, parameters, fields = MODELS[name]
    parameters = damage_parameters() if parameters is None else parameters
    tolerance = 1e-12 if "momentum" in fields else 1e-10  # that fixes the state to more digits than are compared
    (ours, found), (_, expected) = (run(make(), dict(parameters), how, tolerance) for how in (FieldSplitSolver, Direct))
    adapter = Adapter(ours)
    scene = adapter.scene()
    assert scene.fields == tuple(fields.split())
    assert len(found) == len(expected) == 2
    for (steps, state), (steps_there, exact) in zip(found, expected, strict=True):
        assert steps == steps_there
        ours_by_field = adapter.from_porepy(state)
        for field, values in adapter.from_porepy(exact).items():
            assert np.linalg.norm(ours_by_field[field] - values) <= 1e-6 * np.linalg.norm(values), field
    choice = choose(Facts.of(scene, MPI.COMM_SELF))
    others = [f for f in scene.fields if f.startswith("other_")]
    assert (f"no file has a place for {''.join(others)}: solved after all others, by ILU" in choice.left_out) == bool(
        others
    )
    assert all(len(centers) == scene.sizes[f] for f, centers in scene.cell_centers.items() if f in others)
