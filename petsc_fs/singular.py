"""Singular systems: parts whose pressure nothing fixes, and pieces of rock that nothing holds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.fields import MECHANICS
from petsc_fs.system import FieldArrays, System

Labels = dict[str, NDArray[np.int64]]

NULL = 1e-12
"""Part of |A| |v| in an equation that rounding explains."""
GROUPS = (
    (("intf_flow", "well_flow", "mass"), ("mass",)),
    (("intf_fourier", "intf_enthalpy", "well_enthalpy", "energy"), ("energy",)),
    (MECHANICS, MECHANICS),
)
"""Fields whose blocks make up the parts, and those of them that a null vector is in."""
SCALARS = {"mass": "pressure", "energy": "temperature"}
MOST = 12
"""Parts that are looked at one by one; a system with more is called by the first of them."""


@dataclass
class NullVector:
    """A vector that the matrix maps to zero, equation by equation.

    Attributes:
        what: it stands for, in words.
        values: local rows of each field.
        is_left: whether the transposed matrix of the equilibrated system maps it, too, so that no residual can be less
            than the part of the right-hand side along it.
    """

    what: str
    values: FieldArrays
    is_left: bool


def null_vectors(system: System) -> list[NullVector]:
    """Constant pressures and temperatures, and rigid motions, of connected parts that no equation notices. Collective.

    The parts are those of the pattern of the blocks of `GROUPS`; couplings between these, as by contact, count when the
    whole matrix is applied.
    """
    found = []
    fields = system.layout.fields
    for group, kinds in GROUPS:
        there = tuple(f for f in fields if f in group)
        if not any(f in kinds for f in there):
            continue
        labels, sizes = components(system, there)
        own = [f for f in there if f in kinds]
        for what, vectors in modes(system, own):
            unheld = _unheld(system, own, vectors, labels, sizes.size)
            for part in np.flatnonzero(unheld & (sizes > 0))[:MOST]:
                cut = {f: np.where(_rows(system, f, labels[f]) == part, vectors[f], 0.0) for f in own}
                whole = {f: cut.get(f, np.zeros(system.layout.sizes(f)[0])) for f in fields}
                if _maps_to_zero(system, whole):
                    name = f"{what}{_place(system, own, labels, int(part), sizes)}"
                    found.append(NullVector(name, whole, _maps_to_zero(system, whole, transposed=True)))
    return found


def components(system: System, fields: Sequence[str]) -> tuple[Labels, NDArray[np.int64]]:
    """Connected parts of the cells of some fields: per field the part of each local cell, and the cells of each part.

    Collective; rank 0 computes.
    """
    layout, comm = system.layout, system.layout.comm
    counts = {f: layout.sizes(f)[1] // layout.block_size(f) for f in fields}
    first = dict(zip(fields, np.cumsum([0, *counts.values()])[:-1], strict=True))
    edges = []
    for r in fields:
        for c in fields:
            if (r, c) not in system.blocks:
                continue
            A = system.blocks[r, c]
            indptr, indices, values = A.getValuesCSR()
            rows = np.repeat(np.arange(indptr.size - 1) + A.getOwnershipRange()[0], np.diff(indptr))
            pairs = np.column_stack(
                [first[r] + rows // layout.block_size(r), first[c] + indices // layout.block_size(c)]
            )
            edges.append(np.unique(pairs[values != 0], axis=0))
    gathered = comm.gather(np.concatenate(edges) if edges else np.zeros((0, 2), dtype=np.int64))
    label: NDArray[np.int64] | None = None
    if gathered is not None:
        label = np.arange(sum(counts.values()))
        a, b = np.concatenate(gathered).T
        while True:  # every cell takes the least label of its neighbours, and then that cell's
            least: NDArray[np.int64] = label.copy()
            np.minimum.at(least, a, label[b])
            np.minimum.at(least, b, label[a])
            least = least[least]
            if np.array_equal(least, label):
                break
            label = least
        label = np.unique(label, return_inverse=True)[1].ravel()
    label = comm.bcast(label)
    assert label is not None
    own = {}
    for f in fields:
        start, stop = (n // layout.block_size(f) for n in layout.rows(f))
        own[f] = label[first[f] + start : first[f] + stop]
    return own, np.bincount(label)


def modes(system: System, fields: Sequence[str]) -> Iterator[tuple[str, FieldArrays]]:
    """Constant pressure or temperature; or translations, and rotations where coordinates are known. Local."""
    layout = system.layout
    if fields[0] in SCALARS:
        yield SCALARS[fields[0]], {f: np.ones(layout.sizes(f)[0]) for f in fields}
        return
    D = layout.dimension
    for k in range(D):
        yield f"displacement along {'xyz'[k]}", {f: np.tile(np.eye(D)[k], layout.sizes(f)[0] // D) for f in fields}
    places = {f: system.blocks[f, f].query("coordinates") for f in fields}
    if not all(places.values()):
        return
    for i in range(D):
        for j in range(i + 1, D):
            turned = {}
            for f in fields:
                x = places[f].getArray().reshape(-1, D)
                turned[f] = np.zeros_like(x)
                turned[f][:, i], turned[f][:, j] = -x[:, j], x[:, i]
            yield f"rotation in the {'xyz'[i]}{'xyz'[j]} plane", {f: v.ravel() for f, v in turned.items()}


def _rows(system: System, f: str, labels: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.repeat(labels, system.layout.block_size(f))


def _unheld(
    system: System, fields: Sequence[str], vectors: FieldArrays, labels: Labels, parts: int
) -> NDArray[np.bool_]:
    """Parts none of whose own equations notices a vector. Collective."""
    held = np.zeros(parts, dtype=np.int64)
    for r in fields:
        product, size = (np.zeros(system.layout.sizes(r)[0]) for _ in range(2))
        for c in fields:
            if (r, c) in system.blocks:
                product += nest.multiply(system.blocks[r, c], vectors[c])
                size += nest.multiply_absolute(system.blocks[r, c], vectors[c])
        noticed = np.abs(product) > NULL * size
        held += np.bincount(_rows(system, r, labels[r])[noticed], minlength=parts)
    system.layout.comm.Allreduce(MPI.IN_PLACE, held, op=MPI.SUM)
    return np.asarray(held == 0)


def _maps_to_zero(system: System, v: FieldArrays, *, transposed: bool = False) -> bool:
    """Whether every equation maps a vector to zero, or every unknown of the transposed matrix. Collective."""
    product = {f: np.zeros(n.size) for f, n in v.items()}
    size = {f: np.zeros(n.size) for f, n in v.items()}
    used = system.layout.comm.allreduce({f for f in v if v[f].any()}, lambda a, b: a | b)
    for (r, c), block in system.blocks.items():
        source, target = (r, c) if transposed else (c, r)
        if source in used:
            A = block.copy().transpose() if transposed else block
            product[target] += nest.multiply(A, v[source])
            size[target] += nest.multiply_absolute(A, v[source])
    noticed = any((np.abs(product[f]) > NULL * size[f]).any() for f in v)
    return not system.layout.comm.allreduce(noticed, MPI.LOR)


def _place(system: System, fields: Sequence[str], labels: Labels, part: int, sizes: NDArray[np.int64]) -> str:
    """Where a part is: "" if it is all there is. Collective."""
    if np.count_nonzero(sizes) == 1:
        return ""
    f = fields[-1]
    mine = np.flatnonzero(labels[f] == part)
    start = system.layout.rows(f)[0] // system.layout.block_size(f)
    first = system.layout.comm.allreduce(int(mine[0]) + start if mine.size else np.iinfo(np.int64).max, MPI.MIN)
    if first >= system.layout.sizes(f)[1]:
        return ""
    return f" of the {int(sizes[part])} connected cells around cell {system.layout.scene_cell(f, first)} of {f}"


def attach(system: System, A: PETSc.Mat, vectors: Sequence[NullVector]) -> None:
    """Have Krylov methods leave the null vectors alone. Collective."""
    right = _null_space(system, vectors)
    A.setNullSpace(right)
    A.setTransposeNullSpace(_null_space(system, [v for v in vectors if v.is_left]))


def _null_space(system: System, vectors: Sequence[NullVector]) -> PETSc.NullSpace:
    basis: list[PETSc.Vec] = []
    for vector in vectors:
        v = system.b.duplicate()
        v.setArray(np.concatenate([vector.values[f] for f in system.layout.fields]))
        for other in basis:
            v.axpy(-v.dot(other), other)
        v.normalize()
        basis.append(v)
    return PETSc.NullSpace().create(vectors=basis, comm=system.layout.comm)


def describe(system: System, vectors: Sequence[NullVector]) -> str:
    """One line: what is not determined, and the least residual that any solution has. Collective."""
    left = [v for v in vectors if v.is_left]
    text = "singular: nothing determines the " + "; the ".join(v.what for v in vectors)
    if left:
        space = _null_space(system, left)
        rest = system.b.copy()
        space.remove(rest)
        rest.aypx(-1.0, system.b)
        part = rest.norm() / (system.b.norm() or 1.0)
        if part > NULL:
            text += (
                f". The right-hand side has a part of {part:.1e} of it that no solution can balance: fix the pressure "
                "or hold the rock somewhere, or take that part out"
            )
    return text
