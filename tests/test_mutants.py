"""What the algorithm does, exactly: iterations of every options file on every scene, and its formulas cell by cell.

Narrow on purpose: each test fails where a number or a factor of the algorithm is changed that other tests let pass.
`python tests/test_mutants.py` prints the table of iterations anew.
"""

from pathlib import Path

import numpy as np
import pytest
from petsc4py import PETSc
from sample import SCENES

from petsc_fs import options
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Material, Scene
from petsc_fs.solver import Result, Solver
from petsc_fs.tools.contraction import ContactRows, contact_terms, coupling_term

SHIPPED = {f.path.stem: f for f in options.shipped()}
SIZES = {path.stem: hdf5.read_sizes(path)[1] for path in sorted(SCENES.glob("*.h5"))}

ITERATIONS = {
    "contact_mechanics": {"contact": 15},
    "contact_mechanics_fast": {"contact": 18},
    "contact_poromechanics": {"model1": 20, "model2": 18, "model3": 30},
    "contact_poromechanics_fast": {"model1": 24, "model2": 22, "model3": 38},
    "contact_poromechanics_gamg": {"model1": 36, "model2": 38, "model3": 51},
    "contact_poromechanics_left": {"model1": 30, "model2": 19, "model3": 30},
    "contact_thermoporomechanics": {"cold2": 18},
    "contact_thermoporomechanics_cpr": {"cold2": 22},
    "contact_thermoporomechanics_fast": {"cold2": 17},
    "contact_thermoporomechanics_gamg": {"cold2": 28},
    "fixed_stress_richardson": {"model1": 17},
    "flow": {"flow": 8},
    "flow_fast": {"flow": 11},
    "poromechanics": {"biot": 14, "undrained": 21},
    "poromechanics_fast": {"biot": 17, "undrained": 23},
    "poromechanics_gamg": {"biot": 27, "undrained": 34},
}
"""On one rank."""

SINCE_3_22 = {
    "contact_poromechanics_gamg": {"model1": 47, "model2": 32, "model3": 50},
    "poromechanics_gamg": {"biot": 22, "undrained": 27},
    "contact_thermoporomechanics_gamg": {"cold2": 25},
}
"""What is different with PETSc 3.22 and hypre 2.32."""
if PETSc.Sys.getVersion() >= (3, 22):
    ITERATIONS = {file: row | SINCE_3_22.get(file, {}) for file, row in ITERATIONS.items()}

ROUNDED = {
    ("contact_poromechanics_gamg", "model1"): 2,
    ("contact_poromechanics_left", "model1"): 1,
    ("fixed_stress_richardson", "model1"): 1,
}
"""How far counts may be from these with OpenBLAS, which rounds as the processor has it."""
LOADED = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
if not any("openblas" in line and "numpy" not in line for line in LOADED):
    ROUNDED = {}

DIRECT = {"contact_poromechanics_direct", "direct", "retry"}
"""Files with a factorisation of mechanics or of all, whose iterations are refinement, as rounding has it."""

RESTART = {
    "contact_poromechanics": 30,
    "contact_poromechanics_left": 30,
    "contact_thermoporomechanics": 30,
    "contact_thermoporomechanics_cpr": 30,
    "contact_mechanics": 30,
    "poromechanics": 30,
    "flow": 30,
    "contact_poromechanics_fast": 60,
    "contact_thermoporomechanics_fast": 60,
    "contact_mechanics_fast": 60,
    "poromechanics_fast": 60,
    "flow_fast": 60,
}
"""Iterations that GMRES keeps, of the published runs and of the fast files."""
TRUNCATED = {
    "contact_thermoporomechanics": 0,
    "contact_thermoporomechanics_cpr": 0,
    "contact_thermoporomechanics_fast": 2,
}
"""Multigrids whose interpolation is truncated, if not the one of pressure alone."""


def solve(file: str, scene: str) -> Result:
    with options.inserted(SHIPPED[file].path):
        return Solver(hdf5.read(SCENES / f"{scene}.h5")).solve()


def claimed(file: str) -> list[str]:
    """The scenes that an options file is for."""
    return [name for name, sizes in SIZES.items() if SHIPPED[file].fits(sizes) and name not in SHIPPED[file].not_for]


def test_the_table_has_every_file_and_scene():
    assert set(ITERATIONS) == set(SHIPPED) - DIRECT
    assert {file: sorted(counts) for file, counts in ITERATIONS.items()} == {f: claimed(f) for f in ITERATIONS}


@pytest.mark.parametrize(("file", "scene"), [(file, scene) for file, row in ITERATIONS.items() for scene in row])
def test_iterations_are_exactly_those_of_the_algorithm(clean, file, scene):
    """Undrained rock notices the damping exponent; model 3 the restart of the files that take more than 30."""
    found = solve(file, scene).iterations
    assert abs(found - ITERATIONS[file][scene]) <= ROUNDED.get((file, scene), 0)


@pytest.mark.parametrize("file", RESTART)
def test_restart_and_truncation_are_those_that_were_chosen(file):
    values = options.parse(SHIPPED[file].path)
    assert values["ksp_gmres_restart"] == str(RESTART[file])
    flow = [v for name, v in values.items() if name.endswith("boomeramg_truncfactor")]
    assert flow == ["0.3"] * TRUNCATED.get(file, "mass" in SHIPPED[file].fields)


@pytest.mark.parametrize("file", ["poromechanics", "poromechanics_fast"])
def test_undrained_rock_needs_its_fixed_stress(clean, monkeypatch, file):
    """Without the diagonal twice the iterations, and more."""
    clean["ksp_rtol"] = 1e-6
    with_it = solve(file, "undrained").iterations
    monkeypatch.setattr("petsc_fs.pc.fixed_stress.checked", lambda analytic, *_: 0 * analytic)
    assert solve(file, "undrained").iterations >= 2 * with_it


def test_fixed_stress_adds_the_coefficients_with_the_published_damping(clean):
    scene = hdf5.read(SCENES / "undrained.h5")
    with options.inserted(SHIPPED["poromechanics"].path):
        solver = Solver(scene)
        solver.set_up()
    pc = solver.ksp.getPC().getFieldSplitSubKSP()[1].getPC()
    added = pc.getPythonContext().inners[0].getOperators()[1].getDiagonal() - pc.getOperators()[1].getDiagonal()
    base, ratio = scene.fixed_stress_coefficients().T
    scale = 2.0 ** solver.system.row_scale["mass"]
    np.testing.assert_allclose(added.getArray(), scale * base * ratio**0.6, rtol=1e-6)


def cells(dimension: int, of_cells: list[int], **material: object) -> Scene:
    """The mass balance of some cells of given dimensions, with numbers that can be followed by hand."""
    data = {
        "shear_modulus": 3.0,
        "lame_lambda": 2.0,
        "biot_coefficient": 0.5,
        "porosity": 0.1,
        "fluid_compressibility": 0.5,
        "fluid_density": 10.0,
        "normal_jump": 0.1,
        "time_step": 5.0,
    }
    n = len(of_cells)
    return Scene(
        dimension=dimension,
        sizes={"mass": n, "contact": dimension * of_cells.count(dimension - 1)},
        blocks={},
        rhs={"mass": np.zeros(n)},
        cell_volumes={"mass": np.arange(1.0, n + 1)},
        cell_dimension=np.array(of_cells),
        material=Material(**(data | material)),
    )


def test_fixed_stress_coefficients_of_the_rock_by_hand():
    """V rho / dt = 2 V; l_min = 0.25 / (12 + 4) = 1/64; l_mat = 0.25 / (3 + 2) = 1/20 in 2D, 0.25 / (2 + 2) in 3D.

    The second cell has alpha = 1, hence four times as much; the third G = 1 and lambda = 4: l_min = 0.25 / 12 and
    l_mat = 0.25 / 5, in 3D 0.25 / (2/3 + 4).
    """
    changes = {
        "biot_coefficient": np.array([0.5, 1.0, 0.5]),
        "shear_modulus": np.array([3.0, 3.0, 1.0]),
        "lame_lambda": np.array([2.0, 2.0, 4.0]),
    }
    for dimension, ratio in ((2, [3.2, 3.2, 2.4]), (3, [4.0, 4.0, 18 / 7])):
        found = cells(dimension, [dimension] * 3, **changes).fixed_stress_coefficients()
        np.testing.assert_allclose(found[:, 0], [2 / 64, 4 * 4 / 64, 6 * 0.25 / 12], rtol=1e-14)
        np.testing.assert_allclose(found[:, 1], ratio, rtol=1e-14)


@pytest.mark.parametrize("dimension", [2, 3])
def test_fixed_stress_coefficients_of_fractures_by_hand(dimension):
    """l_frac = [u]_n alpha^2 c_f / (lambda (1/M + phi c_f)), not in rock and not in intersections, of any dimension.

    1/M = (0.5 - 0.1)(1 - 0.5) / (2 + 2) = 0.05 = phi c_f, hence l_frac = 0.1 * 0.25 * 0.5 / (2 * 0.1) = 1/16 and
    2 V l_frac = 1/8, 1/4, ...; the second fracture cell is three times as wide, the third has lambda = 4, and so
    1/M = 1/30 and l_frac = 0.0125 / (4 * (1/30 + 1/20)) = 0.0375.
    """
    lower = [dimension - 2, 0]
    scene = cells(
        dimension,
        [dimension - 1] * 3 + lower,
        normal_jump=np.array([0.1, 0.3, 0.1, 0.1, 0.1]),
        lame_lambda=np.array([2.0, 2.0, 4.0, 2.0, 2.0]),
    )
    found = scene.fixed_stress_coefficients()
    np.testing.assert_allclose(found[:, 0], [1 / 8, 3 / 4, 6 * 0.0375, 0, 0], rtol=1e-14)
    np.testing.assert_array_equal(found[:, 1], 1.0)


def test_coupling_term_of_the_condition_by_hand():
    """Lambda (1/M + phi c_f) / ([u]_n c_f alpha^2), which is 1 / l_frac, with the numbers above; infinite if closed."""
    scene = cells(2, [1, 1, 1, 1], normal_jump=np.array([0.1, 0.2, 0.0, 0.1]), lame_lambda=np.array([2.0, 2, 2, 4]))
    np.testing.assert_allclose(coupling_term(scene), [16, 8, np.inf, 1 / 0.0375], rtol=1e-14)


def test_contact_terms_of_the_condition_by_hand():
    """Per cell, each from the numbers of that cell; the theorem takes the worst of each by itself.

    Three cells that slide: 2 / beta_b, 2 c epsilon / (|y| + epsilon) and 2 F |y| / ((|y| + epsilon) beta_b).
    """
    nan = np.full(3, np.nan)
    rows = ContactRows(
        closed=np.full(3, True),
        sticking=np.full(3, False),
        sliding=np.full(3, True),
        area=np.ones(3),
        constant=10.0,
        beta_b=np.array([0.5, 0.25, 0.1]),
        slip=nan,
        bound=nan,
        trial=np.array([4.0, 3.0, 8.0]),
        mismatch=np.array([1.0, -1.0, 0.0]),
        friction=np.array([0.5, 0.5, 0.25]),
        jump=CSR(np.zeros(1, dtype=int), np.zeros(0, dtype=int), np.zeros(0)),
    )
    terms, theorem = contact_terms(rows)
    np.testing.assert_allclose(terms["normal"], [4, 8, 20])
    np.testing.assert_allclose(terms["mismatch"], [4, -10, 0])
    np.testing.assert_allclose(terms["friction"], [1.6, 6, 5])
    assert theorem["normal"] == pytest.approx(20)
    assert theorem["mismatch"] == pytest.approx(2 * 10 * 1 / 2)
    assert theorem["friction"] == pytest.approx(2 / 2 * 20)


if __name__ == "__main__":
    for file in sorted(set(SHIPPED) - DIRECT):
        PETSc.Sys.Print(f'    "{file}":', {scene: solve(file, scene).iterations for scene in claimed(file)})
