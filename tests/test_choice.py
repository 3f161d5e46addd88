"""The smallest solver of a scene: exactly the levels that it needs, as -ksp_view shows them, and the same answer."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from common import comm, csr, load, times, unequal
from mpi4py import MPI
from petsc4py import PETSc
from programs import ENVIRONMENT, MPIEXEC
from sample import dense

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.fields import FIELD_NAMES
from petsc_fs.options import Facts
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Result, Solver
from petsc_fs.tools import stress_cases

BUNDLED = ("biot", "cold2", "contact", "flow", "model1", "model2", "model3")
WARM = ("contact", "intf_force", "momentum", "intf_flow", "mass")
HOT = ("contact", "intf_force", "momentum", "intf_flow", "intf_fourier", "intf_enthalpy", "mass", "energy")

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
    for (r, c), block in scene.blocks.items():
        rhs[r] += times(block, x[c]).astype(float)
    return replace(scene, rhs=rhs, reference=x)


def all_open(scene: Scene) -> Scene:
    """No contact anywhere: the traction is given, whatever the displacements."""
    n = scene.sizes["contact"]
    blocks = {rc: b for rc, b in scene.blocks.items() if rc[0] != "contact"}
    blocks["contact", "contact"] = CSR(np.arange(n + 1), np.arange(n), np.ones(n))
    return smooth(replace(scene, blocks=blocks, contact_state=np.full(n // scene.dimension, 2)))


def uncoupled(scene: Scene, *, rock_from_flow: bool = True, flow_from_rock: bool = True) -> Scene:
    """Without the action of flow on mechanics, of mechanics on flow, or both."""
    flow, rock = {"intf_flow", "mass"}, {"intf_force", "momentum"}

    def gone(r: str, c: str) -> bool:
        return (rock_from_flow and r in rock and c in flow) or (flow_from_rock and r in flow and c in rock)

    return smooth(replace(scene, blocks={rc: b for rc, b in scene.blocks.items() if not gone(*rc)}))


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


def joined_levels(prefix: str, *, fluxes: str, heat: bool) -> Levels:
    """Fluxes as one, or one alone, and pressure with temperature or alone, below a prefix."""
    inner = f"{prefix}joined_"
    last = f"{inner}fieldsplit_{'potentials' if heat else 'mass'}_" if fluxes else inner
    apart = {inner: "fieldsplit", f"{inner}fieldsplit_{fluxes}_": "asm"} if fluxes else {}
    splits = {"mass": "hypre", "energy": "hypre", "2": "asm"}
    both = {last: "fieldsplit"} | {f"{last}fieldsplit_{name}_": kind for name, kind in splits.items()}
    return {prefix: "python"} | apart | (both if heat else {last: "hypre"})


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
    ("intf_force", "momentum", "intf_flow", "mass"): coupled_levels("", "0", intf_flow=True),
    ("contact", "intf_force", "momentum"): CONTACT_MECHANICS,
    ("contact", "intf_force", "momentum", "mass"): TRANSFORM
    | contact_levels("qr_", coupled_levels("qr_fieldsplit_1_", "mechanics", intf_flow=False)),
    WARM: FULL,
    ("mass", "energy"): joined_levels("", fluxes="", heat=True),
    ("intf_flow", "intf_fourier", "intf_enthalpy", "mass", "energy"): joined_levels("", fluxes="fluxes", heat=True),
    ("intf_flow", "mass", "energy"): joined_levels("", fluxes="intf_flow", heat=True),
    ("intf_flow", "intf_fourier", "intf_enthalpy", "mass"): joined_levels("", fluxes="fluxes", heat=False),
    ("momentum", "mass", "energy"): {
        "": "fieldsplit",
        **displacements("fieldsplit_momentum_"),
        "fieldsplit_1_": "python",
        **joined_levels("fieldsplit_1_fs_", fluxes="", heat=True),
    },
    HOT: TRANSFORM
    | contact_levels(
        "qr_",
        {
            "qr_fieldsplit_1_": "fieldsplit",
            **displacements("qr_fieldsplit_1_fieldsplit_mechanics_"),
            "qr_fieldsplit_1_fieldsplit_1_": "python",
            **joined_levels("qr_fieldsplit_1_fieldsplit_1_fs_", fluxes="fluxes", heat=True),
        },
    ),
}
CLOSED = ("model3", ("contact", "intf_force", "momentum", "mass"))
"""Fractures of model3 without interface flow are closed vessels that fixed stress is not made for."""


def choice_of(scene: Scene) -> options.Choice:
    return options.choose(Facts.of(scene, MPI.COMM_SELF))


class Solved:
    """A scene solved by its smallest solver, which is shown by KSPView."""

    def __init__(self, scene: Scene, path: Path, layout: Layout | None = None) -> None:
        before = options.unused()
        self.choice = choice_of(scene)
        options.insert_all(self.choice.values)
        solver = Solver(scene, layout=layout)
        self.result: Result = solver.solve()
        self.unused = sorted(set(options.unused()) - set(before))
        viewer = PETSc.Viewer().createASCII(str(path / "view.txt"), comm=comm)
        solver.ksp.view(viewer)
        viewer.destroy()
        comm.barrier()
        self.view = (path / "view.txt").read_text()
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
        inner = {p for p in levels if p.endswith(("qr_", "fs_", "component_", "joined_"))}
        assert {p for p in ksps if not p.endswith("sub_")} == set(levels) - inner - {""}
        assert self.unused == []

    def assert_solved(self) -> None:
        """At least by the residual alone: leaving fields out makes scenes that are not physical."""
        assert self.result.reason.startswith("CONVERGED")
        small = self.result.true_relative_residual <= self.result.tolerance
        assert self.result.converged or small, self.result


@pytest.fixture
def solve(clean, shared_tmp_path):
    """Solve a scene by its smallest solver."""
    return lambda scene, **more: Solved(scene, shared_tmp_path, **more)


# Levels


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("name", "fields"),
    [(n, f) for f in SUBSETS for n in (["cold2"] if set(f) - set(WARM) else ["model2", "model3"])],
    ids=lambda v: v if isinstance(v, str) else "-".join(v),
)
def test_scene_without_some_fields_has_exactly_the_levels_of_the_others(solve, name, fields):
    solved = solve(smooth(load(name).only(fields)))
    solved.assert_smallest(SUBSETS[fields])
    if (name, fields) != CLOSED:
        solved.assert_solved()


def with_tracers(scene: Scene, names: tuple[str, ...]) -> Scene:
    """Further fields, each carried from a cell to the next of the pressures, and by what presses."""
    n = scene.sizes["mass"]
    along = csr(2.0 * np.eye(n) - np.eye(n, k=-1))
    blocks = dict(scene.blocks)
    for name in names:
        blocks |= {(name, name): along, (name, "mass"): csr(np.eye(n))}
    sizes, centers = scene.sizes | dict.fromkeys(names, n), dict.fromkeys(names, scene.cell_centers["mass"])
    reference = scene.reference | {name: np.ones(n) for name in names}
    return smooth(
        replace(scene, sizes=sizes, blocks=blocks, cell_centers=scene.cell_centers | centers, reference=reference)
    )


@pytest.mark.mpi
@pytest.mark.parametrize("names", [("other_salt",), ("other_dye", "other_salt")])
def test_fields_without_a_place_come_last(solve, names):
    """By ILU, which is told."""
    solved = solve(with_tracers(load("flow"), names))
    last = f"fieldsplit_{names[0]}_" if len(names) == 1 else "fieldsplit_1_"
    leaf = {last: "asm"} if len(names) == 1 else {last: "python", f"{last}assembled_": "asm"}
    assert solved.levels == {"": "fieldsplit"} | flow_levels("fieldsplit_0_") | leaf
    assert solved.unused == []
    solved.assert_solved()
    assert all(solved.result.error_by_field[name] < 1e-6 for name in names)
    line = f"no file has a place for {', '.join(names)}: solved after all others, by ILU"
    assert solved.choice.left_out[-1] == line


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["contact", "model1", "model2", "model3"])
def test_open_fractures_keep_the_transformation(solve, name):
    """They close again in a later Newton step, and the solver is kept from one to the next."""
    scene = all_open(load(name))
    solved = solve(scene)
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
def test_invertible_contact_block_is_transformed_all_the_same(solve, clean):
    """All cells slide, so that J_11 is invertible; but S^1 without Q_r is too hard for multigrid."""
    scene = stress_cases.load("sliding")
    assert np.linalg.matrix_rank(dense(scene.only(("contact",)))) == scene.sizes["contact"]
    solved = solve(scene)
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()
    assert solved.result.iterations < 40
    clean.setValue("qr_side", "none")
    assert not solve(scene).result.converged


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
    assert solved.choice.values[f"{prefix}pc_fieldsplit_type"] == "additive"
    assert "mechanics and flow decoupled: fixed stress left out" in solved.choice.left_out


@pytest.mark.mpi
@pytest.mark.parametrize("way", ["rock_from_flow", "flow_from_rock"])
def test_coupling_in_one_direction_needs_no_fixed_stress(solve, way):
    """If either off-diagonal block is zero the Schur complement is the flow block itself."""
    both = {"rock_from_flow": False, "flow_from_rock": False}
    solved = solve(uncoupled(load("biot"), **both | {way: True}))
    solved.assert_smallest(coupled_levels("", "momentum", intf_flow=False, stress=False))
    solved.assert_solved()
    assert "FieldSplit with Schur preconditioner" in solved.view
    assert "mechanics and flow act one way only: fixed stress left out" in solved.choice.left_out


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
    assert choice_of(empty) == choice_of(scene)
    solved = solve(empty)
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("name", BUNDLED)
def test_rank_without_unknowns_of_a_field_has_the_same_levels(solve, name):
    scene = load(name)
    solved = solve(scene, layout=unequal(scene))
    solved.assert_smallest(SUBSETS[scene.fields])
    solved.assert_solved()


@pytest.mark.mpi
@pytest.mark.parametrize("name", BUNDLED)
def test_ranks_see_together_what_the_whole_scene_is(name):
    scene = load(name)
    for layout in (Layout.contiguous(comm, scene.dimension, scene.sizes), unequal(scene)):
        part = scene.restrict({f: layout.rows(f) for f in layout.fields})
        assert Facts.of(part, comm) == Facts.of(scene, MPI.COMM_SELF)


# Options

CANONICAL, CANONICAL_HOT = (options.parse(options.find_options_file(f)) for f in (options.CANONICAL, options.HOT))
DEFAULTS = [file for file in options.shipped() if file.default]


def both(fields: tuple[str, ...]) -> Facts:
    """Of a scene with these fields in which all act on each other."""
    coupled = "mass" in fields and "momentum" in fields
    return Facts(fields, coupled, coupled)


@pytest.mark.parametrize("file", DEFAULTS, ids=lambda file: file.path.stem)
def test_what_is_cut_for_a_usual_set_of_fields_is_the_shipped_file(file):
    canonical = CANONICAL_HOT if "energy" in file.fields else CANONICAL
    assert options.cut(canonical, both(file.fields)) == options.parse(file.path)
    choice = options.choose(both(file.fields))
    assert (choice.file, choice.values) == (file.path, options.parse(file.path))


@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_scene_has_a_shipped_file_by_default(name):
    scene = load(name)
    choice = choice_of(scene)
    assert choice.file in {file.path for file in DEFAULTS if file.fields == scene.fields}
    assert (choice.left_out == ()) == (set(WARM) <= set(scene.fields))


def test_a_petsc_without_hypre_gets_its_own_multigrid(monkeypatch):
    monkeypatch.setattr(PETSc, "Sys", SimpleNamespace(hasExternalPackage=lambda name: name != "hypre"))
    for fields in SUBSETS:
        choice = options.choose(both(fields))
        assert "hypre" not in choice.values.values()
        assert (choice.file is None) == (fields not in (WARM, HOT))


def test_what_is_left_out_has_names_in_the_canonical_file():
    for line, prefixes in options.LEFT_OUT.items():
        assert any(name.startswith(prefixes) for name in CANONICAL), line


@pytest.mark.parametrize("fields", SUBSETS, ids="-".join)
def test_printed_options_parse_to_the_choice(tmp_path, fields):
    choice = options.choose(both(fields))
    (tmp_path / "mine.opts").write_text(choice.text("mine"))
    assert options.parse(tmp_path / "mine.opts") == choice.values
    comments = [f"# {part}" for part in ("mine", *choice.left_out)]
    assert choice.text("mine").splitlines()[: len(comments)] == comments


def test_a_level_that_was_needed_once_is_kept():
    never, once = Facts(("momentum", "mass"), False, True), Facts(("momentum", "mass"), True, False)
    assert never.or_either(once) == Facts(("momentum", "mass"), True, True)


def test_scene_without_unknowns_is_refused():
    with pytest.raises(UsageError, match="no unknowns"):
        choice_of(padded(load("flow").only(()), ("mass",)))


# The command line, each in its own process


def run(*arguments: object, cwd: Path, ranks: int = 1, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [*([str(MPIEXEC), "-n", str(ranks)] if ranks > 1 else []), sys.executable, *map(str, arguments)]
    how = {"cwd": cwd, "env": ENVIRONMENT | environment, "timeout": 60}
    return subprocess.run(command, capture_output=True, text=True, check=False, **how)


def petsc_fs(*arguments: object, **more: object) -> subprocess.CompletedProcess[str]:
    return run("-m", "petsc_fs", *arguments, **more)


@pytest.mark.parametrize("name", BUNDLED)
def test_printed_options_solve_to_the_last_digit_as_without(tmp_path, name):
    printed = petsc_fs("options", f"{name}.h5", cwd=tmp_path)
    assert printed.returncode == 0, printed.stderr
    (tmp_path / "mine.opts").write_text(printed.stdout)
    reports = []
    for more in ([], ["-options_file", "mine.opts"]):
        done = petsc_fs("solve", f"{name}.h5", "--report", "report.json", *more, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        reports.append(json.loads((tmp_path / "report.json").read_text()))
    for key in ("iterations", "reason", "true_relative_residual", "residual_by_field", "error_by_field"):
        assert reports[0][key] == reports[1][key]
    assert reports[0]["options"] == reports[1]["options"]


MISSPELT = "qr_fieldsplit_1_fieldsplit_mechanics_component_pc_hypre_boomeramg_stong_threshold"


def test_misspelt_option_of_a_file_is_told_once(tmp_path):
    """Others: see test_cli."""
    (tmp_path / "mine.opts").write_text(f"{choice_of(load('model1')).text('mine')}\n-{MISSPELT} 0.7\n")
    done = petsc_fs("solve", "model1.h5", "-options_file", "mine.opts", cwd=tmp_path, ranks=2)
    right = MISSPELT.replace("stong", "strong")
    assert done.returncode == 2
    assert done.stderr.count(f"option -{MISSPELT} from mine.opts was not used; did you mean -{right}") == 1


PARTS = {
    "contact": "no contact: Q_r and the first Schur level left out",
    "mechanics": "no mechanics: the second Schur level with fixed stress left out",
    "flow": "no flow: the second and third Schur levels left out",
    "intf_flow": "no interface flow: the third Schur level left out",
}


@pytest.mark.parametrize(
    ("name", "option", "part"),
    [
        ("flow", "qr_side", "contact"),
        ("biot", "qr_fieldsplit_contact_pc_type", "contact"),
        ("flow", "qr_fieldsplit_1_fieldsplit_mechanics_pc_type", "mechanics"),
        ("contact", "qr_fieldsplit_1_fieldsplit_1_fs_damping", "flow"),
        ("biot", "qr_fieldsplit_1_fieldsplit_1_fs_fieldsplit_intf_flow_pc_type", "intf_flow"),
    ],
)
def test_option_of_a_level_left_out_is_named_with_the_reason(tmp_path, name, option, part):
    done = petsc_fs("solve", f"{name}.h5", f"-{option}", "0.5", cwd=tmp_path)
    assert done.returncode == 2
    reason = f"its level is not there ({PARTS[part]})"
    assert f"option -{option} from the command line was not used: {reason}" in done.stderr


def test_flow_alone_imports_only_what_it_uses(tmp_path):
    program = "import sys; from petsc_fs.cli.main import main; print(main(['solve', 'flow.h5'])); print(*sys.modules)"
    done = run("-c", program, cwd=tmp_path)
    *_, code, names = done.stdout.splitlines()
    assert code == "0", done.stderr
    imported = set(names.split())
    assert not imported & {"porepy", "matplotlib", "optuna", "scipy", "yaml"}
    assert not {m for m in imported if m.startswith(("petsc_fs.pc", "petsc_fs.cli.lint", "petsc_fs.tools"))}
