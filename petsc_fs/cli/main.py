"""The command line: arguments, exit codes, and one line for whatever goes wrong, on all ranks together."""

from __future__ import annotations

import argparse
import contextlib
import io
import locale
import os
import sys
import time
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from petsc_fs import options
from petsc_fs.errors import PetscFsError, UsageError, together
from petsc_fs.io.bundled import bundled, find_scene

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
  mpiexec -n 2 petsc-fs solve model3.h5 -options_file contact_poromechanics.opts -ksp_monitor

Options with two dashes are this program's; those with one dash are PETSc's and are passed on."""

LINT_EPILOG = """\
The solver is set up on the scene but does not run. Found are: lines PETSc would stop at, options that
nothing asks for (with the closest valid names), prefixes that match no split, levels without an explicit
ksp_type or pc_type, and values that PETSc rejects. Exit code 2 if there is any of it."""

CONVERT_EPILOG = """\
The folder holds matrix.petsc (MatLoad), rhs.petsc and, if known, reference.petsc (VecLoad), one
fields/NAME.petsc per field (ISLoad: the rows and columns of the field), and scene.h5 with what PETSc's
format has no place for (cell data, material, units), without which the way back gives less and needs
--dimension."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code. Collective on all ranks of an MPI run."""
    from mpi4py import MPI

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


class _Parser(argparse.ArgumentParser):
    """One line on a wrong call, as for any other error."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


def _parser(command: list[str]) -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="petsc-fs", description=DESCRIPTION, formatter_class=raw)
    parser.set_defaults(summary=None, close=None)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, summary: str, run: Any, **more: Any) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=summary, description=summary, formatter_class=raw, **more)
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

    convert = add("convert", "turn a scene into PETSc's binary format, or back", _convert, epilog=CONVERT_EPILOG)
    convert.add_argument("source", metavar="SOURCE", help="scene or sequence (.h5), or folder in PETSc's format")
    convert.add_argument("target", metavar="TARGET", help="folder to write, or scene (.h5)")
    convert.add_argument("--step", type=int, metavar="K", help="of a sequence, write this step as a scene; from 0")
    convert.add_argument(
        "--dimension", type=int, choices=(2, 3), help="of the rock, where SOURCE is a folder without scene.h5"
    )
    return parser


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
