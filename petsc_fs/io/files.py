"""Files that appear under their name only once they are complete."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from petsc_fs.errors import UsageError


@contextmanager
def complete(target: Path) -> Iterator[Path]:
    """A temporary path beside the target, which becomes the target at the end of the block.

    Local. If the block fails, nothing is left and an older file stays as it was.

    Raises:
        UsageError: the file cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        os.close(handle)
    except OSError as e:
        raise UsageError(f"{target}: cannot be written: {e.strerror}") from e
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    except (OSError, RuntimeError, TypeError, ValueError) as e:
        raise UsageError(f"{target}: cannot be written: {e}") from e
    finally:
        temporary.unlink(missing_ok=True)


def write_text(target: Path, text: str) -> None:
    """Write a text file, see `complete`."""
    with complete(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
