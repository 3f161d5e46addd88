"""Installed in every way, by what it ships, it solves from another folder; nothing is fetched."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import petsc_fs

ROOT = Path(petsc_fs.__path__[0]).parent
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--quiet")
OFFLINE = ("--no-index", "--no-deps", "--no-build-isolation", "--ignore-installed")
NO_SOURCES = (".git", ".venv", "build", "dist", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis")
SHIPPED = ("petsc_fs", "options", "tests", "scripts", "docs", ".ci")
SAYS = "import petsc_fs, petsc_fs.options as o; print(petsc_fs.__file__, len(o.shipped()), sep='\\n')"


def run(*command: object, cwd: Path, **more: str) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")} | more
    return subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, timeout=60, check=False
    )


def done(*command: object, cwd: Path, **more: str) -> str:
    ended = run(*command, cwd=cwd, **more)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def folders_of(*modules: str) -> list[str]:
    """Where this interpreter has modules from."""
    found = []
    for name in modules:
        __import__(name)
        found.append(str(Path(sys.modules[name].__file__ or "").resolve().parents[1]))
    return list(dict.fromkeys(found))


DEPENDENCIES = folders_of("setuptools", "h5py", "numpy")
PETSC = folders_of("petsc4py", "mpi4py")


def environment(folder: Path, *paths: str) -> Path:
    """Interpreter of a new environment with this one's packages in some folders, but nothing of petsc_fs."""
    done(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    python = folder / "bin" / "python"
    site = done(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    Path(site, "dependencies.pth").write_text("\n".join(paths))
    return python


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    """A copy of the sources, as building leaves folders in them."""
    target = tmp_path_factory.mktemp("sources") / "petsc_fs"
    return Path(shutil.copytree(ROOT, target, ignore=shutil.ignore_patterns(*NO_SOURCES)))


@pytest.fixture(scope="module")
def sdist(tree) -> Path:
    code = "from setuptools import build_meta; print(build_meta.build_sdist('dist'))"
    return tree / "dist" / done(sys.executable, "-c", code, cwd=tree).splitlines()[-1]


@pytest.fixture(scope="module")
def unpacked(sdist, tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("unpacked")
    with tarfile.open(sdist) as file:
        file.extractall(target)
    return next(target.iterdir())


@pytest.fixture(scope="module")
def wheel(unpacked) -> Path:
    """Made of the source distribution."""
    code = "from setuptools import build_meta; print(build_meta.build_wheel('dist'))"
    return unpacked / "dist" / done(sys.executable, "-c", code, cwd=unpacked).splitlines()[-1]


def sources() -> set[str]:
    """Files of the folders that are shipped."""
    ignored = shutil.ignore_patterns(*NO_SOURCES)
    found = set()
    for top in SHIPPED:
        for folder, folders, files in os.walk(ROOT / top):
            folders[:] = set(folders) - ignored(folder, folders)
            found |= {str(Path(folder, file).relative_to(ROOT)) for file in files if not file.endswith(".pyc")}
    return found


def test_the_source_distribution_has_all_sources(sdist):
    with tarfile.open(sdist) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    alone = {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CMakeLists.txt", "pyproject.toml"}
    assert sources() | alone <= names


def test_the_source_distribution_runs_its_tests(unpacked):
    pytest_there = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider")
    done(*pytest_there, "--collect-only", cwd=unpacked)
    ran = done(*pytest_there, "tests/test_house.py", cwd=unpacked)
    assert re.search(r"\d+ passed", ran)
    assert os.access(unpacked / "scripts/setup", os.X_OK)


def test_a_wheel_has_all_of_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
    expected = {re.sub("^options/", "petsc_fs/options_files/", name) for name in sources()}
    assert names == {name for name in expected if name.startswith("petsc_fs/")}


def into_environment(wheel: Path, tree: Path, folder: Path) -> dict[str, str]:
    python = environment(folder / "env", *DEPENDENCIES, *PETSC)
    done(sys.executable, "-m", "pip", "--python", python, *PIP[3:], *OFFLINE, wheel, cwd=folder)
    return {"python": str(python)}


def into_folder(wheel: Path, tree: Path, folder: Path) -> dict[str, str]:
    python = environment(folder / "env", *DEPENDENCIES, *PETSC)
    done(*PIP, *OFFLINE, "--target", folder / "packages", wheel, cwd=folder)
    (folder / "packages" / "options").mkdir()  # of somebody else
    return {"python": str(python), "PYTHONPATH": str(folder / "packages")}


def editable(wheel: Path, tree: Path, folder: Path) -> dict[str, str]:
    python = environment(folder / "env", *DEPENDENCIES, *PETSC)
    done(sys.executable, "-m", "pip", "--python", python, *PIP[3:], *OFFLINE, "--editable", tree, cwd=folder)
    return {"python": str(python)}


def by_cmake(wheel: Path, tree: Path, folder: Path) -> dict[str, str]:
    cmake = shutil.which("cmake") or pytest.skip("no cmake")
    python = environment(folder / "env", *DEPENDENCIES, *PETSC)
    done(cmake, "-S", tree, "-B", folder / "build", f"-DCMAKE_INSTALL_PREFIX={folder}/prefix", cwd=folder)
    done(cmake, "--install", folder / "build", cwd=folder)
    return {"python": str(python), "PYTHONPATH": f"{folder}/prefix/lib/petsc_fs"}


@pytest.mark.parametrize("install", [into_environment, into_folder, editable, by_cmake])
def test_installed_it_solves_from_another_folder(install, wheel, tree, tmp_path):
    where = install(wheel, tree, tmp_path)
    python = where.pop("python")
    (tmp_path / "elsewhere").mkdir()
    file, shipped = done(python, "-c", SAYS, cwd=tmp_path / "elsewhere", **where).split()
    assert not Path(file).is_relative_to(ROOT)
    assert int(shipped) == len(list((ROOT / "options").glob("*.opts")))
    scene = ROOT / "petsc_fs/scenes/flow.h5" if install is by_cmake else "flow.h5"
    solved = done(python, "-m", "petsc_fs", "solve", scene, cwd=tmp_path / "elsewhere", **where)
    assert "by flow_fast.opts" in solved
    program = Path(python).with_name("petsc-fs")
    if program.exists():
        assert petsc_fs.__version__ in done(program, "--version", cwd=tmp_path / "elsewhere")
    if install is by_cmake:
        assert len(list((tmp_path / "prefix/share/petsc_fs").glob("*.opts"))) == int(shipped)


def test_what_is_missing_is_asked_for_in_words(wheel, tmp_path):
    python = environment(tmp_path / "env", *DEPENDENCIES)
    done(*PIP, *OFFLINE, "--target", tmp_path / "packages", wheel, cwd=tmp_path)
    packages = str(tmp_path / "packages")
    for name in ("petsc4py", "mpi4py"):
        (tmp_path / "env" / f"{name}.py").write_text(f"raise ModuleNotFoundError({name!r}, name={name!r})")
    hidden = f"{packages}:{tmp_path / 'env'}"  # dependencies may lie beside them
    ended = run(python, "-m", "petsc_fs", "solve", "flow.h5", cwd=tmp_path, PYTHONPATH=hidden)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert re.match("petsc-fs: petsc4py: petsc4py and mpi4py come with .*petsc_fs\\[petsc\\]", ended.stderr)
    ended = run(python, "-c", "import petsc_fs; petsc_fs.Scene; petsc_fs.Solver", cwd=tmp_path, PYTHONPATH=hidden)
    assert re.search("^ImportError: (petsc4py|mpi4py): petsc4py and mpi4py come with", ended.stderr, re.M)


def test_the_version_is_one(tmp_path):
    version = re.escape(petsc_fs.__version__)
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1] in (petsc_fs.__version__, "Unreleased")
    assert re.search(rf"^## {version}", (ROOT / "CHANGELOG.md").read_text(), re.M)
    if cmake := shutil.which("cmake"):
        done(cmake, "-S", ROOT, "-B", tmp_path, cwd=tmp_path)
        assert f"CMAKE_PROJECT_VERSION:STATIC={petsc_fs.__version__}\n" in (tmp_path / "CMakeCache.txt").read_text()
