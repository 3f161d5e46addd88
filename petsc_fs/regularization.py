"""Regularisation: diagonal blocks that are nearly singular are lifted in the preconditioner, never in the matrix.

The true residual is that of the matrix as it was given, and so is the answer. What the preconditioner divides by, D_22,
J~_11 and diag(J_44), just does not blow up at a few cells; the Krylov method makes up for the difference, whose rank
is the number of singular values that were lifted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.diagnostics import DIVIDED_BY, Strengths, block_name, contact_state, transformed_contact_block
from petsc_fs.dm import Blocks, Members, Problem, field_nest
from petsc_fs.layout import Layout
from petsc_fs.scene import Scene


def lift(problem: Problem, members: Members, scene: Scene, least: float) -> tuple[PETSc.Mat, Blocks, list[str]]:
    """The matrix for the preconditioner: with the weak diagonal blocks of those fields lifted that are divided by.

    Collective.

    Args:
        problem: with the blocks of the Jacobian.
        members: fields as the Jacobian has them; those that are merged into one are left alone.
        scene: the rows of this rank, with what is known of cells.
        least: strength that each block is lifted to, relative to the median of its field.

    Returns:
        A MatNest, the blocks it is made of, of which the lifted ones are new matrices, and what was done, a line per
        field.
    """
    layout, blocks, lines = problem.layout, dict(problem.blocks), []
    alone = [names[0] for _, names in members if len(names) == 1]
    for name in DIVIDED_BY:
        if name in alone:
            delta, line = _deficit(Strengths.of(layout, blocks, name), layout, scene, name, least)
            if delta is not None:
                blocks[name, name] = _plus(blocks[name, name], delta)
                lines.append(line)
    transformed = transformed_contact_block(replace(problem, blocks=blocks)) if "contact" in alone else None
    if transformed is not None:
        weak = Strengths.of(layout, {("contact", "contact"): transformed}, "contact")
        transformed.destroy()
        delta, line = _deficit(weak, layout, scene, "contact", least)
        if delta is not None:
            blocks["contact", "contact"] = _plus(blocks["contact", "contact"], delta)
            lines.append(line)
    return field_nest(members, blocks, layout), blocks, lines


def _deficit(
    strengths: Strengths, layout: Layout, scene: Scene, name: str, least: float
) -> tuple[PETSc.Mat | None, str]:
    """What has to be added to a field's diagonal, and what that does in words; None if nothing has to. Collective.

    Of B = U S V^T the singular values below the wanted one are raised to it. The sign of each change, which the
    decomposition leaves open where B is singular, is the one that B's neighbours have in the mean.
    """
    comm = layout.comm
    usual_size = np.concatenate(comm.allgather(strengths.sizes))
    sizes = np.where(strengths.sizes > 0, strengths.sizes, np.median(usual_size) if usual_size.size else 0.0)
    wanted = least * strengths.usual * sizes
    U, values, V = np.linalg.svd(strengths.dense)
    mean = comm.allreduce((strengths.dense / np.where(sizes > 0, sizes, 1.0)[:, None, None]).sum(axis=0))
    signs = np.where(np.einsum("kij,il,kjl->kj", U, mean, V) < 0, -1.0, 1.0)
    missing = np.maximum(wanted[:, None] - values, 0.0)
    weak = np.flatnonzero(missing.any(axis=1))
    first = layout.rows(name)[0] // layout.block_size(name)
    found = [(first + int(k), float(strengths.ratios[k] / strengths.usual)) for k in weak]
    everywhere = [entry for part in comm.allgather(found) for entry in part]
    if not everywhere:
        return None, ""
    delta = np.einsum("kij,kj,kjl->kil", U[weak], (signs * missing)[weak], V[weak])
    words = []
    for cell, ratio in everywhere:
        state = contact_state(layout, scene, name, cell)
        words.append(f"cell {layout.scene_cell(name, cell)}" + (f" ({state})" if state else "") + f" from {ratio:.1e}")
    line = f"for the preconditioner only, {block_name(name)} was lifted to {least:.1e} of what is usual at "
    return _block_diagonal(delta, weak, layout, name), line + ", ".join(words)


def _block_diagonal(dense: NDArray[np.float64], cells: NDArray[np.intp], layout: Layout, name: str) -> PETSc.Mat:
    """AIJ with diagonal blocks at some cells of this rank. Collective."""
    bs, (n, _) = layout.block_size(name), layout.sizes(name)
    counts = np.zeros((n // bs, bs), dtype=PETSc.IntType)
    counts[cells] = bs
    indptr = np.concatenate([[0], np.cumsum(counts.ravel())]).astype(PETSc.IntType)
    columns = layout.rows(name)[0] + (cells * bs)[:, None, None] + np.zeros((bs, 1), dtype=np.int64) + np.arange(bs)
    csr = (indptr, columns.ravel().astype(PETSc.IntType), dense.ravel())
    return PETSc.Mat().createAIJ((layout.sizes(name), layout.sizes(name)), bsize=bs, csr=csr, comm=layout.comm)


def _plus(block: PETSc.Mat, delta: PETSc.Mat) -> PETSc.Mat:
    """Their sum as a new matrix; the second one is freed. Collective."""
    total = block.copy()
    total.axpy(1.0, delta, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    total.setBlockSizes(*block.getBlockSizes())
    delta.destroy()
    return total
