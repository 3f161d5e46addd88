"""The fixed-stress approximation of the Schur complement of mechanics: a diagonal on the mass block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.dm import Members, Problem, field_dm
from petsc_fs.errors import UsageError
from petsc_fs.fields import MECHANICS
from petsc_fs.pc.wrapper import WrapperPC, choice
from petsc_fs.scene import Integers, gather_rows

PUBLISHED_DAMPING = 0.6


class FixedStress(WrapperPC):
    """An inner PC on S^2, the operator with D_55 added to the diagonal of its mass block.

    The operator has the field `mass`, alone or beside others, as a MatNest or as one AIJ.

    Options, with the prefix of this PC:
        -fs_type analytic: D_55 from material data, see `petsc_fs.scene.Scene.fixed_stress_coefficients`
            (paper, eq:fixed_stress_coefs); the default where the scene has the data.
        -fs_type algebraic: D_55 from the matrix alone, for scenes without material data; needs the
            blocks of mechanics, see `algebraic_diagonal`.
        -fs_damping t: l_mat is damped to l_min (l_mat / l_min)^t; 1 is the paper's formula, the
            default 0.6 is what its published code uses. Only for analytic.
        -fs_pc_type, ...: the inner PC.
    """

    prefix = "fs_"
    kind = "analytic"
    damping = PUBLISHED_DAMPING

    def build(self, pc: PETSc.PC, problem: Problem, members: Members) -> tuple[PETSc.Mat, PETSc.DM]:
        """S^2 and the DM of this PC. Collective."""
        _, operator = pc.getOperators()
        names = [name for name, _ in members]
        if "mass" not in names:
            raise UsageError(f"FixedStress needs a field 'mass'; it was given {', '.join(names)}")
        prefix = pc.getOptionsPrefix() or ""
        coefficients = problem.fixed_stress
        kinds = ("algebraic", "analytic") if coefficients is None else ("analytic", "algebraic")
        self.kind = choice(pc, "fs_type", kinds)
        if self.kind == "algebraic":
            diagonal = algebraic_diagonal(problem)
        elif coefficients is not None:
            self.damping = PETSc.Options(prefix).getReal("fs_damping", PUBLISHED_DAMPING)
            diagonal = coefficients[:, 0] * coefficients[:, 1] ** self.damping
        else:
            raise UsageError(
                f"-{prefix}fs_type analytic: the scene lacks material data, cell volumes or cell dimensions; "
                f"use -{prefix}fs_type algebraic"
            )
        if operator.getType() == "nest":
            k = names.index("mass")
            rows = range(len(names))
            grid = [[operator.getNestSubMatrix(i, j) or None for j in rows] for i in rows]
            grid[k][k] = add_to_diagonal(grid[k][k], diagonal)
            return PETSc.Mat().createNest(grid, comm=problem.layout.comm), field_dm(problem, members)
        local = [problem.layout.sizes(f)[0] for _, fields in members for f in fields]
        padded = np.zeros(sum(local))
        padded[sum(local[: names.index("mass")]) :][: diagonal.size] = diagonal
        return add_to_diagonal(operator, padded), field_dm(problem, members)

    def describe(self) -> str:
        """The diagonal in one line."""
        damping = f", damping exponent {self.damping:g}" if self.kind == "analytic" else ""
        return f"{self.kind} fixed-stress diagonal on the mass block{damping}"


def add_to_diagonal(A: PETSc.Mat, diagonal: NDArray[np.float64]) -> PETSc.Mat:
    """A + diag as a new matrix; `diagonal` has the local rows."""
    S = A.duplicate(copy=True)
    S.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)  # the diagonal may be missing from the pattern
    vector = S.createVecLeft()
    vector.setArray(diagonal)
    S.setDiagonal(vector, addv=PETSc.InsertMode.ADD_VALUES)
    return S


def algebraic_diagonal(problem: Problem) -> NDArray[np.float64]:
    """Diagonal of -J_5m A^-1 J_m5 with A^-1 replaced by local solves, cell by cell.

    For the pressure of each cell the displacements it acts on are taken together, the mechanics
    matrix is restricted to them, and -j^T A_loc^-1 k is what that pressure receives: the fully
    algebraic stabilisation that the paper cites (Franceschini, Gazzola, Ferronato, 2022), used here
    for rock and fractures alike. Cells without displacement neighbours get 0.

    Collective. Costs one dense solve per cell.

    Returns:
        (mass rows on this rank,), not negative.
    """
    layout, blocks = problem.layout, problem.blocks
    mechanics = [f for f in layout.fields if f in MECHANICS]
    start, stop = layout.rows("mass")
    local_mass = np.arange(start, stop)
    needed = {}
    for f in mechanics:
        J = blocks.get(("mass", f))
        needed[f] = np.unique(J.getValuesCSR()[1]) if J else np.zeros(0, dtype=np.int64)
    A = _local_csr(problem, mechanics, mechanics, needed, needed)
    rows = _local_csr(problem, ["mass"], mechanics, {"mass": local_mass}, needed)
    columns = _local_csr(problem, mechanics, ["mass"], needed, {"mass": local_mass})
    columns_by_cell = _transpose(*columns, n=local_mass.size)
    place = np.full(sum(v.size for v in needed.values()), -1)
    result = np.zeros(local_mass.size)
    for k in range(local_mass.size):
        dofs, _, j = _rows(rows, np.array([k]))
        if not dofs.size:
            continue
        place[dofs] = np.arange(dofs.size)
        A_loc, right = np.zeros((dofs.size, dofs.size)), np.zeros(dofs.size)
        others, at, values = _rows(A, dofs)
        inside = place[others] >= 0
        A_loc[at[inside], place[others[inside]]] = values[inside]
        others, _, values = _rows(columns_by_cell, np.array([k]))
        inside = place[others] >= 0
        right[place[others[inside]]] = values[inside]
        place[dofs] = -1
        try:
            result[k] = -j @ np.linalg.solve(A_loc, right)
        except np.linalg.LinAlgError:
            result[k] = -j @ np.linalg.lstsq(A_loc, right, rcond=None)[0]
    return np.maximum(result, 0.0)


Triplet = tuple[Integers, Integers, NDArray[np.float64]]


def _local_csr(
    problem: Problem,
    rows: list[str],
    columns: list[str],
    row_ids: dict[str, Integers],
    column_ids: dict[str, Integers],
) -> Triplet:
    """Rows and columns with given global numbers, fetched to this rank, as one CSR in that order."""
    pieces: list[tuple[Integers, Integers, NDArray[np.float64]]] = []
    row_start = 0
    for r in rows:
        column_start = 0
        for c in columns:
            if (r, c) in problem.blocks:
                sets = [
                    PETSc.IS().createGeneral(ids.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
                    for ids in (row_ids[r], column_ids[c])
                ]
                (part,) = problem.blocks[r, c].createSubMatrices([sets[0]], [sets[1]])
                indptr, indices, values = part.getValuesCSR()
                row_of = np.repeat(np.arange(row_ids[r].size), np.diff(indptr))
                pieces.append((row_start + row_of, column_start + indices, values.copy()))
                part.destroy()
            column_start += column_ids[c].size
        row_start += row_ids[r].size
    if not pieces:
        return np.zeros(row_start + 1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
    i, j, v = (np.concatenate([p[k] for p in pieces]) for k in range(3))
    order = np.argsort(i, kind="stable")
    return np.concatenate([[0], np.cumsum(np.bincount(i, minlength=row_start))]), j[order], v[order]


def _transpose(indptr: Integers, indices: Integers, values: NDArray[np.float64], *, n: int) -> Triplet:
    order = np.argsort(indices, kind="stable")
    row_of = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
    return np.concatenate([[0], np.cumsum(np.bincount(indices, minlength=n))]), row_of[order], values[order]


def _rows(csr: Triplet, rows: Integers) -> Triplet:
    """Entries of some rows: their columns, the place of their row among `rows`, their values."""
    indptr, indices, values = csr
    take, counts = gather_rows(indptr, rows)
    return indices[take], np.repeat(np.arange(rows.size), counts), values[take]
