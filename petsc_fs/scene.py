"""Scene: one linear system with what its solver needs and nothing of the simulator."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.fields import FIELD, FIELD_NAMES, in_order
from petsc_fs.partition import rows_of

if TYPE_CHECKING:
    from petsc_fs.cutting import Cutter
    from petsc_fs.partition import Layout

Floats = NDArray[np.float64]
Integers = NDArray[np.integer[Any]]

ALMOST_SINGULAR = 1e-14
"""Ratio of least to greatest singular value at which a small matrix counts as singular."""

SLAB = 1 << 20
"""Number of entries that are sorted or renumbered at a time, which bounds the memory it takes."""

CONTACT_STATES = ("sticking", "sliding", "open")
"""Names of the values 0, 1, 2 of `Scene.contact_state`."""


class CSR(NamedTuple):
    """A sparse block in compressed rows; columns are numbered within the column field, globally."""

    indptr: Integers
    indices: Integers
    data: Floats


class Columns(NamedTuple):
    """For each column of a whole matrix the number of its field, and its number there."""

    owner: Integers
    local: Integers


@dataclass(kw_only=True)
class Material:
    """What the fixed-stress diagonals are made of, in the units of the scene.

    Each entry but `time_step` is a number, or an array with one value per mass cell.

    Attributes:
        shear_modulus: G.
        lame_lambda: first Lamé coefficient.
        biot_coefficient: alpha.
        porosity: phi.
        fluid_compressibility: c_f.
        fluid_density: rho_f.
        normal_jump: normal component of the displacement jump; used on fracture cells only.
        time_step: length of the time step.
    """

    shear_modulus: ArrayLike
    lame_lambda: ArrayLike
    biot_coefficient: ArrayLike
    porosity: ArrayLike
    fluid_compressibility: ArrayLike
    fluid_density: ArrayLike
    normal_jump: ArrayLike
    time_step: float

    def cell_data(self) -> dict[str, ArrayLike]:
        """Name and value of everything given per mass cell."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "time_step"}


@dataclass(kw_only=True)
class Metadata:
    """Where a scene comes from.

    Attributes:
        model: name of the model, with its parameters.
        time_step_index: number of the time step, from 1; -1 if unknown.
        newton_index: number of the Newton step in it, from 0; -1 if unknown.
        time: end of the time step, in the units of the scene; NaN if unknown.
        units: size of each base unit in SI, for example {"kg": 1e10} where mass counts in 1e10 kg.
        producers: name and version of each program that took part.
    """

    model: str = ""
    time_step_index: int = -1
    newton_index: int = -1
    time: float = float("nan")
    units: dict[str, float] = field(default_factory=dict)
    producers: dict[str, str] = field(default_factory=dict)


@dataclass(kw_only=True)
class Scene:
    """A Jacobian in blocks, its right-hand side, and what is known about them.

    A scene holds all rows, or, where `rows` says so, those of one rank; then the arrays per row
    and per cell cover these rows only, while `sizes` and column numbers stay global. The part of one
    rank is numbered, rows and columns, as the `petsc_fs.partition.Layout` that it was made for.

    Attributes:
        dimension: of the rock matrix, D = 2 or 3.
        sizes: global number of unknowns of each field present.
        blocks: (row field, column field) to block; what is missing is zero.
        rhs: right-hand side per field.
        reference: a solution known to be accurate, per field; empty if unknown.
        cell_centers: per field an array (cells, 3); fields without known centres are missing.
        cell_volumes: per field an array (cells,).
        cell_dimension: (mass cells,) dimension of the subdomain each pressure lives in.
        contact_state: (fracture cells,) 0 sticking, 1 sliding, 2 open.
        material: data of the fixed-stress diagonals, None if unknown.
        metadata: where the scene comes from.
        rows: per field the half-open range of rows held here; None if all.
        cells: per field the numbers in the whole scene of the cells held here; missing where they are
            the `rows`. Errors name rows and cells by these.
    """

    dimension: int
    sizes: dict[str, int]
    blocks: dict[tuple[str, str], CSR]
    rhs: dict[str, Floats]
    reference: dict[str, Floats] = field(default_factory=dict)
    cell_centers: dict[str, Floats] = field(default_factory=dict)
    cell_volumes: dict[str, Floats] = field(default_factory=dict)
    cell_dimension: Integers | None = None
    contact_state: Integers | None = None
    material: Material | None = None
    metadata: Metadata = field(default_factory=Metadata)
    rows: dict[str, tuple[int, int]] | None = None
    cells: dict[str, Integers] = field(default_factory=dict)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields present, in the order of the table."""
        return in_order(self.sizes)

    def block_size(self, name: str) -> int:
        """Unknowns per cell of a field."""
        return FIELD[name].block_size(self.dimension)

    def row_range(self, name: str) -> tuple[int, int]:
        """Half-open global range of the rows of a field that are held here."""
        return self.rows[name] if self.rows is not None else (0, self.sizes[name])

    def row_name(self, name: str, row: int) -> int:
        """Number in the whole scene of a row of a field, given its place among those held here."""
        bs = self.block_size(name)
        if name in self.cells:
            return int(self.cells[name][row // bs]) * bs + row % bs
        return self.row_range(name)[0] + row

    @classmethod
    def from_matrix(
        cls,
        matrix: Any,
        rhs: ArrayLike,
        fields: Mapping[str, Any],
        *,
        dimension: int,
        columns: Mapping[str, Any] | None = None,
        cutter: Cutter | None = None,
        **known: Any,
    ) -> Scene:
        """Cut one sparse matrix into the blocks of a scene.

        Args:
            matrix: (n, n) in compressed rows: anything with `indptr`, `indices` and `data`, such as
                a `scipy.sparse.csr_matrix`. Columns of a row come in any order.
            rhs: (n,) right-hand side.
            fields: field name to the rows of its equations, as an index array, range or slice.
                Vector fields list all components of a cell before the next cell.
            dimension: of the rock matrix.
            columns: field name to the columns of its unknowns, where they differ from the rows.
            cutter: remembers how a matrix was cut, which makes it faster for the next one of the same pattern.
            known: further attributes of the scene (`material`, `cell_centers`, `reference`, ...).

        Raises:
            LayoutError: a row or column belongs to no field or to two, or rows and columns of a
                field differ in number, or matrix and right-hand side do.
            SceneError: a number is complex or not finite.
        """
        if np.iscomplexobj(matrix.data) or np.iscomplexobj(rhs):
            raise SceneError("matrix or rhs is complex; a scene is real")
        b = np.asarray(rhs, dtype=np.float64)
        n = b.size
        if getattr(matrix, "format", "csr") != "csr":
            raise LayoutError(f"matrix: expected compressed rows (csr), found {matrix.format}")
        if b.ndim != 1 or np.size(matrix.indptr) != n + 1:
            raise LayoutError(f"matrix has {np.size(matrix.indptr) - 1} rows, rhs has shape {b.shape}")
        if np.size(matrix.indices) and not (0 <= np.min(matrix.indices) and np.max(matrix.indices) < n):
            raise LayoutError(f"matrix: a column number is outside 0:{n}")
        if columns is not None and set(columns) != set(fields):
            raise LayoutError(f"columns are given for {', '.join(columns)}; rows for {', '.join(fields)}")
        names = in_order(fields)
        for unknown in set(fields) - set(FIELD_NAMES):
            raise LayoutError(f"unknown field {unknown!r}; fields are {', '.join(FIELD_NAMES)}")
        row_ids = {f: _indices(fields[f], n) for f in names}
        whole = CSR(np.asarray(matrix.indptr, dtype=np.int64), np.asarray(matrix.indices), np.asarray(matrix.data))
        col_ids = {f: _indices(columns[f], n) for f in names} if columns is not None else row_ids
        for f in names:
            if row_ids[f].size != col_ids[f].size:
                raise LayoutError(f"{f}: {row_ids[f].size} rows but {col_ids[f].size} columns; they must pair up")
        _inverse(row_ids, n, "row")
        target = _inverse(col_ids, n, "column")

        blocks: dict[tuple[str, str], CSR] = {}
        for r in names:
            if cutter is not None:
                cut = cutter.cut(r, whole, row_ids[r], target, len(names))
            else:
                cut = cut_rows(whole, row_ids[r], target, len(names))
            blocks |= {(r, c): block for c, block in zip(names, cut, strict=True) if block.data.size}
        scene = cls(
            dimension=dimension,
            sizes={f: row_ids[f].size for f in names},
            blocks=blocks,
            rhs={f: b[row_ids[f]] for f in names},
            **known,
        )
        scene.validate(cutter.valid if cutter is not None else None)
        if cutter is not None:
            cutter.valid = {rc: (block.indptr, block.indices) for rc, block in blocks.items()}
        return scene

    def validate(self, valid: Mapping[tuple[str, str], tuple[Integers, Integers]] | None = None) -> None:
        """Check that all parts fit together and are finite.

        Local: looks at the rows held here and does not communicate.

        Args:
            valid: `indptr` and `indices` of blocks that have passed in a scene of the same sizes: where a block has
                these very arrays, only its values are looked at.

        Raises:
            LayoutError: a length, block size or column number is wrong.
            SceneError: a number is not finite, or a value is outside its range.
        """
        if self.dimension not in (2, 3):
            raise SceneError(f"dimension: expected 2 or 3, found {self.dimension}")
        if not self.sizes:
            raise SceneError(f"the scene has no field; fields are {', '.join(FIELD_NAMES)}")
        for name, size in self.sizes.items():
            if name not in FIELD:
                raise LayoutError(f"unknown field {name!r}; fields are {', '.join(FIELD_NAMES)}")
            bs = self.block_size(name)
            start, stop = self.row_range(name)
            if size % bs or start % bs or stop % bs:
                raise LayoutError(
                    f"{name}: {size} rows, range {start}:{stop}, is not a multiple of block size {bs} "
                    f"in {self.dimension}D"
                )
            if not 0 <= start <= stop <= size:
                raise LayoutError(f"{name}: row range {start}:{stop} is not inside 0:{size}")
            self._check_length(name, "rhs", self.rhs.get(name), stop - start)
            if name in self.reference:
                self._check_length(name, "reference", self.reference[name], stop - start)
            cells = (stop - start) // bs
            if name in self.cell_centers:
                self._check_length(name, "cell_centers", self.cell_centers[name], cells, 3)
            if name in self.cell_volumes:
                self._check_length(name, "cell_volumes", self.cell_volumes[name], cells)
        for what in ("rhs", "reference", "cell_centers", "cell_volumes"):
            for name in set(getattr(self, what)) - set(self.sizes):
                raise LayoutError(f"{what}: the scene has no field {name!r}")
        self._check_blocks(valid or {})
        self._check_cell_data()

    def _check_length(
        self, name: str, what: str, values: NDArray[Any] | None, length: int, width: int | None = None
    ) -> None:
        shape = (length,) if width is None else (length, width)
        if values is None:
            raise LayoutError(f"{name}: {what} is missing")
        if values.shape != shape:
            raise LayoutError(f"{name}: {what} has shape {values.shape}, expected {shape}")
        if not np.isfinite(values).all():
            raise SceneError(f"{name}: {what} has an entry that is not finite (NaN or Inf)")

    def _check_blocks(self, valid: Mapping[tuple[str, str], tuple[Integers, Integers]]) -> None:
        for (r, c), block in self.blocks.items():
            indptr, indices = valid.get((r, c), (None, None))
            if block.indptr is not indptr or block.indices is not indices:
                self._check_pattern(r, c, block)
            self._check_values(r, c, block)

    def _check_pattern(self, r: str, c: str, block: CSR) -> None:
        for name in (r, c):
            if name not in self.sizes:
                raise LayoutError(f"block ({r}, {c}): the scene has no field {name!r}")
        start, stop = self.row_range(r)
        if block.indptr.dtype.kind not in "iu" or block.indices.dtype.kind not in "iu":
            raise LayoutError(f"block ({r}, {c}): indptr and indices must be integers")
        if block.indptr.shape != (stop - start + 1,):
            raise LayoutError(f"block ({r}, {c}): indptr has {block.indptr.size} entries, expected {stop - start + 1}")
        if block.indptr[0] != 0 or (block.indptr[1:] < block.indptr[:-1]).any():
            raise LayoutError(f"block ({r}, {c}): indptr must start at 0 and not decrease")
        if not block.indptr[-1] == block.indices.size == block.data.size:
            raise LayoutError(
                f"block ({r}, {c}): indptr ends at {block.indptr[-1]}, but there are "
                f"{block.indices.size} indices and {block.data.size} values"
            )
        if block.indices.size and not (0 <= block.indices.min() and block.indices.max() < self.sizes[c]):
            raise LayoutError(f"block ({r}, {c}): a column number is outside 0:{self.sizes[c]}")
        if not increasing(block):
            raise LayoutError(f"block ({r}, {c}): columns of a row must increase, without duplicates")

    def _check_values(self, r: str, c: str, block: CSR) -> None:
        if not np.isfinite(block.data).all():
            at = np.flatnonzero(~np.isfinite(block.data))[0]
            row = int(np.searchsorted(block.indptr, at, side="right")) - 1
            raise SceneError(
                f"block ({r}, {c}): row {self.row_name(r, row)} has an entry that is not finite (NaN or Inf)"
            )

    def _check_cell_data(self) -> None:
        if self.contact_state is not None:
            start, stop = self.row_range("contact") if "contact" in self.sizes else (0, 0)
            cells = (stop - start) // self.dimension
            if self.contact_state.shape != (cells,):
                raise LayoutError(f"contact_state has shape {self.contact_state.shape}, expected {(cells,)}")
            if not np.isin(self.contact_state, range(len(CONTACT_STATES))).all():
                raise SceneError("contact_state: expected 0 (sticking), 1 (sliding) or 2 (open)")
        if "mass" not in self.sizes:
            return
        start, stop = self.row_range("mass")
        if self.cell_dimension is not None:
            self._check_length("mass", "cell_dimension", self.cell_dimension, stop - start)
            if ((self.cell_dimension < 0) | (self.cell_dimension > self.dimension)).any():
                raise SceneError(f"mass: cell_dimension must lie between 0 and {self.dimension}")
        if self.material is not None:
            for name, value in self.material.cell_data().items():
                values = np.asarray(value, dtype=np.float64)
                if values.ndim:
                    self._check_length("mass", name, values, stop - start)
                elif not np.isfinite(values):
                    raise SceneError(f"material: {name} is not finite")
            if not (np.isfinite(self.material.time_step) and self.material.time_step > 0):
                raise SceneError(f"material: time_step must be positive, found {self.material.time_step}")

    def only(self, fields: Iterable[str]) -> Scene:
        """The part of a scene with these fields, its rows and columns; the rest is forgotten."""
        names = in_order(f for f in fields if f in self.sizes)

        def part(values: dict[str, Any]) -> dict[str, Any]:
            return {f: values[f] for f in names if f in values}

        return replace(
            self,
            sizes=part(self.sizes),
            blocks={(r, c): b for (r, c), b in self.blocks.items() if r in names and c in names},
            rhs=part(self.rhs),
            reference=part(self.reference),
            cell_centers=part(self.cell_centers),
            cell_volumes=part(self.cell_volumes),
            cell_dimension=self.cell_dimension if "mass" in names else None,
            contact_state=self.contact_state if "contact" in names else None,
            material=self.material if "mass" in names else None,
            rows=None if self.rows is None else part(self.rows),
            cells=part(self.cells),
        )

    def restrict(self, where: Layout | Mapping[str, tuple[int, int]]) -> Scene:
        """The part of a whole scene that one rank holds, numbered as the layout.

        Local: does not communicate.

        Args:
            where: a layout, for its part on this rank; or per field a half-open range of rows, whole cells.

        Raises:
            LayoutError: the scene is a part already, or `where` lacks a field, is for another size or cuts
                through a cell.
        """
        if self.rows is not None:
            raise LayoutError("restrict: the scene is already the part of one rank")
        own, places = {}, {}
        rows = dict(where) if isinstance(where, Mapping) else {f: where.rows(f) for f in where.fields}
        for name, size in self.sizes.items():
            if name not in rows or not 0 <= rows[name][0] <= rows[name][1] <= size:
                raise LayoutError(f"{name}: row range {rows.get(name)} is not inside 0:{size}")
            if isinstance(where, Mapping):
                own[name] = np.arange(*(n // self.block_size(name) for n in rows[name]))
                continue
            if where.sizes(name)[1] != size:
                raise LayoutError(f"{name}: {size} rows in the scene, {where.sizes(name)[1]} in the layout")
            own[name] = where.own_cells(name)
            if name in where.cells:
                places[name] = where.places(name)
        own_rows = {f: rows_of(cells, self.block_size(f)) for f, cells in own.items()}

        def of_cells(values: Any, name: str) -> Any:
            return values[own[name]] if values is not None and name in own else None

        material = self.material if "mass" in self.sizes else None
        if material is not None:
            cut = {k: v if np.ndim(v) == 0 else np.asarray(v)[own["mass"]] for k, v in material.cell_data().items()}
            material = Material(**cut, time_step=material.time_step)
        part = Scene(
            dimension=self.dimension,
            sizes=dict(self.sizes),
            blocks={
                (r, c): _renumbered(_take_rows(b, own_rows[r]), places.get(c), self.block_size(c))
                for (r, c), b in self.blocks.items()
            },
            rhs={f: v[own_rows[f]] for f, v in self.rhs.items()},
            reference={f: v[own_rows[f]] for f, v in self.reference.items()},
            cell_centers={f: v[own[f]] for f, v in self.cell_centers.items()},
            cell_volumes={f: v[own[f]] for f, v in self.cell_volumes.items()},
            cell_dimension=of_cells(self.cell_dimension, "mass"),
            contact_state=of_cells(self.contact_state, "contact"),
            material=material,
            metadata=self.metadata,
            rows={f: (int(a), int(b)) for f, (a, b) in rows.items()},
            cells={f: own[f] for f in places},
        )
        part.validate()
        return part


def _take_rows(block: CSR, rows: Integers) -> CSR:
    """Some rows of a block, in the order given; without a copy if they follow each other."""
    if not rows.size or (np.diff(rows) == 1).all():
        return csr_rows(block, int(rows[0]), int(rows[-1]) + 1) if rows.size else csr_rows(block, 0, 0)
    take, counts = gather_rows(block.indptr, rows)
    return CSR(np.concatenate([[0], np.cumsum(counts)]), block.indices[take], block.data[take])


def _renumbered(block: CSR, places: Integers | None, block_size: int) -> CSR:
    """A block with other column numbers, see `renumber`; the same block where there are none."""
    if places is None:
        return block
    out = CSR(block.indptr, np.empty_like(block.indices), np.empty_like(block.data))
    renumber(block, places, block_size, out)
    return out


def increasing(block: CSR) -> bool:
    """Whether the columns of each row increase, without duplicates."""
    for a, b, start, stop in slabs(block.indptr, SLAB):
        columns = block.indices[start:stop]
        falls = columns[1:] <= columns[:-1]
        ends = block.indptr[a + 1 : b] - start  # rows may begin anywhere
        falls[ends[(ends > 0) & (ends < columns.size)] - 1] = False
        if falls.any():
            return False
    return True


def renumber(block: CSR, places: Integers, block_size: int, out: CSR) -> None:
    """Give columns other numbers and sort them again.

    Args:
        block: rows of a block.
        places: (cells of the columns,) the new number of each cell.
        block_size: unknowns per cell of the columns.
        out: of the same rows; may be `block` itself.
    """
    numbers = (places[:, None] * block_size + np.arange(block_size)).ravel()
    for a, b, start, stop in slabs(block.indptr, SLAB):
        columns = numbers[block.indices[start:stop]]
        rows = np.repeat(np.arange(b - a), np.diff(block.indptr[a : b + 1]))
        order = np.argsort(rows * (places.size * block_size) + columns, kind="stable")
        out.indices[start:stop], out.data[start:stop] = columns[order], block.data[start:stop][order]


def slabs(indptr: Integers, entries: int) -> Iterator[tuple[int, int, int, int]]:
    """Groups of whole rows with about so many entries each: first and last row, first and last entry (half-open)."""
    a, n = 0, indptr.size - 1
    while a < n:
        b = max(a + 1, int(np.searchsorted(indptr, int(indptr[a]) + entries, side="right")) - 1)
        yield a, b, int(indptr[a]), int(indptr[b])
        a = b


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


def _indices(spec: Any, n: int) -> Integers:
    """Index array from an array, range or slice."""
    if isinstance(spec, slice):
        return np.arange(*spec.indices(n))
    return np.asarray(spec, dtype=np.int64).ravel()


def _inverse(ids: Mapping[str, Integers], n: int, what: str) -> Columns:
    """For each index the number of its field and its place there.

    Raises:
        LayoutError: an index is outside 0:n, or in no field, or in two.
    """
    owner = np.full(n, -1, dtype=np.int8)
    local: Integers = np.zeros(n, dtype=np.int32 if n < 2**31 else np.int64)
    for k, (name, index) in enumerate(ids.items()):
        if index.size and not (0 <= index.min() and index.max() < n):
            raise LayoutError(f"{name}: a {what} number is outside 0:{n}")
        if (owner[index] >= 0).any() or np.unique(index).size != index.size:
            raise LayoutError(f"{name}: a {what} is listed twice or belongs to two fields")
        owner[index] = k
        local[index] = np.arange(index.size)
    missing = np.flatnonzero(owner < 0)
    if missing.size:
        raise LayoutError(f"{missing.size} {what}s belong to no field, the first is {missing[0]}")
    return Columns(owner, local)


def gather_rows(indptr: Integers, rows: Integers) -> tuple[Integers, Integers]:
    """Positions of all entries of the given rows, row by row, and the number of entries of each."""
    counts = np.diff(indptr)[rows]
    offset = np.cumsum(counts) - counts
    return np.asarray(np.repeat(indptr[rows] - offset, counts) + np.arange(counts.sum())), counts


def _sorted_rows(rows: Integers, cols: Integers, data: Floats, n: int) -> CSR:
    """Compressed rows with sorted columns from triplets whose rows do not decrease."""
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    place = rows.astype(np.int64) * (int(cols.max(initial=0)) + 1) + cols
    if (place[1:] < place[:-1]).any():
        order = np.argsort(place, kind="stable")  # which is fast where most of it is in order, as here
        cols, data = cols[order], data[order]
    return CSR(indptr, cols, data)


def cut_rows(matrix: CSR, rows: Integers, target: Columns, parts: int) -> list[CSR]:
    """Some rows of a matrix, cut by the owners of their columns, which are renumbered and sorted."""
    blocks: list[list[CSR]] = [[] for _ in range(parts)]
    for piece in _pieces(matrix.indptr, rows):
        take, counts = gather_rows(matrix.indptr, piece)
        cols, data = matrix.indices[take], matrix.data[take].astype(np.float64, copy=False)
        row_of = np.repeat(np.arange(piece.size), counts)
        owners = target.owner[cols]
        for k, block in enumerate(blocks):
            mine = owners == k
            block.append(_sorted_rows(row_of[mine], target.local[cols[mine]], data[mine], piece.size))
    return [_stack(block) for block in blocks]


def _pieces(indptr: Integers, rows: Integers) -> list[Integers]:
    """Rows in their order, cut where about `SLAB` entries are full."""
    full = np.cumsum(indptr[rows + 1] - indptr[rows]) // SLAB
    return list(np.split(rows, np.flatnonzero(np.diff(full)) + 1))


def _stack(parts: list[CSR]) -> CSR:
    """Blocks below each other as one; the list is emptied on the way, so that little is held twice."""
    if len(parts) == 1:
        return parts[0]
    ends = np.cumsum([part.data.size for part in parts])
    indptr = np.concatenate([parts[0].indptr, *(p.indptr[1:] + e for p, e in zip(parts[1:], ends, strict=False))])
    indices, data = np.empty(ends[-1], dtype=parts[0].indices.dtype), np.empty(ends[-1])
    for end in ends[::-1]:
        part = parts.pop()
        indices[end - part.data.size : end] = part.indices
        data[end - part.data.size : end] = part.data
    return CSR(indptr, indices, data)


def contact_state_counts(states: Iterable[int]) -> dict[str, int]:
    """Number of fracture cells in each contact state."""
    counts = np.bincount(np.asarray(list(states), dtype=np.int64), minlength=len(CONTACT_STATES))
    return dict(zip(CONTACT_STATES, counts.tolist(), strict=True))
