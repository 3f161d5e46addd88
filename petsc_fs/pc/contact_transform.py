"""The transformation that makes the contact block invertible, and the exact first Schur complement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from petsc4py import PETSc

from petsc_fs.diagnostics import REMEDY
from petsc_fs.dm import Blocks, Members, Problem, field_dm, field_nest, merge_mechanics
from petsc_fs.errors import LayoutError, SceneError, UsageError, together
from petsc_fs.fields import MECHANICS, in_order
from petsc_fs.pc.wrapper import WrapperPC, choice
from petsc_fs.scene import CONTACT_STATES, CSR, diagonal_blocks, singular

FEW_ROWS = 5000
"""Rows of mechanics per rank up to which blocks of several fields are copied: for a `ComponentSweep` that of mechanics,
and for any solver those above the diagonal."""


class ContactTransform(WrapperPC):
    """Right (or left) transformation of the Jacobian, and an inner PC on the transformed matrix.

    The contact block J_11 is singular where a fracture sticks. With D_22 the block diagonal of J_22,

    - right: T = -D_22^-1 J_21, Q_r = I + T in block (2,1), J~ = J Q_r, solution x = Q_r x~;
    - left: L = -J_12 D_22^-1, Q_l = I + L in block (1,2), J~ = Q_l J, residual r~ = Q_l r,

    has J~_11 = J_11 - J_12 D_22^-1 J_21, block-diagonal and invertible (paper, eq:Qright and
    eq:J_tilde). With side none, for a J_11 that is invertible as it is, J~ = J.

    The inner PC is set up on a MatNest with the contact column and row of J~ and, in place of the
    other blocks, S^1 = J_ij - J~_i1 J~_11^-1 J~_1j (eq:S^1). All products are as small as the
    fractures; other blocks of J are passed on by reference. `intf_force` and `momentum` become one
    field `mechanics`: one matrix that keeps the block size for multigrid, and the only copy that is
    made of the large block of `momentum`.

    Options, with the prefix of this PC:
        -qr_side right|left|none: the transformation.
        -qr_mechanics_mat_type aij|hypre|nest: storage of the block of mechanics; hypre, the default where the
            options give that field a PCHYPRE, saves PCHYPRE its own copy; nest, the default where they give
            it a `ComponentSweep` and the ranks have more than `FEW_ROWS` rows each, makes no copy at all.
        -qr_pc_type, ...: the inner PC, whose fields are contact, mechanics, intf_flow, mass.

    The operator must be a MatNest over the five fields, or those of them that a scene has.
    """

    prefix = "qr_"
    side = "right"

    def build(self, pc: PETSc.PC, problem: Problem, members: Members) -> tuple[PETSc.Mat, PETSc.DM]:
        """Nest of J~ and S^1, and its DM. Collective."""
        _, nest = pc.getOperators()
        names = [name for name, _ in members]
        if nest.getType() != "nest":
            raise UsageError("ContactTransform needs the blocks of a MatNest: leave out -petsc_fs_mat_type aij")
        for needed in ("contact", "intf_force"):
            if needed not in names:
                raise UsageError(f"ContactTransform needs a field {needed!r}; this scene has {', '.join(names)}")
        self.side = choice(pc, "qr_side", ("right", "left", "none"))
        blocks = {
            (r, c): nest.getNestSubMatrix(i, j)
            for i, r in enumerate(names)
            for j, c in enumerate(names)
            if nest.getNestSubMatrix(i, j)
        }
        if not {("intf_force", "contact"), ("contact", "intf_force")} <= set(blocks):
            self.side = "none"  # J~_11 = J_11, as with all cells open
        eliminated = self._eliminate(blocks, problem)
        inner_members = merge_mechanics(names)
        inner_problem = replace(problem, blocks=eliminated)
        few = _few_rows(problem)
        mat_type = choice(pc, "qr_mechanics_mat_type", _storages(pc, copied=few))
        matrix = field_nest(inner_members, eliminated, problem.layout, mat_type, assembled=few)
        return matrix, field_dm(inner_problem, inner_members)

    def _eliminate(self, J: Blocks, problem: Problem) -> Blocks:
        """Blocks of J~ in the row and column of contact, of S^1 elsewhere."""
        S = dict(J)
        others = in_order(name for pair in J for name in pair)  # the same order on all ranks
        changed = {}
        if self.side != "none":
            D_inverse = block_diagonal_inverse(J["intf_force", "intf_force"], "D_22, block of intf_force", problem)
        if self.side == "right":
            self._transform = D_inverse.matMult(J["intf_force", "contact"])
            changed = {(r, "contact"): (J[r, "intf_force"], self._transform) for r in others if (r, "intf_force") in J}
        elif self.side == "left":
            self._transform = J["contact", "intf_force"].matMult(D_inverse)
            changed = {("contact", c): (self._transform, J["intf_force", c]) for c in others if ("intf_force", c) in J}
        if changed:
            self._transform.scale(-1)
            self._source, self._target = self._transform.createVecs()
        for pair, (left, right) in changed.items():
            S[pair] = add_product(J.get(pair), left, right)
        lifted = self.side != "none"  # -petsc_fs_regularize leaves J_11 itself alone
        C_inverse = block_diagonal_inverse(S["contact", "contact"], "J~_11, block of contact", problem, lifted=lifted)
        rows = [r for r in others if r != "contact" and (r, "contact") in S]
        columns = [c for c in others if c != "contact" and ("contact", c) in S]
        for c in columns:
            W = C_inverse.matMult(S["contact", c])
            W.scale(-1)
            for r in rows:
                S[r, c] = add_product(J.get((r, c)), S[r, "contact"], W)
        return S

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = Q_r P^-1 x (right) or P^-1 Q_l x (left). Collective."""
        if self.side == "right":
            super().apply(pc, x, y)
            self._add_transformed(y)
        elif self.side == "none":
            super().apply(pc, x, y)
        else:
            work = x.copy()
            self._add_transformed(work)
            super().apply(pc, work, y)
            work.destroy()

    def _add_transformed(self, v: PETSc.Vec) -> None:
        """v_2 += T v_1 (right) or v_1 += L v_2 (left), in place. Collective.

        The two fields are the first ones of v on each rank. VecGetSubVector would ask all ranks whether they are.
        """
        values = v.getArray()
        sizes = self._source.getLocalSize(), self._target.getLocalSize()
        places = (slice(0, sizes[0]), slice(sizes[0], sum(sizes)))
        if self.side == "left":
            places = (slice(sizes[1], sum(sizes)), slice(0, sizes[1]))
        self._source.placeArray(values[places[0]])
        self._target.placeArray(values[places[1]])
        self._transform.multAdd(self._source, self._target, self._target)
        self._source.resetArray()
        self._target.resetArray()

    def describe(self) -> str:
        """The transformation in one line."""
        where = {"right": "J Q_r", "left": "Q_l J", "none": "J"}[self.side]
        return f"inner PC on {where} with the exact Schur complement of contact"


def _few_rows(problem: Problem) -> bool:
    """Whether mechanics is so small that messages cost more than copies of blocks. Local, the same on all ranks."""
    layout = problem.layout
    return sum(layout.sizes(f)[1] for f in layout.fields if f in MECHANICS) <= FEW_ROWS * layout.comm.size


def _storages(pc: PETSc.PC, *, copied: bool) -> tuple[str, ...]:
    """Storages for the block of mechanics, the best for the inner solver first. Local.

    Others than AIJ serve where the inner solver only ever hands the block to a PC that knows them. Schur
    complements that PETSc assembles multiply matrices, which it can in AIJ only. A `ComponentSweep` takes its parts out
    of one AIJ by a third of the messages that the blocks of a MatNest take, and `copied` says that this decides.
    """
    prefix = (pc.getOptionsPrefix() or "") + ContactTransform.prefix
    leaf = "fieldsplit_mechanics_"
    chosen = {k: str(v) for k, v in PETSc.Options().getAll().items() if k.startswith(prefix)}
    levels = [k.removesuffix(f"{leaf}pc_type") for k in chosen if k.endswith(f"{leaf}pc_type")]
    assembling = {chosen.get(level + "pc_fieldsplit_schur_precondition") for level in levels} & {"selfp", "full"}
    kinds = {chosen[f"{level}{leaf}pc_type"] for level in levels}
    best = "aij"
    if not assembling and kinds == {"hypre"} and PETSc.Sys.hasExternalPackage("hypre"):
        best = "hypre"
    elif not assembling and kinds == {"python"}:
        types = {chosen.get(f"{level}{leaf}pc_python_type") for level in levels}
        best = "nest" if types == {"petsc_fs.pc.ComponentSweep"} and not copied else "aij"
    return (best, *(kind for kind in ("aij", "hypre", "nest") if kind != best))


def add_product(M: PETSc.Mat | None, A: PETSc.Mat, B: PETSc.Mat) -> PETSc.Mat:
    """M + A B as a new matrix with the block sizes of A's rows and B's columns."""
    X = A.matMult(B)
    if M:
        X.axpy(1.0, M, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    X.setBlockSizes(A.getBlockSizes()[0], B.getBlockSizes()[1])
    return X


def block_diagonal_inverse(A: PETSc.Mat, what: str, problem: Problem, *, lifted: bool = True) -> PETSc.Mat:
    """AIJ with the inverses of the diagonal blocks of a square matrix, block by block.

    Collective.

    Args:
        A: with blocks as large as the dimension.
        what: its name, the field last.
        problem: with what is known of cells.
        lifted: whether -petsc_fs_regularize lifts weak blocks of it.

    Raises:
        LayoutError: the block size was lost on the way.
        SceneError: a block is singular to rounding; named with its cell and, if known, contact state.
    """
    D = problem.layout.dimension
    (n, _), _ = A.getSizes()
    if A.getBlockSize() != D:
        raise LayoutError(f"{what}: block size is {A.getBlockSize()}, expected {D}")
    cells = n // D
    first = A.getOwnershipRange()[0]
    dense = diagonal_blocks(CSR(*A.getDiagonalBlock().getValuesCSR()), D)
    with together(problem.layout.comm):
        bad = np.flatnonzero(singular(dense))
        if bad.size:
            cell = int(bad[0])
            state, name = "", what.rsplit(" ", 1)[-1]
            if "contact" in what and problem.contact_state is not None:
                state = f" ({CONTACT_STATES[int(problem.contact_state[cell])]})"
            raise SceneError(
                f"{what}: singular at cell {problem.layout.scene_cell(name, first // D + cell)}{state}"
                + (f", and at {bad.size - 1} more on this rank" if bad.size > 1 else "")
                + "; the contact unknowns cannot be eliminated"
                + (f" unless -petsc_fs_regularize (try {REMEDY:g}) lifts it for the preconditioner" if lifted else "")
            )
    inverse = np.linalg.inv(dense)
    columns = first + (np.arange(cells) * D)[:, None, None] + np.zeros((D, 1), dtype=np.int64) + np.arange(D)
    csr = (
        (np.arange(n + 1) * D).astype(PETSc.IntType),
        columns.ravel().astype(PETSc.IntType),
        inverse.ravel(),
    )
    return PETSc.Mat().createAIJ(A.getSizes(), bsize=D, csr=csr, comm=problem.layout.comm)
