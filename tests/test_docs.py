"""The documents: every relative link resolves, and nobody is told of an option that is gone."""

import re
from pathlib import Path

import pytest

import petsc_fs

HOME = Path(petsc_fs.__path__[0]).parent
PAGES = [HOME / "README.md", HOME / "CHANGELOG.md", *sorted((HOME / "docs").rglob("*.md"))]
OPTIONS = sorted((HOME / "options").rglob("*.*"))
GONE = re.compile("-petsc_fs_(error_factor|true_rtol|restarts|scaling|fallback|regularize|stagnation|reuse|mat_type)")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(HOME)))
def test_relative_links_resolve(page):
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", [p for p in PAGES + OPTIONS if p != PAGES[1]], ids=lambda p: str(p.relative_to(HOME)))
def test_options_that_are_gone_are_not_named(page):
    assert GONE.findall(page.read_text(encoding="utf-8")) == []


def test_options_of_this_package_that_are_named_are_asked_for_somewhere():
    named = set(re.findall("-(petsc_fs_[a-z_]+)", PAGES[0].read_text(encoding="utf-8")))
    source = "".join(path.read_text(encoding="utf-8") for path in (HOME / "petsc_fs").rglob("*.py"))
    assert named and [name for name in named if f'"{name}"' not in source] == []
