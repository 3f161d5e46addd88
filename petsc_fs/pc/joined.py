"""Fields of the same kind as one: fluxes between subdomains, and pressure with temperature, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import UsageError
from petsc_fs.nest import Blocks
from petsc_fs.pc.base import WrapperPC, text, told

GROUPS = "fluxes=intf_flow,intf_fourier,intf_enthalpy,well_flow,well_enthalpy:potentials=mass,energy"
"""Default of -joined_groups."""


class Joined(WrapperPC):
    """An inner PC on a MatNest in which groups of fields are one matrix each, with the unknowns of a cell together.

    ILU, multigrid for systems and Schur complements of type `selfp` work on one matrix, and the first two want to know
    the unknowns of a cell. Fields of a group that have as many cells on each rank are taken to have the same cells:
    the unknowns of a cell follow each other, and the block size is their number. Otherwise one field follows the other.

    The operator is a MatNest with a named diagonal block per field. Where all of its fields are in one group, the inner
    PC has the matrix of it.

    Options, with the prefix of this PC:
        -joined_groups <fluxes=intf_flow,intf_fourier,intf_enthalpy,well_flow,well_enthalpy:potentials=mass,energy>:
            names of groups and of the fields in each. A group of which one field alone is there has its name; fields
            in none come last.
        -joined_*: of the inner PC, whose fields are the groups.
    """

    prefix = "joined_"
    _order: NDArray[Any]
    _vectors: tuple[PETSc.Vec, ...] = ()

    def build(self, pc: PETSc.PC) -> PETSc.Mat:
        """The MatNest of the groups, or the matrix of the only one. Collective.

        Raises:
            UsageError: the operator is no MatNest, or the groups cannot be read.
        """
        operator, prefix = pc.getOperators()[1], pc.getOptionsPrefix() or ""
        if operator.getType() != "nest":
            raise UsageError("Joined needs a MatNest with a block per field; petsc_fs.nest.split makes one")
        names, blocks = nest.field_names(operator), nest.blocks_of(operator)
        groups = _groups(text(pc, "joined_groups", GROUPS), names)
        if groups is None:
            raise UsageError(f"-{prefix}joined_groups: expected NAME=FIELD,FIELD:NAME=FIELD,... of other fields each")
        sizes = [blocks[f, f].getSizes()[0][0] for f in names]
        start = dict(zip(names, np.cumsum([0, *sizes]), strict=False))
        places = {g: _places(blocks, members, pc.comm) for g, members in groups.items()}
        order = [np.concatenate([start[f] + np.arange(p.size) for f, p in of.items()]) for of, _ in places.values()]
        place = [np.concatenate([*of.values()]) for of, _ in places.values()]
        self._order = np.concatenate([part[np.argsort(at)] for part, at in zip(order, place, strict=True)])
        made = {
            (r, c): whole for r, c in product(groups, groups) if (whole := _one(blocks, places[r], places[c], pc.comm))
        }
        for name, members in groups.items():
            made[name, name].setName(name)
            if places[name][1] in (1, len(members)) and len(members) > 1:
                made[name, name].setAttr(nest.COMPONENTS, [(f, blocks[f, f].getSizes()[0]) for f in members])
        if len(groups) == 1:
            return made.popitem()[1]
        joined = nest.nest_of([*groups], made, pc.comm)
        for whole in made.values():
            whole.destroy()  # the nest holds it
        return joined

    @told
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = inner PC applied to x, both with the fields one after the other. Collective."""
        if not self._vectors:
            self._vectors = self.inners[0].getOperators()[1].createVecs()
        update, residual = self._vectors
        residual.setArray(x.getArray(readonly=True)[self._order])
        self.inners[0].apply(residual, update)
        found = np.empty(self._order.size)
        found[self._order] = update.getArray(readonly=True)
        y.setArray(found)

    def describe(self) -> str:
        """In one line."""
        return "inner PC on groups of fields as one matrix each"

    def release(self) -> None:
        """Free the matrix and vectors. Collective; may be called twice."""
        super().release()
        for vector in self._vectors:
            vector.destroy()
        self._vectors = ()


def _groups(words: str, names: Sequence[str]) -> dict[str, list[str]] | None:
    """Fields of each group, of those that are there; None if the words cannot be read."""
    groups: dict[str, list[str]] = {}
    for word in words.split(":"):
        name, _, fields = word.partition("=")
        if not (name and fields):
            return None
        if members := [f for f in names if f in fields.split(",")]:
            groups[name if len(members) > 1 else members[0]] = members
    known = [f for members in groups.values() for f in members]
    return groups | {f: [f] for f in names if f not in known} if len({*known}) == len(known) else None


Places = tuple[dict[str, NDArray[Any]], int]
"""Number of each local row of the fields of a group in the group, and the block size."""


def _places(blocks: Blocks, members: Sequence[str], comm: PETSc.Comm) -> Places:
    """Collective."""
    widths = [blocks[f, f].getBlockSize() for f in members]
    rows = [blocks[f, f].getSizes()[0][0] for f in members]
    cells = [n // width for n, width in zip(rows, widths, strict=True)]
    if comm.tompi4py().allreduce(len({*cells}) == 1, MPI.LAND):
        bs, first = sum(widths), np.cumsum([0, *widths])
        found = [
            (np.arange(n)[:, None] * bs + first[k] + np.arange(width)).ravel()
            for k, (n, width) in enumerate(zip(cells, widths, strict=True))
        ]
    else:
        bs, ends = 1, np.cumsum(rows)
        found = [np.arange(end - n, end) for n, end in zip(rows, ends, strict=True)]
    return dict(zip(members, found, strict=True)), bs


def _one(blocks: Blocks, rows: Places, columns: Places, comm: PETSc.Comm) -> PETSc.Mat | None:
    """The blocks of two groups as one matrix; None if there are none. Collective."""
    if not any(rc in blocks for rc in product(rows[0], columns[0])):
        return None
    if len(rows[0]) == len(columns[0]) == 1:
        block = blocks[next(iter(rows[0])), next(iter(columns[0]))]
        block.incRef()
        return block
    grid = [
        [blocks.get((r, c)) or nest.empty((blocks[r, r].getSizes()[0], blocks[c, c].getSizes()[1]), comm)
         for c in columns[0]] for r in rows[0]
    ]  # fmt: skip
    sets = []
    for places, _ in (rows, columns):
        first = comm.tompi4py().exscan(sum(p.size for p in places.values())) or 0
        sets.append([PETSc.IS().createGeneral((p + first).astype(PETSc.IntType), comm=comm) for p in places.values()])
    part = PETSc.Mat().createNest(grid, *sets, comm=comm)
    whole = part.convert("aij", PETSc.Mat())
    whole.setBlockSizes(rows[1], columns[1])
    part.destroy()
    return whole
