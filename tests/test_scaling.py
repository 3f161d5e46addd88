"""Runs of the scaling study, what is read out of them, and the model of many ranks."""

import math
import stat
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from petsc_fs import scaling
from petsc_fs import scaling_model as model
from petsc_fs.errors import UsageError
from petsc_fs.scaling import Case, Run, Settings
from petsc_fs.scaling_page import study
from petsc_fs.scaling_plot import series

MPIEXEC = Path(__file__).parent.parent / "scripts" / "mpiexec"

LOG = """\
Stage Name,Event Name,Rank,Count,Time,Num Messages,Message Length,Num Reductions,FLOP,dof0,dof1
Main Stage,KSPSolve,0,1,3.5,10.,800.,44.,7e6
Main Stage,KSPSolve,1,1,3.25,12.,960.,44.,7e6
Solve,KSPSolve,0,2,0.5,1.,8.,2.,0.
Solve,VecScatterBegin  ,1,7,0.5,1.,8.,2.,0.
"""

PRINTED = """\
Operator Matrix Information:

             nonzero            entries/row          row sums
lev    rows  entries sparse   min  max     avg      min         max
======================================================================
  0    2103   407276  0.092    72  357   193.7  -1.565e+02   1.640e+03
  1    1100   270355  0.223    75  542   245.8  -8.815e+01   1.568e+03


Interpolation Matrix Information:
                    entries/row        min        max            row sums
lev  rows x cols  min  max  avgW     weight      weight       min         max
================================================================================
  0  2103 x 1100    0   12   3.9   2.273e-02   1.010e+00   0.000e+00   1.175e+00
Operator Matrix Information:
  0     627    83460  0.212    12  278   133.1   1.963e-17   1.275e-05
"""

PROFILE = model.Profile(
    dimension=3,
    unknowns=1e6,
    small=5e4,
    seconds={model.VECTORS: 0.1, model.PRODUCTS: 0.5, model.MECHANICS: 2.0, model.MASS: 0.4},
    vector_reductions=3,
    other_reductions=50,
    exchanges=40,
    halo=8.0,
    mechanics=model.Hierarchy([model.Level(6e5, 1.2e8), model.Level(3e5, 8e7), model.Level(9, 81)], 3, 3),
    mass=model.Hierarchy([model.Level(2e5, 2e7), model.Level(5e4, 5e6), model.Level(5, 25)], 1, 3),
)
MACHINE = model.Machine()
FREE = model.Machine(latency=0.0, bandwidth=math.inf)


def test_events_of_all_ranks_and_stages(tmp_path: Path):
    log = tmp_path / "log.csv"
    log.write_text(LOG)
    events = scaling.read_events(log)
    assert events["KSPSolve"]["Count"] == [3, 1]
    assert events["KSPSolve"]["Time"] == [4.0, 3.25]
    assert events["VecScatterBegin"]["Count"] == [0, 7]
    log.write_text("a,b\n1,2\n")
    with pytest.raises(UsageError, match="log_view"):
        scaling.read_events(log)


def test_hierarchies_that_hypre_prints():
    assert scaling.read_hierarchies(PRINTED) == [[(2103, 407276), (1100, 270355)], [(627, 83460)]]
    assert scaling.read_hierarchies("") == []


def test_one_rank_is_not_partitioned():
    found = scaling.cases(["a.h5"], ["x.opts", "y.opts"], [1, 2], ["contiguous", "rcb"])
    assert [(c.options_file, c.ranks, c.partition) for c in found if c.options_file == "x.opts"] == [
        ("x.opts", 1, ""),
        ("x.opts", 2, "contiguous"),
        ("x.opts", 2, "rcb"),
    ]
    assert len(found) == 6


def test_table_comes_back_as_it_was(tmp_path: Path):
    runs = [
        Run("a.h5", "x.opts", "rcb", 2, 0, dimension=3, unknowns=10, converged=True, solve_seconds=0.1 + 0.2),
        Run("a.h5", "", "", 1, 1, outcome="ended after 3 s, really"),
    ]
    scaling.write_csv(runs, tmp_path / "runs.csv")
    assert scaling.read_csv(tmp_path / "runs.csv") == runs
    with pytest.raises(UsageError, match="not a table"):
        scaling.read_csv(tmp_path / "none.csv")


def test_median_leaves_failures_out():
    runs = [Run("a", "", "", 1, i, solve_seconds=s) for i, s in enumerate([3.0, 1.0, 2.0])]
    runs.append(Run("a", "", "", 1, 3, outcome="failed", solve_seconds=0.0))
    assert scaling.median(runs, "solve_seconds") == 2.0
    assert math.isnan(scaling.median(runs[3:], "solve_seconds"))


def test_run_on_one_rank_belongs_to_every_partition():
    runs = [Run("a.h5", "x.opts", kind, n, 0) for kind, n in (("", 1), ("rcb", 2), ("contiguous", 2))]
    assert {label: sorted(at) for label, at in series(runs).items()} == {
        "a, x, rcb": [1, 2],
        "a, x, contiguous": [1, 2],
    }


def program(path: Path, text: str) -> Path:
    """An executable shell script in place of mpiexec."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_run_that_takes_too_long_is_ended_with_its_children(tmp_path: Path):
    beats = tmp_path / "beats"
    slow = program(tmp_path / "mpiexec", f"(while sleep 0.05; do echo >> {beats}; done) & sleep 60")
    run = scaling.run(Case("model1.h5", "", 2), Settings(slow, limit=1))
    assert run.outcome == "ended after 1 s"
    size = beats.stat().st_size
    time.sleep(0.3)
    assert 0 < size == beats.stat().st_size


def test_a_run_that_fails_says_why(tmp_path: Path):
    failing = program(tmp_path / "mpiexec", "echo noise >&2; echo 'petsc-fs: no such thing' >&2; exit 2")
    assert scaling.run(Case("model1.h5", "", 2), Settings(failing)).outcome == "petsc-fs: no such thing"
    killed = program(tmp_path / "mpiexec2", "kill -9 $$")
    assert scaling.run(Case("model1.h5", "", 2), Settings(killed)).outcome == "exit code -9"


def test_study(tmp_path: Path):
    lines: list[str] = []
    chosen = scaling.cases(["model1.h5"], ["contact_poromechanics.opts"], [1, 2], ["contiguous"])
    settings = Settings(MPIEXEC, limit=120, petsc=("-ksp_rtol", "1e-6"))
    out = tmp_path / "scaling"
    assert study(chosen, settings, 1, machine=MACHINE, out=out, progress=lines.append)
    one, two = scaling.read_csv(out.with_suffix(".csv"))
    assert (one.ranks, two.ranks, one.repetition) == (1, 2, 0)
    assert one.messages == one.reductions == 0 < min(two.messages, two.reductions, two.message_bytes)
    assert two.krylov_reductions < two.reductions
    assert one.iterations > 5 and one.unknowns == two.unknowns and one.dimension == 2
    for run in (one, two):
        assert 0 < run.mechanics_seconds < run.preconditioner_seconds < run.solve_seconds
        assert 0 < run.processor_share < 1.5
        assert 0 < run.own_bytes < run.peak_bytes <= run.ranks * run.rank_bytes
    assert len(lines) == 2 and lines[0].startswith("[1/2] model1.h5")
    assert out.with_suffix(".png").stat().st_size > 10_000
    page = out.with_suffix(".md").read_text()
    assert model.MECHANICS in page and "100,000 ranks" in page and f"| {one.unknowns:,} |" in page


def test_one_rank_does_not_communicate():
    costs = model.predict(PROFILE, MACHINE, 1)
    assert all(cost.communication == 0 for cost in costs.values())
    assert model.total(costs).total == pytest.approx(sum(PROFILE.seconds.values()))


@given(ranks=st.integers(1, 10**7))
def test_work_is_never_shared_out_better_than_perfectly(ranks: int):
    costs = model.predict(PROFILE, FREE, ranks)
    assert all(cost.communication == 0 for cost in costs.values())
    assert model.total(costs).work * ranks >= sum(PROFILE.seconds.values()) * (1 - 1e-9)


@given(ranks=st.integers(2, 10**6), factor=st.floats(1.5, 100))
def test_a_worse_network_costs_in_proportion(ranks: int, factor: float):
    worse = replace(MACHINE, latency=factor * MACHINE.latency, bandwidth=MACHINE.bandwidth / factor)
    before, after = (model.predict(PROFILE, m, ranks) for m in (MACHINE, worse))
    for part, cost in before.items():
        assert after[part].communication == pytest.approx(factor * cost.communication)
        assert after[part].work == cost.work


def test_collectives():
    assert [model.collective(2.0, n) for n in (1, 2, 3, 1024, 100_000)] == [0, 2, 4, 20, 34]
    costs = model.predict(PROFILE, MACHINE, 1024)
    assert costs[model.VECTORS].collectives == pytest.approx(3 * 10 * MACHINE.latency)
    assert costs[model.PRODUCTS].collectives == pytest.approx(50 * 10 * MACHINE.latency)


def test_a_large_cube_has_26_neighbours_and_a_shell():
    assert model.neighbours(10**6, 1.0, 1000.0, 3) == 26
    assert model.neighbours(10**6, 1.0, 1000.0, 2) == 8
    assert model.neighbours(10**6, 3.0, 8.0, 3) == 5**3 - 1  # its halo reaches past them
    assert model.neighbours(5, 3.0, 8.0, 3) == 4
    assert model.halo(10**6, 1.0, 1000.0, 3) == pytest.approx(12**3 - 10**3)
    assert model.halo(2, 50.0, 8.0, 3) == 8
    assert model.radius(125.0, 3) == pytest.approx(2.0) and model.radius(1.0, 3) == 1.0


def test_a_level_with_less_cells_than_ranks_stops_getting_faster():
    costs = [model.level_cost(PROFILE.mechanics, 1, 1.0, FREE, ranks).work for ranks in (10, 10**5, 10**6, 10**7)]
    assert costs[0] > costs[1] == costs[2] == costs[3]
    assert costs[1] == pytest.approx(8e7 / (1.2e8 + 8e7 + 81) / 1e5)


def test_limits():
    found = dict(model.limits(PROFILE, MACHINE))
    assert set(found) == set(model.predict(PROFILE, MACHINE, 1))
    for part, ranks in found.items():
        perfect = sum(PROFILE.seconds.values())
        for n, beyond in ((ranks, True), (ranks // 2, False)):
            share = model.predict(PROFILE, MACHINE, 1)[part].work / n
            assert (model.predict(PROFILE, MACHINE, n)[part].total - share > perfect / n) is beyond
    assert list(found.values()) == sorted(found.values())
    slow = dict(model.limits(PROFILE, replace(MACHINE, latency=100 * MACHINE.latency)))
    assert all(slow[part] <= ranks for part, ranks in found.items())


def test_mesh_refined():
    assert model.grown(PROFILE, 1.0) == PROFILE
    fine = model.grown(PROFILE, 1000.0)
    assert fine.unknowns == 1e9 and fine.small == pytest.approx(5e4 * 100)
    assert fine.mechanics.levels[0] == model.Level(6e8, 1.2e11)
    assert fine.mechanics.levels[-1].rows <= 9 < fine.mechanics.levels[-2].rows
    alone = model.total(model.predict(fine, MACHINE, 1))
    assert alone.total == pytest.approx(1000 * sum(PROFILE.seconds.values()))


def test_script_tells_its_arguments():
    import subprocess

    script = MPIEXEC.with_name("scaling")
    done = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "--partition" in done.stdout
