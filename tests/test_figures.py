"""Every figure of a page that is written by hand is in the page of measurements that it links to.

Figures are numbers of seconds, bytes, iterations and the like, and rows of a table with several numbers. A block of
text (between blank lines) with figures has to link to a page of `scripts/pages` that has the same words. Blocks of code
are not looked at: other tests run them, and hold what they print against what README and examples say of it.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from programs import ENVIRONMENT, ROOT

MADE = {path.stem for path in (ROOT / "scripts" / "page").glob("[a-z]*.py")}
"""Names of the pages that `scripts/pages` makes."""
PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").rglob("*.md")) if p.stem not in MADE)]
NUMBER = r"(?:\d[\d.,]*\d|\d|twice|two|three|four|five|six|seven|eight|nine|ten)"
UNITS = "times|s|seconds?|minutes?|hours?|[KMGT]i?B|µs|ms|iterations|solves|unknowns"
FIGURE = re.compile(rf"\b(?:{NUMBER}(?: to |–| and |, | or ))*{NUMBER}(?: ?%|[ -](?:{UNITS})\b)|\btwice\b")
ALLOWED = {
    "docs/install.md": ["64 times"],  # ranks of the call before, each of which prints
    "docs/builds.md": ["a table"],  # of iterations, which test_builds.py holds against what is installed
}
"""What needs no page, and why."""


def prose(text: str) -> str:
    """A page without blocks of code, and code in lines."""
    return re.sub(r"^```.*?^```|^ {4}[^\n]*$|`[^`\n]*`", "", text, flags=re.MULTILINE | re.DOTALL)


def untraced(page: Path, text: str) -> list[str]:
    """Figures of a page that no page it links to beside them has."""
    found = []
    for block in re.split(r"\n\s*\n", prose(text)):
        links = [page.parent / link for link in re.findall(r"\]\(([^)#]+\.md)", block)]
        sources = " ".join(" ".join(link.read_text().split()) for link in links if link.stem in MADE and link.exists())
        words = " ".join(re.sub(r"\]\([^)]*\)", "]", block).split())
        found += [figure for figure in FIGURE.findall(words) if figure not in sources]
        rows = [re.findall(r"(?<=\|) *[\d.,]*\d *(?=\|)", line) for line in block.splitlines()]
        found += ["a table"] * any(len(cells) > 1 for cells in rows)
    return [figure for figure in found if figure not in ALLOWED.get(str(page.relative_to(ROOT)), [])]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_figures_are_of_pages_that_are_made(page):
    assert untraced(page, page.read_text(encoding="utf-8")) == []


def test_a_figure_that_is_not_is_found():
    page = ROOT / "README.md"
    text = prose(page.read_text(encoding="utf-8"))
    figures = FIGURE.findall(text)
    assert len(figures) > 3
    for figure in figures:
        (found,) = untraced(page, text.replace(figure, f"9{figure}", 1))
        assert f"9{figure}" in found
    more = {
        "It takes 0.3 s.": "0.3 s",
        "It is 12 %\nfaster, see [speed](docs/speed.md).": "12 %",
        "| a | 1 | 2.5 |": "a table",
    }
    assert untraced(page, "\n\n".join([text, *more])) == list(more.values())


def pages(*words: str, **environment: str) -> tuple[int, str, str]:
    """Exit code and output of `scripts/pages`."""
    command = [sys.executable, str(ROOT / "scripts" / "pages"), *words]
    done = subprocess.run(command, env=ENVIRONMENT | environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


def test_pages_are_made_from_what_is_there(tmp_path):
    assert pages("--check") == (0, "", "")
    page = (ROOT / "docs" / "speed.md").read_text(encoding="utf-8")
    file = "options/contact_poromechanics_fast.opts"
    (tmp_path / "speed.md").write_text(re.sub(f"(?<={file} )[0-9a-f]+", "0", page))
    said = f"docs/speed.md: {file} is not what it was made from; scripts/pages speed makes it anew\n"
    assert pages("--check", "speed", "--docs", str(tmp_path)) == (1, said, "")


def test_a_page_that_lacks_its_scenes_is_left_as_it_is(tmp_path):
    (tmp_path / "porepy.py").write_text("raise ImportError('not here')")
    words = ("speed", "--docs", str(tmp_path), "--scenes", str(tmp_path / "scenes"))
    code, _, said = pages(*words, PYTHONPATH=os.pathsep.join([str(tmp_path), ENVIRONMENT["PYTHONPATH"]]))
    assert code == 1
    assert "docs/speed.md is not made: it needs what `petsc-fs export model1 --refine 10 --steps 1:1` writes" in said
    assert not (tmp_path / "speed.md").exists()


@pytest.mark.parametrize("name", sorted(MADE))
def test_a_page_that_is_made_is_in_the_index(name):
    assert f"| [{name}.md]({name}.md) |" in (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert f"{name}.md\n" in (ROOT / "scripts" / "docs.yml").read_text(encoding="utf-8")
