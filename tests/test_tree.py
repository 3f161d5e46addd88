"""The smallest tree of a scene: exactly the levels that it needs, as -ksp_view shows them, and the same answer."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_pc import dense, gathered, local_order, python_pc, system_of
from test_solver import load, unequal

import petsc_fs
from petsc_fs import options
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fields import FIELD_NAMES
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Result, Solver
from petsc_fs.tools import stress_cases
from petsc_fs.tree import Facts, Tree, canonical_name, smallest_tree

comm = MPI.COMM_WORLD
MPIEXEC = Path(petsc_fs.__path__[0]).parent / "scripts" / "mpiexec"
ENVIRONMENT = dict(os.environ, OMP_NUM_THREADS="1")
BUNDLED = ("biot", "contact", "flow", "model1", "model2", "model3")

Levels = dict[str, str]
"""Type of each PC by its prefix."""


# Scenes made from the bundled ones


def smooth(scene: Scene) -> Scene:
    """The scene with a right-hand side of which a smooth vector, of the size of the solution, is the answer."""
    x = {}
    for f, n in scene.sizes.items():
        components = scene.block_size(f)
        place = np.linspace(0, np.pi, n // components)
        size = np.abs(scene.reference[f]).mean() if n else 1.0
        x[f] = size * np.stack([1 + np.sin((i + 1) * place) for i in range(components)], axis=1).ravel()
    rhs = {f: np.zeros(n) for f, n in scene.sizes.items()}
    for (r, c), (indptr, indices, data) in scene.blocks.items():
        rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
        rhs[r] += np.bincount(rows, data * x[c][indices], minlength=indptr.size - 1)
    return replace(scene, rhs=rhs, reference=x)


def identity(n: int, factor: float = 1.0) -> CSR:
    return CSR(np.arange(n + 1), np.arange(n), np.full(n, factor))


def all_open(scene: Scene, *, stored_zeros: bool = False) -> Scene:
    """No contact anywhere: the traction is given, whatever the displacements."""
    n = scene.sizes["contact"]
    blocks = {rc: b for rc, b in scene.blocks.items() if rc[0] != "contact"}
    blocks["contact", "contact"] = identity(n)
    if stored_zeros:
        old = scene.blocks["contact", "intf_force"]
        blocks["contact", "intf_force"] = CSR(old.indptr, old.indices, np.zeros_like(old.data))
    return smooth(replace(scene, blocks=blocks, contact_state=np.full(n // scene.dimension, 2)))


def uncoupled(scene: Scene, *, rock_from_flow: bool = True, flow_from_rock: bool = True) -> Scene:
    """Without the action of flow on mechanics, of mechanics on flow, or both."""
    flow, rock = {"intf_flow", "mass"}, {"intf_force", "momentum"}

    def gone(r: str, c: str) -> bool:
        return (rock_from_flow and r in rock and c in flow) or (flow_from_rock and r in flow and c in rock)

    return smooth(replace(scene, blocks={rc: b for rc, b in scene.blocks.items() if not gone(*rc)}))


def without_biot(scene: Scene) -> Scene:
    """The data say that pressure and rock do not act on each other; the matrix has their blocks nevertheless."""
    assert scene.material is not None
    return replace(scene, material=replace(scene.material, biot_coefficient=0.0))


def padded(scene: Scene, fields: tuple[str, ...]) -> Scene:
    """The scene with further fields that have no unknowns."""
    empty = {f: np.zeros(0) for f in fields}
    state = scene.contact_state if "contact" in scene.sizes else np.zeros(0, dtype=np.int64)
    sizes = dict.fromkeys(fields, 0) | scene.sizes
    return replace(scene, sizes=sizes, rhs=empty | scene.rhs, reference={}, contact_state=state)


# Trees as they should be


def flow_levels(prefix: str = "") -> Levels:
    return {
        prefix: "fieldsplit",
        f"{prefix}fieldsplit_intf_flow_": "asm",
        f"{prefix}fieldsplit_mass_": "hypre",
    }


def displacements(prefix: str = "") -> Levels:
    """Multigrid component by component, below a prefix."""
    return {prefix: "python", f"{prefix}component_": "hypre"}


def coupled_levels(prefix: str, mechanics: str, *, intf_flow: bool, stress: bool = True) -> Levels:
    """Mechanics apart from flow, below a prefix."""
    rest = f"{prefix}fieldsplit_1_" if intf_flow else f"{prefix}fieldsplit_mass_"
    inner = f"{rest}fs_" if stress else rest
    return {
        prefix: "fieldsplit",
        **displacements(f"{prefix}fieldsplit_{mechanics}_"),
        **({rest: "python"} if stress else {}),
        **(flow_levels(inner) if intf_flow else {inner: "hypre"}),
    }


def contact_levels(prefix: str, rest: Levels) -> Levels:
    return {prefix: "fieldsplit", f"{prefix}fieldsplit_contact_": "pbjacobi", **rest}


TRANSFORM = {"": "python"}
MECHANICS_LEAF = displacements("qr_fieldsplit_mechanics_")
CONTACT_MECHANICS = TRANSFORM | contact_levels("qr_", MECHANICS_LEAF)
FULL = TRANSFORM | contact_levels("qr_", coupled_levels("qr_fieldsplit_1_", "mechanics", intf_flow=True))

SUBSETS: dict[tuple[str, ...], Levels] = {
    ("mass",): {"": "hypre"},
    ("momentum",): displacements(),
    ("intf_force", "momentum"): displacements(),
    ("intf_flow", "mass"): flow_levels(),
    ("momentum", "mass"): coupled_levels("", "momentum", intf_flow=False),
    ("momentum", "intf_flow", "mass"): coupled_levels("", "momentum", intf_flow=True),
    ("intf_force", "momentum", "intf_flow", "mass"): coupled_levels("", "mechanics", intf_flow=True),
    ("contact", "intf_force", "momentum"): CONTACT_MECHANICS,
    ("contact", "intf_force", "momentum", "mass"): TRANSFORM
    | contact_levels("qr_", coupled_levels("qr_fieldsplit_1_", "mechanics", intf_flow=False)),
    ("contact", "intf_force", "momentum", "intf_flow", "mass"): FULL,
}
CLOSED = ("model3", ("contact", "intf_force", "momentum", "mass"))
"""Fractures of model3 without interface flow are closed vessels that fixed stress is not made for."""


def canonical() -> options.Mapping[str, str | None]:
    return options.parse(options.find_options_file(canonical_name()))


def tree_of(scene: Scene) -> Tree:
    return smallest_tree(canonical(), Facts.of(scene, MPI.COMM_SELF))


class Solved:
    """A scene solved by its smallest tree, which is shown by KSPView."""

    def __init__(self, scene: Scene, path: Path, layout: Layout | None = None) -> None:
        before = options.unused()
        self.tree = tree_of(scene)
        # fields are left out, which makes bad scenes of good ones: the residual alone judges
        options.insert_all({**self.tree.options, "petsc_fs_error_factor": "0"})
        solver = Solver(scene, layout=layout)
        self.result: Result = solver.solve()
        self.unused = sorted(set(options.unused()) - set(before))
        viewer = PETSc.Viewer().createASCII(str(path / "view.txt"), comm=comm)
        solver.ksp.view(viewer)
        viewer.destroy()
        comm.barrier()
        self.view = (path / "view.txt").read_text()
        self.has_dm = solver.ksp.getDM().getAppCtx() is not None
        self.mat_type = solver.system.J.getType().removeprefix("seq").removeprefix("mpi")
        solver.destroy()

    @property
    def levels(self) -> Levels:
        """PCs but those of the blocks of block Jacobi, which are not levels."""
        found = re.findall(r"PC Object: \((\w*)\) .*\n\s*type: (\w+)", self.view)
        return {prefix: kind for prefix, kind in found if not prefix.endswith("sub_")}

    def assert_smallest(self, levels: Levels) -> None:
        """Exactly these levels, nothing empty, no option idle, no default KSP, and a solution."""
        assert self.levels == levels
        splits = len([kind for kind in levels.values() if kind == "fieldsplit"])
        assert self.view.count("FieldSplit with") == splits
        python = len(re.findall(r"type: python\n", self.view))  # PETSc shows the solver of a triangular factor twice
        assert len(re.findall(r"Python: petsc_fs\.pc\.\w+", self.view)) == python
        assert self.view.count("Python: petsc_fs.pc.ContactTransform") == ("qr_" in levels)
        own_blocks = r"type: seq\w+\n\s*rows=\d+, cols=\d+" if comm.size > 1 else "$^"
        assert not re.search(r"\b(rows|cols)=0\b", re.sub(own_blocks, "", self.view))  # a rank may have nothing
        ksps = dict(re.findall(r"KSP Object: \((\w*)\) .*\n\s*type: (\w+)", self.view))
        assert ksps.pop("") == "gmres"
        assert set(ksps.values()) <= {"preonly"}
        inner = {p for p in levels if p.endswith(("qr_", "fs_", "component_"))}
        assert {p for p in ksps if not p.endswith("sub_")} == set(levels) - inner - {""}
        assert self.unused == []
        assert self.has_dm == ("fieldsplit" in levels.values())
        assert self.mat_type == ("nest" if self.has_dm else "aij")

    def assert_solved(self) -> None:
        assert self.result.converged, self.result
        assert self.result.reason.startswith("CONVERGED")


@pytest.fixture
def solve(clean, shared_tmp_path):
    """Solve a scene by its smallest tree."""
    return lambda scene, **more: Solved(scene, shared_tmp_path, **more)


# Levels


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["model1", "model2", "model3"])
@pytest.mark.parametrize("fields", SUBSETS, ids="-".join)
def test_scene_without_some_fields_has_exactly_the_levels_of_the_others(solve, name, fields):
    solved = solve(smooth(load(name).only(fields)))
    solved.assert_smallest(SUBSETS[fields])
    if (name, fields) != CLOSED:
        solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_scene_has_the_levels_of_its_fields(solve, name):
    scene = load(name)
    solved = solve(scene)
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("stored_zeros", [False, True], ids=["no_block", "stored_zeros"])
@pytest.mark.parametrize("name", ["contact", "model1", "model2", "model3"])
def test_open_fractures_need_neither_transformation_nor_schur_complement(solve, name, stored_zeros):
    scene = all_open(load(name), stored_zeros=stored_zeros)
    solved = solve(scene)
    rest = displacements("fieldsplit_mechanics_")
    if "mass" in scene.sizes:
        rest = coupled_levels("fieldsplit_1_", "mechanics", intf_flow=True)
    solved.assert_smallest(contact_levels("", rest))
    solved.assert_solved()
    assert solved.tree.options["petsc_fs_mat_type"] == "merged"
    assert "qr_side" not in solved.tree.options
    assert str(solved.tree.left_out[0]) == (
        "contact and interfaces do not act on each other: Q_r and the exact Schur complement of contact left out"
    )


@pytest.mark.mpi
def test_schur_complement_of_open_fractures_is_the_jacobian(clean):
    """S^1 = J where J_12 = 0: what ContactTransform would compute there changes nothing."""
    system = system_of(all_open(load("contact")))
    pc = python_pc(system, "ContactTransform", "o_", qr_pc_type="none")
    mechanics = gathered(pc.getPythonContext().inner.getOperators()[1].getNestSubMatrix(1, 1))
    names = ("intf_force", "momentum")
    J = np.block([[dense(load("contact"), r, c) for c in names] for r in names])
    order = np.concatenate(comm.allgather(local_order(system, names)))
    np.testing.assert_array_equal(mechanics, J[np.ix_(order, order)])
    pc.destroy()


@pytest.mark.mpi
def test_invertible_contact_block_is_transformed_all_the_same(solve, clean):
    """All cells slide, so that J_11 is invertible; but S^1 without Q_r is too hard for multigrid."""
    scene = stress_cases.load("sliding")
    assert np.linalg.matrix_rank(dense(scene, "contact", "contact")) == scene.sizes["contact"]
    solved = solve(scene)
    solved.assert_smallest(SUBSETS[scene.fields])
    assert solved.result.converged
    assert solved.result.iterations < 40
    clean.setValue("qr_side", "none")
    without = solve(scene)
    assert "ContactTransform: inner PC on J with the exact Schur complement" in without.view
    assert not without.result.converged


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("name", "fields"), [("model2", ("momentum", "intf_flow", "mass")), ("biot", ()), ("model2", ())], ids=str
)
def test_decoupled_physics_is_split_additively(solve, name, fields):
    """Without Biot coupling the level of mechanics and flow is block-diagonal."""
    scene = uncoupled(load(name).only(fields or load(name).fields))
    solved = solve(scene)
    mechanics = "mechanics" if "contact" in scene.sizes else "momentum"
    prefix = "qr_fieldsplit_1_" if "contact" in scene.sizes else ""
    levels = coupled_levels(prefix, mechanics, intf_flow="intf_flow" in scene.sizes, stress=False)
    solved.assert_smallest(TRANSFORM | contact_levels("qr_", levels) if prefix else levels)
    solved.assert_solved()
    assert "FieldSplit with ADDITIVE composition" in solved.view
    assert solved.tree.options[f"{prefix}pc_fieldsplit_type"] == "additive"
    assert "mechanics and flow decoupled: fixed stress left out" in map(str, solved.tree.left_out)


@pytest.mark.mpi
@pytest.mark.parametrize("way", ["rock_from_flow", "flow_from_rock"])
def test_coupling_in_one_direction_needs_no_fixed_stress(solve, way):
    """If either off-diagonal block is zero the Schur complement is the flow block itself."""
    both = {"rock_from_flow": False, "flow_from_rock": False}
    solved = solve(uncoupled(load("biot"), **both | {way: True}))
    solved.assert_smallest(coupled_levels("", "momentum", intf_flow=False, stress=False))
    solved.assert_solved()
    assert "FieldSplit with Schur preconditioner" in solved.view
    assert "mechanics and flow act one way only: fixed stress left out" in map(str, solved.tree.left_out)


@pytest.mark.mpi
def test_zero_diagonal_needs_no_fixed_stress(solve):
    solved = solve(smooth(without_biot(load("biot"))))
    solved.assert_smallest(coupled_levels("", "momentum", intf_flow=False, stress=False))
    solved.assert_solved()
    assert "fixed-stress diagonal zero: fixed stress left out" in map(str, solved.tree.left_out)


@pytest.mark.mpi
def test_unknown_diagonal_keeps_fixed_stress(solve):
    solved = solve(smooth(replace(load("biot"), material=None)))
    solved.assert_smallest(SUBSETS["momentum", "mass"])
    solved.assert_solved()
    assert "FixedStress: algebraic fixed-stress diagonal" in solved.view


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["flow", "biot", "contact"])
def test_fields_without_unknowns_are_as_good_as_absent(solve, name):
    scene = smooth(load(name))
    empty = padded(scene, FIELD_NAMES)
    empty.validate()
    assert tree_of(empty) == tree_of(scene)
    solved = solve(empty)
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("name", BUNDLED)
def test_rank_without_unknowns_of_a_field_has_the_same_tree(solve, name):
    scene = load(name)
    solved = solve(scene, layout=unequal(scene))
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("name", BUNDLED)
def test_ranks_see_together_what_the_whole_scene_is(name):
    for scene in [load(name), *([all_open(load(name))] if "contact" in load(name).sizes else [])]:
        for layout in (Layout.contiguous(comm, scene.dimension, scene.sizes), unequal(scene)):
            part = scene.restrict({f: layout.rows(f) for f in layout.fields})
            assert Facts.of(part, comm) == Facts.of(scene, MPI.COMM_SELF)


@pytest.mark.mpi
def test_impossible_material_on_one_rank_fails_on_all():
    scene = load("biot")
    stiffness = np.full(scene.sizes["mass"], 1e10)
    stiffness[-1] = 0.0
    broken = replace(scene, material=replace(scene.material, shear_modulus=stiffness, lame_lambda=stiffness))
    layout = Layout.contiguous(comm, scene.dimension, scene.sizes)
    part = broken.restrict({f: layout.rows(f) for f in layout.fields})
    with pytest.raises(SceneError, match="coefficients are not finite"):
        Facts.of(part, comm)


# Options


@pytest.mark.parametrize(
    ("name", "file"), [("biot", "poromechanics_fast"), ("flow", "flow_fast"), ("contact", "contact_mechanics_fast")]
)
def test_derived_options_are_those_of_the_shipped_file(name, file):
    derived = dict(tree_of(load(name)).options)
    shipped = options.parse(options.find_options_file(f"{file}.opts"))
    derived.pop("ksp_atol", None)
    shipped.pop("ksp_atol", None)
    assert derived == shipped


@pytest.mark.parametrize("name", ["model1", "model2", "model3"])
def test_complete_scene_has_the_canonical_tree(name):
    tree = tree_of(load(name))
    assert tree.options == canonical()
    assert tree.left_out == ()
    assert "nothing of the canonical tree is left out" in tree.text(name)


@pytest.mark.parametrize("name", BUNDLED)
def test_printed_options_parse_to_the_tree(tmp_path, name):
    tree = tree_of(load(name))
    (tmp_path / "mine.opts").write_text(tree.text("mine"))
    assert options.parse(tmp_path / "mine.opts") == tree.options
    for part in tree.left_out:
        assert f"# {part}\n" in tree.text("mine")


def test_scene_without_unknowns_is_refused():
    with pytest.raises(UsageError, match="no unknowns"):
        tree_of(padded(load("flow").only(()), ("mass",)))


# The command line, each in its own process


def run(*arguments: object, cwd: Path, ranks: int = 1, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [*([str(MPIEXEC), "-n", str(ranks)] if ranks > 1 else []), sys.executable, "-m", "petsc_fs"]
    return subprocess.run(
        [*command, *map(str, arguments)],
        cwd=cwd,
        env=ENVIRONMENT | environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("name", BUNDLED)
def test_printed_options_solve_to_the_last_digit_as_without(tmp_path, name):
    printed = run("options", f"{name}.h5", cwd=tmp_path)
    assert printed.returncode == 0, printed.stderr
    (tmp_path / "mine.opts").write_text(printed.stdout)
    reports = []
    for more in ([], ["-options_file", "mine.opts"]):
        done = run("solve", f"{name}.h5", "--report", "report.json", *more, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        reports.append(json.loads((tmp_path / "report.json").read_text()))
    for key in ("iterations", "reason", "true_relative_residual", "residual_by_field", "error_by_field"):
        assert reports[0][key] == reports[1][key]
    assert reports[0]["options"] == reports[1]["options"]


MISSPELT = "qr_fieldsplit_1_fieldsplit_mechanics_component_pc_hypre_boomeramg_stong_threshold"


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("origin", ["the command line", "mine.opts", "PETSC_OPTIONS"])
def test_misspelt_option_fails_with_its_origin(tmp_path, origin, ranks):
    (tmp_path / "mine.opts").write_text(
        f"{tree_of(load('model1')).text('mine')}\n-{MISSPELT} 0.7\n" if origin == "mine.opts" else ""
    )
    arguments = {"the command line": [f"-{MISSPELT}", "0.7"], "mine.opts": ["-options_file", "mine.opts"]}
    environment = {"PETSC_OPTIONS": f"-{MISSPELT} 0.7"} if origin == "PETSC_OPTIONS" else {}
    done = run("solve", "model1.h5", *arguments.get(origin, []), cwd=tmp_path, ranks=ranks, **environment)
    assert done.returncode == 2, done.stderr
    right = MISSPELT.replace("stong", "strong")
    message = f"option -{MISSPELT} from {origin} was not used; did you mean -{right}"
    assert done.stderr.count(message) == 1
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("ranks", [1, 2])
def test_option_that_may_be_idle_is_let_pass(tmp_path, ranks):
    idle = [f"-{MISSPELT}", "0.7", "-petsc_fs_allow_unused", "mine_*,*stong*"]
    done = run("solve", "model1.h5", *idle, cwd=tmp_path, ranks=ranks)
    assert done.returncode == 0, done.stderr
    done = run("solve", "model1.h5", *idle, "-yours_x", "1", cwd=tmp_path, ranks=ranks)
    assert done.returncode == 2
    assert "option -yours_x from the command line was not used" in done.stderr
    assert "stong" not in done.stderr


@pytest.mark.parametrize(
    ("name", "option", "reason"),
    [
        ("flow", "qr_side", "no contact: Q_r and the first Schur level left out"),
        ("biot", "qr_fieldsplit_contact_pc_type", "no contact: Q_r and the first Schur level left out"),
        (
            "flow",
            "qr_fieldsplit_1_fieldsplit_mechanics_pc_type",
            "no mechanics: the second Schur level with fixed stress left out",
        ),
        ("contact", "qr_fieldsplit_1_fieldsplit_1_fs_damping", "no flow: the second and third Schur levels left out"),
        (
            "biot",
            "qr_fieldsplit_1_fieldsplit_1_fs_fieldsplit_intf_flow_pc_type",
            "no interface flow: the third Schur level left out",
        ),
    ],
)
def test_option_of_a_level_left_out_is_named_with_the_reason(tmp_path, name, option, reason):
    done = run("solve", f"{name}.h5", f"-{option}", "0.5", cwd=tmp_path)
    assert done.returncode == 2
    assert f"option -{option} from the command line was not used: its level is not there ({reason})" in done.stderr


def test_flow_alone_imports_only_what_it_uses(tmp_path):
    program = (
        "import sys, petsc_fs.cli; print(petsc_fs.cli.main.main(['solve', 'flow.h5'])); print(*sorted(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    *_, code, names = done.stdout.splitlines()
    assert code == "0", done.stderr
    imported = set(names.split())
    assert not imported & {"porepy", "matplotlib", "optuna", "scipy", "yaml"}
    assert not {m for m in imported if m.startswith(("petsc_fs.pc", "petsc_fs.cli.lint", "petsc_fs.tools.plots"))}
    assert "petsc_fs.tree" in imported
