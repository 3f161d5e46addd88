"""`petsc-fs inspect`: what is in a scene or a sequence, and whether the theory of fixed stress holds for it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from petsc_fs import options
from petsc_fs.cli.tables import contents_table, scene_table, table, wrapped
from petsc_fs.errors import UsageError, together
from petsc_fs.fields import learn_aliases
from petsc_fs.io import hdf5, sequence
from petsc_fs.io.bundled import check_targets, find_scene
from petsc_fs.io.files import write_text
from petsc_fs.porepy.cases import describe_permeability

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.tools.contraction import Contraction

SPREAD = ("cells", "least", "median", "greatest", "at (m)")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the arguments of `command`."""
    parser.add_argument("scene", metavar="SCENE", help="file, or name of a bundled one such as model1.h5")
    parser.add_argument(
        "--fields", type=learn_aliases, metavar="NAME=FIELD,...", help="other names of fields there: u=momentum,p=mass"
    )
    parser.add_argument("--step", type=int, metavar="K", help="of a sequence, show this step; from 0")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the block structure (.png, .svg, .pdf)")
    parser.add_argument(
        "--contraction", action="store_true", help="evaluate the condition under which fixed stress converges"
    )
    parser.add_argument("--json", type=Path, metavar="FILE.json", help="with --contraction: write its numbers")


def command(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    """Show what the arguments of `add_arguments` name; rank 0 does it. Collective.

    Raises:
        UsageError: the arguments do not go together, or a file cannot be written.
        SceneError: the scene cannot be read.
    """
    if args.contraction:
        options.Given.of([]).start()  # on all ranks, as its end is collective
    with together(comm):
        if args.json is not None and not args.contraction:
            raise UsageError("--json goes with --contraction")
        lines = _lines(args) if comm.rank == 0 else []
    if comm.rank == 0:
        print("\n".join(lines), flush=True)
    return 0


def _lines(args: argparse.Namespace) -> list[str]:
    path = find_scene(args.scene)
    check_targets(args.json, args.plot, sources=(path,))
    many = sequence.is_sequence(path)
    if args.step is not None and not many:
        raise UsageError(f"--step: {path} is no sequence")
    if many and args.step is None:
        for name in ("plot", "contraction"):
            if getattr(args, name):
                raise UsageError(f"--{name} is about one step of a sequence: choose it with --step K")
        return [contents_table(path.name, sequence.read_contents(path))]
    scene = sequence.read(path, args.step) if many else hdf5.read(path)
    lines = [scene_table(scene)]
    if permeability := describe_permeability(scene.metadata.model):
        lines.append(f"fracture permeability: {permeability}")
    if args.contraction:
        from petsc_fs.tools import contraction

        found = contraction.evaluate(scene)
        lines += ["", contraction_text(found)]
        if args.json is not None:
            write_text(args.json, found.to_json())
    if args.plot is not None:
        from petsc_fs.tools.plots import plot_blocks

        lines.append(f"block structure drawn in {plot_blocks(scene, args.plot)}")
    return lines


def contraction_text(found: Contraction) -> str:
    """The terms of the convergence condition, which of them dominates, and what the scene does not meet."""
    from petsc_fs.tools.contraction import FORMULAS, VIOLATIONS

    def spread(values: NDArray[np.float64] | None) -> tuple[str, ...]:
        s = found.summary(values)
        if not s["cells"]:
            return ("0", "", "", "", "")
        at = "" if s["max_at_m"] is None else ", ".join(f"{round(x)}" for x in s["max_at_m"])
        return (str(s["cells"]), *(f"{s[what] + 0.0:.1e}" for what in ("min", "median", "max")), at)

    rows = [
        (name, *spread(found.terms.get(name)), f"{found.theorem[name]:.1e}" if name in found.theorem else "?")
        for name in FORMULAS
    ]
    parts = [
        "convergence condition of fixed stress: 4 G D >= sum of the terms, in Pa/m",
        table(["term", *SPREAD, "in theorem"], rows),
        *(f"{name} = {formula}" for name, formula in FORMULAS.items()),
    ]
    if found.demand is not None:
        parts.append(f"sum of the terms: {found.demand:.2e} Pa/m")
    if found.stiffness is not None:
        parts.append("4 G D: between {:.2e} and {:.2e} Pa/m".format(*found.stiffness))
    parts.append(f"condition: {found.verdict}" + (f"; {found.dominant} dominates" if found.dominant else ""))
    if found.rate is not None:
        parts.append(f"where it holds, every iteration reduces the error at least by the factor {found.rate:.3f}")
    if found.violations:
        words = [(VIOLATIONS[name], *spread(values)) for name, values in found.violations.items()]
        parts += ["", "against its assumptions", table(["", *SPREAD], words)]
    return "\n".join([*parts, wrapped(f"- {note}" for note in found.notes)])
