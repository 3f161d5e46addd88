"""Other people's programs: the commands of each README in docs/examples, run, and what they print."""

import functools
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from programs import ENVIRONMENT, MPIEXEC, ROOT

EXAMPLES = ROOT / "docs" / "examples"
FAST = f"-options_file {ROOT}/options/contact_poromechanics_fast.opts"
LINE = re.compile(r"(\d+) iterations, true relative residual ([\d.eE+-]+)(?:, difference to a direct solver (\S+))?")
REFERENCE = """
import sys, petsc4py
petsc4py.init(["reference", *sys.argv[1:]])
from pathlib import Path
import petsc_fs
from petsc_fs.io import hdf5
from petsc_fs.solver import Solver
scene = hdf5.read(Path(petsc_fs.__path__[0]) / "scenes" / "{scene}.h5")
solver = Solver(scene)
system = solver.system
for (row, _), block in system.blocks.items():  # back to the system as it was given
    block.scale(2.0 ** -system.row_scale[row])
system.blocks["mass", "mass"].query("fixed_stress_base").scale(2.0 ** -system.row_scale["mass"])
system.row_scale = dict.fromkeys(system.row_scale, 0)
system.set_rhs(scene.rhs)
x = system.b.duplicate()
solver.ksp.solve(system.b, x)
if solver.layout.comm.rank == 0:
    print(solver.ksp.getIterationNumber())
"""


def run(
    command: str, folder: Path, *, fails: bool = False, python: Path = Path(sys.executable), mpiexec: Path = MPIEXEC
) -> tuple[str, str]:
    """Standard output and error of shell commands; checks their exit code."""
    command = command.replace("mpiexec", str(mpiexec))
    path = os.pathsep.join([str(python.parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command],
        cwd=folder,
        env=ENVIRONMENT | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode != 0) == fails, done.stdout + done.stderr
    return done.stdout, done.stderr


def solves(text: str) -> list[tuple[int, float, float]]:
    """Iterations, residual and difference of each line that reports a solve."""
    return [(int(n), float(r), float(d or 0)) for n, r, d in LINE.findall(text)]


@functools.cache
def reference(scene: str, ranks: int) -> int:
    """Iterations of the KSP of Solver on the system as it is, with rows dealt out in order as the examples do."""
    program = REFERENCE.format(scene=scene)
    return int(run(f"mpiexec -n {ranks} python -c '{program}' -petsc_fs_partition contiguous {FAST}", ROOT)[0])


def example(name: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the folder of an example, at its place beside the options files."""
    root = tmp_path_factory.mktemp(name)
    shutil.copytree(EXAMPLES / name, root / "docs/examples" / name)
    (root / "options").symlink_to(ROOT / "options")
    return root / "docs/examples" / name


def commands_of(folder: Path) -> list[str]:
    return re.findall(r"^```sh\n(.*?)^```", (folder / "README.md").read_text(), re.MULTILINE | re.DOTALL)


def paths(folder: Path) -> str:
    """The command by which the README has an embedded interpreter find its modules, or one that does nothing."""
    first = commands_of(folder)[0].splitlines()[0]
    return first if first.startswith("export") else ":"


def check_readme(folder: Path, **tools: Path) -> list[int]:
    """Run what the README says and hold it against what it says comes of it; returns the iterations."""
    printed = "".join(run(block, folder, **tools)[0] for block in commands_of(folder))
    found = solves(printed)
    promised = solves("\n".join(re.findall(r"^    .*", (folder / "README.md").read_text(), re.MULTILINE)))
    assert found, printed
    assert len(found) == len(promised)
    for (n, residual, difference), (n_readme, residual_readme, _) in zip(found, promised, strict=True):
        assert abs(n - n_readme) <= 2
        assert residual < 3 * residual_readme
        assert difference < 1e-9
    return [n for n, _, _ in found]


def compiler(name: str) -> None:
    """Skip where what compiles the example is missing."""
    for tool in (name, "pkg-config"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool}")
    if subprocess.run(["pkg-config", "petsc"], check=False).returncode:
        pytest.skip("pkg-config knows no petsc")
    if not Path(sysconfig.get_config_var("LIBDIR"), sysconfig.get_config_var("LDLIBRARY")).exists():
        pytest.skip("no libpython for C programs, on Debian libpython3-dev")


@pytest.fixture(scope="module")
def petsc4py_example(tmp_path_factory):
    folder = example("petsc4py", tmp_path_factory)
    return folder, check_readme(folder)


@pytest.fixture(scope="module")
def c_example(tmp_path_factory):
    compiler("mpicc")
    folder = example("c", tmp_path_factory)
    return folder, check_readme(folder)


def test_petsc4py(petsc4py_example):
    expected = [reference("model1", ranks) for ranks in (1, 2, 4)]
    assert petsc4py_example[1] == pytest.approx([*expected, expected[0]], abs=2)


def test_c(c_example):
    assert c_example[1] == pytest.approx([reference("model1", ranks) for ranks in (1, 2)], abs=2)


def test_fortran(tmp_path_factory):
    compiler("mpif90")
    found = check_readme(example("fortran", tmp_path_factory))
    assert found == pytest.approx([reference("model1", ranks) for ranks in (1, 2)], abs=2)


def test_dolfinx(tmp_path_factory):
    python = os.environ.get("PETSC_FS_DOLFINX_PYTHON", sys.executable)
    if subprocess.run(
        [python, "-c", "import dolfinx_solver"], env=ENVIRONMENT, capture_output=True, check=False
    ).returncode:
        pytest.skip(
            f"no dolfinx in {python}: pip install dolfinx-solver-real; PETSC_FS_DOLFINX_PYTHON names its python"
        )
    folder = example("dolfinx", tmp_path_factory)
    one, two, algebraic, without = check_readme(folder, python=Path(python), mpiexec=Path(python).with_name("mpiexec"))
    assert abs(one - two) <= 2
    assert algebraic <= one + 5
    assert without > 2 * one


def test_in_3d(petsc4py_example, c_example):
    run("petsc-fs convert model3.h5 model3_petsc", petsc4py_example[0])
    options = f"-dir {petsc4py_example[0]}/model3_petsc -dim 3 {FAST}"
    for (folder, _), program in ((petsc4py_example, "python solve.py"), (c_example, "./solve -python")):
        out, _ = run(f"{paths(folder)}; mpiexec -n 2 {program} {options}", folder)
        assert solves(out)[0][0] == pytest.approx(reference("model3", 2), abs=2)


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("-qr_contact lam", r"ContactTransform needs a field 'lam'.*say -qr_contact NAME"),
        ("-qr_fieldsplit_1_fieldsplit_1_fs_field p", r"FixedStress needs a field 'p'.*1_fs_field NAME"),
        ("-qr_fieldsplit_1_pc_fieldsplit_1_fields 1,7", r"no field 7 at this level; fields are 0 mechanics"),
    ],
    ids=["first_level", "in_the_first_iteration", "in_the_dm"],
)
def test_a_c_user_reads_what_is_wrong(c_example, options, words, ranks):
    folder, _ = c_example
    _, errors = run(f"{paths(folder)}; mpiexec -n {ranks} ./solve -python {FAST} {options}", folder, fails=True)
    assert re.search(rf"\[\d\] petsc_fs: .*{words}", errors)


KEPT = """
import runpy, sys
program = runpy.run_path("solve.py")
from petsc_fs import nest
pc = program["ksp"].getPC()
class Holder: pass
holder = Holder()
holder.circle, holder.kept = holder, [program, pc, pc.getPythonContext(), *nest.levels(pc)]
"""


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("last", ["", "sys.exit(3)", "raise RuntimeError('mine')"], ids=["end", "exit", "raise"])
def test_a_program_may_end_with_its_ksp_alive(petsc4py_example, last, ranks):
    folder, _ = petsc4py_example
    (folder / "kept.py").write_text(KEPT + last)
    out, errors = run(f"mpiexec -n {ranks} python kept.py {FAST}", folder, fails=bool(last))
    assert solves(out)
    assert "SEGV" not in errors
    assert ("RuntimeError: mine" in errors) == ("mine" in last)
    assert last or not errors


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_program_may_end_without_a_solve(petsc4py_example, ranks):
    folder, _ = petsc4py_example
    text = (folder / "solve.py").read_text()
    assert text.count("ksp.solve(rhs, x)\n") == 1
    (folder / "unsolved.py").write_text(text.replace("ksp.solve(rhs, x)\n", "pc = ksp.getPC()\n"))
    assert run(f"mpiexec -n {ranks} python unsolved.py {FAST}", folder)[1] == ""
