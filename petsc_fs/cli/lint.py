"""Checks of options files against the solver they describe."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from petsc_fs import options
from petsc_fs.errors import PetscFsError, UsageError
from petsc_fs.io import hdf5


def lint(file: Path, scenes: Sequence[Path]) -> list[str]:
    """Everything wrong with an options file, one line each.

    Initialises PETSc, puts the file into its options database, and sets the solver up on the first scene
    that has the fields of the file's header; it does not solve.

    Args:
        file: options file.
        scenes: to choose from.

    Raises:
        UsageError: no scene fits.
    """
    try:
        chosen = options.parse(file)
    except UsageError as e:
        return [str(e)]
    try:
        options.check(chosen)
    except UsageError as e:
        return [f"{file}: {e}"]
    header = options.read_header(file)
    scene = next((s for s in scenes if header.fits(hdf5.read_sizes(s)[1])), None)
    if scene is None:
        raise UsageError(f"{file}: none of the scenes has the fields {', '.join(header.fields)}; name one")

    options.Given.of(["-options_file", str(file)]).start()
    from petsc_fs.nest import levels
    from petsc_fs.solver import Solver

    found = [f"{file}: {problem}" for problem in _levels_without_types(chosen)]
    try:
        solver = Solver(hdf5.read(scene))
        solver.set_up()
    except PetscFsError as e:
        return [*found, f"{file}: the solver cannot be set up: {e}"]
    useless = options.refused([name for name in options.unused() if name in chosen])
    splits = {pc.getOptionsPrefix() or "" for pc in levels(solver.ksp.getPC())}
    for name in useless:
        missing = next((p for p in _split_prefixes(name) if p not in splits), None)
        if missing is None:
            found.append(f"{file}: {options.explain([name], file=file)}")
        else:
            similar = options.closest(missing, splits)
            hint = f"; there is {' and '.join('-' + s for s in similar)}" if similar else ""
            found.append(f"{file}: option -{name}: no split has the prefix -{missing}{hint}")
    solver.destroy()
    return found


def _levels_without_types(chosen: Mapping[str, str | None]) -> Iterator[str]:
    """Splits that leave their KSP or PC to PETSc's defaults."""
    for prefix in sorted({p for name in chosen for p in _split_prefixes(name)}):
        for kind, default in (("ksp_type", "GMRES"), ("pc_type", "ILU or block Jacobi")):
            if f"{prefix}{kind}" not in chosen:
                yield f"level -{prefix} has no {kind}; PETSc would take {default}: name it"


def _split_prefixes(name: str) -> list[str]:
    """The prefixes of splits in an option name, outermost first."""
    return [name[: m.end()] for m in re.finditer(options.SPLIT, name)]
