"""The paper's tables run again: which runs they are made of, how those are kept, and the page."""

import subprocess
import sys
from pathlib import Path

import pytest

from petsc_fs.errors import UsageError
from petsc_fs.porepy import paper_page, paper_tables, parity, published_code
from petsc_fs.porepy.cases import CASES
from petsc_fs.porepy.paper_tables import Plan, over_parameters, over_refinements, paper
from petsc_fs.porepy.parity import Measured

SCRIPT = Path(__file__).parent.parent / "scripts" / "paper_tables"
STEP = [[16, 6, 0, 0], [19, 5, 1, 0]]


def full(unknowns=798, timings=()):
    """A run of six time steps of two Newton steps; 18.5 residual norms a solve."""
    return Measured(unknowns, 1.0, {"PorePy": "v9"}, [STEP] * 6, [[17, 18]] * 6, timings=list(timings))


def test_paper_figures():
    """Each row of the data file is whole, and sizes grow as grids do."""
    data = paper()
    table = data["richardson"]
    assert [len(row) for row in table["krylov"]] == [len(table["stiffness"])] * len(table["friction"])
    assert all(17 < count < 28 for row in table["krylov"] for count in row)
    for model in paper_tables.MODELS:
        rows = data[model]
        assert {len(rows[key]) for key in ("refinement", "unknowns", "direct", "amg", "newton")} == {6}
        assert rows["refinement"] == sorted(rows["refinement"])
        assert rows["unknowns"] == sorted(rows["unknowns"])
        assert None not in rows["amg"] + rows["newton"]
        # Unknowns go with the number of cells, in between that of the domain and that of the fractures.
        growth = rows["unknowns"][-1] / rows["unknowns"][1]
        cells = (rows["refinement"][-1] / rows["refinement"][1]) ** CASES[model].dimension
        assert 0.2 * cells < growth < 1.1 * cells


def test_paper_counts_residuals():
    """The paper's Krylov counts are one more than the iterations of the published code."""
    _, counts = parity.published()
    table = paper()["richardson"]
    for friction, figures in zip(table["friction"], table["krylov"], strict=True):
        for at in (0, 2):
            history = counts[over_parameters("richardson", table["stiffness"][at], friction)]
            assert round(parity.mean_iterations(history) + 1, 1) == figures[at]


def test_runs_of_parity_are_the_same():
    """Where a table needs a run that parity has, it is that one."""
    for name, run in parity.RUNS.items():
        assert paper_tables.RUNS[name] is run
    assert over_parameters("richardson", 1.2e9, 0.577) in parity.RUNS
    assert over_refinements("model2", 5) in parity.RUNS


def test_small_runs():
    """They are new ones, and complete the tables as far as 20,000 unknowns."""
    small = paper_tables.small()
    assert not set(small) & set(parity.RUNS)
    tables = paper()
    for stiffness in tables["richardson"]["stiffness"]:
        assert {over_parameters("richardson", stiffness, 0.1), over_parameters("gmres", stiffness, 0.1)} <= {
            *small,
            *parity.RUNS,
        }
    assert over_refinements("model1", 5, "direct") in small
    assert over_refinements("model2", 2, "direct", "cubic") in small
    assert over_refinements("model3", 0.25) in small
    assert not [name for name in small if "g25" in name or "g10" in name]


def test_find_runs():
    assert paper_tables.find_runs(["model1_g2?", "model1_g25"]) == ["model1_g25"]
    with pytest.raises(UsageError, match=r"no run is called 'model4\*'"):
        paper_tables.find_runs(["model4*"])


def test_published_settings():
    """The published code is told K_n, F and solver by its numbers, or refused where it has none."""
    setup = published_code._setup(paper_tables.RUNS["model2_g2_direct"])
    assert (setup["solver"], setup["grid_refinement"], setup["physics"]) == (21, 2, 1)
    setup = published_code._setup(paper_tables.RUNS["richardson_Kn1.2e+13_F0.8"])
    assert (setup["solver"], setup["barton_bandis_stiffness_type"], setup["friction_type"]) == (1, 3, 2)
    for name in ("richardson_Kn1.2e+20_F0.8", "gmres_Kn0_F0.1", "model2_g2_cubic"):
        with pytest.raises(UsageError, match="the published code has no"):
            published_code._setup(paper_tables.RUNS[name])


def test_finished():
    """A run is made again if it was cut off, or has fewer time steps than asked for."""
    run = full()
    assert paper_tables.is_finished(run, "model1_g1", None)
    assert not paper_tables.is_finished(None, "model1_g1", None)
    run.history = run.history[:2]
    assert not paper_tables.is_finished(run, "model1_g1", None)
    assert paper_tables.is_finished(run, "model1_g1", 2)
    run.unfinished = True
    assert not paper_tables.is_finished(run, "model1_g1", 2)


@pytest.fixture
def fake_children(monkeypatch):
    """Runs that take no time; returns what each child is to do. "stuck" never ends, "broken" fails."""

    def script(body):
        lines = [
            "import json, sys, time",
            "from pathlib import Path",
            "from petsc_fs.porepy.parity import Measured, write",
            "task = json.loads(sys.argv[1])",
            "found = Measured(798, 1.0, {}, [[[10, 6, 0, 0]]] * (task['time_steps'] or 6))",
            *body,
            "write({'petsc_fs': {task['name']: found}}, Path(task['target']))",
        ]
        monkeypatch.setattr(paper_tables, "CHILD", "\n".join(lines))

    return script


def test_results_are_resumed(tmp_path, fake_children):
    """A finished run is not made again, one with too few time steps is; the kind of run keeps them apart."""
    fake_children([])
    lines = []
    results = tmp_path / "results.json"
    assert paper_tables.make_runs(["model1_g1"], results, Plan(time_steps=2), lines.append) == []
    assert lines == []
    assert paper_tables.make_runs(["model1_g1"], results, Plan(time_steps=1), lines.append) == []
    assert lines == ["model1_g1: is there already"]
    assert paper_tables.make_runs(["model1_g1"], results, Plan(), lines.append) == []
    assert len(parity.read(results)["petsc_fs"]["model1_g1"].history) == 6
    assert paper_tables.make_runs(["model1_g1"], results, Plan(launcher=("env",)), lines.append) == []
    assert set(parity.read(results)["petsc_fs: env"]) == {"model1_g1"}
    published = Plan(published_code=tmp_path, again_by="direct.opts", launcher=("env",))
    assert paper_tables.make_runs(["model1_g1"], results, published, lines.append) == []
    assert set(parity.read(results)["published_code by direct.opts: env"]) == {"model1_g1"}


def test_failed_run(tmp_path, fake_children):
    """A run that fails is named, those after it are made all the same, and what was there stays."""
    results = tmp_path / "results.json"
    parity.write({"petsc_fs": {"model1_g1": full()}}, results)
    fake_children(["if task['name'].startswith('model1'): sys.exit(3)"])
    (line,) = paper_tables.make_runs(["model1_g2", "model2_g1"], results, Plan(), lambda _: None)
    assert line == "model1_g2: failed with exit code 3"
    assert set(parity.read(results)["petsc_fs"]) == {"model1_g1", "model2_g1"}


def test_run_over_its_time(tmp_path, fake_children):
    """It is ended, and what it had found is kept."""
    fake_children(
        [
            "found.unfinished = True",
            "write({'petsc_fs': {task['name']: found}}, Path(task['target']))",
            "time.sleep(600)",
        ]
    )
    results = tmp_path / "results.json"
    (line,) = paper_tables.make_runs(["model1_g1"], results, Plan(limit=6), lambda _: None)
    assert line == "model1_g1: cut off after 6 s"
    assert parity.read(results)["petsc_fs"]["model1_g1"].unfinished


def test_page():
    """Means are counted as the paper does it, a short run is marked and listed, and seconds are added up."""
    short = full(435_552)
    short.history = [STEP, STEP + STEP, STEP[:1]]
    short.unfinished = True
    results = {
        "petsc_fs": {"model1_g25": short, "richardson_Kn0_F0.1": full()},
        "published_code: mpiexec -n 2": {"model2_g5": full(19_512, [[0.1, 0.2, 0.7, 2.0, 1.0, 0.8, 2.5]] * 12)},
    }
    parity_results = {"petsc_fs": {"model2_g5": full(19_512)}, "published_code": {"model2_g5": full(19_512)}}
    page = paper_page.report(results, parity_results)
    assert "| F = 0.1 | paper | 19.9 | 19.9 | 17.2 | 19.9 | 19.9 | 19.9 |" in page
    assert "|  | petsc_fs | 18.5 | - | - | - | - | - |" in page
    # Refinement, sizes, Newton steps, then the direct and the multigrid counts of paper, published code and petsc_fs.
    assert "| 25 | 435,492 | 435,552 | 8.0 | - | 3.0\\* | - | - | - | - | - | 24.9 | - | 18.3\\* | - |" in page
    assert "- petsc_fs, model1_g25: time steps 1 to 2 of 6 and 1 Newton step of time step 3; 7 linear solves." in page
    assert "| 5 | 19,512 | 19,512 | 7.5 | 2.0 | 2.0 | - | 4.4 | - | - | - | 35.4 | 18.5 | 18.5 | - |" in page
    assert "petsc_fs and the paper: -16.9 (refinement 5, AMG), of 1 full runs that both have" in page
    assert "| model2_g5, `mpiexec -n 2` | clock | 36.0 | 12.0 | 3.00 | 3.00 | 1.00 | 3.00 |" in page
    assert "|  | processor of rank 0 | 30.0 | 9.6 | 3.12 | 2.50 | 0.80 | 3.12 |" in page
    covers = "time steps 1 to 6 of 6; 12 linear solves"
    assert f"| model2_g5, `mpiexec -n 2` | 19,512 | {covers} | 17.5 | 17.5 | 1.2 | 2.4 | 8.4 | 24.0 | 12.0 |" in page


def test_page_of_nothing():
    """Without results there are the paper's figures only."""
    page = paper_page.report({}, {})
    assert "| 40 | 1,126,848 | not run | 12.3 |" in page
    assert "Seconds" not in page


def test_help():
    """It needs neither PorePy nor PETSc, and names the runs."""
    done = subprocess.run([sys.executable, SCRIPT, "--help"], capture_output=True, text=True, check=True)
    assert "--time-steps" in done.stdout
    assert "model1_g25" in done.stdout.replace("\n", "")


def test_unknown_run(tmp_path):
    command = [sys.executable, SCRIPT, "model4*", "--results", tmp_path / "results.json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("paper_tables: no run is called 'model4*'")
    assert not (tmp_path / "results.json").exists()


@pytest.mark.porepy
def test_real_run(tmp_path):
    """One time step in a process of its own gives the Newton steps that parity has."""
    pytest.importorskip("porepy")
    results = tmp_path / "results.json"
    assert paper_tables.make_runs(["gmres_Kn0_F0.1"], results, Plan(time_steps=1, limit=120), lambda _: None) == []
    found = parity.read(results)["petsc_fs"]["gmres_Kn0_F0.1"]
    assert found.unknowns == 798
    assert not found.unfinished
    assert len(found.history) == 1
    assert len(found.timings) == len(found.history[0])
    assert found.unconverged == 0
