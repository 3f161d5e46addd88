"""The documents: what they have run runs, links resolve, and what they say of options and files is so."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec

import h5py
import pytest
from blocks import blocks, run
from programs import ENVIRONMENT, ROOT
from sample import SCENES

PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
OPTIONS = sorted((ROOT / "options").rglob("*.*"))
GONE = re.compile("-petsc_fs_(error_factor|true_rtol|restarts|scaling|fallback|regularize|stagnation|reuse|mat_type)")
NOTEBOOK = ROOT / "docs" / "examples" / "first_hour.ipynb"
FORMAT = (ROOT / "docs" / "scene_format.md").read_text(encoding="utf-8")
PROGRAMS = [page for page in sorted((ROOT / "docs").glob("*.md")) if blocks(page.read_text(encoding="utf-8"))]
NEEDS = {"porepy.md": "porepy", "matrix.md": "scipy"}
"""Packages that the programs of a page import, beside those of this one."""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_relative_links_resolve(page):
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", [p for p in PAGES + OPTIONS if p != PAGES[1]], ids=lambda p: str(p.relative_to(ROOT)))
def test_options_that_are_gone_are_not_named(page):
    assert GONE.findall(page.read_text(encoding="utf-8")) == []


def test_options_of_this_package_that_are_named_are_explained():
    named = {n for page in PAGES if page != PAGES[1] for n in re.findall("-(petsc_fs_[a-z_0-9]+)", page.read_text())}
    explained = set(re.findall("`-(petsc_fs_[a-z_0-9]+)", (ROOT / "docs" / "options.md").read_text()))
    assert named
    assert sorted(n for n in named - explained if not n.startswith("petsc_fs_mat_partitioning_")) == []


@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=[pytest.mark.porepy] if NEEDS.get(p.name) == "porepy" else [], id=p.name) for p in PROGRAMS],
)
def test_commands_and_programs_of_a_page_run(page, tmp_path):
    """All of its blocks; one with title="NAME" is a file. The pages in docs/examples are those of test_examples.py."""
    if (needed := NEEDS.get(page.name)) is not None and find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed in {sys.executable}")
    for info, text in blocks(page.read_text(encoding="utf-8")):
        language, _, name = info.partition(" title=")
        if name:
            (tmp_path / name.strip('"')).write_text(text)
        else:
            run(language, text, tmp_path)


def test_the_notebook_runs_and_has_been_run(tmp_path):
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 5
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert not [out for cell in cells for out in cell["outputs"] if out["output_type"] == "error"]
    run("python", "\n".join("".join(cell["source"]) + "\n" for cell in cells), tmp_path)


def contents(group: h5py.Group, where: str = "") -> Iterator[tuple[str, str, str]]:
    """Where each attribute (A) and dataset (D) of a scene is, and its name."""
    yield from ((where or "/", "A", name) for name in group.attrs)
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            yield where or "/", "D", name
        else:
            yield from contents(item, f"{where}/{name}")


def test_the_scene_format_is_that_of_the_files():
    """Every attribute and dataset of the bundled scenes has its row, and every row is met in one of them."""
    said, place = set(), ""
    for where, what, *_ in re.findall(r"^\|([^|\n]*)\|([^|\n]*)\|", FORMAT, re.MULTILINE):
        place = next(iter(re.findall("`(.*?)`", where)), place)
        kinds = re.findall(r"\b[AD]\b", what.split("`")[0])
        said |= {(place, kind, name) for kind in kinds for name in re.findall("`(.*?)`", what)}
    found = set()
    for path in SCENES.glob("*.h5"):
        with h5py.File(path) as file:
            for where, kind, name in contents(file):
                place = re.sub(r"/blocks/\w+/\w+", "/blocks/ROW/COLUMN", where)
                own = {"cell_dimension": "/fields/mass", "contact_state": "/fields/contact"}.get(name)
                place = own or re.sub(r"/fields/\w+", "/fields/NAME", place)
                if place not in ("/units", "/producers"):
                    found.add((place, kind, name))
    assert found - said == set()
    assert {row for row in said if row[0] not in ("/units", "/producers", "/material")} - found == set()
    assert {row[2] for row in said if row[0] == "/material"} == {row[2] for row in found if row[0] == "/material"}


def test_pages_build_without_a_warning_and_need_no_network(tmp_path):
    if "CI" not in os.environ and not (ROOT / "build" / "docs-env" / "wanted").exists():
        pytest.skip("scripts/docs, which gets its tools from the network, has not been run here")
    done = subprocess.run(
        [ROOT / "scripts" / "docs", tmp_path / "site"], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    pages = sorted((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        assert re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="?https?://[^"> ]*', page.read_text()) == []
    assert "fs_damping" in (tmp_path / "site" / "search" / "search_index.js").read_text()
    shutil.rmtree(tmp_path / "site")
