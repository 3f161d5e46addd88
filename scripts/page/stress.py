"""Extreme scenes by every options file: right, refused or wrong."""

from page import Place

INPUTS = (
    "options/*.opts",
    "petsc_fs/scenes/stress/*",
    *(f"petsc_fs/tools/{module}.py" for module in ("measure", "probe", "reference", "stress", "stress_cases")),
)


def make(place: Place) -> str:
    """The page that `petsc-fs stress` writes."""
    page = place.docs / "stress.md"
    place.run(*f"petsc-fs stress --suite full --ranks 1 2 --page {page}".split(), fine=(0, 1))
    return page.read_text(encoding="utf-8")
