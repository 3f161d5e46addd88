"""The command line. Only this module prints, and only on rank 0."""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from petsc_fs.errors import PetscFsError, SceneError, UsageError, together
from petsc_fs.fields import in_order
from petsc_fs.io.files import write_text

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.scene import Scene
    from petsc_fs.solver import Result, Solver
    from petsc_fs.tree import Tree

TAKES_PETSC = ("solve", "compare", "run", "stress")
"""Commands that pass PETSc's options on."""

MODULES = {
    "compare": ("measure error against seconds of options files, and draw it", "petsc_fs.tools.compare"),
    "sweep": ("search a space of PETSc options for better options files", "petsc_fs.tools.sweep"),
    "stress": ("solve extreme scenes by every options file, and say which answers were right", "petsc_fs.tools.stress"),
    "run": ("run a PorePy model with petsc_fs as its linear solver", "petsc_fs.porepy.simulation"),
    "export": ("run a PorePy model and write its linear systems as scenes", "petsc_fs.porepy.export"),
}
"""Commands with a module of their own: summary, and the module. It has `add_arguments(parser)`, which describes the
arguments, and `command(args, petsc, comm)`, which runs and returns the exit code, collectively on all ranks; it is
imported only where its command is called."""

SECONDS_TO_AGREE = 5.0
"""How long ranks wait for each other after an error before they take the others for stuck."""

DESCRIPTION = """\
Solve linear systems of contact poromechanics with PETSc's nested fieldsplit preconditioners.

A scene is one such system in an HDF5 file. Try, with the scenes that come along:

  petsc-fs inspect model2.h5
  petsc-fs solve model2.h5
  mpiexec -n 2 petsc-fs solve model3.h5 -options_file contact_poromechanics.opts -ksp_monitor

Options with two dashes are this program's; those with one dash are PETSc's and are passed on."""

SOLVE_EPILOG = """\
PETSc options follow the scene, for example
  -options_file FILE     an options file of yours, or the name of a shipped one
  -ksp_rtol 1e-6         relative tolerance      -ksp_monitor   residual at each iteration
  -ksp_view              the solver tree         -log_view      where time goes
  -petsc_fs_partition rcb    which rank gets which cells: auto, rcb, ptscotch or contiguous
  -petsc_fs_ordering morton  order of the cells of a rank: auto, natural (that of the file), or along a curve
  -petsc_fs_mat_type aij     one assembled matrix instead of blocks, for direct solvers
  -petsc_fs_true_rtol 1e-8   tolerance for the true residual, default that of -ksp_rtol
  -petsc_fs_fallback iterations,direct_mechanics,monolithic   stronger solvers to try in turn where a solve
      fails; also regularize, smoother, cycles and direct_mass

exit codes: 0 the true residual of the untransformed system meets the tolerance; 1 it does not, or the
solve failed; 2 wrong call or option; 3 a scene that cannot be read or does not fit together"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Collective on all ranks of an MPI run."""
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    own, petsc = split_arguments(sys.argv[1:] if argv is None else argv)
    try:
        with contextlib.redirect_stdout(io.StringIO() if comm.rank else sys.stdout):
            args = _parser(own[:1]).parse_args(own)
        if petsc and args.command not in TAKES_PETSC:
            raise UsageError(
                f"{petsc[0]}: PETSc options go with {' and '.join(TAKES_PETSC)}; options of petsc-fs have two dashes"
            )
        return int(args.run(args, petsc, comm))
    except SystemExit as e:  # --help
        return int(e.code or 0)
    except PetscFsError as e:
        return _fail(comm, f"petsc-fs: {e}", e.exit_code)
    except KeyboardInterrupt as e:
        return _fail(comm, f"petsc-fs: {str(e) or 'interrupted'}", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except Exception:
        return _fail(comm, traceback.format_exc().rstrip(), 70)


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """This program's arguments, and PETSc's: single-dash options with the values that follow them."""
    own: list[str] = []
    petsc: list[str] = []
    to_petsc = False
    for word in argv:
        if word.startswith("--") or word == "-h":
            to_petsc = False
        elif word.startswith("-") and not _is_number(word):
            to_petsc = True
        (petsc if to_petsc else own).append(word)
    return own, petsc


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _fail(comm: MPI.Intracomm, message: str, code: int) -> int:
    """Print one message and return the code if all ranks failed; else end the ranks that are stuck."""
    request = comm.Ibarrier()
    deadline = time.monotonic() + (SECONDS_TO_AGREE if comm.size > 1 else 0)
    while not (agreed := request.Test()) and time.monotonic() < deadline:
        time.sleep(0.01)
    if comm.rank == 0 or not agreed:
        where = "" if agreed else f" (on rank {comm.rank}, others did not get there)"
        print(message + where, file=sys.stderr, flush=True)
    if not agreed:
        comm.Abort(code)
    return code


class _Parser(argparse.ArgumentParser):
    """One line on a wrong call, as for any other error."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


def _parser(command: list[str]) -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="petsc-fs", description=DESCRIPTION, formatter_class=raw)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, summary: str, run: Any, **more: Any) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=summary, description=summary, formatter_class=raw, **more)
        sub.set_defaults(run=run)
        return sub

    solve = add("solve", "solve a scene, or a sequence of them, and say how well", _solve, epilog=SOLVE_EPILOG)
    solve.add_argument("scene", metavar="SCENE", help="file, or name of a bundled one such as model1.h5")
    solve.add_argument("--report", type=Path, metavar="FILE.json", help="write what was done and measured")
    solve.add_argument("--save", type=Path, metavar="FILE.h5", help="write the solution, in the scene's numbering")
    solve.add_argument("--steps", metavar="A:B", help="of a sequence, solve these only; from 0, B excluded")

    inspect = add("inspect", "show fields, blocks and contact states of a scene", _inspect)
    inspect.add_argument("scene", metavar="SCENE")
    inspect.add_argument("--step", type=int, metavar="K", help="of a sequence, show this step; from 0")
    inspect.add_argument("--plot", type=Path, metavar="FILE", help="draw the block structure (.png, .svg, .pdf)")
    inspect.add_argument(
        "--contraction", action="store_true", help="evaluate the condition under which fixed stress converges"
    )
    inspect.add_argument("--json", type=Path, metavar="FILE.json", help="with --contraction: write its numbers")

    options = add("options", "print the options file of the smallest solver for a scene", _options)
    options.add_argument("scene", metavar="SCENE")

    lint = add("lint", "check an options file without solving", _lint, epilog=LINT_EPILOG)
    lint.add_argument("file", metavar="FILE", help="options file, or the name of a shipped one")
    lint.add_argument("scene", metavar="SCENE", nargs="?", help="scene it is for; default a bundled one that fits")

    convert = add("convert", "turn a scene into PETSc's binary format, or back", _convert, epilog=CONVERT_EPILOG)
    convert.add_argument("source", metavar="SOURCE", help="scene or sequence (.h5), or folder in PETSc's format")
    convert.add_argument("target", metavar="TARGET", help="folder to write, or scene (.h5)")
    convert.add_argument("--step", type=int, metavar="K", help="of a sequence, write this step as a scene; from 0")
    convert.add_argument(
        "--dimension", type=int, choices=(2, 3), help="of the rock, where SOURCE is a folder without scene.h5"
    )

    for name, (summary, module) in MODULES.items():
        sub = add(name, summary, None)
        if command == [name]:
            own = import_module(module)
            own.add_arguments(sub)
            sub.set_defaults(run=own.command)
    return parser


LINT_EPILOG = """\
The solver is set up on the scene but does not run. Found are: lines PETSc would stop at, options that
nothing asks for (with the closest valid names), prefixes that match no split, levels without an explicit
ksp_type or pc_type, and values that PETSc rejects. Exit code 2 if there is any of it."""

CONVERT_EPILOG = """\
The folder holds matrix.petsc (MatLoad), rhs.petsc and, if known, reference.petsc (VecLoad), one
fields/NAME.petsc per field (ISLoad: the rows and columns of the field), and scene.h5 with what PETSc's
format has no place for (cell data, material, units), without which the way back gives less and needs
--dimension."""


def _solve(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from petsc_fs import options
    from petsc_fs.io import hdf5, sequence

    with together(comm):
        path = find_scene(args.scene)
        replayed = sequence.is_sequence(path)
        if args.steps is not None and not replayed:
            raise UsageError(f"--steps: {path} is no sequence")
    if replayed:
        from petsc_fs.cli import replay

        return replay.command(args, petsc, comm)
    with together(comm):
        sizes = hdf5.read_sizes(path)[1]
        check_folders(args.report, args.save)
        petsc, options_file = with_options_file(petsc, tuple(sizes))
    given = GivenOptions.start_petsc(petsc, options_file)

    from petsc4py import PETSc

    from petsc_fs.io.reader import read_distributed
    from petsc_fs.memory import Phases, return_freed
    from petsc_fs.partition import chosen
    from petsc_fs.solver import Solver

    return_freed()
    phases = Phases()
    started = time.perf_counter()
    scene, layout = read_distributed(path, comm, *chosen(), index_type=PETSc.IntType)
    read_seconds = time.perf_counter() - started
    tree = None
    if options_file is None:
        tree = tree_for(scene, comm)
        options.insert_all(tree.options)
    phases.end("read")
    solver = Solver(scene, comm, layout=layout, release=True)
    phases.end("build")
    solver.set_up()
    phases.end("set-up")
    result = solver.solve()
    phases.end("solve")
    with together(comm):
        given.refuse_unused(tree)

    everything = solver.system.gather(result.solution)
    memory = phases.report(comm)
    with together(comm):
        report = _report(
            scene,
            solver,
            result,
            memory=memory,
            path=path,
            options_file=options_file,
            tree=tree,
            read_seconds=read_seconds,
            database=database(),
        )
        if everything is not None and args.report is not None:
            write_text(args.report, json.dumps(report, indent=2) + "\n")
        if everything is not None and args.save is not None:
            hdf5.write_solution(everything, args.save, scene)
    if comm.rank == 0:
        from petsc_fs.cli.tables import solve_table

        print(solve_table(scene, report), flush=True)
    return 0 if result.converged else 1


def tree_for(scene: Scene, comm: MPI.Intracomm) -> Tree:
    """The smallest solver tree for a scene, from the canonical options file. Collective."""
    from petsc_fs.tree import Facts, shipped_tree

    return shipped_tree(Facts.of(scene, comm))


def check_folders(*targets: Path | None) -> None:
    """Complain about files to write whose folder is missing.

    Raises:
        UsageError: there is one.
    """
    for target in targets:
        if target is not None and not target.absolute().parent.is_dir():
            raise UsageError(f"{target}: the folder {target.absolute().parent} does not exist")


@dataclass(frozen=True)
class GivenOptions:
    """PETSc options of a call, which must not go unused.

    Attributes:
        typed: names on the command line, without the dash.
        given: all names that PETSc started with.
        file: the first options file, if there is one.
    """

    typed: frozenset[str]
    given: frozenset[str]
    file: Path | None

    @classmethod
    def start_petsc(cls, petsc: Sequence[str], file: Path | None) -> GivenOptions:
        """Initialise PETSc with options of the command line. Collective.

        Args:
            petsc: words of the command line, as `with_options_file` returns them.
            file: likewise.
        """
        import petsc4py

        petsc4py.init(["petsc-fs", *petsc])
        from petsc_fs import options

        given = frozenset(options.unused())
        options.insert_all({"options_left": "no"})  # newer PETSc would repeat at its end what is said here
        typed = frozenset(word[1:] for word in petsc if word.startswith("-") and not _is_number(word))
        return cls(typed, given, file)

    def refuse_unused(self, tree: Tree | None = None) -> None:
        """Complain about options that nothing has asked for, after a solve. Local.

        Args:
            tree: from which the options of the solver come where there is no file.

        Raises:
            UsageError: there are any.
        """
        from petsc_fs import options

        useless = options.refused([name for name in options.unused() if name in self.given])
        if useless:
            raise UsageError(options.explain(useless, self.typed, self.file, tree.left_out if tree is not None else ()))


def with_options_file(petsc: list[str], fields: tuple[str, ...]) -> tuple[list[str], Path | None]:
    """PETSc's arguments with every options file found and checked, and the first of them."""
    from petsc_fs import options

    petsc = list(petsc)
    files = []
    for i, word in enumerate(petsc):
        if word == "-options_file":
            if i + 1 == len(petsc):
                raise UsageError("-options_file: the name of the file is missing")
            files.append(options.find_options_file(petsc[i + 1]))
            petsc[i + 1] = str(files[-1])
    if not files:
        return petsc, None
    for file in files:
        options.parse(file)
    header = options.read_header(files[0])
    if not header.fits(fields):
        raise UsageError(
            f"{header.path.name} is for scenes with the fields {', '.join(header.fields)}; "
            f"this one has {', '.join(in_order(fields))}"
        )
    return petsc, files[0]


def _report(
    scene: Scene,
    solver: Solver,
    result: Result,
    *,
    memory: dict[str, Any],
    path: Path,
    options_file: Path | None,
    tree: Tree | None,
    read_seconds: float,
    database: dict[str, str],
) -> dict[str, Any]:
    """What --report writes and the table shows."""
    return {
        "scene": path.name,
        "model": scene.metadata.model,
        "time_step_index": scene.metadata.time_step_index,
        "newton_index": scene.metadata.newton_index,
        "dimension": scene.dimension,
        "fields": {f: solver.layout.sizes(f)[1] for f in solver.layout.fields},
        "ranks": solver.layout.comm.size,
        "read_seconds": read_seconds,
        **result.report(),
        "memory_bytes": memory,
        "options_file": options_file.name if options_file is not None else None,
        "left_out": [str(part) for part in tree.left_out] if tree is not None else [],
        "options": database,
        "versions": versions(),
    }


def database() -> dict[str, str]:
    """The options of this run, as PETSc has them."""
    from petsc4py import PETSc

    return {k: v for k, v in PETSc.Options().getAll().items() if k != "options_left"}


def versions() -> dict[str, str]:
    """Version of everything that takes part in a solve."""
    import platform

    import mpi4py
    import numpy as np
    from petsc4py import PETSc

    from petsc_fs.io import hdf5

    return {
        **hdf5.versions(),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "mpi4py": mpi4py.__version__,
    }


def _inspect(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from petsc_fs.cli.tables import contraction_table, inspect_table, sequence_table
    from petsc_fs.io import hdf5, sequence

    lines = []
    if args.contraction:
        import petsc4py

        petsc4py.init(["petsc-fs"])  # on all ranks, as its end is collective
    with together(comm):
        if args.json is not None and not args.contraction:
            raise UsageError("--json goes with --contraction")
        if comm.rank == 0:
            path = find_scene(args.scene)
            replayed = sequence.is_sequence(path)
            if args.step is not None and not replayed:
                raise UsageError(f"--step: {path} is no sequence")
            if replayed and args.step is None:
                if args.plot is not None:
                    raise UsageError("--plot draws one step of a sequence: choose it with --step K")
                if args.contraction:
                    raise UsageError("--contraction is about one step of a sequence: choose it with --step K")
                lines.append(sequence_table(path.name, sequence.read_contents(path)))
            else:
                scene = sequence.read(path, args.step) if replayed else hdf5.read(path)
                lines.append(inspect_table(scene))
                if args.contraction:
                    from petsc_fs.tools import contraction

                    found = contraction.evaluate(scene)
                    lines.append(contraction_table(found))
                    if args.json is not None:
                        write_text(args.json, found.to_json())
            if args.plot is not None:
                from petsc_fs.tools.plots import plot_blocks

                lines.append(f"block structure drawn in {plot_blocks(scene, args.plot)}")
    if comm.rank == 0:
        print("\n".join(lines), flush=True)
    return 0


def _options(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from mpi4py import MPI

    from petsc_fs.io import hdf5
    from petsc_fs.tree import canonical_name

    with together(comm):
        path = find_scene(args.scene)
        tree = tree_for(hdf5.read(path), MPI.COMM_SELF)
    if comm.rank == 0:
        print(tree.text(f"The smallest solver for {path.name}, cut from {canonical_name()}"), end="", flush=True)
    return 0


def _lint(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from petsc_fs import options
    from petsc_fs.cli import lint

    if comm.size > 1:
        raise UsageError("lint runs on one rank; start it without mpiexec")
    file = options.find_options_file(args.file)
    if args.scene is not None:
        scenes = [find_scene(args.scene)]
    else:
        scenes = sorted((Path(__file__).parent.parent / "scenes").glob("*.h5"))
    found = lint.lint(file, scenes)
    for line in found:
        print(line, file=sys.stderr)
    if not found:
        print(f"{file}: nothing to complain about")
    return UsageError.exit_code if found else 0


def _convert(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    if comm.size > 1:
        raise UsageError("convert runs on one rank; start it without mpiexec")
    import petsc4py

    petsc4py.init(["petsc-fs"])
    from petsc_fs.io import petsc_binary

    source, target = Path(args.source), Path(args.target)
    if args.step is not None:
        from petsc_fs.io import hdf5, sequence

        if target.suffix != ".h5":
            raise UsageError(f"{target}: a step becomes a scene, whose name ends in .h5")
        written = [hdf5.write(sequence.read(find_scene(args.source), args.step), target)]
    elif source.is_dir():
        written = petsc_binary.to_scene(source, target, dimension=args.dimension)
    else:
        written = petsc_binary.from_scene(find_scene(args.source), target)
    print(f"written: {', '.join(str(p) for p in written)}")
    return 0


def find_scene(name: str) -> Path:
    """Path of a scene or sequence: as given, or else one that is bundled under this name.

    Raises:
        SceneError: there is neither.
    """
    path = Path(name)
    if path.exists():
        return path
    here = Path(__file__).parent.parent
    bundled = {kind: sorted((here / kind).glob("*.h5")) for kind in ("scenes", "sequences")}
    for file in (*bundled["scenes"], *bundled["sequences"]):
        if path == Path(file.name):
            return file
    names = ", and ".join(f"bundled {kind} are {', '.join(f.name for f in files)}" for kind, files in bundled.items())
    raise SceneError(f"{path}: no such file; {names}")
