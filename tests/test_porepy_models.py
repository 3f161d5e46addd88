"""Models that PorePy comes with, or tests itself with: the same states as with a direct solver."""

import logging
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import tests
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

THEIR_TESTS = Path(pp.__file__).parents[2] / "tests"

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


def run(cls, parameters, mixin, newton):
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

    model = Watched(parameters | {"times_to_export": []})
    pp.run_time_dependent_model(model, {"progressbars": False} | newton)
    return model, states


def assert_same(adapter, state, exact, zero=0.0):
    """In every field the same to six digits, or to a norm of `zero`."""
    ours = adapter.from_porepy(state)
    for field, values in adapter.from_porepy(exact).items():
        assert np.linalg.norm(ours[field] - values) <= max(1e-6 * np.linalg.norm(values), zero), field


def times(*schedule):
    return {"time_manager": pp.TimeManager(schedule, schedule[1], constant_dt=True)}


class Direct:
    def solve_linear_system(self):
        return solve(*self.linear_system)


@pytest.mark.parametrize("name", MODELS)
def test_states_are_those_of_a_direct_solver(tmp_path, monkeypatch, caplog, name):
    """Without a word of complaint, also where an increment is zero to rounding of the state, as in the warm well."""
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    make, parameters, fields = MODELS[name]
    parameters = damage_parameters() if parameters is None else parameters
    last = 2.0 if "exact_solution" in parameters else 0.2
    tolerance = 1e-12 if "momentum" in fields else 1e-10  # that fixes the state to more digits than are compared
    newton = {"nl_convergence_tol": np.inf, "nl_convergence_tol_res": tolerance, "max_iterations": 30}
    (ours, found), (_, expected) = (
        run(make(), parameters | times(0, last / 2, last), how, newton) for how in (FieldSplitSolver, Direct)
    )
    assert not [record for record in caplog.records if record.name == "petsc_fs"]
    adapter = Adapter(ours)
    scene = adapter.scene()
    assert scene.fields == tuple(fields.split())
    assert len(found) == len(expected) == 2
    for (steps, state), (steps_there, exact) in zip(found, expected, strict=True):
        assert steps == steps_there
        assert_same(adapter, state, exact)
    choice = choose(Facts.of(scene, MPI.COMM_SELF))
    others = [f for f in scene.fields if f.startswith("other_")]
    assert (f"no file has a place for {''.join(others)}: solved after all others, by ILU" in choice.left_out) == bool(
        others
    )
    assert all(len(centers) == scene.sizes[f] for f, centers in scene.cell_centers.items() if f in others)


def named(module, cls):
    """A class of PorePy's, which 1.10 calls Setup, not Model."""
    return getattr(module, cls, None) or getattr(module, cls.replace("Model", "Setup"))


def constants(fluid, solid):
    """Material constants for any supported PorePy."""
    if hasattr(pp, "FluidComponent"):
        return {"material_constants": {"fluid": pp.FluidComponent(**fluid), "solid": pp.SolidConstants(**solid)}}
    return {"material_constants": {"fluid": pp.FluidConstants(fluid), "solid": pp.SolidConstants(solid)}}


def example(name, cls, solid="solid_constants", **others):
    """A model of porepy.examples with the named solid."""

    def make():
        module = pytest.importorskip(f"porepy.examples.{name}", reason="PorePy 1.10 has it not")
        return named(module, cls), {"material_constants": {"solid": getattr(module, solid)}} | others

    return make


def consolidation(name, cls, schedule, **others):
    def make():
        module = import_module(f"porepy.examples.{name}_biot")
        given = constants(getattr(module, f"{name}_fluid_constants"), getattr(module, f"{name}_solid_constants"))
        return named(module, cls), given | times(*schedule) | others

    return make


def manufactured(name, cls, cell_size, parameters, **others):
    """A model of the tests of PorePy, which are beside it in a checkout only."""

    def make():
        if not (THEIR_TESTS / "functional" / "setups" / f"{name}.py").exists():
            pytest.skip("PorePy's tests are not beside it")
        module = import_module(f"tests.functional.setups.{name}")
        return named(module, cls), parameters() | {"meshing_arguments": {"cell_size": cell_size}} | others

    return make


def compressible():
    module = import_module("tests.functional.setups.manu_flow_comp_2d_frac")
    reference = {}
    if hasattr(module, "manu_comp_ref_vals"):
        reference["reference_variable_values"] = pp.ReferenceVariableValues(**module.manu_comp_ref_vals)
    return constants(module.manu_comp_fluid, module.manu_comp_solid) | reference | times(0, 0.5, 1)


def incompressible():
    module = import_module("tests.functional.setups.manu_flow_incomp_frac_2d")
    return constants(module.manu_incomp_fluid, module.manu_incomp_solid)


def deformed():
    given = constants({"compressibility": 0.02}, {"biot_coefficient": 0.5})
    return given | {"heterogeneity": 10.0} | times(0, 0.5, 1)


def pressurised():
    """A fracture under pressure in an elastic square."""
    return constants({}, {"shear_modulus": 1.0, "lame_lambda": 1.0}) | {
        "prepare_simulation": True,
        "a": 0.3,
        "domain_size": 1.0,
        "p0": 1e-4,
        "poi": 0.25,
        "theta_rad": np.pi / 3,
        "num_bem_segments": 200,
        "error_exclusion_zone_fracture_tips": 0.1,
    }


class Heavy(pp.constitutive_laws.GravityForce, Warm, CubeDomainOrthogonalFractures, pp.Poromechanics):
    """Three fractures that cross each other, under the weight of rock and water."""


def heavy(grid_type):
    def make():
        rock = {"biot_coefficient": 0.5, "permeability": 0.5, "residual_aperture": 1e-2}
        rock |= {"shear_modulus": 2e3, "lame_lambda": 2e3}
        return Heavy, constants({"compressibility": 1e-3}, rock) | {
            "fracture_indices": [0, 1, 2],
            "meshing_arguments": {"cell_size": 0.25},
            "grid_type": grid_type,
        } | times(0, 0.1, 0.2)

    return make


SHIPPED = {
    f"case_1_{kind}_{grid}": example(
        "flow_benchmark_2d_case_1",
        "FlowBenchmark2dCase1Model",
        f"solid_constants_{kind}_fractures",
        grid_type=grid,
        meshing_arguments={"cell_size": 0.05},
    )
    for kind in ("conductive", "blocking")
    for grid in ("simplex", "cartesian")
}
SHIPPED |= {
    f"case_3{part}_{scheme}": example(
        "flow_benchmark_2d_case_3",
        f"FlowBenchmark2dCase3{part}Model",
        grid_type="simplex",
        meshing_arguments={"cell_size": 0.1},
        flux_discretization=scheme,
    )
    for part in "ab"
    for scheme in ("tpfa", "mpfa")
}
SHIPPED |= {
    "case_4": example("flow_benchmark_2d_case_4", "FlowBenchmark2dCase4Model", meshing_arguments={"cell_size": 50.0}),
    "mandel": consolidation("mandel", "MandelModel", (0, 25, 50)),
    "mandel_mm_g": consolidation("mandel", "MandelModel", (0, 25, 50), units=pp.Units(m=1e-3, kg=1e-3)),
    "terzaghi": consolidation("terzaghi", "TerzaghiModel", (0, 0.05, 0.1), num_cells=20),
    "terzaghi_mm_g": consolidation("terzaghi", "TerzaghiModel", (0, 0.05, 0.1), units=pp.Units(m=1e-3, kg=1e-3)),
    "sneddon": manufactured("manu_sneddon_2d", "ManuSneddonModel2d", 0.06, pressurised, grid_type="simplex"),
    "heavy": heavy("cartesian"),
    "heavy_simplex": heavy("simplex"),
}
SHIPPED |= {
    f"{name}_{d}d_{grid}": manufactured(f"manu_{module.format(d)}", f"{cls}{d}d", 0.125, parameters, grid_type=grid)
    for name, module, cls, parameters in (
        ("poromechanics", "poromech_nofrac_{}d", "ManuPoroMechModel", deformed),
        ("thermoporomechanics", "thermoporomech_nofrac_{}d", "ManuThermoPoroMechModel", deformed),
        ("compressible", "flow_comp_{}d_frac", "ManuCompFlowModel", compressible),
        ("incompressible", "flow_incomp_frac_{}d", "ManuIncompFlowModel", incompressible),
    )
    for d, grid in ((2, "cartesian"), (2, "simplex"), (3, "cartesian"))
}


ONE_MORE = {"heavy"}
"""Models of which rounding says whether a time step takes one step more: with 1e-16 at random added to the updates of
the direct solver, the increment that decides is between 1.5e-11 and 7e-10, where 1e-10 is asked for."""


@pytest.mark.parametrize("name", SHIPPED)
def test_newton_takes_as_many_steps_to_the_same_state(tmp_path, monkeypatch, caplog, name):
    """By PorePy's own tolerance for increments, and without a word of complaint."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tests, "__path__", [*tests.__path__, str(THEIR_TESTS)])
    with caplog.at_level(logging.WARNING, "petsc_fs"):
        ours, found = run(*SHIPPED[name](), FieldSplitSolver, {})
    assert not [record for record in caplog.records if record.name == "petsc_fs"]
    assert len(ours.linear_solves) == sum(steps for steps, _ in found) > 0
    direct, expected = run(*SHIPPED[name](), Direct, {})
    more = [steps - least for (steps, _), (least, _) in zip(found, expected, strict=True)]
    assert set(more) <= ({0, 1} if name in ONE_MORE else {0})
    adapter = Adapter(direct)
    for (_, state), (_, exact) in zip(found, expected, strict=True):
        assert_same(adapter, state, exact, zero=1e-25)  # some tractions are 0
