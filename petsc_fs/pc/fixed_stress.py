"""The fixed-stress approximation of the Schur complement of mechanics: a diagonal on the block of pressure."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import UsageError
from petsc_fs.pc.algebraic import stabilisation
from petsc_fs.pc.base import WrapperPC, choice, text
from petsc_fs.pc.sparser import sparser

PUBLISHED_DAMPING = 0.6
FAR = 30.0
"""Factor between analytic and algebraic values that no material explains."""


class FixedStress(WrapperPC):
    """An inner PC on S^2, the operator with D_55 added to the diagonal of its block of pressure.

    The operator is a MatNest in which a diagonal block has the name of that field, or the block itself.

    Options, with the prefix of this PC:
        -fs_field <mass>: name of the field of pressure.
        -fs_type <analytic with data, else algebraic> (analytic, algebraic): analytic is D_55 = base * ratio ** damping
            (paper, eq:fixed_stress_coefs), from the vectors "fixed_stress_base" and "fixed_stress_ratio" (1 if it is
            missing) that are composed on the block. `petsc_fs.scene.Scene.fixed_stress_coefficients` has the
            formulas. Where the matrix contradicts these values, see `checked`. algebraic is D_55 from the matrix
            alone, see `petsc_fs.pc.algebraic`; the operator must be the Schur complement that PCFIELDSPLIT makes,
            which knows the blocks of mechanics.
        -fs_damping <0.6>: the exponent; 1 is the paper's formula, 0.6 what its published code uses.
        -fs_fractures <0>: where not 0, cells of fractures have this multiple of the algebraic value in place of the
            analytic one, which leaves out that fractures open as their pressure rises. That of cells which open one by
            one is the algebraic one; fractures open as a whole, more easily.
        -fs_heat <>: name of the field of temperature, for the extended fixed-stress split (Kim, "Unconditionally stable
            sequential schemes for all-way coupled thermoporomechanics", 2018): where mechanics' columns of temperature
            are t times those of pressure, and the energy balance's rows e times those of the mass balance, D_55 times
            [[1, t], [e, e t]] is added, cell by cell, with t and e from the matrix. Without a name the split is
            isothermal: D_55 alone.
        -fs_drop <0>: entries of the block of pressure less than this share of the diagonal of their row are left out,
            see `petsc_fs.pc.sparser`; 0 keeps all.
        -fs_*: of the inner PC.
    """

    prefix = "fs_"
    kind = "analytic"
    damping = PUBLISHED_DAMPING
    fractures = 0.0
    heat = ""

    def build(self, pc: PETSc.PC) -> PETSc.Mat:
        """S^2. Collective.

        Raises:
            UsageError: there is no such field, or not what the type needs.
        """
        complement, operator = pc.getOperators()
        prefix, field = pc.getOptionsPrefix() or "", text(pc, "fs_field", "mass")
        names = nest.field_names(operator)
        whole = operator.getType() == "nest"
        if whole and field not in names:
            raise UsageError(
                f"FixedStress needs a field {field!r}; it was given {', '.join(names)}: name the diagonal blocks, or "
                f"say -{prefix}fs_field NAME"
            )
        k = names.index(field) if whole else 0
        block = operator.getNestSubMatrix(k, k) if whole else operator
        base, ratio = block.query("fixed_stress_base"), block.query("fixed_stress_ratio")
        kinds = ("analytic", "algebraic") if base is not None else ("algebraic", "analytic")
        self.kind = choice(pc, "fs_type", kinds)
        self.damping = PETSc.Options(prefix).getReal("fs_damping", PUBLISHED_DAMPING)
        self.fractures, times = 0.0, PETSc.Options(prefix).getReal("fs_fractures", 0)
        self.heat = text(pc, "fs_heat", "")
        mechanics = (complement, k if whole else None, block.getSizes()[0], prefix)
        if self.kind == "algebraic":
            values = stabilisation(*_mechanics(*mechanics))
        elif base is not None:
            shape = np.ones(base.getLocalSize()) if ratio is None else ratio.getArray()
            values = base.getArray() * shape**self.damping
            if complement.getType() == "schurcomplement":
                algebraic, rock = stabilisation(*_mechanics(*mechanics)), shape != 1.0
                values = checked(values, rock, algebraic)
                if ratio is not None and times:
                    self.fractures, values = times, np.where(rock, values, times * algebraic)
        else:
            raise UsageError(
                f"-{prefix}fs_type analytic: the block of {field} has no vector 'fixed_stress_base' (a scene without "
                f"material data, cell volumes or cell dimensions has none); use -{prefix}fs_type algebraic"
            )
        diagonal = block.getDiagonal()  # whose signs are those of the mass balance
        diagonal.setArray(np.copysign(values, diagonal.getArray()))
        S = sparser(_plus(block, diagonal), PETSc.Options(prefix).getReal("fs_drop", 0))
        S.setName(block.getName())
        changed = {(k, k): S}
        if self.heat:
            if not whole or self.heat not in names:
                raise UsageError(f"-{prefix}fs_heat {self.heat}: no such field; there are {', '.join(names)}")
            h = names.index(self.heat)
            other = (complement, h, operator.getNestSubMatrix(h, h).getSizes()[0], prefix)
            for place, factor in _extension(_mechanics(*mechanics), _mechanics(*other), k, h).items():
                factor.pointwiseMult(factor, diagonal)
                changed[place] = _plus(
                    operator.getNestSubMatrix(*place) or nest.empty(block.getSizes(), pc.comm), factor
                )
                factor.destroy()
            changed[h, h].setName(self.heat)
        diagonal.destroy()
        if not whole:
            return S
        count = range(len(names))
        grid = [[changed.get((i, j)) or operator.getNestSubMatrix(i, j) or None for j in count] for i in count]
        nested = PETSc.Mat().createNest(grid, comm=pc.comm)
        for matrix in changed.values():
            matrix.destroy()  # the nest holds it
        return nested

    def describe(self) -> str:
        """The diagonal in one line."""
        heat = f", extended to {self.heat}" if self.heat else ""
        damping = f", damping exponent {self.damping:g}" if self.kind == "analytic" else ""
        fractures = f", in fractures {self.fractures:g} times the algebraic one" if self.fractures else ""
        return f"{self.kind} fixed-stress diagonal on the mass block{damping}{fractures}{heat}"


def _plus(A: PETSc.Mat, diagonal: PETSc.Vec) -> PETSc.Mat:
    """A copy of A with more on the diagonal, which may be missing from its pattern. Collective."""
    B = A.duplicate(copy=True)
    B.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
    B.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)
    return B


def _extension(
    pressure: tuple[PETSc.Mat, ...], heat: tuple[PETSc.Mat, ...], k: int, h: int
) -> dict[tuple[int, int], PETSc.Vec]:
    """t, e and e t of the extended split by their blocks, from `_mechanics` of fields k and h. Collective."""
    (_, B, C), (_, B_h, C_h) = pressure, heat
    t, e = _likeness(B, B_h, transposed=True), _likeness(C, C_h)
    both = t.duplicate()
    both.pointwiseMult(t, e)
    return {(k, h): t, (h, k): e, (h, h): both}


def _likeness(A: PETSc.Mat, B: PETSc.Mat, *, transposed: bool = False) -> PETSc.Vec:
    """By how much rows of B, or columns, are those of A multiplied: b_i = f_i a_i. Collective.

    From products with vectors at random: exact where rows are proportional, else near to least squares. 0 for rows
    of zeros in A.
    """
    (across, along), random = A.createVecs(), np.random.default_rng(5)
    if transposed:
        across, along = along, across
    above = below = np.zeros(along.getLocalSize())
    for _ in range(4):
        across.setArray(random.standard_normal(across.getLocalSize()))
        parts = []
        for M in (A, B):
            (M.multTranspose if transposed else M.mult)(across, along)
            parts.append(along.getArray().copy())
        above, below = above + parts[0] * parts[1], below + parts[0] ** 2
    across.destroy()
    along.setArray(np.divide(above, below, out=np.zeros_like(above), where=below > 0))
    return along


def checked(
    analytic: NDArray[np.float64], rock: NDArray[np.bool_], algebraic: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Analytic values, and in their place algebraic ones where these contradict them by more than a factor of `FAR`.

    In rock the two are alike (0.15 to 4 times, on all scenes of this package); in fractures the analytic ones are less.
    More than that says that the equations are in other units than the material data. Local.
    """
    wrong = (analytic > FAR * algebraic) | (rock & (analytic * FAR < algebraic))
    return np.where(wrong, algebraic, analytic)


def _mechanics(
    complement: PETSc.Mat, k: int | None, own: tuple[int, int], prefix: str
) -> tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat]:
    """A_00 of a Schur complement, and the parts of A_01 and A_10 of its field k (None: it has one field alone).

    Args:
        complement: with respect to mechanics.
        k: see above.
        own: local and global size of the field.
        prefix: of options, for errors.

    Raises:
        UsageError: the matrix is no Schur complement.
    """
    if complement.getType() != "schurcomplement":
        raise UsageError(
            f"-{prefix}fs_type algebraic: its operator is no Schur complement of PCFIELDSPLIT, so that the blocks of "
            "mechanics are not known; compose 'fixed_stress_base' on the block and use analytic"
        )
    handles = [ctypes.c_void_p() for _ in range(5)]
    nest.call("MatSchurComplementGetSubMatrices", complement, *map(ctypes.byref, handles))
    A, B, C = (nest.borrowed(complement, handle) for handle in handles[1:4])
    if k is None:
        return A, B, C

    def sizes(count: int) -> list[tuple[int, int]]:
        """Of fields of mechanics, or of a single one, which may be a nest itself."""
        return [A.getNestSubMatrix(i, i).getSizes()[0] for i in range(count)] if count > 1 else [A.getSizes()[0]]

    if B.getType() == "nest":
        rows = sizes(B.getNestSize()[0])
        parts = [B.getNestSubMatrix(i, k) or nest.empty((n, own), B.comm) for i, n in enumerate(rows)]
        B = PETSc.Mat().createNest([[part] for part in parts], comm=B.comm)
    if C.getType() == "nest":
        columns = sizes(C.getNestSize()[1])
        parts = [C.getNestSubMatrix(k, j) or nest.empty((own, n), C.comm) for j, n in enumerate(columns)]
        C = PETSc.Mat().createNest([parts], comm=C.comm)
    return A, B, C
