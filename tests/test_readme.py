"""The README's commands run: blocks marked `bash run` and `python run`, in order, in one empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import petsc_fs

HOME = Path(petsc_fs.__path__[0]).parent
README = (HOME / "README.md").read_text(encoding="utf-8")
LIMIT = 120
RUNNERS = {"bash run": ["bash", "-euo", "pipefail", "-c"], "python run": [sys.executable, "-c"]}
FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCKS = [(info.strip(), text) for info, text in FENCE.findall(README)]
TO_RUN = [(info, text) for info, text in BLOCKS if info in RUNNERS]


def title(block: tuple[str, str]) -> str:
    """Language and first word or two of a block."""
    return "_".join([block[0].split()[0], *re.findall(r"[\w.-]+", block[1])[:3]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the blocks run, one after the other."""
    return tmp_path_factory.mktemp("readme")


def test_there_is_something_to_run_in_each_language():
    assert {info for info, _ in TO_RUN} == set(RUNNERS)


def test_no_block_escapes_by_its_mark():
    assert README.count("\n```") == 2 * len(BLOCKS)
    assert [info for info, _ in BLOCKS if "run" in info and info not in RUNNERS] == []


@pytest.mark.parametrize(("language", "text"), TO_RUN, ids=map(title, TO_RUN))
def test_block_runs(folder, language, text):
    before = [Path(sys.executable).parent, HOME / "scripts"]
    environment = dict(os.environ, OMP_NUM_THREADS="1")
    environment["PATH"] = os.pathsep.join([*map(str, before), environment["PATH"]])
    done = subprocess.run(
        [*RUNNERS[language], text],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"


LOCAL = sorted({link for link in re.findall(r"\]\(([^)#\s]+)", README) if "://" not in link})


@pytest.mark.parametrize("link", LOCAL)
def test_file_that_is_linked_to_exists(link):
    assert (HOME / link).exists()
