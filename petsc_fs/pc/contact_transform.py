"""The transformation that makes the contact block invertible, and the exact first Schur complement."""

from __future__ import annotations

from itertools import product
from typing import Any

from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import LayoutError, UsageError
from petsc_fs.nest import Blocks
from petsc_fs.pc.base import WrapperPC, choice, text, told

FEW_ROWS = 5000
"""Rows of mechanics per rank up to which blocks above the diagonal that couple it to one field are copied into one
matrix: a product with a MatNest asks all ranks several times where its parts are."""


class ContactTransform(WrapperPC):
    """Right (or left) transformation of the Jacobian, and an inner PC on the transformed matrix.

    The contact block J_11 is singular where a fracture sticks. With D_22 the block diagonal of J_22,

    - right: T = -D_22^-1 J_21, Q_r = I + T in block (2,1), J~ = J Q_r, solution x = Q_r x~;
    - left: L = -J_12 D_22^-1, Q_l = I + L in block (1,2), J~ = Q_l J, residual r~ = Q_l r,

    has J~_11 = J_11 - J_12 D_22^-1 J_21, block-diagonal and invertible (Zabegaev et al., arXiv:2501.07441, eq:Qright
    and eq:J_tilde). With side none, for a J_11 that is invertible as it is, J~ = J.

    The inner PC is set up on a MatNest with the contact column and row of J~ and, in place of the other blocks,
    S^1 = J_ij - J~_i1 J~_11^-1 J~_1j (eq:S^1). All products are as small as the fractures; other blocks of J are passed
    on by reference, whatever fields they belong to. Fields of mechanics become one, `mechanics`, in one matrix that
    keeps the block size for multigrid.

    The operator is a MatNest with a named diagonal block per field, see `petsc_fs.nest`.

    Options, with the prefix of this PC:
        -qr_side <right> (right, left, none): the transformation.
        -qr_contact <contact>: name of field 1.
        -qr_interface <intf_force>: name of field 2.
        -qr_mechanics <intf_force,momentum>: names of the fields that become one; those that are not there are left
            out. Where -qr_interface is given, its field takes the place of intf_force.
        -qr_mechanics_mat_type <aij> (aij, hypre, nest): storage of the block of mechanics; hypre saves PCHYPRE its own
            copy; nest makes no copy, for a `ComponentSweep`.
        -qr_*: of the inner PC, whose fields are contact, mechanics, and the others in their order.
    """

    prefix = "qr_"
    side = "right"
    _transform: Any = None
    _products: tuple[PETSc.Mat, ...] = ()

    def build(self, pc: PETSc.PC) -> PETSc.Mat:
        """Nest of J~ and S^1. Collective.

        Raises:
            UsageError: a field is missing, or an option has an impossible value.
            LayoutError: the fields of mechanics are apart.
        """
        operator = pc.getOperators()[1]
        if operator.getType() != "nest":
            raise UsageError("ContactTransform needs a MatNest with a block per field; petsc_fs.nest.split makes one")
        names, prefix = nest.field_names(operator), pc.getOptionsPrefix() or ""
        self.names = (text(pc, "qr_contact", "contact"), text(pc, "qr_interface", "intf_force"))
        for option, needed in zip(("qr_contact", "qr_interface"), self.names, strict=True):
            if needed not in names:
                raise UsageError(
                    f"ContactTransform needs a field {needed!r}; there are {', '.join(names)}: name the diagonal "
                    f"blocks (Mat.setName, PetscObjectSetName), or say -{prefix}{option} NAME"
                )
        wanted = text(pc, "qr_mechanics", f"{self.names[1]},momentum").split(",")
        mechanics = tuple(n for n in names if n in wanted)
        places = [names.index(n) for n in mechanics]
        if not mechanics or places != list(range(places[0], places[0] + len(places))) or self.names[0] in mechanics:
            raise LayoutError(
                f"-{prefix}qr_mechanics {','.join(wanted)}: these fields must follow each other; "
                f"the order here is {', '.join(names)}"
            )
        self.side = choice(pc, "qr_side", ("right", "left", "none"))
        mat_type = choice(pc, "qr_mechanics_mat_type", ("aij", "hypre", "nest"))
        J = nest.blocks_of(operator)
        if not {self.names, self.names[::-1]} <= set(J):
            self.side = "none"  # J~_11 = J_11, as with all cells open
        stale = self._products
        S = self._eliminate(J, names)
        for matrix in stale:
            matrix.destroy()
        sizes = [J[n, n].getSizes()[0][0] for n in names]
        starts = {n: sum(sizes[:i]) for i, n in enumerate(names)}
        self._slices = [slice(starts[n], starts[n] + J[n, n].getSizes()[0][0]) for n in self.names]
        return grouped(names, S, mechanics, mat_type, pc.comm)

    def _eliminate(self, J: Blocks, names: tuple[str, ...]) -> Blocks:
        """Blocks of J~ in the row and column of contact, of S^1 elsewhere."""
        contact, interface = self.names
        S, made = dict(J), []
        changed: dict[tuple[str, str], tuple[PETSc.Mat, PETSc.Mat]] = {}
        if self.side != "none":
            D_inverse = nest.inverse_of_diagonal(J[interface, interface], f"D_22, block of {interface}")
            if self.side == "right":
                T = D_inverse.matMult(J[interface, contact])
                changed = {(r, contact): (J[r, interface], T) for r in names if (r, interface) in J}
            else:
                T = J[contact, interface].matMult(D_inverse)
                changed = {(contact, c): (T, J[interface, c]) for c in names if (interface, c) in J}
            D_inverse.destroy()
            T.scale(-1)
            made.append(T)
            self._transform, (self._source, self._target) = T, T.createVecs()
        for pair, (left, right) in changed.items():
            S[pair] = plus_product(J.get(pair), left, right)
            made.append(S[pair])
        S[contact, contact].setName(contact)
        C_inverse = nest.inverse_of_diagonal(
            S[contact, contact], f"J~_11, block of {contact}", "; the contact unknowns cannot be eliminated"
        )
        rows = [r for r in names if r != contact and (r, contact) in S]
        for c in names:
            if c == contact or (contact, c) not in S:
                continue
            W = C_inverse.matMult(S[contact, c])
            W.scale(-1)
            for r in rows:
                S[r, c] = plus_product(J.get((r, c)), S[r, contact], W)
                made.append(S[r, c])
                if r == c:
                    carry_over(J[r, c], S[r, c])
            W.destroy()
        C_inverse.destroy()
        self._products = tuple(made)
        return S

    @told
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = Q_r P^-1 x (right) or P^-1 Q_l x (left). Collective."""
        if self.side == "left":
            work = x.copy()
            self._add_transformed(work)
            super().apply(pc, work, y)
            work.destroy()
            return
        super().apply(pc, x, y)
        if self.side == "right":
            self._add_transformed(y)

    def _add_transformed(self, v: PETSc.Vec) -> None:
        """v_2 += T v_1 (right) or v_1 += L v_2 (left), in place. Collective.

        VecGetSubVector would ask all ranks where the fields are.
        """
        values = v.getArray()
        source, target = self._slices if self.side == "right" else self._slices[::-1]
        self._source.placeArray(values[source])
        self._target.placeArray(values[target])
        self._transform.multAdd(self._source, self._target, self._target)
        self._source.resetArray()
        self._target.resetArray()

    def describe(self) -> str:
        """The transformation in one line."""
        where = {"right": "J Q_r", "left": "Q_l J", "none": "J"}[self.side]
        return f"inner PC on {where} with the exact Schur complement of {self.names[0]}"

    def release(self) -> None:
        """Free the products. Collective; may be called twice."""
        super().release()
        for matrix in self._products:
            matrix.destroy()
        self._products = ()


def grouped(names: tuple[str, ...], S: Blocks, mechanics: tuple[str, ...], mat_type: str, comm: Any) -> PETSc.Mat:
    """The MatNest in which the fields of mechanics are one. Collective."""
    first = names.index(mechanics[0])
    groups = [(n,) for n in names[:first]] + [mechanics] + [(n,) for n in names[first + len(mechanics) :]]
    few = sum(S[n, n].getSizes()[0][1] for n in mechanics) <= FEW_ROWS * comm.size

    def block(i: int, j: int) -> PETSc.Mat | None:
        rows, columns = groups[i], groups[j]
        if len(rows) == len(columns) == 1:
            return S.get((rows[0], columns[0]))
        if not any((r, c) in S for r, c in product(rows, columns)):
            return None
        grid = [[S.get((r, c)) or nest.empty((S[r, r].getSizes()[0], S[c, c].getSizes()[1]), comm) for c in columns]
                for r in rows]  # fmt: skip
        part = PETSc.Mat().createNest(grid, comm=comm)
        if i != j and not (few and i < j):
            return part
        if i == j and mat_type == "nest":
            part.setBlockSizes(*(2 * [S[rows[0], rows[0]].getBlockSize()]))
            return part
        whole = nest.one_matrix(part, mat_type if i == j else "aij")
        part.destroy()
        return whole

    count = range(len(groups))
    grid = [[block(i, j) for j in count] for i in count]
    merged: Any = grid[first][first]
    merged.setName("mechanics" if len(mechanics) > 1 else mechanics[0])
    whole = PETSc.Mat().createNest(grid, comm=comm)
    for i, j in product(count, count):
        part = grid[i][j]
        if part is not None and len(groups[i]) + len(groups[j]) > 2:
            part.destroy()  # the nest holds it
    return whole


def plus_product(M: PETSc.Mat | None, A: PETSc.Mat, B: PETSc.Mat) -> PETSc.Mat:
    """M + A B as a new matrix with the block sizes of A's rows and B's columns. Collective."""
    X = A.matMult(B)
    if M:
        X.axpy(1.0, M, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    X.setBlockSizes(A.getBlockSizes()[0], B.getBlockSizes()[1])
    return X


def carry_over(A: PETSc.Mat, B: PETSc.Mat) -> None:
    """Give B the name of A and what is composed on it. Local."""
    B.setName(A.getName())
    for what in ("fixed_stress_base", "fixed_stress_ratio", "coordinates"):
        if (found := A.query(what)) is not None:
            B.compose(what, found)
    modes = A.getNearNullSpace()
    if modes:
        B.setNearNullSpace(modes)
