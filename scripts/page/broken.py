"""Broken scenes and options: an answer or one clear error."""

from page import ROOT, Place

INPUTS = ("tests/broken.py",)


def make(place: Place) -> str:
    """The page that tests/broken.py writes."""
    target = place.scratch / "broken.md"
    place.run("python", str(ROOT / "tests/broken.py"), "3000", "--two", "500", "--page", str(target), fine=(0, 1))
    return target.read_text(encoding="utf-8")
