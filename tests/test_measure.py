"""Outcomes of measured processes, references and error norms."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petsc_fs.errors import LayoutError, SceneError, SolveError, UsageError
from petsc_fs.io import hdf5, sequence
from petsc_fs.scene import Scene
from petsc_fs.tools import measure as measuring
from petsc_fs.tools import reference
from petsc_fs.tools.measure import EMPTY, KINDS, Job, Variant, measure, measure_all
from petsc_fs.tools.stress_cases import in_units, load, unknowns_in_units, with_rhs
from tests.sample import SCENES, csr, dense

BIOT = str(SCENES / "biot.h5")
ASSEMBLED = "-pc_type python\n-pc_python_type petsc_fs.pc.Assembled\n"


def scene_of(matrix: np.ndarray, rhs: np.ndarray, sizes: dict[str, int], **known: object) -> Scene:
    ends = np.cumsum(list(sizes.values()))
    ranges = {f: range(end - n, end) for (f, n), end in zip(sizes.items(), ends, strict=True)}
    return Scene.from_matrix(matrix, rhs, ranges, dimension=2, **known)


def error_by_hand(sizes: dict[str, int], exact: list[float], found: list[float], **known: object) -> tuple:
    """The error of a solution in total and by field, whose entries are given in a row."""
    n = sum(sizes.values())
    scene = scene_of(np.eye(n), np.ones(n), sizes, **known)
    return reference.forward_error(scene, *(reference.by_field(scene, np.array(x)) for x in (exact, found)))


# --- norms


def test_norm_is_weighted_by_volume() -> None:
    volumes = {"momentum": np.array([3.0, 1.0])}
    total, by_field = error_by_hand({"momentum": 4}, [1, 0, 2, 0], [1, 0.5, 2, 0], cell_volumes=volumes)
    exact, wrong = (3 * 1 + 1 * 4) / 4, 3 * 0.25 / 4  # Σ V x² / Σ V
    assert by_field["momentum"] == pytest.approx(np.sqrt(wrong / exact), rel=1e-15)
    assert total == by_field["momentum"]


def test_each_dimension_counts_alike_whatever_the_unit_of_length() -> None:
    def error(length: float) -> float:
        known = {"cell_volumes": {"mass": np.array([2 * length**2, 2 * length**2, length])}}
        known |= {"cell_dimension": np.array([2, 2, 1])}
        return error_by_hand({"mass": 3}, [1, 1, 1], [1, 1, 3], **known)[0]

    assert error(1.0) == pytest.approx(np.sqrt(4 / 2))  # mean squares: (0 + 4) of the error, (1 + 1) of the reference
    assert error(1e3) == pytest.approx(error(1.0), rel=1e-14)


def test_fluxes_are_measured_by_their_density() -> None:
    volumes = {"intf_flow": np.array([4.0, 1.0])}
    total, _ = error_by_hand({"intf_flow": 2}, [4, 0], [4, 3], cell_volumes=volumes)
    assert total == 1.5  # 3² / 1 of 4² / 4


def test_without_volumes_norms_are_euclidean_and_fields_count_alike() -> None:
    total, by_field = error_by_hand({"momentum": 2, "mass": 2}, [3, 4, 1e6, 0], [3, 5, 1.1e6, 0])
    assert by_field == pytest.approx({"momentum": 0.2, "mass": 0.1})
    assert total == pytest.approx(np.sqrt((0.2**2 + 0.1**2) / 2))


def test_error_is_absolute_and_left_out_of_the_total_where_the_reference_is_zero() -> None:
    total, by_field = error_by_hand({"momentum": 2, "mass": 1}, [0, 0, 4], [0, 7, 5])
    assert by_field == {"momentum": 7.0, "mass": 0.25}
    assert total == 0.25


def test_reference_of_another_scene_is_refused() -> None:
    scene = scene_of(np.eye(2), np.ones(2), {"mass": 2})
    with pytest.raises(LayoutError, match="mass"):
        reference.forward_error(scene, {"mass": np.zeros(3)}, {"mass": np.zeros(3)})


def test_backward_errors_by_hand() -> None:
    scene = scene_of(np.array([[2.0, -1.0], [0.0, 4.0]]), np.array([1.0, 8.0]), {"mass": 2})
    x = {"mass": np.array([1.0, 2.5])}  # residual 1 - (2 - 2.5) = 1.5 and 8 - 10 = -2
    found = reference.backward_error(scene, x)
    assert found["componentwise"] == pytest.approx(max(1.5 / (2 + 2.5 + 1), 2 / (10 + 8)))
    assert found["normwise"] == pytest.approx(2 / (4 * 2.5 + 8))
    assert found["fieldwise"] == pytest.approx(np.hypot(1.5, 2) / np.hypot(2 + 2.5 + 1, 10 + 8))
    assert set(reference.backward_error(scene, {"mass": np.array([1.5, 2.0])}).values()) == {0.0}


def test_componentwise_backward_error_does_not_see_scaling() -> None:
    A, b, x = np.array([[2.0, -1.0], [3.0, 4.0]]), np.array([1.0, 8.0]), np.array([1.0, 2.5])
    r, c = np.array([1024.0, 0.5]), np.array([2.0**-20, 8.0])
    plain, scaled = (
        reference.backward_error(scene_of(m, v, {"mass": 2}), {"mass": y})["componentwise"]
        for m, v, y in ((A, b, x), (r[:, None] * A * c, r * b, x / c))
    )
    assert plain == scaled


# --- references


def exact_solution(A: np.ndarray, b: np.ndarray) -> list[Fraction]:
    """Gauss elimination in rational numbers."""
    rows = [[Fraction(float(v)) for v in row] + [Fraction(float(w))] for row, w in zip(A, b, strict=True)]
    n = len(rows)
    for k in range(n):
        pivot = next(i for i in range(k, n) if rows[i][k])
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for i in range(n):
            if i != k and rows[i][k]:
                rows[i] = [v - rows[i][k] * w for v, w in zip(rows[i], rows[k], strict=True)]
    return [row[n] for row in rows]


def hilbert(n: int) -> np.ndarray:
    return 1.0 / (np.arange(n)[:, None] + np.arange(n) + 1)


def test_residual_is_rounded_once() -> None:
    rng = np.random.default_rng(1)
    A = hilbert(7) * (rng.random((7, 7)) < 0.7)
    b, x, y = rng.random(7), rng.random(7), 1e-17 * rng.random(7)
    b[:3] = (A @ x)[:3]  # so that nothing but rounding is left
    found = reference.residual(csr(A), b, x, y)
    for i in range(7):
        terms = [Fraction(A[i, j]) * (Fraction(x[j]) + Fraction(y[j])) for j in range(7)]
        exact = Fraction(b[i]) - sum(terms)
        assert abs(Fraction(found[i]) - exact) <= Fraction(1, 2**53) * abs(exact) + Fraction(1, 10**31)


def test_reference_is_exact_to_the_last_digit_where_the_factors_alone_are_not() -> None:
    n = 9  # condition number 5e11
    A = np.diag(10.0 ** np.arange(n)) @ hilbert(n) @ np.diag(10.0 ** -np.arange(n))
    b = np.ones(n)
    exact = exact_solution(A, b)

    def error(x: np.ndarray) -> float:
        return max(float(abs(Fraction(v) - e) / abs(e)) for v, e in zip(x, exact, strict=True))

    found = reference.solve(scene_of(A, b, {"mass": n}), "direct")
    assert error(found.solution["mass"]) <= 2.0**-52
    with reference.factors(csr(A)) as (solve, _):
        assert error(solve(b)) > 1e-8
    assert found.corrections[-1] < reference.ENOUGH
    assert found.backward_error["componentwise"] <= 2.0**-52
    assert "LU" in found.method


def test_both_methods_agree_and_beat_the_stored_reference(tmp_path: Path) -> None:
    scene = hdf5.read(SCENES / "model2.h5")
    direct, iterative = (reference.solve(scene, method) for method in ("direct", "iterative"))
    for f, x in direct.solution.items():
        np.testing.assert_allclose(iterative.solution[f], x, rtol=4e-16, atol=0.0, err_msg=f)
    assert "Krylov" in iterative.method
    stored = reference.backward_error(scene, scene.reference)["componentwise"]
    assert direct.backward_error["componentwise"] < stored
    reference.write(direct, tmp_path / "x.npz")
    again = reference.read(tmp_path / "x.npz")
    assert again.about() == direct.about()
    assert all(np.array_equal(again.solution[f], x) for f, x in direct.solution.items())


def test_no_reference_for_a_singular_matrix() -> None:
    for matrix, said in (([[1.0, 1.0], [1.0, 1.0]], "no reference"), ([[1.0, 0.0], [1.0, 0.0]], "zeros")):
        with pytest.raises(SolveError, match=said):
            reference.solve(scene_of(np.array(matrix), np.array([1.0, 2.0]), {"mass": 2}), "direct")


def test_damaged_reference_file(tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_text("no")
    with pytest.raises(SceneError, match="compute it anew"):
        reference.read(tmp_path / "x.npz")


def test_one_block_is_the_whole_matrix() -> None:
    scene = hdf5.read(SCENES / "flow.h5")
    block = reference.one_block(scene)
    whole = np.zeros((block.indptr.size - 1,) * 2)
    whole[np.repeat(np.arange(len(whole)), np.diff(block.indptr)), block.indices] = block.data
    np.testing.assert_array_equal(whole, dense(scene))


# --- outcomes


def outcome(options: dict[str, str | None], **more: object) -> dict[str, Any]:
    base = {"scenes": [BIOT], "options_file": "poromechanics.opts", "options": options, "time_limit": 60.0}
    records = measure(Job(**(base | more)))  # type: ignore[arg-type]
    assert all(set(r) >= {"scene", "rtol", "repetition", "kind", "message", "phase", "iterations"} for r in records)
    assert all(r["kind"] in KINDS for r in records)
    return records[-1]


def python(name: str) -> dict[str, str | None]:
    return {"ksp_type": "gmres", "pc_type": "python", "pc_python_type": f"tests.faulty.{name}"}


def test_converged() -> None:
    found = outcome({})
    assert (found["kind"], found["message"], found["rtol"]) == ("converged", "", None)
    assert found["true_residual"] <= 1e-10 and found["reason"] == "CONVERGED_RTOL"
    assert found["peak_rss"][0] >= found["base_rss"][0] > 0
    assert found["forward_error"] is None and found["backward_error"] is None


def test_tolerances_repetitions_and_errors_on_two_ranks(tmp_path: Path) -> None:
    reference.write(reference.solve(hdf5.read(BIOT)), tmp_path / "x.npz")
    references = {BIOT: tmp_path / "x.npz"}
    job = Job(scenes=[BIOT], ranks=2, rtols=(1e-2, 1e-11), repetitions=2, errors=True, references=references)
    records = measure(job)
    assert [(r["repetition"], r["rtol"], r["kind"]) for r in records] == [
        (i, rtol, "converged") for i in (0, 1) for rtol in (1e-2, 1e-11)
    ]
    for record in records:
        assert record["true_residual"] <= record["rtol"] and len(record["peak_rss"]) == 2
        squares = [v**2 for v in record["residual_by_field"].values()]
        assert record["true_residual"] == pytest.approx(np.sqrt(sum(squares)))
        assert 0 < record["backward_error"]["normwise"]
        assert all(v > 0 for v in measuring.seconds_of(record).values())
    assert records[1]["forward_error"] < 1e-3 * records[0]["forward_error"]
    assert records[0]["iterations"] < records[1]["iterations"]


def test_all_steps_of_a_sequence_count_together() -> None:
    path = SCENES.parent / "sequences" / "model2_run.h5"
    steps = sequence.read_contents(path).steps
    (record,) = measure(Job(scenes=[path], errors=True))
    assert record["kind"] == "converged" and record["iterations"] >= 10 * len(steps)
    assert record["forward_error"] is None
    assert measuring.seconds_of(record)["total"] > 0 and len(record["residual_by_field"]) == 5


WILD = f"-ksp_type richardson\n-ksp_richardson_scale -30\n-ksp_max_it 4\n{ASSEMBLED}-assembled_pc_type jacobi\n"


@pytest.mark.parametrize(
    ("kind", "options", "more", "said"),
    [
        ("stagnated", {"ksp_max_it": "2"}, {}, ""),
        ("diverged", {}, {"options_file": "wild.opts"}, ""),
        ("diverged", python("Wrong"), {"options_file": None}, ""),
        ("crash", python("Crash"), {"options_file": None}, "SIGABRT in phase set-up"),
        ("crash", python("Exit"), {"options_file": None}, "exit code 3 in phase set-up"),
        ("failed", python("Lonely"), {"options_file": None, "ranks": 2}, "only here"),
        ("out_of_memory", python("Greedy"), {"options_file": None, "memory_limit": 4 * 2**30}, ""),
        ("refused", {"fieldsplit_momentum_pc_type": "nonsense"}, {}, ""),
        ("refused", {}, {"options_file": "contact_poromechanics.opts"}, "fields"),
        ("unused_option", {"fieldsplit_momentum_pc_hypre_boomeramg_strong_treshold": "0.5"}, {}, "strong_threshold"),
    ],
)
def test_outcomes(kind: str, options: dict[str, str | None], more: dict[str, Any], said: str, tmp_path: Path) -> None:
    (tmp_path / "wild.opts").write_text(WILD)
    if more.get("options_file") == "wild.opts":
        more = {"options_file": str(tmp_path / "wild.opts")}
    found = outcome(options, **more)
    assert found["kind"] == kind
    assert said in found["message"]
    assert found["iterations"] or kind not in ("stagnated", "unused_option")


def test_crash_of_the_second_scene_keeps_the_first(tmp_path: Path) -> None:
    bad = tmp_path / "bad.h5"
    bad.write_bytes(b"")
    records = measure(Job(scenes=[BIOT, bad]))
    assert [(r["scene"], r["kind"]) for r in records] == [(BIOT, "converged"), (str(bad), "failed")]
    assert "HDF5" in records[1]["message"]


def test_after_a_crash_another_process_takes_the_rest() -> None:
    crash = Variant("crash", options=python("Crash"))
    systems = [BIOT, str(SCENES / "flow.h5")]
    processes = list(measure_all(systems, [crash, Variant("default")], Job(time_limit=60.0), batch=True))
    assert [[(r["scene"], r["variant"], r["kind"]) for r in records] for records in processes] == [
        [(systems[0], "crash", "crash")],
        [(systems[1], "crash", "crash")],
        [(s, "default", "converged") for s in systems],
    ]


def test_hang_is_ended_with_all_its_ranks() -> None:
    started = time.monotonic()
    found = outcome(python("Hang"), options_file=None, time_limit=4.0, ranks=2)
    assert (found["kind"], found["phase"]) == ("hang", "set-up")
    assert "4 s" in found["message"]
    assert time.monotonic() - started < 30
    commands = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if readable(path)]
    assert not any(b"petsc_fs.tools.probe" in c and str(os.getpid()).encode() in c for c in commands)


def readable(path: Path) -> bool:
    try:
        path.read_bytes()
    except OSError:
        return False
    return True


# --- turns


def turns(monkeypatch: pytest.MonkeyPatch, results: Callable[[Job], str], **more: object) -> list[tuple[str, ...]]:
    """What `measure_all` measures, with made-up outcomes: system, label, ranks and round."""
    monkeypatch.setattr(
        measuring,
        "measure",
        lambda job: [EMPTY | {"scene": s, "kind": results(job), "message": ""} for s in job.scenes],
    )
    variants = [Variant(name, path=name) for name in ("x", "y", "z")]
    found = measure_all(["a", "b"], variants, Job(), **more)  # type: ignore[arg-type]
    return [(r["scene"], r["variant"], r["ranks"], r["round"]) for records in found for r in records]


def test_each_round_has_each_combination_once_and_starts_with_another(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = lambda system, variant: (system, variant.label) != ("b", "z")  # noqa: E731
    found = turns(monkeypatch, lambda job: "converged", ranks=(1, 2), repeat=3, fits=fits)
    rounds = [[f[:3] for f in found if f[3] == k] for k in range(3)]
    assert all(sorted(r) == sorted(set(rounds[0])) and len(r) == 10 for r in rounds)
    assert [r[0] for r in rounds] == [("a", "x", 1), ("a", "y", 1), ("a", "z", 1)]


def test_what_hangs_is_not_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    found = turns(monkeypatch, lambda job: "hang" if job.options_file == "y" else "converged", repeat=3)
    assert [f for f in found if f[1] == "y"] == [("a", "y", 1, 0), ("b", "y", 1, 0)]
    assert len(found) == 2 * (2 * 3 + 1)


def test_a_variant_is_a_file_with_options_that_win_over_common_ones() -> None:
    found = Variant.of("direct.opts -ksp_max_it 7 -ksp_monitor", {"ksp_max_it": "9", "scale": "-3"})
    assert found.options == {"ksp_max_it": "7", "ksp_monitor": None, "scale": "-3"}
    assert found.label == "direct -ksp_max_it 7 -ksp_monitor" and found.text.startswith("# One direct solve")
    assert found.fits(["mass"])
    some = Variant("a", fields=("momentum", "mass"), not_for=("box",))
    assert some.fits(["mass", "momentum"], ["other"])
    assert not some.fits(["mass"]) and not some.fits(["mass", "momentum"], ["box"])


def test_petsc_options_go_to_every_run_and_n_does_not() -> None:
    ranks, found = measuring.split_ranks(["-n", "2", "-ksp_max_it", "7", "-ksp_monitor", "-scale", "-3"])
    assert ranks == [2]
    assert found == {"ksp_max_it": "7", "ksp_monitor": None, "scale": "-3"}
    for words in (["-n", "many"], ["-n", "0"], ["stray"]):
        with pytest.raises(UsageError):
            measuring.split_ranks(words)


# --- conditions


def test_conditions_bound_errors() -> None:
    """The theorem that makes errors right: perturbed right-hand sides move no field further than its condition says."""
    scene = load("cut_through")
    exact = reference.solve(scene, "direct").solution
    conditions = reference.field_conditions(scene, exact)
    sizes = reference.magnitudes(scene, exact)
    random, eta = np.random.default_rng(1), 1e-9
    rhs = {}
    for f, b in scene.rhs.items():
        r = random.standard_normal(b.size)
        rhs[f] = b + eta * np.linalg.norm(sizes[f]) * r / np.linalg.norm(r)
    moved = reference.solve(replace(scene, rhs=rhs), "direct").solution
    _, errors = reference.forward_error(scene, exact, moved)
    for f, error in errors.items():
        assert error <= 1.1 * np.sqrt(len(errors)) * eta * conditions[f]


def test_conditions_do_not_depend_on_the_size_of_the_right_hand_side() -> None:
    """Not even where the squares of its entries over- or underflow."""
    scene = load("one_cell")
    exact = reference.solve(scene, "direct").solution
    known = reference.field_conditions(scene, exact)
    for factor in (2.0**-500, 2.0**500):
        other = replace(scene, rhs={f: factor * b for f, b in scene.rhs.items()})
        found = reference.field_conditions(other, {f: factor * x for f, x in exact.items()})
        assert found == pytest.approx(known, rel=1e-6)


def test_fieldwise_backward_error_is_the_same_in_all_units() -> None:
    scene = load("one_cell")
    random = np.random.default_rng(0)
    x = {f: random.standard_normal(n) for f, n in scene.sizes.items()}
    here = reference.backward_error(scene, x)["fieldwise"]
    assert 0 < here <= 1
    factors = unknowns_in_units(scene, m=0.25, s=4.0)
    there = reference.backward_error(in_units(scene, m=0.25, s=4.0), {f: factors[f] * v for f, v in x.items()})
    assert there["fieldwise"] == pytest.approx(here, rel=1e-12)
    zero = with_rhs(scene)
    nothing = {f: np.zeros(n) for f, n in zero.sizes.items()}
    assert reference.backward_error(zero, nothing)["fieldwise"] == 0
