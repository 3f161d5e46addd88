"""Sparse blocks in compressed rows: from any form of a matrix, and what is done with them. numpy only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import LayoutError, SceneError

Floats = NDArray[np.float64]
Integers = NDArray[np.integer[Any]]

ALMOST_SINGULAR = 1e-14
"""Ratio of least to greatest singular value at which a small matrix counts as singular."""

SLAB = 1 << 20
"""Number of entries that are sorted at a time, which bounds the memory it takes."""

WINDOW, WINDOW_LEAST = 128, 12
"""Number of cells whose rows `by_component` looks at, and the least number of cells that say anything."""


class CSR(NamedTuple):
    """A sparse block in compressed rows; columns are numbered within the column field, globally."""

    indptr: Integers
    indices: Integers
    data: Floats


def increasing(block: CSR) -> bool:
    """Whether the columns of each row increase, without duplicates."""
    falls = block.indices[1:] <= block.indices[:-1]
    ends = block.indptr[1:-1]
    falls[ends[(ends > 0) & (ends < block.indices.size)] - 1] = False
    return not falls.any()


def csr_rows(block: CSR, start: int, stop: int) -> CSR:
    """Rows start:stop of a block."""
    a, b = block.indptr[start], block.indptr[stop]
    return CSR(block.indptr[start : stop + 1] - a, block.indices[a:b], block.data[a:b])


def diagonal_blocks(block: CSR, size: int) -> Floats:
    """The blocks on the diagonal of a square block, dense.

    Args:
        block: rows and columns numbered alike.
        size: of the diagonal blocks.

    Returns:
        (rows / size, size, size).
    """
    rows = np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))
    inside = rows // size == block.indices // size
    dense = np.zeros(((block.indptr.size - 1) // size, size, size))
    dense[rows[inside] // size, rows[inside] % size, block.indices[inside] % size] = block.data[inside]
    return dense


def singular(dense: Floats) -> NDArray[np.bool_]:
    """Which matrices of a stack (n, size, size) are singular to rounding, not finite ones included."""
    values = np.linalg.svd(dense, compute_uv=False)
    return np.asarray(~(values[:, -1] > ALMOST_SINGULAR * values[:, 0]))


def singular_diagonal_blocks(block: CSR, size: int) -> int:
    """Number of singular diagonal blocks of a square block, see `diagonal_blocks`."""
    return int(np.count_nonzero(singular(diagonal_blocks(block, size))))


def gather_rows(indptr: Integers, rows: Integers) -> tuple[Integers, Integers]:
    """Positions of all entries of the given rows, row by row, and the number of entries of each."""
    counts = indptr[rows + 1] - indptr[rows]
    offset = np.cumsum(counts) - counts
    return np.asarray(np.repeat(indptr[rows] - offset, counts) + np.arange(counts.sum())), counts


def by_component(rows: Callable[[int, int], CSR], size: int, block_size: int) -> bool:
    """Whether the pattern of a square block says that its unknowns are numbered component by component.

    A coupling of two cells has up to `block_size`² entries. Numbered as they are, unknowns share few couplings that are
    full; numbered otherwise, the same entries seem to be many couplings with little in each. Looks at some cells in the
    middle, and says yes only where the difference is clear.

    Args:
        rows: gives the rows start:stop of the block.
        size: number of rows.
        block_size: unknowns per cell.
    """
    cells = size // block_size
    if block_size == 1 or cells < WINDOW_LEAST:
        return False
    first = max(0, (cells - WINDOW) // 2)
    last = min(cells, first + WINDOW)

    def fill(ranges: list[tuple[int, int]], cell_of: Callable[[Integers], Integers]) -> float:
        """Share of the entries that the couplings of some rows could have."""
        pairs = []
        for start, stop in ranges:
            block = rows(start, stop)
            row = cell_of(np.repeat(np.arange(start, stop), np.diff(block.indptr)))
            pairs.append(row * cells + cell_of(block.indices.astype(np.int64)))
        entries = np.concatenate(pairs)
        return float(entries.size / (block_size**2 * max(1, np.unique(entries).size)))

    by_cell = fill([(first * block_size, last * block_size)], lambda i: i // block_size)
    otherwise = fill([(k * cells + first, k * cells + last) for k in range(block_size)], lambda i: i % cells)
    return bool(otherwise >= max(0.55, 1.4 * by_cell))


def compressed(matrix: Any) -> tuple[CSR, int | None]:
    """A matrix in any form as compressed rows, as they are, and its number of columns if it says it.

    Raises:
        LayoutError: it is no matrix.
        SceneError: its entries are no real numbers.
    """
    if hasattr(matrix, "tocsr"):
        matrix = matrix.tocsr()
    kind = getattr(matrix, "format", "csr")
    if kind != "csr" or not all(hasattr(matrix, name) for name in CSR._fields):
        dense = array_of(matrix) if kind == "csr" else np.empty(0)
        if dense.ndim != 2 or dense.dtype.kind not in "biufc":
            what = kind if kind != "csr" else type(matrix).__name__
            raise LayoutError(
                f"matrix: expected compressed rows (csr) or a dense array of two dimensions, found {what}"
            )
        rows, columns = np.nonzero(dense)
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(dense)))])
        return CSR(indptr, columns, real_numbers(dense[rows, columns], "matrix")), dense.shape[1]
    indptr, indices = (whole_numbers(getattr(matrix, name), f"matrix: {name}") for name in ("indptr", "indices"))
    block = CSR(indptr.astype(np.int64, copy=False), indices, real_numbers(matrix.data, "matrix"))
    return block, int(matrix.shape[-1]) if hasattr(matrix, "shape") else None


def with_ones(matrix: CSR, count: int) -> CSR:
    """A square matrix with further rows and columns, which have 1 on the diagonal and nothing else."""
    n = matrix.indptr.size - 1
    return CSR(
        np.append(matrix.indptr, matrix.indptr[-1] + np.arange(1, count + 1)),
        np.append(matrix.indices, np.arange(n, n + count)),
        np.append(matrix.data, np.ones(count)),
    )


def array_of(values: Any) -> NDArray[Any]:
    """As an array; an empty one of objects for lists of lists that have different lengths."""
    try:
        return np.asarray(values)
    except ValueError:
        return np.empty(0, dtype=object)


def real_numbers(values: Any, what: str) -> Floats:
    """Numbers as they are computed with.

    Raises:
        SceneError: they are complex, or no numbers.
    """
    array = array_of(values)
    if array.dtype.kind not in "biuf":
        found = "complex" if array.dtype.kind == "c" else "not made of numbers"
        raise SceneError(f"{what} is {found}; a scene is real")
    return array.astype(np.float64, copy=False)


def whole_numbers(values: Any, what: str) -> Integers:
    """Integers, also from numbers of another type that are whole.

    Raises:
        LayoutError: they are not.
    """
    array = array_of(values)
    if array.dtype.kind == "i" and array.dtype.isnative:
        return array
    if array.dtype.kind not in "iuf" or not (np.isfinite(array) & (array == np.floor(array))).all():
        raise LayoutError(f"{what} must be integers")
    return array.astype(np.int64)


def check_csr(block: CSR, rows: int, columns: int, what: str) -> None:
    """Refuse what is no block of so many rows and columns, whatever its values; columns may be in any order.

    Raises:
        LayoutError: it is none.
    """
    if block.indptr.dtype.kind not in "iu" or block.indices.dtype.kind not in "iu":
        raise LayoutError(f"{what}: indptr and indices must be integers")
    if block.indptr.shape != (rows + 1,):
        raise LayoutError(f"{what}: indptr has {block.indptr.size} entries, expected {rows + 1}")
    if block.indptr[0] != 0 or (block.indptr[1:] < block.indptr[:-1]).any():
        raise LayoutError(f"{what}: indptr must start at 0 and not decrease")
    if not block.indptr[-1] == block.indices.size == block.data.size:
        raise LayoutError(
            f"{what}: indptr ends at {block.indptr[-1]}, but there are {block.indices.size} indices and "
            f"{block.data.size} values"
        )
    if block.indices.size and not (0 <= block.indices.min() and block.indices.max() < columns):
        raise LayoutError(f"{what}: a column number is outside 0:{columns}")


def cut_rows(matrix: CSR, rows: Integers, owner: Integers, local: Integers, parts: int) -> list[CSR]:
    """Some rows of a matrix, cut by the owners of their columns, in pieces of about `SLAB` entries."""
    full = np.cumsum(matrix.indptr[rows + 1] - matrix.indptr[rows]) // SLAB
    found: list[list[CSR]] = [[] for _ in range(parts)]
    for piece in np.split(rows, np.flatnonzero(np.diff(full)) + 1):
        take: Any
        take, counts = gather_rows(matrix.indptr, piece)
        if take.size and (np.diff(piece) == 1).all():
            take = slice(take[0], take[-1] + 1)  # rows that follow each other: without a copy
        columns, data = matrix.indices[take], matrix.data[take]
        owners, starts = owner[columns], np.concatenate([[0], np.cumsum(counts)])
        for k, blocks in enumerate(found):
            mine = np.flatnonzero(owners == k)
            blocks.append(_in_order(CSR(np.searchsorted(mine, starts), local[columns[mine]], data[mine])))
    return [_stack(blocks) for blocks in found]


def _in_order(block: CSR) -> CSR:
    """The block with the columns of each row in order; entries of the same place are added."""
    if increasing(block):
        return block
    n = block.indptr.size - 1
    rows = np.repeat(np.arange(n), np.diff(block.indptr))
    place = rows * (int(block.indices.max()) + 1) + block.indices
    order = np.argsort(place, kind="stable")  # which is fast where most of it is in order, as here
    place, block = place[order], CSR(block.indptr, block.indices[order], block.data[order])
    again = place[1:] == place[:-1]
    if not again.any():
        return block
    first = np.flatnonzero(np.concatenate([[True], ~again]))
    data = np.add.reduceat(block.data, first)
    return CSR(np.searchsorted(rows[first], np.arange(n + 1)), block.indices[first], data)


def _stack(parts: list[CSR]) -> CSR:
    """Blocks below each other as one."""
    if len(parts) == 1:
        return parts[0]
    indptr = np.concatenate([[0], np.cumsum(np.concatenate([np.diff(part.indptr) for part in parts]))])
    return CSR(indptr, *(np.concatenate([part[k] for part in parts]) for k in (1, 2)))
