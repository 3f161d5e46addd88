"""The ladder of stronger preconditioners: which levels it finds, what it reports, that it leaves no trace."""

import re
from dataclasses import replace

import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_server import on_rank_0

from petsc_fs import options
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fallback import RUNGS, leaves
from petsc_fs.levels import levels
from petsc_fs.scene import Scene
from petsc_fs.server import ServedSolver
from petsc_fs.solver import Result, Solver
from petsc_fs.tools.stress_cases import load, with_block_of_cell

comm, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
FAST = "contact_poromechanics_fast.opts"
TREE = ""
MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_"
FLOW = "qr_fieldsplit_1_fieldsplit_1_fs_"
pytestmark = pytest.mark.mpi


@pytest.fixture
def solver(clean):
    """Solvers by an options file or the smallest tree, with further options."""
    made = []

    def create(scene: Scene, file: str = TREE, prefix: str = "", **more: str) -> Solver:
        options.insert_all(more, prefix)
        chosen = (
            options.parse(options.find_options_file(file))
            if file
            else options.choose(options.Facts.of(scene, comm)).values
        )
        options.insert_all(chosen, prefix)
        made.append(Solver(scene, comm, prefix=prefix))
        return made[-1]

    yield create
    for one in made:
        one.destroy()


def rungs(result: Result) -> list[str]:
    """What each rung did, without the line on the solve before them."""
    return [note for note in result.notes if note.startswith("fallback ")][1:]


def assert_adds_up(result: Result) -> None:
    """Iterations of the result are those of its lines."""
    lines = [note for note in result.notes if note.startswith("fallback ")]
    assert result.iterations == sum(int(n) for line in lines for n in re.findall(r": (\d+) iterations", line))


def test_leaves_of_the_fast_file(solver):
    one = solver(load("base"), FAST)
    one.set_up()
    found = {leaf.prefix: leaf for leaf in leaves(one.ksp.getPC(), one.layout.fields)}
    assert {prefix: leaf.kind for prefix, leaf in found.items()} == {
        "qr_fieldsplit_contact_": "pbjacobi",
        f"{MECHANICS}component_": "boomeramg",
        f"{FLOW}fieldsplit_intf_flow_": "asm",
        f"{FLOW}fieldsplit_mass_": "boomeramg",
    }
    assert found[f"{MECHANICS}component_"].whole == MECHANICS
    assert found[f"{MECHANICS}component_"].fields == ("intf_force", "momentum")
    assert found[f"{FLOW}fieldsplit_mass_"].fields == ("mass",)
    prefixes = [pc.getOptionsPrefix() or "" for pc in levels(one.ksp.getPC())]
    assert prefixes.count(f"{MECHANICS}component_") == 2
    assert prefixes[:2] == ["", "qr_"]


@pytest.mark.parametrize(
    ("name", "file"),
    [("flow.h5", TREE), ("biot.h5", TREE), ("contact.h5", TREE), ("base", TREE), ("base", FAST)],
)
def test_every_tree_ends_at_the_direct_solver(solver, name, file):
    """With two iterations only a factorisation of the whole matrix solves any of them."""
    one = solver(load(name), file, ksp_max_it="2", petsc_fs_fallback="smoother,monolithic")
    kept = PETSc.Options().getAll()
    result = one.solve()
    assert result.converged
    assert result.fallback == "monolithic"
    assert result.reason == "CONVERGED_RTOL"
    assert [line.split(":")[0].split()[1] for line in rungs(result)] == ["smoother", "monolithic"]
    assert max(result.error_by_field.values(), default=0.0) < 1e-5
    assert_adds_up(result)
    assert PETSc.Options().getAll() == kept
    assert not options.refused(options.unused())


@pytest.mark.parametrize(
    ("file", "rung", "where"),
    [
        (
            "contact_poromechanics.opts",
            "smoother",
            [MECHANICS, f"{FLOW}fieldsplit_intf_flow_", f"{FLOW}fieldsplit_mass_"],
        ),
        (FAST, "cycles", [f"{MECHANICS}component_", f"{FLOW}fieldsplit_mass_"]),
        (FAST, "direct_mechanics", [MECHANICS]),
        (TREE, "direct_mass", [f"{FLOW}fieldsplit_mass_"]),
    ],
)
def test_a_rung_strengthens_the_levels_it_names(solver, file, rung, where):
    one = solver(load("base"), file, ksp_max_it="1", petsc_fs_fallback=rung)
    result = one.solve()
    (line,) = rungs(result)
    assert line.startswith(f"fallback {rung} on {', '.join('-' + prefix for prefix in where)}: 1 iterations")
    assert result.fallback in (rung, "")
    kinds = {pc.getOptionsPrefix(): pc for pc in levels(one.ksp.getPC())}
    if rung.startswith("direct"):
        assert all(kinds[prefix].getType() == "lu" for prefix in where)


def test_more_iterations_solve_what_slides(solver):
    result = solver(load("sliding"), qr_side="none", petsc_fs_fallback="iterations,monolithic").solve()
    assert result.converged
    assert result.fallback == "iterations"
    assert result.iterations > 180
    assert_adds_up(result)


def test_nothing_changes_without_a_fallback_or_need(solver):
    plain = solver(load("base")).solve()
    result = solver(load("base"), petsc_fs_fallback=",".join(RUNGS)).solve()
    assert (result.fallback, result.notes) == ("", ())
    assert result.iterations == plain.iterations


@pytest.mark.parametrize(
    ("name", "file", "rung", "why"),
    [
        ("flow.h5", TREE, "direct_mechanics", "no level"),
        ("contact.h5", TREE, "direct_mass", "no level"),
        ("base", "retry.opts", "cycles", "no level"),
        ("base", "retry.opts", "monolithic", "factored already"),
        ("base", TREE, "regularize", "no nearly singular block"),
    ],
)
def test_a_rung_that_does_not_apply_is_skipped(solver, name, file, rung, why):
    result = solver(load(name), file, ksp_rtol="1e-16", ksp_max_it="1", petsc_fs_fallback=rung).solve()
    if not result.converged:
        (line,) = rungs(result)
        assert line.endswith("skipped") and why in line


def test_a_richardson_iteration_becomes_gmres_around_its_factors_and_returns(solver):
    scene = load("base")
    one = solver(scene, "direct.opts", ksp_max_it="0", petsc_fs_fallback="monolithic")
    one.solve()
    assert one.ksp.getType() == "gmres"
    one.update(replace(scene, blocks=dict(load("base").blocks)))
    assert one.ksp.getType() == "richardson"


@pytest.mark.parametrize("given", ["smother", "smoother,,cycles", "smoother direct"])
def test_a_misspelt_rung_is_refused(solver, given):
    with pytest.raises(UsageError, match=r"-petsc_fs_fallback .*expected none, or .*direct_mechanics"):
        solver(load("base"), petsc_fs_fallback=given)


def weak() -> Scene:
    return with_block_of_cell(load("base"), "intf_force", 3, 1e-13)


def test_a_rung_lasts_for_a_matrix_or_for_good(solver):
    one = solver(weak(), petsc_fs_fallback="monolithic")
    ksp = one.ksp.handle
    assert one.solve().fallback == "monolithic"
    again = one.solve()
    assert again.fallback == "monolithic" and not rungs(again) and again.iterations <= 2
    one.update(load("base"))
    plain = one.solve()
    assert plain.fallback == "" and plain.converged
    for climbs in (True, True, False):
        one.update(weak())
        result = one.solve()
        assert result.converged and result.fallback == "monolithic"
        assert bool(rungs(result)) == climbs
    assert one.ksp.handle == ksp


def test_reused_multigrids_are_those_of_the_present_rung(solver):
    """Kept hierarchies of a rung serve no matrix that goes without it."""
    one = solver(load("base"), FAST, ksp_max_it="16", petsc_fs_fallback="cycles,direct_mechanics")
    first = one.solve()
    assert first.converged and first.fallback
    one.update(load("base"))
    again = one.solve()
    assert again.iterations == first.iterations
    assert rungs(again) == rungs(first)


def test_a_preconditioner_that_cannot_be_set_up_is_passed_over(solver):
    scene = with_block_of_cell(load("base"), "intf_force", 3, 0.0)
    with pytest.raises(SceneError, match="D_22"):
        solver(scene).solve()
    for rung in ("monolithic", "regularize"):
        PETSc.Options().delValue("petsc_fs_fallback")
        one = solver(scene, petsc_fs_fallback=f"smoother,{rung}")
        one.set_up()
        result = one.solve()
        assert result.converged and result.fallback == rung
        assert any("smoother: the preconditioner could not be set up, skipped" in note for note in result.notes)


def test_if_every_rung_fails_the_first_error_is_raised(solver):
    scene = with_block_of_cell(load("base"), "intf_force", 3, 0.0)
    with pytest.raises(SceneError, match=r"D_22.*fallback smoother: .*skipped"):
        solver(scene, petsc_fs_fallback="smoother").solve()


def test_a_served_solver_falls_back_on_all_ranks(clean):
    before = clean.getAll()

    def body(client) -> None:
        scene = load("base")
        new = options.insert_all(
            options.choose(options.Facts.of(scene, SELF)).values
            | {"ksp_max_it": "2", "petsc_fs_fallback": "monolithic"}
        )
        served = ServedSolver(client, scene)
        result = served.solve()
        assert result.converged and result.fallback == "monolithic"
        served.update(load("flip_2"))
        assert served.solve().converged
        served.destroy()
        options.delete_all(new)

    on_rank_0(body)
    assert comm.rank or clean.getAll() == before


def test_another_solver_does_not_notice(solver):
    one = solver(load("base"), prefix="a_", ksp_max_it="2", petsc_fs_fallback="direct_mass,monolithic")
    other = solver(load("base"), prefix="b_")
    assert one.solve().fallback == "monolithic"
    result = other.solve()
    assert result.converged and result.fallback == ""
    assert other.ksp.getPC().getType() == "python"
    assert not [name for name, value in PETSc.Options().getAll().items() if value == "lu"]
