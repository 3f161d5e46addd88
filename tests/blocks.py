"""Commands and programs in Markdown: fenced blocks, run in order in one folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

from programs import ENVIRONMENT, ROOT

FENCE = re.compile(r"^```([^\n`]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RUNNERS = {"bash": ["bash", "-euo", "pipefail", "-c"], "python": [sys.executable, "-c"]}
LIMIT = 900


def blocks(text: str) -> list[tuple[str, str]]:
    """The words behind the fence, and the text, of each block."""
    found = [(info.strip(), body) for info, body in FENCE.findall(text)]
    assert text.count("\n```") == 2 * len(found)
    return found


def run(language: str, text: str, folder: Path) -> str:
    """Run a block by the Python of the tests; returns what it printed."""
    beside = [Path(sys.executable).parent, ROOT / "scripts"]
    if not (beside[0] / "petsc-fs").exists():  # a Python that the package is not installed in
        (folder / "petsc-fs").write_text(f'#!/bin/sh\nexec {sys.executable} -m petsc_fs "$@"\n')
        (folder / "petsc-fs").chmod(0o755)
        beside.append(folder)
    done = subprocess.run(
        [*RUNNERS[language], text],
        cwd=folder,
        env=ENVIRONMENT | {"PATH": os.pathsep.join([*map(str, beside), os.environ["PATH"]])},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
    )
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout
