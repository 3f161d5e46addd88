"""Scene: one linear system with what its solver needs and nothing of the simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petsc_fs.csr import (
    CSR,
    Floats,
    Integers,
    array_of,
    by_component,
    check_csr,
    compressed,
    csr_rows,
    cut_rows,
    diagonal_blocks,
    gather_rows,
    increasing,
    real_numbers,
    singular_diagonal_blocks,
    whole_numbers,
    with_ones,
)
from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.fields import FIELD, FIELD_NAMES, in_order

__all__ = [
    "CONTACT_STATES", "CSR", "Floats", "Integers", "Material", "Metadata", "Scene", "check_order",
    "contact_state_counts", "csr_rows", "diagonal_blocks", "gather_rows", "singular_diagonal_blocks",
]  # fmt: skip

CONTACT_STATES = ("sticking", "sliding", "open")
"""Names of the values 0, 1, 2 of `Scene.contact_state`."""


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

    def __repr__(self) -> str:
        sizes = ", ".join(f"{f} {self.sizes[f]:,}" for f in self.fields)
        entries = sum(block.data.size for block in self.blocks.values())
        part = "" if self.rows is None else ", part of one rank"
        return f"<Scene {self.metadata.model!r}, {self.dimension}D: {sizes}; {entries:,} entries{part}>"

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

    @classmethod
    def from_matrix(
        cls,
        matrix: Any,
        rhs: Any,
        fields: Mapping[str, Any],
        *,
        dimension: int,
        columns: Mapping[str, Any] | None = None,
        order: str | Mapping[str, str] = "cell",
        **known: Any,
    ) -> Scene:
        """Cut one sparse matrix into the blocks of a scene.

        Args:
            matrix: (n, n), a sparse matrix of scipy, a dense array, or anything with `indptr`, `indices` and `data` of
                compressed rows. Columns of a row come in any order; entries of the same place are added.
            rhs: (n,) right-hand side, or (n, 1).
            fields: field name to the rows of its equations: numbers, a range, a slice or a mask. A number -1 stands for
                an unknown that was eliminated, a fixed displacement for example: it becomes an equation x = 0.
            dimension: of the rock matrix.
            columns: field name to the columns of its unknowns, where they differ from the rows.
            order: of the numbers of vector fields: "cell" for all components of a cell before the next cell, or
                "component" for the first component of all cells before the second; one word for all, or one for each
                field. A scene is numbered cell by cell: its rows are then `numbers.reshape(dimension, -1).T.ravel()`.
            known: further attributes of the scene, numbered as it is (`material`, `cell_centers`, `reference`, ...).

        Raises:
            LayoutError: a row or column belongs to no field or to two, or rows and columns of a field differ in number,
                or matrix and right-hand side do.
            SceneError: a number is complex or not finite; the order is another one than said; or see `compressed`.
            UsageError: there is no such order.
        """
        b = real_numbers(rhs.toarray() if hasattr(rhs, "toarray") else rhs, "rhs")
        if b.size == max(b.shape, default=0):
            b = b.ravel()
        n, (whole, width) = b.size, compressed(matrix)
        if b.ndim != 1 or whole.indptr.size != n + 1:
            raise LayoutError(f"matrix has {whole.indptr.size - 1} rows, rhs has shape {b.shape}")
        if width not in (None, n):
            raise LayoutError(f"matrix: has {n} rows and {width} columns, and must be square")
        check_csr(whole, n, n, "matrix")
        for unknown in (f for f in fields if f not in FIELD):
            raise LayoutError(f"unknown field {unknown!r}; fields are {', '.join(FIELD_NAMES)}")
        if columns is not None and set(columns) != set(fields):
            raise LayoutError(f"columns are given for {', '.join(columns)}; rows for {', '.join(fields)}")
        names = in_order(fields)
        orders = dict.fromkeys(names, order) if isinstance(order, str) else {f: order.get(f, "cell") for f in names}
        if not {*orders.values()} <= {"cell", "component"}:
            raise UsageError(f"order: expected cell or component, found {order!r}")

        def numbers(given: Mapping[str, Any], what: str) -> dict[str, Integers]:
            found = {f: _numbers(given[f], n, f"{f}: {what} numbers") for f in names}
            for f, ids in found.items():
                bs = FIELD[f].block_size(dimension)
                if bs > 1 and ids.size % bs:
                    raise LayoutError(
                        f"{f}: {ids.size} {what}s, which is not a multiple of block size {bs} in {dimension}D; if "
                        "fixed unknowns were eliminated, give -1 for their numbers, or keep them with 1 on the diagonal"
                    )
                if bs > 1 and orders[f] == "component":
                    found[f] = ids.reshape(bs, -1).T.ravel()
            return found

        row_ids = numbers(fields, "row")
        col_ids = row_ids if columns is None else numbers(columns, "column")
        for f in names:
            if row_ids[f].size != col_ids[f].size:
                raise LayoutError(f"{f}: {row_ids[f].size} rows but {col_ids[f].size} columns; they must pair up")
            absent = row_ids[f] == -1
            if (absent != (col_ids[f] == -1)).any():
                raise LayoutError(f"{f}: rows and columns must be -1 at the same places")
            if absent.any():
                for ids in (row_ids, col_ids):
                    ids[f] = ids[f].copy()
                    ids[f][absent] = np.arange(n, n + np.count_nonzero(absent))
                n += np.count_nonzero(absent)
        if n > b.size:
            whole, b = with_ones(whole, n - b.size), np.append(b, np.zeros(n - b.size))
        _inverse(row_ids, n, "row")
        target = _inverse(col_ids, n, "column")
        blocks = {
            (r, c): block
            for r in names
            for c, block in zip(names, cut_rows(whole, row_ids[r], *target, len(names)), strict=True)
            if block.data.size
        }
        sizes, parts = {f: ids.size for f, ids in row_ids.items()}, {f: b[ids] for f, ids in row_ids.items()}
        scene = cls(dimension=dimension, sizes=sizes, blocks=blocks, rhs=parts, **known)
        scene.validate()
        return scene

    def validate(self) -> None:
        """Check that all parts fit together and are finite.

        Local: looks at the rows held here and does not communicate.

        Raises:
            LayoutError: a length, block size or column number is wrong.
            SceneError: a number is not finite, or a value is outside its range, or a field of a whole scene is numbered
                component by component.
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
            if name not in self.rhs:
                raise LayoutError(f"{name}: rhs is missing")
            rows, cells = (stop - start,), (stop - start) // bs
            for what, shape in (
                ("rhs", rows),
                ("reference", rows),
                ("cell_centers", (cells, 3)),
                ("cell_volumes", (cells,)),
            ):
                if name in getattr(self, what):
                    _check_array(f"{name}: {what}", getattr(self, what)[name], shape)
        for what in ("rhs", "reference", "cell_centers", "cell_volumes"):
            for name in set(getattr(self, what)) - set(self.sizes):
                raise LayoutError(f"{what}: the scene has no field {name!r}")
        for rc, block in self.blocks.items():
            self._check_block(*rc, block)
        self._check_cell_data()

    def _check_block(self, r: str, c: str, block: CSR) -> None:
        what = f"block ({r}, {c})"
        for name in (r, c):
            if name not in self.sizes:
                raise LayoutError(f"{what}: the scene has no field {name!r}")
        start, stop = self.row_range(r)
        check_csr(block, stop - start, self.sizes[c], what)
        if not increasing(block):
            raise LayoutError(f"{what}: columns of a row must increase, without duplicates")
        if not np.isfinite(block.data).all():
            at = np.flatnonzero(~np.isfinite(block.data))[0]
            row = int(np.searchsorted(block.indptr, at, side="right")) - 1
            raise SceneError(f"{what}: row {start + row} has an entry that is not finite (NaN or Inf)")
        if r == c and self.rows is None:
            check_order(r, self.dimension, self.sizes[r], lambda start, stop: csr_rows(block, start, stop))

    def _check_cell_data(self) -> None:
        if self.contact_state is not None:
            start, stop = self.row_range("contact") if "contact" in self.sizes else (0, 0)
            _check_array("contact_state", self.contact_state, ((stop - start) // self.dimension,))
            if not np.isin(self.contact_state, range(len(CONTACT_STATES))).all():
                raise SceneError("contact_state: expected 0 (sticking), 1 (sliding) or 2 (open)")
        if "mass" not in self.sizes:
            return
        start, stop = self.row_range("mass")
        if self.cell_dimension is not None:
            _check_array("mass: cell_dimension", self.cell_dimension, (stop - start,))
            if ((self.cell_dimension < 0) | (self.cell_dimension > self.dimension)).any():
                raise SceneError(f"mass: cell_dimension must lie between 0 and {self.dimension}")
        if self.material is not None:
            for name, value in self.material.cell_data().items():
                values = np.asarray(value, dtype=np.float64)
                _check_array(f"material: {name}", values, (stop - start,) if values.ndim else ())
            if not (np.isfinite(self.material.time_step) and self.material.time_step > 0):
                raise SceneError(f"material: time_step must be positive, found {self.material.time_step}")

    def check_rows(self) -> None:
        """Check that each equation held here has an entry other than zero, and in a whole scene each unknown, too.

        Local: does not communicate.

        Raises:
            SceneError: one has none, so that the matrix is singular; field, cell and component are named.
        """
        found: dict[tuple[str, str], NDArray[np.bool_]] = {}
        for (r, c), block in self.blocks.items():
            full = block.data != 0
            every = bool(full.all())
            ends = block.indptr if every else np.concatenate([[0], np.cumsum(full)])[block.indptr]
            seen = [(("equation", r), ends[1:] > ends[:-1])]
            if self.rows is None and not np.all(found.get(("unknown", c), False)):
                used = np.zeros(self.sizes[c], dtype=bool)
                used[block.indices if every else block.indices[full]] = True
                seen.append((("unknown", c), used))
            for key, mask in seen:
                found[key] = found.get(key, False) | mask
        for name in self.fields:
            start, stop = self.row_range(name)
            for kind in ("equation", "unknown") if self.rows is None else ("equation",):
                empty = np.flatnonzero(~found.get((kind, name), np.zeros(stop - start, dtype=bool)))
                if empty.size:
                    cell, component = divmod(start + int(empty[0]), self.block_size(name))
                    which = f", component {'xyz'[component]}," if self.block_size(name) > 1 else ""
                    among = f" ({empty.size} such {kind}s)" if empty.size > 1 else ""
                    raise SceneError(
                        f"{name}: the {kind} of cell {cell}{which} has no entry or only zeros in the matrix{among}, "
                        "which is singular so; leave the cell out, or give it a row with 1 on the diagonal"
                    )

    def fixed_stress_coefficients(self) -> Floats | None:
        """What the fixed-stress diagonal is made of, for the mass rows held here (paper, eq:fixed_stress_coefs).

        With cell volume V, fluid density rho and time step dt, the diagonal for damping exponent t is
        `first * second ** t`, where

        - rock: first = l_min V rho / dt, second = l_mat / l_min, with l_mat = alpha^2 / (2 G / D + lambda)
          and l_min = alpha^2 / (4 G + 2 lambda);
        - fractures: first = l_frac V rho / dt, second = 1, with
          l_frac = [u]_n alpha^2 c_f / (lambda (1/M + phi c_f)), 1/M = (alpha - phi)(1 - alpha) / (lambda + 2 G / 3);
          and c_f / (1/M + phi c_f) = 1 / phi where neither rock nor fluid stores anything;
        - intersections: 0, as they do not touch the momentum balance.

        The paper has t = 1; its published code has t = 0.6.

        Local: does not communicate.

        Returns:
            (mass rows, 2), or None where the scene lacks material data, cell volumes or cell dimensions.

        Raises:
            SceneError: the coefficients are not finite.
        """
        m = self.material
        if m is None or "mass" not in self.cell_volumes or self.cell_dimension is None:
            return None
        rows = self.cell_dimension.size
        G, lame, alpha, phi, c_f, rho, jump = (
            np.broadcast_to(np.asarray(value, dtype=np.float64), rows) for value in m.cell_data().values()
        )
        scale = self.cell_volumes["mass"] * rho / m.time_step
        rock, fracture = self.cell_dimension == self.dimension, self.cell_dimension == self.dimension - 1
        with np.errstate(divide="ignore", invalid="ignore"):
            l_min = alpha**2 / (4 * G + 2 * lame)
            inverse_biot_modulus = (alpha - phi) * (1 - alpha) / (lame + 2 * G / 3)
            storage = inverse_biot_modulus + phi * c_f
            share = np.where(
                storage == 0, 1 / phi, c_f / storage
            )  # without any storage its limit for 1/M = 0, c_f -> 0
            l_frac = jump * alpha**2 * share / lame
            first = np.select([rock, fracture], [l_min * scale, l_frac * scale])
            second = np.where(rock, (4 * G + 2 * lame) / (2 * G / self.dimension + lame), 1.0)
        result = np.column_stack([first, second])
        if not np.isfinite(result).all():
            raise SceneError(
                "material: the fixed-stress coefficients are not finite (G, lambda and 1/M + phi c_f must not "
                "vanish); correct the material data, or leave it out and use -fs_type algebraic"
            )
        return result

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
        )

    def restrict(self, rows: Mapping[str, tuple[int, int]]) -> Scene:
        """The part of a whole scene that one rank holds; its arrays are views.

        Local: does not communicate.

        Args:
            rows: per field a half-open range of rows, whole cells.

        Raises:
            LayoutError: the scene is a part already, or `rows` lacks a field, goes beyond it or cuts through a cell.
        """
        if self.rows is not None:
            raise LayoutError("restrict: the scene is already the part of one rank")
        for name, size in self.sizes.items():
            if name not in rows or not 0 <= rows[name][0] <= rows[name][1] <= size:
                raise LayoutError(f"{name}: row range {rows.get(name)} is not inside 0:{size}")
        ranges = {f: (int(rows[f][0]), int(rows[f][1])) for f in self.sizes}

        def of_rows(values: Mapping[str, Floats]) -> dict[str, Floats]:
            return {f: v[slice(*ranges[f])] for f, v in values.items()}

        def of_cells(values: Any, name: str) -> Any:
            if np.ndim(values) == 0:  # also None
                return values
            return np.asarray(values)[slice(*(n // self.block_size(name) for n in ranges[name]))]

        material = self.material
        if material is not None:
            own = {k: of_cells(v, "mass") for k, v in material.cell_data().items()}
            material = Material(**own, time_step=material.time_step)
        part = replace(
            self,
            blocks={(r, c): csr_rows(block, *ranges[r]) for (r, c), block in self.blocks.items()},
            rhs=of_rows(self.rhs),
            reference=of_rows(self.reference),
            cell_centers={f: of_cells(v, f) for f, v in self.cell_centers.items()},
            cell_volumes={f: of_cells(v, f) for f, v in self.cell_volumes.items()},
            cell_dimension=of_cells(self.cell_dimension, "mass"),
            contact_state=of_cells(self.contact_state, "contact"),
            material=material,
            rows=ranges,
        )
        part.validate()
        return part


def contact_state_counts(states: Iterable[int]) -> dict[str, int]:
    """Number of fracture cells in each contact state."""
    counts = np.bincount(np.asarray(list(states), dtype=np.int64), minlength=len(CONTACT_STATES))
    return dict(zip(CONTACT_STATES, map(int, counts), strict=True))


def check_order(name: str, dimension: int, size: int, rows: Callable[[int, int], CSR]) -> None:
    """Refuse a field whose diagonal block is clearly numbered component by component, see `by_component`.

    Raises:
        LayoutError: it is.
    """
    if by_component(rows, size, FIELD[name].block_size(dimension)):
        raise LayoutError(
            f"{name}: the unknowns are numbered component by component (all of x, then all of y), expected all "
            'components of a cell before the next cell: as Scene.from_matrix(..., order="component") numbers them'
        )


def _numbers(spec: Any, n: int, what: str) -> Integers:
    """Index array from numbers, a range, a slice or a mask."""
    if isinstance(spec, slice):
        return np.arange(n)[spec]
    array = array_of(spec)
    if array.dtype.kind == "b":
        if array.shape != (n,):
            raise LayoutError(f"{what}: a mask has shape {array.shape}, expected {(n,)}")
        return np.flatnonzero(array)
    return whole_numbers(array, what).ravel()


def _check_array(what: str, values: NDArray[Any], shape: tuple[int, ...]) -> None:
    shape = tuple(map(int, shape))  # integers of numpy are printed otherwise
    if values.shape != shape:
        raise LayoutError(f"{what} has shape {values.shape}, expected {shape}")
    if not np.isfinite(values).all():
        raise SceneError(f"{what} {'has an entry that ' if shape else ''}is not finite (NaN or Inf)")


def _inverse(ids: Mapping[str, Integers], n: int, what: str) -> tuple[Integers, Integers]:
    """For each index the number of its field and its place there.

    Raises:
        LayoutError: an index is outside 0:n, or in no field, or in two.
    """
    owner = np.full(n, -1, dtype=np.int8)
    local: Integers = np.zeros(n, dtype=np.int32 if n < 2**31 else np.int64)
    for k, (name, index) in enumerate(ids.items()):
        if index.size and not (0 <= index.min() and index.max() < n):
            raise LayoutError(f"{name}: a {what} number is outside 0:{n}; they begin at 0")
        if (owner[index] >= 0).any() or np.unique(index).size != index.size:
            raise LayoutError(f"{name}: a {what} is listed twice or belongs to two fields")
        owner[index] = k
        local[index] = np.arange(index.size)
    missing = np.flatnonzero(owner < 0)
    if missing.size:
        raise LayoutError(f"{missing.size} {what}s belong to no field, the first is {missing[0]}")
    return owner, local
