"""Fallback: a ladder of stronger preconditioners, for solves that miss their tolerance.

Each rung is a set of PETSc options, made for the levels that the preconditioner at hand turns out to have, whatever
options file it comes from. Rungs add up: what an earlier one has strengthened stays so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from petsc4py import PETSc

from petsc_fs.diagnostics import REMEDY
from petsc_fs.errors import UsageError
from petsc_fs.fields import MECHANICS
from petsc_fs.levels import levels

RUNGS = ("regularize", "iterations", "smoother", "cycles", "direct_mechanics", "direct_mass", "monolithic")
"""Values of -petsc_fs_fallback, of which any number is listed in the order to be tried:

- regularize: nearly singular blocks that the preconditioner divides by lifted to 1e-2 of what is usual, in it only;
- iterations: four times as many, and GMRES without a restart among the first 200;
- smoother: two sweeps of symmetric Gauss-Seidel in BoomerAMG, four steps on each level of PCMG, ILU(2) for ILU(0) and
  an overlap of two cells in PCASM;
- cycles: three multigrid cycles for one;
- direct_mechanics, direct_mass: a factorisation in place of what solves for displacements, and for pressures;
- monolithic: GMRES with one factorisation of the whole matrix, of which a copy is made for it.
"""

IN_A_ROW = 2
"""Matrices in a row that were solved on a rung, after which further ones start on it."""

MORE = 4
"""Factor of -ksp_max_it on rung `iterations`."""
RESTART = 200
"""-ksp_gmres_restart on rung `iterations`."""

NONE = "none"
"""Value of -petsc_fs_fallback without any rung, the default."""
ITERATE_WELL = ("gmres", "fgmres", "lgmres", "bcgs")
"""KSPs that rung `monolithic` leaves as they are; iterative refinement by others may stall."""

Options = Mapping[str, str]

SMOOTHER: Mapping[str, Options] = {
    "boomeramg": {
        "pc_hypre_boomeramg_relax_type_all": "symmetric-SOR/Jacobi",
        "pc_hypre_boomeramg_grid_sweeps_all": "2",
    },
    "mg": {"mg_levels_ksp_max_it": "4"},
    "ilu": {"pc_factor_levels": "2"},
    "asm": {"pc_asm_overlap": "2", "sub_pc_factor_levels": "2"},
    "bjacobi": {"sub_pc_factor_levels": "2"},
    "sor": {"pc_sor_its": "4"},
}
"""Stronger smoothers, by kind of leaf."""
CYCLES: Mapping[str, Options] = {
    "boomeramg": {"pc_hypre_boomeramg_max_iter": "3"},
    "mg": {"pc_mg_multiplicative_cycles": "3"},
}
"""More cycles, by kind of leaf."""
FACTORISATIONS = ("lu", "cholesky")
FIELDS_OF: Mapping[str, tuple[str, ...]] = {"direct_mechanics": MECHANICS, "direct_mass": ("mass",)}


@dataclass(frozen=True)
class Leaf:
    """What solves at one level of a tree, and is no split itself.

    Attributes:
        prefix: of its options.
        whole: prefix of the level; differs from `prefix` where it is solved component by component.
        kind: PCType; "boomeramg" for that of PCHYPRE, "mg" for PCGAMG, too.
        fields: of the level.
    """

    prefix: str
    whole: str
    kind: str
    fields: tuple[str, ...]


def leaves(pc: PETSc.PC, fields: tuple[str, ...]) -> list[Leaf]:
    """The leaves of a set-up tree, in the order of elimination. Collective.

    Args:
        pc: the outermost.
        fields: of the whole system.
    """
    found: dict[str, Leaf] = {}
    whole = pc.getOptionsPrefix() or ""
    for level in levels(pc):
        prefix, kind = level.getOptionsPrefix() or "", level.getType()
        dm = level.getDM()  # of which the components of a level have none
        if dm and dm.getType() == "shell" and dm.getAppCtx() is not None:
            _, members = dm.getAppCtx()
            whole, fields = prefix, tuple(f for _, names in members for f in names)
        if kind == "fieldsplit" or (kind == "python" and _has_inner(level)):
            continue
        if kind == "hypre":
            kind = level.getHYPREType()
        elif kind == "gamg":
            kind = "mg"
        found.setdefault(prefix, Leaf(prefix, whole, kind, fields))
    return list(found.values())


def _has_inner(pc: PETSc.PC) -> bool:
    context = pc.getPythonContext()
    return getattr(context, "inner", None) is not None or bool(getattr(context, "inners", ()))


class NotApplicableError(Exception):
    """A rung has nothing to change; the text says why."""


@dataclass(frozen=True)
class _Ground:
    """What rungs change of a KSP."""

    kind: str
    max_it: int
    side: int
    norm: int

    @classmethod
    def of(cls, ksp: PETSc.KSP) -> _Ground:
        return cls(ksp.getType(), ksp.getTolerances()[3], ksp.getPCSide(), ksp.getNormType())

    def restore(self, ksp: PETSc.KSP, restart: int) -> None:
        ksp.setTolerances(max_it=self.max_it)
        if ksp.getType() != self.kind:
            ksp.setType(self.kind)
            ksp.setPCSide(self.side)
            ksp.setNormType(self.norm)
        ksp.setGMRESRestart(restart)


class Fallback:
    """Where a solver stands on its ladder; the same on all ranks.

    Attributes:
        rungs: in the order to be tried.
        prefix: of all options.
        taken: names of the rungs in force, the present one last.
        options: of the preconditioner that they have, by full name.
    """

    def __init__(self, rungs: Iterable[str] = (), prefix: str = "") -> None:
        self.rungs = tuple(rungs)
        self.prefix = prefix
        self.taken: tuple[str, ...] = ()
        self.options: dict[str, str] = {}
        self._leaves: list[Leaf] | None = None
        self._weak = False
        self._ground: _Ground | None = None
        self._in_a_row = 0

    @classmethod
    def from_options(cls, prefix: str = "") -> Fallback:
        """By -petsc_fs_fallback. Local.

        Raises:
            UsageError: there is no such rung.
        """
        given = PETSc.Options(prefix).getString("petsc_fs_fallback", NONE)
        rungs = list(dict.fromkeys(given.split(","))) if given != NONE else []
        for name in rungs:
            if name not in RUNGS:
                raise UsageError(
                    f"-{prefix}petsc_fs_fallback {given}: expected {NONE}, or a list with commas of {', '.join(RUNGS)}"
                )
        return cls(rungs, prefix)

    @property
    def name(self) -> str:
        """The rung that the solver stands on; "" if it has the options as they were given."""
        return self.taken[-1] if self.taken else ""

    @property
    def monolithic(self) -> bool:
        """Whether the whole matrix is factored by a rung."""
        return "monolithic" in self.taken

    def remaining(self) -> tuple[str, ...]:
        """The rungs above the present one."""
        return self.rungs[self.rungs.index(self.name) + 1 :] if self.taken else self.rungs

    @property
    def lifted(self) -> float:
        """-petsc_fs_regularize by a rung; 0 without."""
        return REMEDY if "regularize" in self.taken else 0.0

    def see(self, pc: PETSc.PC | None, fields: tuple[str, ...], weak: bool) -> None:
        """Take note of what there is to strengthen, before the first rung. Collective.

        Args:
            pc: the tree by the options as they were given; None if it could not be set up.
            fields: of the whole system.
            weak: whether the preconditioner divides by a nearly singular block.
        """
        if not self.taken:
            self._leaves = None if pc is None else leaves(pc, fields)
            self._weak = weak

    def climb(self, rung: str, ksp: PETSc.KSP) -> str:
        """Put a rung in force; where that strengthens the solver, as " on ...".

        `options` have to be in the database for the next set-up of a new PC.

        Raises:
            NotApplicableError: there is nothing that this rung could change.
        """
        values = self._values(rung, ksp)
        self.taken += (rung,)
        self.options = self.options | {
            prefix + name: value for prefix, more in values.items() for name, value in more.items()
        }
        self.adapt(ksp)
        places = [f"-{prefix}" if prefix != self.prefix else "the whole system" for prefix in values]
        return f" on {', '.join(places)}" if places else ""

    def adapt(self, ksp: PETSc.KSP) -> None:
        """Give a KSP that was made by the options what the rungs in force have for it."""
        if self.taken:
            self._ground = self._ground or _Ground.of(ksp)
        if "iterations" in self.taken and self._ground is not None:
            ksp.setTolerances(max_it=MORE * self._ground.max_it)
            ksp.setGMRESRestart(RESTART)
        if self.monolithic and ksp.getType() not in ITERATE_WELL:
            ksp.setType(PETSc.KSP.Type.GMRES)
            ksp.setPCSide(PETSc.PC.Side.RIGHT)
            ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)

    def take_matrix(self, ksp: PETSc.KSP, solved: bool) -> bool:
        """Decide where the next matrix starts; whether the preconditioner has to be made anew for that.

        Args:
            ksp: goes back to what the options give, or stays.
            solved: whether the last solve converged.
        """
        self._in_a_row = self._in_a_row + 1 if self.taken and solved else 0
        if not self.taken or self._in_a_row >= IN_A_ROW:
            return False
        changed = bool(self.options)  # a matrix of its own for the preconditioner is a change by itself
        self.taken, self.options = (), {}
        if self._ground is not None:
            self._ground.restore(ksp, PETSc.Options(self.prefix).getInt("ksp_gmres_restart", 30))
            self._ground = None
        return changed

    @property
    def _factored(self) -> bool:
        """Whether the options as they were given factor the whole matrix."""
        return self._leaves is not None and [leaf.kind in FACTORISATIONS for leaf in self._leaves] == [True]

    def _values(self, rung: str, ksp: PETSc.KSP) -> dict[str, Options]:
        """Options of a rung, by the prefixes of the levels that they are for."""
        if rung == "regularize":
            if not self._weak or self._factored:
                raise NotApplicableError("the preconditioner divides by no nearly singular block")
            return {}
        if rung == "monolithic":
            if self._factored and ksp.getType() in ITERATE_WELL:
                raise NotApplicableError("the whole matrix is factored already")
            return {self.prefix: factorisation(ksp.comm.size)}
        if self._leaves is None:
            raise NotApplicableError("the preconditioner could not be set up")
        if rung == "iterations":
            if ksp.getType() == PETSc.KSP.Type.PREONLY:
                raise NotApplicableError("there is no Krylov method")
            return {}
        if rung in FIELDS_OF:
            wanted = set(FIELDS_OF[rung])
            there = [leaf for leaf in self._leaves if set(leaf.fields) <= wanted]
            values = {leaf.whole: factorisation(ksp.comm.size) for leaf in there if leaf.kind not in FACTORISATIONS}
            if there and not values:
                raise NotApplicableError("it is factored already")
        else:
            table = SMOOTHER if rung == "smoother" else CYCLES
            values = {leaf.prefix: table[leaf.kind] for leaf in self._leaves if leaf.kind in table}
        if not values:
            raise NotApplicableError("no level that it could strengthen")
        return values


def factorisation(ranks: int) -> Options:
    """Options of a PC that factors its matrix, by what this PETSc has.

    Raises:
        NotApplicableError: there is nothing for several ranks.
    """
    if PETSc.Sys.hasExternalPackage("mumps"):
        return {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps", "mat_mumps_icntl_14": "200"}
    if PETSc.Sys.hasExternalPackage("superlu_dist"):
        return {"pc_type": "lu", "pc_factor_mat_solver_type": "superlu_dist"}
    if ranks > 1:
        raise NotApplicableError("this PETSc has neither MUMPS nor SuperLU_DIST")
    return {"pc_type": "lu", "pc_factor_mat_solver_type": "petsc"}
