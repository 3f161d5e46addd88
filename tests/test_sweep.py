"""Spaces of options, and sweeps of them: what becomes of trials, going on after a kill, and the best file."""

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from petsc_fs import options
from petsc_fs.cli.main import main
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.tools import measure, space
from tests.sample import SCENES

pytest.importorskip("yaml")
optuna = pytest.importorskip("optuna")
from petsc_fs.tools.sweep import Settings, Sweep, aggregate, front, judge, write  # noqa: E402

FLOW = SCENES / "flow.h5"
HERE = Path(__file__).parent

BASE = """\
# A base file of one level
#
# fields: intf_flow mass
# default: yes

# Krylov method
-ksp_type gmres  # any
-ksp_rtol 1e-8
-ksp_pc_side right
-prefix_push pc_
  -type asm
-prefix_pop
-sub_ksp_type preonly
-sub_pc_type ilu
"""

SPACE = """\
base: base.opts
groups:
  all:
    parameters:
      ksp_type: {choices: [gmres, fgmres, bcgs]}
      ksp_gmres_restart: {integer: [10, 50], step: 20, start: 30, when: {ksp_type: [gmres, fgmres]}}
      pc_asm_overlap: {choices: [~, 1, 2]}
      ksp_divtol: {log: [1e3, 1e7], points: 3, when: {pc_asm_overlap: ~}}
  sub:
    prefix: sub_
    parameters:
      pc_type: {choices: {ilu: {}, jacobi: {pc_type: jacobi}}}
      pc_factor_levels: {float: [0, 1], step: 1, when: {pc_type: ilu, all.ksp_type: gmres}}
"""


def make(folder: Path, text: str = SPACE, base: str = BASE) -> space.Space:
    (folder / "base.opts").write_text(base)
    (folder / "some.yaml").write_text(text)
    return space.read(folder / "some.yaml")


# --- spaces


def test_parameters_exist_where_their_conditions_hold(tmp_path: Path) -> None:
    wanted = {"all.ksp_type": "gmres", "all.ksp_gmres_restart": 10, "all.pc_asm_overlap": space.ABSENT}
    wanted |= {"all.ksp_divtol": 1e3, "sub.pc_type": "ilu", "sub.pc_factor_levels": 0.0}
    some = make(tmp_path)
    assert some.suggest(optuna.trial.FixedTrial(wanted)) == wanted
    other = {"all.ksp_type": "bcgs", "all.pc_asm_overlap": "2", "sub.pc_type": "ilu"}
    assert some.suggest(optuna.trial.FixedTrial(wanted | other)) == other


def test_grid_has_each_combination_of_existing_parameters_once(tmp_path: Path) -> None:
    grid = make(tmp_path).grid()
    # gmres: 3 restarts · (3 divtol + 2 overlaps) · (2 levels + jacobi); fgmres: 3 · 5 · 2; bcgs: 5 · 2
    assert len(grid) == 3 * 5 * 3 + 3 * 5 * 2 + 5 * 2
    assert len({json.dumps(values) for values in grid}) == len(grid)
    assert [v["all.ksp_divtol"] for v in grid[:9:3]] == pytest.approx([1e3, 1e5, 1e7])


def test_first_trial_is_the_base_file(tmp_path: Path) -> None:
    some = make(tmp_path)
    assert some.start() == {
        "all.ksp_type": "gmres",
        "all.ksp_gmres_restart": 30,
        "all.pc_asm_overlap": space.ABSENT,
        "sub.pc_type": "ilu",
    }
    assert some.changes(some.start()) == {"ksp_gmres_restart": "30"}


def test_choices_by_name_set_several_options_and_take_some_out(tmp_path: Path) -> None:
    text = "base: base.opts\ngroups: {a: {parameters: {x: {choices: {lu: {pc_type: lu, sub_pc_type: ~}}}}}}"
    some = make(tmp_path, text)
    assert some.changes({"a.x": "lu"}) == {"pc_type": "lu", "sub_pc_type": None}
    edited = some.text({"a.x": "lu"})
    assert "  -type lu\n-prefix_pop\n-sub_ksp_type preonly\n" in edited
    assert "sub_pc_type" not in edited


@pytest.mark.parametrize("file", [f.path for f in options.shipped()], ids=lambda p: p.stem)
@given(data=st.data())
def test_edited_file_has_exactly_the_changes(file: Path, data: st.DataObject) -> None:
    before = options.parse(file)
    some = st.sampled_from(sorted(before)) | st.sampled_from(sorted(before)).map(lambda name: name + "_more")
    changes = data.draw(st.dictionaries(some, st.none() | st.sampled_from(["1", "abc"]), max_size=5))
    text = space.edit(file.read_text(), changes)
    wanted = {k: v for k, v in (before | changes).items() if not (k in changes and v is None)}
    with tempfile.NamedTemporaryFile("w") as target:
        target.write(text)
        target.flush()
        assert options.parse(Path(target.name)) == wanted
    assert [line for line in text.splitlines() if line.lstrip().startswith("#")] == [
        line for line in file.read_text().splitlines() if line.lstrip().startswith("#")
    ]


def test_new_option_goes_where_its_like_are() -> None:
    text = options.find_options_file("contact_poromechanics.opts").read_text()
    leaf = "qr_fieldsplit_1_fieldsplit_mechanics_"
    edited = space.edit(text, {f"{leaf}pc_hypre_boomeramg_P_max": "4"})
    assert "      -pc_hypre_type boomeramg\n      -pc_hypre_boomeramg_P_max 4\n    -prefix_pop\n" in edited


@pytest.mark.parametrize("file", space.shipped(), ids=lambda p: p.stem)
def test_shipped_spaces_start_at_their_base_file(file: Path) -> None:
    some = space.read(file)
    start = some.start()
    assert {p.name for p in some.parameters if p.active(start)} == set(start)
    base = options.parse(some.base)
    assert not [name for name, value in some.changes(start).items() if value is None or name in base]


A = "base: base.opts\ngroups:\n  a:\n    parameters:\n      "


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[1, 2]", "expected a mapping of names, found [1, 2]"),
        ("base: base.opts\ngroups: {a: [}", "not YAML"),
        ("groups: {}", "'base' is missing"),
        ("base: base.opts\ngruops: {}", "unknown entry 'gruops'; did you mean groups?"),
        ("base: nowhere.opts\ngroups: {}", "base: options file nowhere.opts: no such file"),
        ("base: base.opts\ngroups: {}", "no parameters; declare some"),
        (
            "base: base.opts\ngroups: {a: {prefix: fieldsplit_mass_, parameters: {}}}",
            "has the prefix 'fieldsplit_mass_'",
        ),
        (A + "x: 3", "parameter a.x: expected a mapping of names, found 3"),
        (A + "x: {}", "parameter a.x: expected exactly one of choices, integer, float, log, found none"),
        (A + "x: {float: [0, 1], log: [1, 2]}", "found float, log"),
        (A + "x: {chioces: [1]}", "unknown entry 'chioces'; did you mean choices?"),
        (A + "x: {choices: []}", "expected a list of values, or a mapping"),
        (A + "x: {choices: [a, a]}", "a value occurs twice"),
        (A + "x: {choices: [a], step: 2}", "'step' does not go with 'choices'"),
        (A + "x: {choices: [a, b], start: c}", "start: 'c' is none of the choices a, b"),
        (A + "x: {integer: 3}", "integer: expected [least, greatest], found 3"),
        (A + "x: {integer: [3, 1]}", "the least value 3 is not below the greatest, 1"),
        (A + "x: {integer: [0.5, 2]}", "expected whole numbers, found [0.5, 2]; or take 'float'"),
        (A + "x: {integer: [1, 9], step: 0.5}", "step: expected a positive number, found 0.5"),
        (A + "x: {log: [0, 1]}", "values must be positive, found 0; take 'float'"),
        (A + "x: {float: [0, 1], start: 2}", "start 2 is no number in [0, 1]"),
        (A + "x: {float: [0, 1], points: 1}", "a grid needs both ends"),
        (A + "'x y': {float: [0, 1]}", "'x y' is no name of an option"),
        (A + "x: {float: [0, 1], when: {y: 1}}", "there is no parameter a.y before this one; declare it before"),
        (A + "xx: {choices: [1, 2]}\n      y: {float: [0, 1], when: {xy: 1}}", "did you mean a.xx?"),
        (A + "x: {choices: [1, 2]}\n      y: {float: [0, 1], when: {x: 3}}", "a.x is never '3'; its choices are 1, 2"),
        (A + "x: {float: [0, 1]}\n      y: {option: x, float: [0, 1]}", "parameters a.x and a.y both set -x"),
    ],
)
def test_errors_name_file_parameter_and_remedy(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        make(tmp_path, text)
    assert f"space {tmp_path / 'some.yaml'}" in str(caught.value)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


# --- searches, with measurements made up

SCENE_A, SCENE_B = SCENES / "flow.h5", SCENES / "biot.h5"


def record(seconds: float = 1.0, **more: Any) -> measure.Record:
    found = {"kind": "converged", "message": "", "iterations": 7, "true_residual": 1e-9, "forward_error": 1e-8}
    found |= {"seconds": {"setup": seconds / 2, "solve": seconds / 2}, "peak_rss": [300], "base_rss": [100]}
    return measure.EMPTY | found | {"cpu_seconds": {"setup": seconds, "solve": seconds}} | more


Measured = Callable[[dict[str, str | None]], measure.Record]


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[tuple[str, str]]]:
    """Replaces measurements by a function of the options; gives the list of scenes and files that were measured."""

    def install(measured: Measured, on_disk: bool = False) -> list[tuple[str, str]]:
        calls: list[tuple[str, str]] = []

        def fake(job: measure.Job) -> list[measure.Record]:
            (scene,) = job.scenes
            calls.append((Path(scene).name, Path(str(job.options_file)).name))
            found = measured(options.parse(Path(str(job.options_file))))
            if found["kind"] == "slow":
                return [record(scene=scene, kind="hang", message=f"no result within {job.time_limit:g} s")]
            return [found | {"scene": scene}] * job.repetitions

        monkeypatch.setattr(measure, "measure", fake)
        monkeypatch.setattr(Sweep, "_reference", lambda sweep, scene: None)
        if not on_disk:  # quicker by far
            stores: dict[Path, Any] = {}
            new = optuna.storages.InMemoryStorage
            monkeypatch.setattr(Sweep, "_storage", lambda sweep: stores.setdefault(sweep.settings.out, new()))
        return calls

    return install


def settings(folder: Path, **more: Any) -> Settings:
    some = make(folder)
    return Settings(**({"scenes": (SCENE_A,), "space": some, "out": folder / "out", "trials": 12} | more))


def by_restart(chosen: dict[str, str | None]) -> measure.Record:
    """Time grows with the restart, memory falls; bcgs fails."""
    if chosen["ksp_type"] == "bcgs":
        return record(kind="diverged", message="DIVERGED_DTOL")
    restart = int(chosen.get("ksp_gmres_restart") or 30)
    return record(restart / 30, peak_rss=[100 + 6000 // restart])


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_sampled_trials_respect_conditions_and_end_as_measured(tmp_path: Path, made_up: Any, sampler: str) -> None:
    made_up(by_restart)
    results = Sweep(settings(tmp_path, sampler=sampler, trials=40)).run()
    assert len(results["trials"]) == 40
    for trial in results["trials"]:
        values = trial["values"]
        assert ("all.ksp_gmres_restart" in values) == (values["all.ksp_type"] != "bcgs")
        assert ("all.ksp_divtol" in values) == (values["all.pc_asm_overlap"] == space.ABSENT)
        assert trial["outcome"] == ("diverged" if values["all.ksp_type"] == "bcgs" else "solved")
    best = results["trials"][results["final"]["best"]]
    assert best["values"]["all.ksp_gmres_restart"] == 10
    restarts = {results["trials"][n]["values"]["all.ksp_gmres_restart"] for n in results["front"]}
    assert restarts == {10, 30, 50}  # time and memory contradict each other
    assert {"diverged", "solved"} == set(results["outcomes"])


def test_grid_measures_every_point_once_and_then_stops(tmp_path: Path, made_up: Any) -> None:
    calls = made_up(by_restart)
    results = Sweep(settings(tmp_path, sampler="grid", trials=500, confirm=1, finalists=1)).run()
    assert len(results["trials"]) == 85
    trials = [file for _, file in calls if file != "base.opts"]
    assert len(trials) == len(set(trials)) + 1  # the finalist
    with pytest.raises(UsageError, match=r"has 85 points, more than --trials 20; .*--sampler random"):
        Sweep(settings(tmp_path, sampler="grid", trials=20, out=tmp_path / "other")).run()


def test_same_options_are_not_measured_again(tmp_path: Path, made_up: Any) -> None:
    calls = made_up(by_restart)
    text = "base: base.opts\ngroups: {a: {parameters: {ksp_type: {choices: [gmres, fgmres]}}}}"
    more = {"space": make(tmp_path, text), "trials": 9, "confirm": 1, "finalists": 1}
    results = Sweep(Settings(scenes=(SCENE_A,), out=tmp_path / "out", sampler="random", **more)).run()
    measured = [t for t in results["trials"] if t["same_as"] is None]
    assert len(results["trials"]) == 9
    assert len(measured) == 2
    assert len([file for _, file in calls if file != "base.opts"]) == 3
    assert len(results["front"]) == 2 or {t["totals"]["time"] for t in measured} == {1.0}


def test_scenes_are_aggregated_and_held_out_ones_come_last(tmp_path: Path, made_up: Any) -> None:
    calls = made_up(by_restart)
    some = settings(tmp_path, scenes=(SCENE_A, SCENE_B), hold_out=(SCENES / "model1.h5",), trials=30, aggregate="worst")
    results = Sweep(some).run()
    held_out = [k for k, (scene, _) in enumerate(calls) if scene == "model1.h5"]
    assert held_out == list(range(len(calls) - 6, len(calls)))  # three times the base file and the best one
    assert set(results["final"]["hold_out"]) == {"model1.h5"}
    assert results["final"]["hold_out"]["model1.h5"]["ratios"]["time"] == pytest.approx(1 / 3)
    for trial in results["trials"]:
        if trial["outcome"] == "solved":
            assert set(trial["scenes"]) == {"flow.h5", "biot.h5"}
    assert aggregate([0.25, 4.0], "mean") == pytest.approx(1.0)
    assert aggregate([0.25, 4.0], "worst") == 4.0


def test_fast_but_inaccurate_is_no_solution(tmp_path: Path, made_up: Any) -> None:
    def measured(chosen: dict[str, str | None]) -> measure.Record:
        return record(0.01, forward_error=1e-6) if chosen["ksp_type"] == "fgmres" else record()

    made_up(measured)
    results = Sweep(settings(tmp_path, sampler="random")).run()
    wrong = [t for t in results["trials"] if t["outcome"] == "inaccurate"]
    assert {t["values"]["all.ksp_type"] for t in wrong} == {"fgmres"}
    assert "error 1.0e-06, with the base file 1.0e-08" in wrong[0]["message"]
    assert results["trials"][results["final"]["best"]]["values"]["all.ksp_type"] != "fgmres"
    assert not {t["number"] for t in wrong} & set(results["front"])


def test_hopelessly_slow_trials_are_pruned(tmp_path: Path, made_up: Any) -> None:
    def measured(chosen: dict[str, str | None]) -> measure.Record:
        return record(kind="slow") if chosen["ksp_type"] == "fgmres" else record()

    made_up(measured)
    results = Sweep(settings(tmp_path, sampler="random", patience=4.0)).run()
    pruned = [t for t in results["trials"] if t["outcome"] == "pruned"]
    assert pruned
    assert re.search(r"within [\d.]+ s, that is 4 times what the base file takes", pruned[0]["message"])
    results = Sweep(settings(tmp_path, sampler="random", patience=0.0, out=tmp_path / "b", time_limit=50.0)).run()
    assert {t["message"] for t in results["trials"] if t["outcome"] == "hang"} == {"no result within 50 s"}


def test_base_file_that_fails_ends_the_sweep(tmp_path: Path, made_up: Any) -> None:
    made_up(lambda chosen: record(kind="stagnated", message="DIVERGED_ITS"))
    with pytest.raises(SolveError, match=r"base.opts does not solve flow.h5.*stagnated: DIVERGED_ITS"):
        Sweep(settings(tmp_path)).run()


def test_memory_and_processor_time_can_be_what_counts(tmp_path: Path, made_up: Any) -> None:
    made_up(by_restart)
    results = Sweep(settings(tmp_path, objective=("memory",), clock="cpu", trials=30)).run()
    assert results["trials"][results["final"]["best"]]["values"]["all.ksp_gmres_restart"] == 50
    assert results["front_objectives"] == ["memory", "time"]
    assert results["final"]["finalists"][str(results["final"]["best"])]["flow.h5"]["base"]["seconds"] == 2.0


def test_another_sweep_in_the_folder_is_refused(tmp_path: Path, made_up: Any) -> None:
    made_up(by_restart)
    Sweep(settings(tmp_path, trials=1)).run()
    with pytest.raises(UsageError, match="the sweep in it has another scenes; name another folder"):
        Sweep(settings(tmp_path, scenes=(SCENE_B,))).run()
    with pytest.raises(UsageError, match="the sweep in it has another tolerance"):
        Sweep(settings(tmp_path, rtol=1e-3)).run()


def test_front_and_judgement() -> None:
    assert front([(1.0, 3.0), (2.0, 2.0), (2.0, 3.0), (3.0, 1.0), (2.0, 2.0)]) == [0, 1, 3, 4]
    base = {"error": 1e-8}
    assert judge([record(), record(forward_error=9e-8)], base) == ("solved", "")
    assert judge([record(), record(forward_error=2e-7)], base)[0] == "inaccurate"
    assert judge([record(), record(kind="crash", message="SIGSEGV")], base) == ("crash", "SIGSEGV")
    assert judge([record(forward_error=1.0)], {"error": None}) == ("solved", "")


# --- killed and resumed

KILLED = """\
import sys, time
from pathlib import Path
from petsc_fs.tools import measure, sweep
from tests.test_sweep import by_restart, options, settings

def slow(job):
    time.sleep(0.15)
    return [by_restart(options.parse(Path(job.options_file))) | {"scene": job.scenes[0]}]

measure.measure = slow
sweep.Sweep._reference = lambda self, scene: None
sweep.Sweep(settings(Path(sys.argv[1]), trials=1000, sampler="random")).run()
"""


def trials_in(folder: Path) -> list[Any]:
    return list(optuna.load_study(study_name="sweep", storage=f"sqlite:///{folder / 'study.db'}").trials)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=["kill -9", "Ctrl-C"])
def test_killed_sweep_goes_on_without_losing_or_repeating(tmp_path: Path, made_up: Any, number: int) -> None:
    env = {**os.environ, "PYTHONPATH": str(HERE.parent)}
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], env=env, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("out/trials/*.opts"))) < 6:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(number)
    before = trials_in(tmp_path / "out")
    finished = {t.number: t for t in before if t.state.is_finished()}
    running = [t for t in before if not t.state.is_finished()]
    assert len(finished) >= 5
    assert len(running) <= 1

    calls = made_up(by_restart, on_disk=True)
    wanted = len(finished) + 4
    results = Sweep(settings(tmp_path, trials=wanted, sampler="random", finalists=1, confirm=1)).run()
    after = {t.number: t for t in trials_in(tmp_path / "out")}
    assert all(after[n] == finished[n] for n in finished)  # parameters, values, measurements and times of day
    assert len(results["trials"]) == wanted
    assert {t["number"] for t in results["trials"]} >= set(finished)
    measured = [file for _, file in calls if file.startswith("00")][:-1]  # the last one is the finalist
    assert not {int(file[:4]) for file in measured} & set(finished)
    assert results["outcomes"].get("interrupted", 0) == len(running)
    for lost in running:
        again = next(t for t in after.values() if t.number > lost.number)
        assert lost.params.items() <= again.params.items()  # what it had drawn is tried first
    assert len({json.dumps(t["values"]) for t in results["trials"]}) > wanted / 2  # and no numbers are drawn again


def test_trial_that_was_measured_but_not_ended_is_not_repeated(
    tmp_path: Path, made_up: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = made_up(by_restart)
    some = settings(tmp_path, sampler="random", trials=5, finalists=1, confirm=1)
    with monkeypatch.context() as patch:
        tell = Sweep._tell

        def interrupted(sweep: Sweep, attempt: Any) -> None:
            if attempt["number"] == 2:
                raise KeyboardInterrupt
            tell(sweep, attempt)

        patch.setattr(Sweep, "_tell", interrupted)
        with pytest.raises(KeyboardInterrupt):
            Sweep(some).run()
    assert calls[-1][1] == "0002.opts"
    del calls[:]
    results = Sweep(some).run()
    assert [t["number"] for t in results["trials"]] == list(range(5))
    assert "interrupted" not in results["outcomes"]
    assert {file for _, file in calls[:-1]} <= {"base.opts", "0003.opts", "0004.opts"}  # the last one is the finalist


def test_two_sweeps_in_a_folder_do_not_mix(tmp_path: Path, made_up: Any) -> None:
    made_up(by_restart)
    (tmp_path / "out").mkdir()
    code = "import fcntl, sys, time; f = open(sys.argv[1], 'w'); fcntl.flock(f, 2); print('held', flush=True); input()"
    command = [sys.executable, "-c", code, str(tmp_path / "out" / "lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(UsageError, match="another sweep is running in it"):
            Sweep(settings(tmp_path)).run()
        process.communicate("\n")


# --- searches in earnest

FAULTY_BASE = """\
# One factorisation
#
# fields: intf_flow mass

-ksp_type gmres
-ksp_rtol 1e-8
-ksp_pc_side right
-pc_type python
-pc_python_type petsc_fs.pc.Assembled
-assembled_pc_type lu
"""

FAULTY = """\
base: base.opts
groups:
  all:
    parameters:
      which:
        choices:
          good: {assembled_pc_factor_mat_solver_type: mumps}
          hungry: {pc_python_type: tests.faulty.Greedy, assembled_pc_type: ~}
          hanging: {pc_python_type: tests.faulty.Hang, assembled_pc_type: ~}
          misspelt: {assembled_pc_factor_mat_solver_tpye: mumps}
"""

EXPECTED = {"good": "solved", "hungry": "out_of_memory", "hanging": "hang", "misspelt": "unused_option"}
"""Outcomes of `petsc_fs.tools.measure`, see its tests; limits are those of the sweep."""


@pytest.mark.usefixtures("clean")  # of what lint puts into the database
def test_each_way_to_end_is_recorded_as_what_it_is(tmp_path: Path) -> None:
    make(tmp_path, FAULTY, FAULTY_BASE)
    out = tmp_path / "out"
    arguments = ["sweep", "flow.h5", "--space", str(tmp_path / "some.yaml"), "--sampler", "grid", "--trials", "20"]
    arguments += ["--patience", "0", "--time-limit", "10", "--memory-limit", "4", "--finalists", "1", "--confirm", "1"]
    arguments += ["--out", str(out), "--page", str(tmp_path / "page.md")]
    assert main(arguments) == 0
    results = json.loads((out / "sweep.json").read_text())
    assert {t["values"]["all.which"]: t["outcome"] for t in results["trials"]} == EXPECTED
    said = {t["values"]["all.which"]: t["message"] for t in results["trials"]}
    assert "assembled_pc_factor_mat_solver_type" in said["misspelt"]  # what it might have meant
    assert "within 10 s" in said["hanging"]
    assert results["outcomes"] == dict.fromkeys(EXPECTED.values(), 1)

    assert main(["lint", str(out / "best.opts")]) == 0
    header = options.read_header(out / "best.opts")
    assert (header.fields, header.default) == (("intf_flow", "mass"), False)
    best = options.parse(tmp_path / "base.opts") | {"assembled_pc_factor_mat_solver_type": "mumps"}
    assert options.parse(out / "best.opts") == best
    for page in (out / "report.md", tmp_path / "page.md"):
        text = page.read_text()
        assert all(kind in text for kind in EXPECTED.values())
        picture = re.search(r"!\[.*\]\((.*)\)", text)
        assert picture is not None
        assert (page.parent / picture[1]).stat().st_size > 1000


def test_results_without_a_solved_trial_are_written_all_the_same(tmp_path: Path, made_up: Any) -> None:
    def measured(chosen: dict[str, str | None]) -> measure.Record:
        return record() if "ksp_gmres_restart" not in chosen else record(kind="crash", message="SIGFPE | in | set-up")

    made_up(measured)
    some = settings(tmp_path, trials=1)
    results = Sweep(some).run()
    assert results["final"] is None
    written = write(results, some.out)
    assert {p.name for p in written} == {"sweep.json", "report.md"}
    assert r"SIGFPE \| in \| set-up" in (some.out / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["flow.h5"], 2, "--space"),
        (
            ["flow.h5", "--space", "nothing"],
            2,
            "space nothing: no such file; shipped are amg.yaml, flow.yaml, heat.yaml",
        ),
        (["model1.h5", "--space", "flow"], 2, "model1.h5: flow.opts is for scenes with the fields intf_flow, mass"),
        (["flow.h5", "flow.h5", "--space", "flow"], 2, "flow.h5: named twice"),
        (["flow.h5", "--space", "flow", "--trials", "0"], 2, "--trials: expected a positive number, found 0"),
        (["flow.h5", "--space", "flow", "--patience", "0.5"], 2, "--patience 0.5: expected at least 1, or 0 for never"),
        (["flow.h5", "--space", "flow", "--rtol", "2"], 2, "--rtol 2: expected a number between 0 and 1"),
        (["none.h5", "--space", "flow"], 3, "none.h5: no such file"),
    ],
)
def test_wrong_calls_are_one_line(
    arguments: list[str], code: int, says: str, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["sweep", *arguments]) == code
    error = capfd.readouterr().err
    assert says in error
    assert error.count("\n") == 1
