"""The benchmark: what it makes of records, and one run on a bundled scene."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from sample import SCENES

from petsc_fs import bench, bench_page, bench_probe, options
from petsc_fs.bench import Benchmark, Row, Settings
from petsc_fs.errors import SolveError, UsageError

SCRIPT = Path(__file__).parent.parent / "scripts" / "bench"
BASE, FAST = "contact_poromechanics.opts", "contact_poromechanics_fast.opts"
PRINTED = """\
Operator Matrix Information:

             nonzero            entries/row          row sums
lev    rows  entries sparse   min  max     avg      min         max
======================================================================
  0    2103   407276  0.092    72  357   193.7  -1.565e+02   1.640e+03
  1     778   166124  0.274    59  402   213.5  -3.104e+01   1.057e+03


Interpolation Matrix Information:
lev  rows x cols  min  max  avgW     weight      weight       min         max
================================================================================
  0  2103 x 778     0    4   3.7  -3.583e-01   1.010e+00   0.000e+00   1.200e+00

     Complexity:    grid = 1.474085
                operator = 1.475184
                memory = 1.496194

            Number of sweeps:            1    2     1
   Type 0=Jac, 3=hGS, 6=hSGS, 9=GE:      6    3     9
"""
ABOUT = {
    "kind": "input",
    "model": "model",
    "dimension": 2,
    "sizes": {"contact": 2, "intf_force": 4, "momentum": 10, "intf_flow": 3, "mass": 6},
    "entries": {
        "momentum momentum": 50,
        "momentum mass": 20,
        "mass momentum": 20,
        "mass mass": 30,
        "contact contact": 2,
    },
    "steps": 0,
}


def hierarchy(rows: int, *entries: int, memory: float = 0.0) -> dict[str, object]:
    levels = [(rows // 2**k, n) for k, n in enumerate(entries)]
    return {"levels": levels, "memory": memory, "sweeps": [1, 1], "relaxation": [3, 3]}


def solved(file: str, number: int, setup: float, solve: float) -> dict[str, object]:
    return {
        "kind": "solved",
        "file": file,
        "round": number,
        "iterations": 10,
        "solves": 1,
        "converged": True,
        "true_residual": 1e-11,
        "wall": {"setup": setup, "solve": solve},
        "cpu": {"setup": 1.0, "solve": 1.0},
        "peak_bytes": [100, 50],
    }


def warm_up(file: str) -> dict[str, object]:
    found = [hierarchy(14, 100, 50), hierarchy(6, 30, 6)]
    return {"kind": "warm-up", "file": file, "round": -1, "hierarchies": found, "restart": 30, "python_share": 0.01}


def test_hierarchies_are_read_from_what_hypre_prints():
    (found,) = bench_probe.read_hierarchies("more\n" + PRINTED)
    assert found["levels"] == [(2103, 407276), (778, 166124)]
    assert found["memory"] == 1.496194
    assert found["sweeps"] == [1, 2]
    assert found["relaxation"] == [6, 3]


def test_complexities_of_components_count_together():
    found = [hierarchy(7, 100, 50), hierarchy(7, 300, 50), hierarchy(6, 10, 10)]
    assert bench.operator_complexities(found, {"mass": 6}) == {"mechanics": 500 / 400, "mass": 2.0}


def test_traffic_counts_operators_cycles_and_vectors():
    products = 12 * 122 + 28 * 25 + 12 * 20 + 2 * 12 * 2
    assert bench.traffic(ABOUT, [], 1, 30) == products + 2 * 8 * 25
    cycle = 3 * (12 * 100 + 28 * 14 + 12 * 50 + 28 * 7) + 2 * 12 * (160 - 150)
    with_cycle = bench.traffic(ABOUT, [hierarchy(14, 100, 50, memory=1.6)], 1, 30)
    assert with_cycle == pytest.approx(products + cycle + 2 * 8 * 25)
    longer = bench.traffic(ABOUT, [], 3, 30)
    assert longer == pytest.approx(products + 2 * 2 * 8 * 25)  # 2 vectors on average
    assert bench.traffic(ABOUT, [], 4, 2) == pytest.approx(products + 1.5 * 2 * 8 * 25)


def test_ratios_are_to_the_first_file_in_the_same_turn():
    records = [{"kind": "machine", "bandwidth": 1e9}, ABOUT, warm_up("a"), warm_up("b")]
    for number, noise in enumerate((1.0, 5.0, 2.0)):
        records += [solved("a", number, 2 * noise, 6 * noise), solved("b", number, noise, noise)]
    a, b = bench.rows_of("scene", 2, [*records, {"kind": "done"}], Settings(("a", "b")))
    assert (a.ratio, a.lowest, a.highest) == (1.0, 1.0, 1.0)
    assert b.ratio == b.lowest == b.highest == 0.25
    assert (b.setup_ratio, b.solve_ratio) == (0.5, 1 / 6)
    assert (b.setup, b.solve, b.total) == (2.0, 2.0, 4.0)
    assert b.peak == 150
    assert (b.complexity, b.mass_complexity) == (1.5, 1.2)
    assert b.bandwidth == pytest.approx(b.traffic * 10 / 2.0)


def test_a_file_that_fails_has_a_row_that_says_why():
    records = [{"kind": "machine", "bandwidth": 1e9}, ABOUT, warm_up("a"), solved("a", 0, 1, 1)]
    records += [{"kind": "failed", "file": "b", "round": -1, "message": "no such thing"}]
    a, b = bench.rows_of("scene", 1, records, Settings(("a", "b"), repeat=1))
    assert a.outcome == ""
    assert b.outcome == "no such thing"
    assert math.isnan(b.ratio)
    text = bench_page.page(Benchmark((a, b), Settings(("a", "b")), {}))
    assert "no such thing" in text


def test_tables_of_a_page_are_written_anew_and_its_text_stays(tmp_path):
    rows = [Row("model1", 2, 100, 1, 1, "a", converged=True, iterations=10, ratio=1.0)]
    rows += [Row("model1", 2, 100, 1, 1, "b", converged=True, iterations=20, ratio=0.5)]
    grown = Row("model1_g5", 2, 2500, 1, 1, "b", converged=True, iterations=25, ratio=0.25)
    for name, found in (("small.json", rows), ("large.json", [rows[0], grown])):
        (tmp_path / name).write_text(Benchmark(tuple(found), Settings(("a", "b")), {}).to_json())
    text = "Before\n<!-- bench: small.json large.json -->\nold\n<!-- end -->\nbetween\n"
    text += "<!-- growth: small.json large.json -->\n"
    target = tmp_path / "page.md"
    target.write_text(text + "<!-- end -->\nafter\n")
    bench_page.fill_page(target)
    once = target.read_text()
    assert once.startswith("Before\n<!-- bench: small.json large.json -->\n\n| input |")
    assert once.endswith("after\n") and "between" in once and "old" not in once
    assert once.count("| model1_g5 | 2,500 | 1 | `b` | 25 |") == 1
    assert "- `b`, 1 rank: geometric mean 0.35, worst 0.50 on model1" in once
    assert "| model1 | 1 | `b` | 100, 2,500 | 20, 25 | 1.25 |" in once
    bench_page.fill_page(target)
    assert target.read_text() == once
    (tmp_path / "large.json").unlink()
    with pytest.raises(UsageError, match=r"large\.json"):
        bench_page.fill_page(target)
    assert target.read_text() == once
    with pytest.raises(UsageError, match="no table"):
        bench_page.fill("only text", tmp_path)


def test_page_of_the_documentation_has_the_tables_of_its_measurements():
    docs = SCRIPT.parent.parent / "docs"
    text = (docs / "fast.md").read_text()
    assert bench_page.fill(text, docs) == text


def test_numbers_survive_json():
    row = Row("scene", 2, 10, 1, 1, "a", iterations=3, ratio=0.5)
    found = Benchmark((row,), Settings(("a.opts",), options={"ksp_rtol": "1e-5"}), {"processor": "x"})
    again = Benchmark.from_json(found.to_json())
    assert again.settings == found.settings
    assert again.rows[0].ratio == 0.5


def test_files_of_one_name_are_refused(tmp_path):
    other = tmp_path / BASE
    other.write_text("-ksp_type gmres\n")
    with pytest.raises(UsageError, match="different names"):
        bench.run([], [1], Settings((BASE, str(other))), print)


def test_options_after_a_file_make_another_entry():
    text = f"{FAST} -qr_component_pc_hypre_boomeramg_P_max 6 -component_order none"
    assert bench.label(text) == "contact_poromechanics_fast, P_max 6, order none"
    assert bench_probe.entry(text) == (
        FAST,
        {"qr_component_pc_hypre_boomeramg_P_max": "6", "component_order": "none"},
    )


def test_each_file_has_its_own_order_of_cells():
    from mpi4py import MPI

    kept = bench_probe.Kept(SCENES / "model1.h5", MPI.COMM_SELF)
    assert not kept.layout.cells
    natural = kept.scenes[0]
    with options.inserted({"petsc_fs_ordering": "morton"}):
        kept.distribute()
        assert "momentum" in kept.layout.cells
        assert kept.scenes[0].rhs["momentum"].sum() == pytest.approx(natural.rhs["momentum"].sum())
    kept.distribute()
    assert kept.scenes[0] is natural


def test_nothing_solved_is_an_error(monkeypatch):
    failure = [{"kind": "failed", "file": None, "message": "no machine"}]
    monkeypatch.setattr(bench, "measure", lambda *_: failure)
    with pytest.raises(SolveError, match="no machine"):
        bench.run([Path("scene.h5")], [1], Settings((BASE,)), lambda _: None)


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Of scripts/bench."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI", "PMIX"))}
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        env=environment,
        check=False,
    )


def test_a_scene_and_a_sequence_are_measured(tmp_path):
    done = call("model2.h5", "model2_run.h5", "--options", FAST, "--repeat", "2", "--out", str(tmp_path / "found"))
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    files = ["contact_poromechanics, ordering natural", "contact_poromechanics_fast"]
    assert [(r["input"], r["file"]) for r in rows] == [(i, f) for i in ("model2", "model2_run") for f in files]
    assert all(r["converged"] and not r["outcome"] for r in rows)
    assert rows[0]["ratio"] == 1.0
    assert [r["solves"] for r in rows] == [1, 1, 4, 4]
    base, fast = rows[:2]
    assert 0 < fast["complexity"] < base["complexity"]
    assert 0 < fast["traffic"] < base["traffic"]
    assert 0 < fast["python_share"] < 1
    assert base["stream"] > 0
    page = (tmp_path / "found.md").read_text()
    assert page.count("| model2 |") == 2


def test_a_misspelt_option_is_a_failure():
    done = call("model2.h5", "--options", FAST, "--repeat", "1", "-ksp_rtool", "1e-3")
    assert done.returncode == 1
    assert "-ksp_rtool was not used" in done.stderr


def test_a_missing_file_is_named():
    done = call("model2.h5", "--options", "nowhere.opts")
    assert done.returncode == 2
    assert "nowhere.opts" in done.stderr
