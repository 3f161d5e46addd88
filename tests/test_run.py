"""`petsc-fs run`: what a run of a PorePy model leaves, and how it ends."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import petsc_fs
from petsc_fs.cli import main as cli
from petsc_fs.io import sequence
from petsc_fs.porepy.cases import CASES
from petsc_fs.porepy.simulation import PHASES, PICTURE, RECORDS, SEQUENCE, SUMMARY, VTU

MPIEXEC = Path(petsc_fs.__path__[0]).parent / "scripts" / "mpiexec"
ENVIRONMENT = dict(os.environ, OMP_NUM_THREADS="1")
"""As this session was started: MPI has added to what a process below it would get otherwise."""

LIMIT = 250
COARSE = ("model2", "--refine", "0.5")

OWN_MODEL = """\
import porepy as pp
from petsc_fs.porepy.models import FlowModel, make_model

like = make_model("flow", refinement=0.5)
model_params = like.params

class Mine(FlowModel):
    case = like.case
    parameters = like.parameters

class NotAModel:
    pass
"""


@pytest.fixture(scope="module")
def pp():
    return pytest.importorskip("porepy", reason="PorePy is not installed")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def start(*arguments, cwd, ranks=1):
    """`petsc-fs run` in a process of its own."""
    command = [sys.executable, "-m", "petsc_fs", "run", *map(str, arguments)]
    if ranks > 1:
        command = [str(MPIEXEC), "-n", str(ranks), *command]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=cwd, env=ENVIRONMENT, text=True, start_new_session=True, **pipes)


def run(*arguments, cwd, ranks=1):
    """Exit code, standard output, and standard error of a run."""
    process = start(*arguments, cwd=cwd, ranks=ranks)
    try:
        out, err = process.communicate(timeout=LIMIT)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, out, err


def records_of(folder):
    return [json.loads(line) for line in (folder / RECORDS).read_text().splitlines()]


def summary_of(folder):
    return json.loads((folder / SUMMARY).read_text())


def ours(err):
    """Our own messages, among warnings of others and lines of progress."""
    return [line for line in err.splitlines() if line.startswith("petsc-fs: ")]


# Runs that end well


@pytest.mark.porepy
@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
def test_a_run_leaves_records_picture_states_and_a_sequence_that_replays_alike(pp, tmp_path, ranks):
    steps = 3 - ranks
    options = ["--time-steps", steps, "--out", "mine", "--vtu", "--sequence", "--picture", "svg"]
    petsc = ["-ksp_rtol", "1e-9", "-petsc_fs_least_rows", "1"]
    code, out, err = run(*COARSE, *options, *petsc, cwd=tmp_path, ranks=ranks)
    assert (code, ours(err)) == (0, []), err
    folder = tmp_path / "mine"
    assert {p.name for p in folder.iterdir()} == {RECORDS, SUMMARY, SEQUENCE, VTU, f"{PICTURE}.svg"}

    records, summary = records_of(folder), summary_of(folder)
    assert {record["time_step"] for record in records} == {*range(1, steps + 1)}
    for before, after in zip(records, [*records[1:], None], strict=True):
        ends = after is None or after["time_step"] > before["time_step"]
        assert before["newton_converged"] == ends == (before["newton_residual"] < 1e-7)
        assert ends or after["newton_index"] == before["newton_index"] + 1
    assert all(record["converged"] and record["ranks"] == ranks for record in records)
    assert {record["forcing"] for record in records} == {1e-9}  # the option has arrived
    assert len({sum(record["contact_states"].values()) for record in records}) == 1
    assert np.allclose([record["time"] for record in records], [900.0 * record["time_step"] for record in records])

    assert (summary["result"], summary["message"], summary["ranks"]) == ("finished", None, ranks)
    assert (summary["time_steps"], summary["newton_steps"]) == (steps, len(records))
    assert summary["iterations"] == sum(record["iterations"] for record in records)
    seconds = summary["seconds"]
    assert all(seconds[phase] > 0 for phase in PHASES)
    assert sum(seconds[name] for name in (*PHASES, "other")) == pytest.approx(seconds["total"])
    for phase in ("transfer", "setup", "solve"):
        assert seconds[phase] == pytest.approx(sum(record[f"{phase}_seconds"] for record in records))
    assert f"{steps} time steps, {len(records)} Newton steps, {summary['iterations']} Krylov iterations" in out
    assert err.count("Krylov iterations") == len(records)

    assert "contact_state" in (folder / VTU / f"model2_1_00000{steps}.vtu").read_text(errors="replace")
    assert f"model2_00000{steps}.pvd" in {p.name for p in (folder / VTU).iterdir()}
    picture = (folder / f"{PICTURE}.svg").read_text()
    assert set(re.findall("<!-- (.*) -->", picture)) > {"sticking", "sliding", "open", "fracture cells", "iterations"}

    contents = sequence.read_contents(folder / SEQUENCE)
    assert contents.complete
    assert [step.run["iterations"] for step in contents.steps] == [record["iterations"] for record in records]
    again = replay(folder / SEQUENCE, ranks, tmp_path)
    assert [step["iterations"] for step in again["steps"]] == [record["iterations"] for record in records]


def replay(path, ranks, tmp_path):
    command = [sys.executable, "-m", "petsc_fs", "solve", str(path), "--report", "replay.json", "-ksp_rtol", "1e-9"]
    if ranks > 1:
        command = [str(MPIEXEC), "-n", str(ranks), *command]
    subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, check=True, timeout=LIMIT, capture_output=True)
    return json.loads((tmp_path / "replay.json").read_text())


@pytest.mark.porepy
def test_a_model_of_the_users(pp, folder, capsys):
    (folder / "own.py").write_text(OWN_MODEL)
    assert cli.main(["run", "own.py:Mine", "--time-steps", "1"]) == 0
    captured = capsys.readouterr()
    assert "1 time steps" in captured.out
    result = folder / "Mine_run"
    assert {p.name for p in result.iterdir()} == {RECORDS, SUMMARY}  # without contact there is no picture of it
    records = records_of(result)
    assert records[-1]["newton_converged"]
    assert summary_of(result)["model"] == "Mine"


@pytest.mark.porepy
def test_a_sequence_by_export(pp, folder, capsys):
    """The direct solver goes the same way, without iterations to compare with."""
    arguments = ["flow", "--refine", "0.5", "--sequence", "--time-steps", "2", "--out", "made/flow.h5"]
    assert cli.main(["export", *arguments]) == 0
    contents = sequence.read_contents(folder / "made" / "flow.h5")
    assert contents.complete
    assert {step.time_step_index for step in contents.steps} == {1, 2}
    assert all(step.run == {} for step in contents.steps)
    assert [p.name for p in (folder / "made").iterdir()] == ["flow.h5"]


# Runs that do not


@pytest.mark.porepy
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_keeps_what_there_is(pp, tmp_path, number):
    process = start(*COARSE, "--out", "mine", "--sequence", cwd=tmp_path)
    records = tmp_path / "mine" / RECORDS
    deadline = time.monotonic() + LIMIT
    while not (records.exists() and records.read_text().count("\n") >= 2):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    done = records_of(tmp_path / "mine")
    summary = summary_of(tmp_path / "mine")
    # CPython ends by the signal itself, which is 130 to a shell, where it came in code made by exec.
    assert process.returncode in (130, -signal.SIGINT), err
    (message,) = ours(err)
    assert (
        message
        == f"petsc-fs: interrupted; mine keeps {len(done)} solves in {summary['time_steps']} complete time steps"
    )
    assert "Traceback" not in err
    assert (summary["result"], summary["newton_steps"]) == ("interrupted", len(done))
    contents = sequence.read_contents(tmp_path / "mine" / "sequence.partial.h5")
    assert not contents.complete
    assert len(contents.steps) in (len(done), len(done) + 1)  # a step is written before its Newton step is judged
    assert not (tmp_path / "mine" / SEQUENCE).exists()


@pytest.mark.porepy
def test_newton_that_does_not_converge(pp, folder, capsys, monkeypatch):
    from petsc_fs.porepy import models

    monkeypatch.setitem(models.NEWTON, "nl_convergence_tol_res", 1e-300)
    monkeypatch.setitem(CASES, "flow", replace(CASES["flow"], newton_iterations=2))
    assert cli.main(["run", "flow", "--refine", "0.5", "--out", "mine"]) == 1
    message = ours(capsys.readouterr().err)
    assert len(message) == 1
    assert re.search(r"flow \(refinement=0\.5\): Newton did not converge in time step 1", message[0])
    summary = summary_of(folder / "mine")
    assert (summary["result"], summary["time_steps"]) == ("failed", 0)
    assert "did not converge" in summary["message"]
    assert len(records_of(folder / "mine")) == summary["newton_steps"] > 1


WRONG = {
    "unknown_model": (["run", "model9"], "unknown model 'model9'; models are model1, "),
    "no_file": (["run", "nowhere.py:Mine"], "nowhere.py: no such file"),
    "no_class": (["run", "own.py:Yours"], "own.py has no PorePy model of the name Yours"),
    "no_model": (["run", "own.py:NotAModel"], "own.py has no PorePy model of the name NotAModel"),
    "no_module": (["run", "no.such.module:Mine"], "no.such.module:Mine: No module named 'no'"),
    "no_time_step": (["run", "flow", "--time-steps", "0"], "expected a whole number from 1 on, found '0'"),
    "refinement": (["run", "flow", "--refine", "0"], "refinement: must be positive"),
    "parameters_of_own": (["run", "own.py:Mine", "--friction", "0.1"], "friction=0.1: only the models of this package"),
    "no_options_file": (["run", "flow", "-options_file", "nowhere.opts"], "options file nowhere.opts: no such file"),
    "two_options_files": (["run", "flow", *2 * ["-options_file", "flow.opts"]], "-options_file: a run takes one"),
    "folder_is_a_file": (["run", "flow", "--out", "own.py"], "own.py: cannot be written to"),
    "picture": (["run", "flow", "--picture", "gif"], "invalid choice: 'gif'"),
    "steps_of_a_sequence": (["export", "flow", "--sequence", "--steps", "all"], "--sequence writes every Newton step"),
    "sequence_over_a_folder": (["export", "flow", "--sequence", "--out", "own.py/x.h5"], "cannot be made a directory"),
}


@pytest.mark.porepy
@pytest.mark.parametrize("name", WRONG)
def test_an_error_is_one_clear_line(pp, folder, capsys, name):
    arguments, message = WRONG[name]
    (folder / "own.py").write_text(OWN_MODEL)
    assert cli.main(arguments) in (2, 3)
    captured = capsys.readouterr()
    assert ours(captured.err) == captured.err.splitlines()
    assert message in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not captured.out
    left = {p.name for p in folder.rglob("*") if p.is_file()} - {"own.py"}
    assert not left - {RECORDS, SUMMARY}, left  # a run that had begun says so in its summary


@pytest.mark.porepy
def test_an_option_that_does_nothing_ends_the_run_at_its_first_solve(pp, tmp_path):
    code, out, err = run("flow", "--refine", "0.5", "-ksp_rtoll", "1e-3", cwd=tmp_path)
    assert (code, out.strip()) == (2, "")  # gmsh may end a line
    (message,) = ours(err)
    assert message.startswith("petsc-fs: option -ksp_rtoll from the command line was not used; did you mean -ksp_rtol")
    assert len(records_of(tmp_path / "flow_run")) <= 1


def test_a_missing_porepy_is_named(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "porepy", None)
    for command in (["run", "flow"], ["export", "flow", "--sequence"]):
        assert cli.main(command) == 2
        assert "petsc-fs: PorePy is not installed" in capsys.readouterr().err
    assert not list(folder.iterdir())
