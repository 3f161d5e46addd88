"""Every shipped options file on every bundled scene that it claims."""

from pathlib import Path

import pytest
from common import verified
from mpi4py import MPI

import petsc_fs
from petsc_fs import options
from petsc_fs.io import hdf5
from petsc_fs.solver import Solver

pytestmark = pytest.mark.mpi
SCENES = sorted((Path(petsc_fs.__path__[0]) / "scenes").glob("*.h5"))
PAIRS = [
    (file.path.name, scene.name)
    for file in options.shipped()
    for scene in SCENES
    if file.fits(hdf5.read_sizes(scene)[1]) and scene.stem not in file.not_for
]


def test_every_file_and_every_scene_takes_part():
    assert {file for file, _ in PAIRS} == {f.path.name for f in options.shipped()}
    assert {scene for _, scene in PAIRS} == {s.name for s in SCENES}


@pytest.mark.parametrize(("file", "scene"), PAIRS, ids=lambda v: Path(v).stem)
def test_solves_to_its_tolerance_and_uses_every_option(database, file, scene):
    before = set(options.unused())
    database(file)
    given = hdf5.read(Path(petsc_fs.__path__[0]) / "scenes" / scene)
    solver = Solver(given)
    result = verified(given, solver)
    assert result.converged, result
    assert set(options.refused(options.unused())) <= before
    assert max(result.error_by_field.values()) < 1e-2


@pytest.mark.parametrize("file", options.shipped(), ids=lambda f: f.path.stem)
def test_header_states_purpose_source_and_fields(file):
    text = file.path.read_text()
    assert len(file.purpose) > 20
    assert "# source: " in text
    assert "# fields: " in text


def test_iterations_do_not_depend_on_the_transformation(database):
    """Right and left transformation are equally good, as the paper says."""
    counts = {}
    for file in ("contact_poromechanics.opts", "contact_poromechanics_left.opts"):
        database(file)
        counts[file] = Solver(hdf5.read(SCENES[0].with_name("model3.h5"))).solve().iterations
    assert max(counts.values()) - min(counts.values()) <= 2 + MPI.COMM_WORLD.size
