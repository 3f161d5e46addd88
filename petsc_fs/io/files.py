"""Files that appear under their name only once they are complete."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from petsc_fs.errors import SceneError, UsageError


@contextmanager
def complete(target: Path) -> Iterator[Path]:
    """A temporary path beside the target, which becomes the target at the end of the block.

    Local. If the block fails, nothing is left and an older file stays as it was. A link stays one, to the new file.

    Raises:
        UsageError: the file cannot be written, or is a directory or device.
    """
    try:
        target = target.resolve() if target.is_symlink() else target
        if target.exists() and not target.is_file():
            raise UsageError(f"{target}: cannot be written: is a directory or device, not a file")
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        os.close(handle)
    except (OSError, RuntimeError, ValueError) as e:
        raise UsageError(f"{target}: cannot be written: {getattr(e, 'strerror', None) or e}") from e
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


def check_regular(path: Path, what: str) -> None:
    """Refuse what cannot be read as a file, without opening it: a FIFO would never answer.

    Args:
        path: to read.
        what: it should be, for the message.

    Raises:
        SceneError: it is missing, out of reach, a directory, or a device, FIFO or socket.
    """
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as e:
        raise SceneError(f"{path}: no such file") from e
    except (OSError, ValueError) as e:
        raise SceneError(f"{path}: cannot be read: {getattr(e, 'strerror', None) or e}") from e
    if stat.S_ISDIR(mode):
        raise SceneError(f"{path}: is a directory, not a {what}")
    if not stat.S_ISREG(mode):
        raise SceneError(f"{path}: is a device, FIFO or socket, not a {what}")
