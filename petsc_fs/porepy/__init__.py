"""PorePy models, and scenes from them: the only part of the package that imports porepy.

Importing this package does not import porepy; using a name of `models` or `adapter` does, and says
how to install PorePy where it is missing. `export`, `cases` and `solver` can be read without PorePy.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from petsc_fs.errors import UsageError

_HOME = {
    "Adapter": "adapter",
    "scene_from_model": "adapter",
    "FieldSplitSolver": "solver",
    "LinearSolve": "solver",
    "MODELS": "models",
    "make_model": "models",
    "run": "models",
    "ModelParameters": "cases",
    "export": "export",
}


class PorePyMissingError(UsageError, ImportError):
    """PorePy cannot be imported."""


def require_porepy() -> Any:
    """The module porepy.

    Raises:
        PorePyMissingError: it cannot; the message says how to install it.
    """
    try:
        return import_module("porepy")
    except ImportError as e:
        raise PorePyMissingError(
            f'PorePy is not installed ({e}); pip install "porepy @ git+https://github.com/pmgbergen/porepy@v1.11"'
        ) from e


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = import_module(f"{__name__}.{_HOME[name]}")
    return home if name == _HOME[name] else getattr(home, name)
