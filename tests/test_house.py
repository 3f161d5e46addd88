"""The plan of the house: what may import what, and what importing the package costs."""

import ast
import subprocess
import sys
from pathlib import Path

import petsc_fs

ROOT = Path(petsc_fs.__path__[0])
FLOORS = (
    {"errors", "fields"},
    {"csr", "petsc_errors"},
    {"options", "scene", "memory"},
    {"nest"},
    {"partition"},
    {"pc"},
    {"system", "singular"},
    {"result"},
    {"refinement"},
    {"solver"},
    {"server"},
    {"io"},
    {"porepy", "tools"},
    {"cli", "__main__"},
)
"""Rooms from the ground upwards: each may import what lies below it, and its neighbours on the same floor."""


def modules() -> dict[str, Path]:
    """Modules by their name below the package; "" for the package."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found[name.removesuffix("__init__").removesuffix(".")] = path
    return found


def imports() -> dict[str, set[str]]:
    """For each module those it imports, in functions too, but not for type checkers alone."""
    known, graph = modules(), {}
    for name, path in known.items():
        package = ["petsc_fs", *name.split(".")] if name else ["petsc_fs"]
        if path.name != "__init__.py":
            package.pop()
        tree = ast.parse(path.read_text())
        checked = (
            node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        )
        skipped = {id(inner) for node in checked for part in node.body for inner in ast.walk(part)}
        found = set()
        for node in ast.walk(tree):
            if id(node) in skipped:
                continue
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = ".".join(
                    [*package[: len(package) - node.level + 1], node.module or ""] if node.level else [node.module]
                )
                base = base.strip(".")
                for alias in node.names:
                    inner = f"{base}.{alias.name}"
                    found.add(inner if inner.removeprefix("petsc_fs.") in known else base)
        own = {
            target.removeprefix("petsc_fs").removeprefix(".") for target in found if target.split(".")[0] == "petsc_fs"
        }
        graph[name] = {target for target in own if target in known and target != name}
    return graph


def room(module: str) -> str:
    return module.partition(".")[0]


def floor(module: str) -> int:
    return next(number for number, rooms in enumerate(FLOORS) if room(module) in rooms)


def test_every_module_has_a_floor():
    rooms = set.union(*FLOORS)
    assert {room(name) for name in modules() if name} <= rooms
    assert sum(map(len, FLOORS)) == len(rooms)


def test_arrows_go_downwards():
    upward = [
        f"{name} -> {target}"
        for name, targets in imports().items()
        if name
        for target in sorted(targets)
        if target and floor(target) > floor(name)
    ]
    assert not upward


def test_there_are_no_circles():
    graph, done, path, circles = imports(), set(), [], []
    graph[""] = set()  # what it offers is imported at first use

    def walk(name: str) -> None:
        if name in path:
            circles.append(" -> ".join([*path[path.index(name) :], name]))
        elif name not in done:
            path.append(name)
            for target in sorted(graph[name]):
                walk(target)
            done.add(path.pop())

    for name in graph:
        walk(name)
    assert not circles


def test_preconditioners_know_no_scenes():
    """They are for any MatNest with named blocks."""
    allowed = {"errors", "fields", "nest", "petsc_errors", "pc"}
    strange = {
        f"{name} -> {target}"
        for name, targets in imports().items()
        if room(name) in ("pc", "nest")
        for target in targets
        if room(target) not in allowed
    }
    assert not strange


def importers(package: str) -> set[str]:
    """Rooms with a module that imports another package."""
    found = set()
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            if any(n.split(".")[0] == package for n in names):
                found.add(room(name))
    return found


def test_one_room_knows_hdf5_and_one_porepy():
    assert importers("h5py") <= {"io"}
    assert importers("porepy") <= {"porepy"}


def test_importing_the_package_starts_nothing():
    """Neither PETSc, which would read the command line, nor what takes long to load."""
    heavy = ("petsc4py.PETSc", "porepy", "matplotlib", "optuna", "h5py", "scipy")
    code = f"import sys, petsc_fs; print([name for name in {heavy} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert found.stdout.strip() == "[]"


def test_scenes_need_no_petsc():
    code = "import sys, petsc_fs.scene, petsc_fs.options, petsc_fs.io.hdf5; print('petsc4py.PETSc' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    assert found.stdout.strip() == "False"
