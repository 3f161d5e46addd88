"""The file format `petsc_fs sequence`, version 1: the linear systems of a whole run in one HDF5 file.

    /                     encoding-type "petsc_fs sequence", encoding-version 1, model;
                          complete: whether the run went to its end
    /steps/0, 1, 2, ...   one group per Newton step, each a whole scene in the format of `petsc_fs.io.hdf5`
    /steps/K/run          what the run did with the system, as attributes: its ranks and iterations, for example,
                          and forcing, the relative tolerance of that solve, if Newton was inexact

Arrays that are equal are stored once: every further one is a hard link to the first. So the pattern of a
block is there once, or once more each time it changes; the blocks of linear elasticity are there once for
the whole run; and any HDF5 tool can read a step, or copy it out as a scene (`h5copy -s /steps/3`).

A run writes to NAME.partial.h5, closed after each step, and gives it its name at the end. Of a run that is
interrupted that file stays, with the steps so far.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from petsc_fs.errors import SceneError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.scene import Scene, contact_state_counts

ENCODING = "petsc_fs sequence"
VERSION = 1

LIBRARY = "v110"
"""Oldest HDF5 that reads the files; before it, every small dataset costs two kilobytes."""

Rows = Callable[[int, dict[str, int]], Mapping[str, tuple[int, int]]]
Attributes = Mapping[str, int | float | str]


@dataclass(frozen=True, kw_only=True)
class Step:
    """What is known of one step without reading its arrays.

    Attributes:
        index: place in the sequence, from 0.
        time_step_index: see `petsc_fs.scene.Metadata`.
        newton_index: see there.
        time: see there.
        dimension: of the rock matrix.
        sizes: global number of unknowns of each field.
        entries: stored entries of the matrix.
        contact_states: number of fracture cells in each contact state; empty without contact.
        run: what the run did with the system, as given to `Writer.append`.
    """

    index: int
    time_step_index: int
    newton_index: int
    time: float
    dimension: int
    sizes: dict[str, int]
    entries: int
    contact_states: dict[str, int]
    run: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What is in a sequence.

    Attributes:
        model: name of the model, with its parameters.
        complete: whether the run that wrote it went to its end.
        steps: in order.
    """

    model: str
    complete: bool
    steps: tuple[Step, ...]


class Writer:
    """Writes a sequence step by step.

    After each step the file is closed, so that it is sound whatever happens to the run.

    Attributes:
        path: of the sequence once it is complete.
        partial: of the file until then; removed where nothing is in it.
        steps: number of steps written.
    """

    def __init__(self, path: str | os.PathLike[str], *, model: str = "", compression: str | None = "gzip") -> None:
        """Begin an empty sequence.

        Raises:
            UsageError: the file cannot be written.
        """
        self.path = Path(path)
        self.partial = self.path.with_name(f"{self.path.stem}.partial{self.path.suffix}")
        self.steps = 0
        self._create = hdf5.dataset_creator(compression)
        self._stored: dict[bytes, str] = {}
        if self.path.is_dir():
            raise UsageError(f"{self.path}: is a directory, not a file to write")
        with self._file("w") as file:
            file.attrs["encoding-type"] = ENCODING
            file.attrs["encoding-version"] = VERSION
            file.attrs["model"] = model
            file.attrs["complete"] = False
            file.create_group("steps")

    def append(self, scene: Scene, run: Attributes | None = None) -> None:
        """Write one more step.

        Args:
            scene: with all rows.
            run: what the run did with it: names and numbers or words.

        Raises:
            SceneError: the scene does not fit together, or is the part of one rank.
            UsageError: the file cannot be written; it is removed then.
        """
        scene.validate()
        if scene.rows is not None:
            raise SceneError(f"{self.path}: only whole scenes can be written, this is the part of one rank")
        with self._file("r+") as file:
            group = file.create_group(f"steps/{self.steps}")
            hdf5.write_group(group, scene, self._put)
            group.create_group("run").attrs.update(run or {})
        self.steps += 1

    def finish(self) -> Path:
        """Give the file its name; the sequence is complete.

        Raises:
            UsageError: there is no step, or the file cannot be written.
        """
        if not self.steps:
            self.discard()
            raise UsageError(f"{self.path}: not written, the run has no Newton step")
        with self._file("r+") as file:
            file.attrs["complete"] = True
        try:
            self.partial.replace(self.path)
        except OSError as e:
            raise UsageError(f"{self.path}: cannot be written: {e.strerror}; the steps are in {self.partial}") from e
        return self.path

    def abandon(self) -> Path | None:
        """Leave the sequence incomplete; path of the file that keeps the steps so far, if there are any."""
        if self.steps:
            return self.partial
        self.discard()
        return None

    def discard(self) -> None:
        """Remove the incomplete file."""
        self.partial.unlink(missing_ok=True)

    def _put(self, group: h5py.Group, name: str, array: Any) -> None:
        """Store an array, or link to the one that is equal to it."""
        digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        first = self._stored.setdefault(digest.digest(), f"{group.name}/{name}")
        if first == f"{group.name}/{name}":
            self._create(group, name, array)
        else:
            group[name] = group.file[first]

    @contextmanager
    def _file(self, mode: str) -> Iterator[h5py.File]:
        try:
            with h5py.File(self.partial, mode, libver=LIBRARY) as file:
                yield file
        except (OSError, RuntimeError, TypeError, ValueError) as e:
            self.discard()
            raise UsageError(f"{self.path}: cannot be written: {e}") from e


def is_sequence(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a sequence; False also for what cannot be read at all."""
    try:
        with hdf5.open_file(Path(path)) as file:
            return "encoding-type" in file.attrs and hdf5.attribute(file, "encoding-type", str) == ENCODING
    except SceneError:
        return False


def read_contents(path: str | os.PathLike[str]) -> Contents:
    """What is in a sequence, without reading any matrix.

    Raises:
        SceneError: the file is missing, no HDF5, no sequence or of another version.
    """
    with hdf5.open_file(Path(path)) as file:
        steps = tuple(_step(group, k) for k, group in enumerate(_groups(file)))
        return Contents(
            model=hdf5.attribute(file, "model", str), complete=bool(hdf5.attribute(file, "complete", int)), steps=steps
        )


def read(path: str | os.PathLike[str], step: int, rows: Rows | None = None) -> Scene:
    """Read one step of a sequence, or the rows of one rank.

    Local: each rank calls it for itself and opens the file for reading only.

    Args:
        path: of the file.
        step: from 0; negative ones count from the end.
        rows: see `petsc_fs.io.hdf5.read`.

    Raises:
        SceneError: there is no such step; and see `petsc_fs.io.hdf5.read`.
        LayoutError: see there.
    """
    with hdf5.open_file(Path(path)) as file, find_step(file, step) as group:
        return hdf5.read_group(group, rows)


@contextmanager
def find_step(file: h5py.File, step: int) -> Iterator[h5py.Group]:
    """Group of one step in an open sequence; what goes wrong in the block says which step it is.

    Raises:
        SceneError: there is no such step.
    """
    groups = _groups(file)
    if not -len(groups) <= step < len(groups):
        raise SceneError(f"there is no step {step}; steps are 0 to {len(groups) - 1}")
    try:
        yield groups[step]
    except SceneError as e:
        raise type(e)(f"step {step}: {e}") from e
    except KeyError as e:
        raise SceneError(f"step {step} is incomplete: {e.args[0]}") from e


def parse_steps(text: str, count: int) -> range:
    """Steps that a:b names, with b excluded and either left out, as Python's slices do; or one number.

    Raises:
        UsageError: it cannot be read, or names no step.
    """
    parts = text.split(":")
    try:
        ends = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        ends = []
    if len(ends) == 1 and ends[0] is not None:
        chosen = range(count)[ends[0] :][:1] if -count <= ends[0] < count else range(0)
    elif len(ends) == 2:
        chosen = range(count)[slice(*ends)]
    else:
        raise UsageError(f"steps: cannot read {text!r}; expected a:b, a:, :b or one number")
    if not chosen:
        raise UsageError(f"steps: {text} names none of the steps 0 to {count - 1}")
    return chosen


def _groups(file: h5py.File) -> list[h5py.Group]:
    hdf5.check_encoding(file, ENCODING)
    steps = file["steps"]
    if not len(steps):
        raise SceneError("the sequence has no steps")
    return [steps[str(k)] for k in range(len(steps))]


def _step(group: h5py.Group, index: int) -> Step:
    dimension, sizes = hdf5.read_header(group)
    meta = hdf5.read_metadata(group)
    states = hdf5.field_groups(group)["contact"].get("contact_state") if "contact" in sizes else None
    return Step(
        index=index,
        time_step_index=meta.time_step_index,
        newton_index=meta.newton_index,
        time=meta.time,
        dimension=dimension,
        sizes=sizes,
        entries=sum(block["data"].size for row in group["blocks"].values() for block in row.values()),
        contact_states={} if states is None else contact_state_counts(states[:]),
        run={k: v.item() if isinstance(v, np.generic) else v for k, v in group["run"].attrs.items()},
    )
