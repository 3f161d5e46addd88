"""The command line: arguments, exit codes, and one line for whatever goes wrong, on all ranks together."""

from __future__ import annotations

import argparse
import contextlib
import io
import locale
import os
import sys
import textwrap
import time
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from petsc_fs import missing, options
from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.fields import learn_aliases
from petsc_fs.io.bundled import bundled, find_scene, versions

if TYPE_CHECKING:
    from mpi4py import MPI

TAKES_PETSC = ("solve", "compare", "run", "stress")
"""Commands that pass PETSc's options on."""

MODULES = {
    "solve": ("solve a scene, or a sequence of them, and say how well", "petsc_fs.cli.solve"),
    "inspect": ("show fields, blocks and contact states of a scene", "petsc_fs.cli.inspect"),
    "compare": ("measure error against seconds of options files, and draw it", "petsc_fs.tools.compare"),
    "sweep": ("search a space of PETSc options for better options files", "petsc_fs.tools.sweep"),
    "stress": ("solve extreme scenes by every options file, and say which answers were right", "petsc_fs.tools.stress"),
    "run": ("run a PorePy model with petsc_fs as its linear solver", "petsc_fs.porepy.simulation"),
    "export": ("run a PorePy model and write its linear systems as scenes", "petsc_fs.porepy.export"),
}
"""Commands with a module of their own: summary, and the module. It has `add_arguments(parser)`, which describes the
arguments, and `command(args, petsc, comm)`, which runs and returns the exit code, collectively on all ranks; it is
imported only where its command is called. A run leaves what is to be shown of it in `args.summary`, on rank 0, and a
command what is to be called at its end, whether it has failed or not, in `args.close`. Collective."""

SECONDS_TO_AGREE = 5.0
"""How long ranks wait for each other after an error before they take the others for stuck."""
INTERRUPTED, CUT_OFF = 130, 141
"""Exit codes as shells have them: 128 and the number of the signal."""

DESCRIPTION = """\
Solve linear systems of contact poromechanics with PETSc's nested fieldsplit preconditioners.

A scene is one such system in an HDF5 file. Try, with the scenes that come along:

  petsc-fs inspect model2.h5
  petsc-fs solve model2.h5
  mpiexec -n 2 petsc-fs solve model3.h5 -ksp_rtol 1e-8 -ksp_monitor

Options with two dashes are this program's; those with one dash are PETSc's and are passed on.
petsc-fs COMMAND --help tells more, and of solve also the options of the preconditioners."""

LINT_EPILOG = """\
The solver is set up on the scene but does not run. Found are: lines PETSc would stop at, options that
nothing asks for (with the closest valid names), prefixes that match no split, levels without an explicit
ksp_type or pc_type, and values that PETSc rejects. Exit code 2 if there is any of it."""

CONVERT_EPILOG = """\
The folder holds matrix.petsc (MatLoad), rhs.petsc and, if known, reference.petsc (VecLoad), one
fields/NAME.petsc per field (ISLoad: the rows and columns of the field), and scene.h5 with what PETSc's
format has no place for (cell data, material, units), without which the way back gives less and needs
--dimension.

A matrix alone is in Matrix Market's format or .npz (which need scipy), .npy, hypre's IJ files (all that
have the prefix SOURCE), or PETSc's binary format; so is the right-hand side, or it is a text of numbers:

  petsc-fs convert A.mtx mine.h5 --rhs b.mtx --rows momentum=0:100,mass=100:150 --dimension 2
  petsc-fs convert A.npz mine.h5 --rhs b.npy --rows momentum=@u.txt,mass=@p.txt --dimension 3
  petsc-fs convert IJ.out.A mine.h5 --rhs IJ.out.b --dofmap dofmap.out --rows momentum=0:3,mass=3 --dimension 3

Rows are slices as in Python, single numbers, or @FILE with numbers (from 0; -1 for an unknown that was
eliminated, which becomes an equation x = 0); more than one for a field follow each other:
mass=100:150,160:170. With --dofmap they are labels."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Collective on all ranks of an MPI run."""
    try:
        import petsc4py  # noqa: F401
        from mpi4py import MPI
    except (ImportError, RuntimeError) as e:  # the latter from a wheel of mpi4py that finds no MPI
        print(f"petsc-fs: {missing(e)}", file=sys.stderr)
        return UsageError.exit_code
    comm = MPI.COMM_WORLD
    locale.setlocale(locale.LC_NUMERIC, "C")  # or PETSc reads no decimal points
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    args, message, code = argparse.Namespace(close=None), "", 0
    try:
        own, petsc = split_arguments(sys.argv[1:] if argv is None else argv)
        said = io.StringIO()  # for argparse does not tell whether it could write
        try:
            with contextlib.redirect_stdout(said):
                args = _parser(own[:1]).parse_args(own)
        except SystemExit as e:  # --help
            print(said.getvalue() if comm.rank == 0 else "", end="", flush=True)
            return int(e.code or 0)
        if petsc and args.command not in TAKES_PETSC:
            raise UsageError(
                f"{petsc[0]}: PETSc options go with {' and '.join(TAKES_PETSC)}; options of petsc-fs have two dashes"
            )
        _explain(petsc, comm)
        code = int(args.run(args, petsc, comm))
        if args.summary is not None:
            from petsc_fs.cli.tables import run_table

            print(run_table(args.summary))
        sys.stdout.flush()
    except PetscFsError as e:
        message, code = str(e), e.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python tries once more at its end
        message, code = "standard output was closed before all was written", CUT_OFF
    except KeyboardInterrupt as e:
        message, code = str(e) or "interrupted", INTERRUPTED
    except BaseException as e:
        message, code = _describe(e), PetscFsError.exit_code
    if message:
        _fail(comm, f"petsc-fs: {message}", code)
    if args.close is not None:  # all ranks are here, and no frame of an error holds PETSc's objects any more
        args.close()
    return code


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """This program's arguments, and PETSc's: single-dash options, each with the value that may follow it.

    What looks like a scene is none of the latter's values, so that -ksp_view model2.h5 has no need of a third word.
    """
    own: list[str] = []
    petsc: list[str] = []
    option = ""  # that may take the next word
    for word in argv:
        if word.startswith("--") or word == "-h" or not (options.is_option(word) or option):
            own.append(word)
            option = ""
        elif options.is_option(word):
            petsc.append(word)
            option = word.lstrip("-")
        else:
            (own if option not in options.TAKE_FILES and _is_scene(word) else petsc).append(word)
            option = ""
    if "-help" in petsc and len(own) < 2:  # no scene, of whose solver PETSc would tell
        own.append("--help")
    return own, petsc


def _is_scene(word: str) -> bool:
    """Whether a word names a scene rather than a value, as `hdf5:x.h5` is one for a viewer."""
    if word.endswith(".h5"):
        return ":" not in word
    try:
        with open(word, "rb") as file:
            return os.path.isfile(word) and file.read(4) == b"\x89HDF"
    except (OSError, ValueError):
        return False


def _explain(petsc: Sequence[str], comm: MPI.Intracomm) -> None:
    """With -help, show the options of this package before PETSc shows its own."""
    if "-help" in petsc and comm.rank == 0:
        from petsc_fs.cli import manual

        print(manual.text(), flush=True)


def _fail(comm: MPI.Intracomm, message: str, code: int) -> None:
    """Print one message if all ranks failed; else end the ranks that are stuck."""
    request = comm.Ibarrier()
    deadline = time.monotonic() + (SECONDS_TO_AGREE if comm.size > 1 else 0)
    while not (agreed := request.Test()) and time.monotonic() < deadline:
        time.sleep(0.01)
    if comm.rank == 0 or not agreed:
        where = "" if agreed else f" (on rank {comm.rank}, others did not get there)"
        with contextlib.suppress(OSError):
            print(message + where, file=sys.stderr, flush=True)
    if not agreed:
        comm.Abort(code)


def _describe(error: BaseException) -> str:
    """An error that nobody foresaw, in a line: what it is, and the last line of Python that it came through."""
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"out of memory{f': {text}' if text else ''}"
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno}, in {frames[-1].name})" if frames else ""
    return f"{type(error).__name__}: {text}{where}"


class _Help(argparse.RawDescriptionHelpFormatter):
    """Paragraphs filled to the width of the terminal, and lines that begin with a space as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts: list[str] = []
        for line in text.splitlines():
            if parts and line and parts[-1] and not line.startswith(" ") and not parts[-1].startswith(" "):
                parts[-1] += f" {line}"
            else:
                parts.append(line)
        return "\n".join(
            textwrap.fill(
                part, width, subsequent_indent="      " if part.startswith(" ") else "", break_on_hyphens=False
            )
            for part in parts
        )


class _Parser(argparse.ArgumentParser):
    """One line on a wrong call, as for any other error; help with the options of this package."""

    def format_help(self) -> str:
        found = super().format_help()
        if self.prog.split()[-1] not in TAKES_PETSC:
            return found
        from petsc_fs.cli import manual

        return f"{found}\n{manual.text()}\n"

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


def _parser(command: list[str]) -> argparse.ArgumentParser:
    parser = _Parser(prog="petsc-fs", description=DESCRIPTION, formatter_class=_Help)
    parser.set_defaults(summary=None, close=None)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, summary: str, run: Any, **more: Any) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=summary, description=summary, formatter_class=_Help, **more)
        sub.set_defaults(run=run)
        return sub

    for name, (summary, module) in MODULES.items():
        sub = add(name, summary, None)
        if command == [name]:
            own = import_module(module)
            own.add_arguments(sub)
            sub.set_defaults(run=own.command)

    chosen = add("options", "print the options file of the smallest solver for a scene", _options)
    chosen.add_argument("scene", metavar="SCENE")

    lint = add("lint", "check an options file without solving", _lint, epilog=LINT_EPILOG)
    lint.add_argument("file", metavar="FILE", help="options file, or the name of a shipped one")
    lint.add_argument("scene", metavar="SCENE", nargs="?", help="scene it is for; default a bundled one that fits")

    convert = add(
        "convert",
        "turn a matrix into a scene, a scene into PETSc's binary format, or back",
        _convert,
        epilog=CONVERT_EPILOG,
    )
    convert.add_argument(
        "source", metavar="SOURCE", help="scene or sequence (.h5), folder in PETSc's format, or matrix"
    )
    convert.add_argument("target", metavar="TARGET", help="folder to write, or scene (.h5)")
    convert.add_argument("--step", type=int, metavar="K", help="of a sequence, write this step as a scene; from 0")
    convert.add_argument("--dimension", type=int, choices=(2, 3), help="of the rock, where nothing in SOURCE tells it")
    convert.add_argument("--rows", metavar="FIELD=ROWS,...", help="of a matrix: which rows belong to which field")
    convert.add_argument("--rhs", type=Path, metavar="FILE", help="of a matrix: the right-hand side")
    convert.add_argument(
        "--dofmap", type=Path, metavar="FILE", help="of a matrix: labels of the rows, as hypre has them"
    )
    convert.add_argument(
        "--order", choices=("cell", "component"), default="cell",
        help="of a matrix: vector fields list all components of a cell before the next cell, or the other way round",
    )  # fmt: skip
    convert.add_argument(
        "--fields", type=learn_aliases, metavar="NAME=FIELD,...", help="other names of fields there: u=momentum,p=mass"
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show versions of all that takes part")
    return parser


class _Version(argparse.Action):
    """Print the versions of all that takes part, and end. Collective."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        options.Given.of([]).start()
        print("\n".join(f"{name:12}{version}" for name, version in versions().items()))
        parser.exit()


def _options(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from mpi4py import MPI

    from petsc_fs.io import hdf5

    options.Given.of([]).start()
    with together(comm):
        path = find_scene(args.scene)
        choice = options.choose(options.Facts.of(hdf5.read(path), MPI.COMM_SELF))
    source = f"cut from {options.CANONICAL}" if choice.file is None else choice.file.name
    if comm.rank == 0:
        print(choice.text(f"The smallest solver for {path.name}: {source}"), end="")
    return 0


def _lint(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    from petsc_fs.cli import lint

    if comm.size > 1:
        raise UsageError("lint runs on one rank; start it without mpiexec")
    file = options.find_options_file(args.file)
    scenes = bundled()["scenes"] if args.scene is None else [find_scene(args.scene)]
    found = lint.lint(file, scenes)
    for line in found:
        print(line, file=sys.stderr)
    if not found:
        print(f"{file}: nothing to complain about")
    return UsageError.exit_code if found else 0


def _convert(args: argparse.Namespace, petsc: list[str], comm: MPI.Intracomm) -> int:
    if comm.size > 1:
        raise UsageError("convert runs on one rank; start it without mpiexec")
    options.Given.of([]).start()
    from petsc_fs.io import hdf5, matrices, petsc_binary, sequence

    source, target = Path(args.source), Path(args.target)
    if args.rows is None and (args.rhs or args.dofmap):
        raise UsageError("--rhs and --dofmap are about a matrix, which needs --rows FIELD=ROWS,... too")
    if args.rows is not None:
        if args.rhs is None or args.dimension is None:
            raise UsageError("--rows: a matrix needs --rhs FILE and --dimension 2 or 3 besides")
        more = {"dimension": args.dimension, "order": args.order, "dofmap": args.dofmap}
        written = matrices.to_scene(source, target, rhs=args.rhs, rows=args.rows, **more)
    elif source.is_dir() and args.step is None:
        written = petsc_binary.to_scene(source, target, dimension=args.dimension)
    elif args.step is None and target.suffix != ".h5":
        written = petsc_binary.from_scene(find_scene(args.source), target)
    else:
        if target.suffix != ".h5":
            raise UsageError(f"{target}: a step becomes a scene, whose name ends in .h5")
        path = find_scene(args.source)
        scene = hdf5.read(path) if args.step is None else sequence.read(path, args.step)
        written = [hdf5.write(scene, target)]
    print(f"written: {', '.join(str(p) for p in written)}")
    return 0
