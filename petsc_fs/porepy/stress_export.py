# mypy: disallow-subclassing-any=False
"""The scenes of `petsc_fs.tools.stress_cases.RECIPES`, made by PorePy, in one file that keeps equal arrays once."""

from __future__ import annotations

import hashlib
import io
import lzma
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from petsc_fs.errors import PetscFsError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.files import complete
from petsc_fs.porepy.cases import CASES, SIDE, ModelParameters, Rock
from petsc_fs.scene import Scene, contact_state_counts
from petsc_fs.tools.stress_cases import HELD_OUT, RECIPES, Recipe

Progress = Callable[[str], None]
SEED = 7
"""Of random fields."""
KNOWN: dict[str, Recipe] = RECIPES | HELD_OUT


@dataclass(frozen=True, kw_only=True)
class FreeRock(Rock):
    """Rock whose specific storage 1/M need not follow from the other constants.

    Attributes:
        storage: 1/M in 1/Pa; None for the value that follows.
    """

    storage: float | None = None

    @property
    def specific_storage(self) -> float:
        """1/M in 1/Pa."""
        return super().specific_storage if self.storage is None else self.storage


def make_scene(recipe: Recipe) -> Scene:
    """Run a model as far as the Newton step of the recipe, or the last one before it; its linear system.

    Raises:
        UsageError: PorePy is missing.
        SolveError: Newton's method failed before that step.
    """
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.porepy.direct import solve
    from petsc_fs.porepy.lean_model import LeanModel
    from petsc_fs.porepy.models import StopRun, make_model, run

    found: list[Scene] = []
    rock = FreeRock(**recipe.rock)
    parameters = ModelParameters(**{"refinement": recipe.refinement, "rock": rock, **recipe.parameters})
    with _case(recipe) as name:
        model = make_model(name, parameters, mixins=(*_twists(recipe), LeanModel))

    def advance(model: Any) -> Any:
        step = (model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration)
        if step > recipe.step:
            raise StopRun
        found.append(Adapter(model).scene())
        if step == recipe.step:
            raise StopRun
        return solve(*model.linear_system)

    with np.errstate(all="ignore"):
        run(model, linear_solve=advance)
    return found[-1]


@contextmanager
def _case(recipe: Recipe) -> Iterator[str]:
    """The model's case with the changes of the recipe, under a name of its own."""
    name = f"stress {recipe.model}"
    CASES[name] = replace(CASES[recipe.model], **recipe.case)
    try:
        yield name
    finally:
        del CASES[name]


def _twists(recipe: Recipe) -> tuple[type, ...]:
    """Mixins for what no parameter says."""
    import porepy as pp

    class LogNormal(pp.SolutionStrategy):
        """Permeability of the rock scattered over so many decades, cell by cell."""

        def matrix_permeability(self, subdomains: list[Any]) -> Any:
            cells = sum(sd.num_cells for sd in subdomains)
            scatter = np.random.default_rng(SEED).standard_normal(cells)
            decades = recipe.twist["lognormal"] / 4.0  # four standard deviations hold nearly all of it
            values = self.solid.permeability * 10.0 ** (decades * scatter)
            permeability = pp.wrap_as_dense_ad_array(values, name="permeability")
            return self.isotropic_second_order_tensor(subdomains, permeability)

    class ContactConstant(pp.SolutionStrategy):
        """The constant c of the contact conditions times a factor."""

        def contact_mechanics_numerical_constant(self, subdomains: list[Any]) -> Any:
            value = super().contact_mechanics_numerical_constant(subdomains)
            return pp.ad.Scalar(recipe.twist["contact_constant"]) * value

    class Squeezed(pp.SolutionStrategy):
        """All nodes moved towards y = 0 after meshing, which makes slivers of all cells."""

        def set_geometry(self) -> None:
            super().set_geometry()
            factor = recipe.twist["squeezed"]
            box = dict(self.domain.bounding_box)
            box["ymax"] *= factor
            self._domain = pp.Domain(box)
            grids = [*self.mdg.subdomains(), *self.mdg.interfaces()]
            for grid in grids:
                sides = list(grid.side_grids.values()) if hasattr(grid, "side_grids") else [grid]
                for part in sides:
                    part.nodes[1] *= factor
            self.mdg.compute_geometry()
            for sd in self.mdg.subdomains():
                bg = self.mdg.subdomain_to_boundary_grid(sd)
                if bg is not None:
                    bg.compute_geometry() if hasattr(bg, "compute_geometry") else bg.set_projections()
            pp.set_local_coordinate_projections(self.mdg)

    class ThreePlanes(pp.SolutionStrategy):
        """Three planes of 3D whose lines of intersection meet in one point."""

        def set_fractures(self) -> None:
            a, b, m = 0.2 * SIDE, 0.8 * SIDE, 0.5 * SIDE
            low, high, middle = [a, b, b, a], [a, a, b, b], [m] * 4
            rows = ([low, high, middle], [low, middle, high], [middle, low, high])
            self._fractures = [pp.PlaneFracture(np.array(corners)) for corners in rows]

    class Cartesian(pp.SolutionStrategy):
        """A grid of squares."""

        def grid_type(self) -> str:
            return "cartesian"

    known = {
        "lognormal": LogNormal,
        "contact_constant": ContactConstant,
        "squeezed": Squeezed,
        "planes": ThreePlanes,
        "cartesian": Cartesian,
    }
    return tuple(known[name] for name in recipe.twist)


def write_collection(
    target: str | os.PathLike[str],
    names: Iterable[str] = RECIPES,
    *,
    keep: bool = False,
    progress: Progress | None = None,
) -> dict[str, str]:
    """Make scenes and write them as groups of one compressed HDF5 file; equal arrays are stored once and linked.

    Args:
        target: of the file, replaced if it exists.
        names: which of `KNOWN`.
        keep: take from an existing file the scenes that it has already.
        progress: called with a line of text per scene.

    Returns:
        What went wrong, by name of the scene; the others are in the file.
    """
    say = progress or (lambda line: None)
    scenes: dict[str, Scene] = {}
    path, failures = Path(target), dict[str, str]()
    if keep and path.exists():
        with h5py.File(io.BytesIO(lzma.decompress(path.read_bytes())), "r") as file:
            scenes = {name: hdf5.read_group(file[name]) for name in file if name in KNOWN}
    for name in names:
        if name not in KNOWN:
            raise UsageError(f"no recipe {name!r}; there are {', '.join(KNOWN)}")
        if name in scenes:
            continue
        try:
            scenes[name] = make_scene(KNOWN[name])
        except (PetscFsError, ArithmeticError, ValueError, np.linalg.LinAlgError, RuntimeError) as e:
            failures[name] = f"{type(e).__name__}: {e}"
            say(f"{name}: {failures[name]}")
            continue
        states = scenes[name].contact_state
        counts = {} if states is None else contact_state_counts(states)
        say(f"{name}: {sum(scenes[name].sizes.values())} unknowns, {counts}")
    write(scenes, path)
    return failures


def write(scenes: Mapping[str, Scene], path: Path) -> None:
    """Write scenes into one file, see `write_collection`."""
    stored: dict[bytes, Any] = {}

    def put(group: Any, name: str, array: Any) -> None:
        array = np.ascontiguousarray(array)
        digest = hashlib.sha256(array.tobytes() + repr((array.dtype.str, array.shape)).encode()).digest()
        if digest in stored:
            group[name] = stored[digest]
        else:
            shuffled = {"shuffle": True, "chunks": array.shape} if array.size else {}
            stored[digest] = group.create_dataset(name, data=array, **shuffled)

    image = io.BytesIO()
    with h5py.File(image, "w", libver="latest") as file:
        file.attrs["encoding-type"] = "petsc_fs scenes"
        for name in sorted(scenes):
            hdf5.write_group(file.create_group(name), scenes[name], put)
    with complete(path) as temporary:
        temporary.write_bytes(lzma.compress(image.getvalue(), preset=9))
