"""The README's commands run: blocks marked `bash run` and `python run`, in order, in one empty folder; so does demo."""

import re
import subprocess
from pathlib import Path

import pytest
from blocks import blocks, run
from programs import ENVIRONMENT, ROOT

import petsc_fs.pc

README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = blocks(README)
TO_RUN = [(info.removesuffix(" run"), text) for info, text in BLOCKS if info in ("bash run", "python run")]


def title(block: tuple[str, str]) -> str:
    """Language and first word or two of a block."""
    return "_".join([block[0], *re.findall(r"[\w.-]+", block[1])[:3]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the blocks run, one after the other."""
    return tmp_path_factory.mktemp("readme")


def test_every_block_is_run():
    assert {language for language, _ in TO_RUN} == {"bash", "python"}
    assert len(TO_RUN) == len(BLOCKS)


@pytest.mark.parametrize(("language", "text"), TO_RUN, ids=map(title, TO_RUN))
def test_block_runs(folder, language, text):
    run(language, text, folder)


def words(text: str) -> list[list[str]]:
    """Lines by their words, without blank ones; numbers, which differ from machine to machine, are all alike."""
    lines = [re.sub(r"\d[\d.,e+-]*", "0", line).split() for line in text.splitlines()]
    return [line for line in lines if line and not set(line[0]) == {"-"}]


def test_the_first_command_prints_what_is_said(folder):
    printed = run(*TO_RUN[0], folder)
    said = "\n".join(re.findall(r"^    .*$", README.split(TO_RUN[0][1])[1].split("## ")[0], re.MULTILINE))
    assert words(said) == words(printed)[: len(words(said))]
    assert len(words(printed)) <= len(words(said)) + 3
    promised, found = (int(n) for text in (said, printed) for n in re.findall(r"(\d+) iterations", text))
    assert abs(promised - found) <= 2


def test_so_many_preconditioners_are_in_python():
    numbers = {4: "four", 5: "five", 6: "six"}
    assert f"{numbers[len(petsc_fs.pc.__all__)]} small Python PCs" in " ".join(README.split())


def test_the_first_own_matrix_comes_soon():
    assert README.splitlines().index("## Your own matrix") < 90


def test_demo_ends_with_what_a_direct_solver_takes():
    done = subprocess.run(
        [str(ROOT / "scripts" / "demo")],
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "by contact_poromechanics_fast.opts on 2 ranks" in done.stdout
    ours, direct = done.stdout.splitlines()[-2:]
    number = r"[\d.]+(e-\d+)?"
    assert re.fullmatch(rf"model3.h5: {number} s .*, greatest error of a field {number};", ours)
    assert re.fullmatch(rf"a direct solver .* takes {number} s, greatest error of a field {number}", direct)


LOCAL = sorted({link for link in re.findall(r"\]\(([^)#\s]+)", README) if "://" not in link})


@pytest.mark.parametrize("link", LOCAL)
def test_file_that_is_linked_to_exists(link):
    assert (ROOT / link).exists()
