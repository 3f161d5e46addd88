"""A search for better multigrid options, and its best file on other scenes."""

import shutil

from page import Place

INPUTS = (
    "options/contact_poromechanics.opts",
    "options/sweeps/amg.yaml",
    *(f"petsc_fs/tools/{module}.py" for module in ("measure", "probe", "space", "sweep")),
)


def make(place: Place) -> str:
    """The page that `petsc-fs sweep` writes."""
    call = "petsc-fs sweep model3.h5 --space amg.yaml --trials 60 --clock cpu --seed 1 --hold-out model1.h5 model2.h5"
    place.run(*call.split(), "--page", "sweep.md")
    shutil.copy(place.scratch / "sweep.png", place.docs)
    return (place.scratch / "sweep.md").read_text(encoding="utf-8")
