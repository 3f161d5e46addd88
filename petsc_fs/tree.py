"""The smallest solver tree that solves a scene, cut from the canonical options file.

The canonical file has three nested levels for five fields. Where a scene lacks a field, or a block makes
a level superfluous, that level disappears and what was inside moves up, with its prefixes rewritten.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from petsc_fs.errors import UsageError, together
from petsc_fs.fields import FIELD_NAMES, MECHANICS
from petsc_fs.options import find_options_file, parse
from petsc_fs.scene import Scene

if TYPE_CHECKING:
    from mpi4py import MPI

Options = dict[str, "str | None"]
FLOW = ("intf_flow", "mass")

CANONICAL = "contact_poromechanics_fast.opts"
"""Options file with all levels."""

WITHOUT_HYPRE = "contact_poromechanics_gamg.opts"
"""The same for a PETSc that lacks hypre."""


def canonical_name() -> str:
    """Name of the options file with all levels that this PETSc can run."""
    from petsc4py import PETSc

    return CANONICAL if PETSc.Sys.hasExternalPackage("hypre") else WITHOUT_HYPRE


def canonical_options() -> Options:
    """Options of the file with all levels that this PETSc can run, by full name."""
    return parse(find_options_file(canonical_name()))


@dataclass(frozen=True)
class LeftOut:
    """A part of the canonical tree that a scene does not need.

    Attributes:
        part: what it is.
        reason: why it is not needed.
        prefixes: beginnings of the canonical names of its options.
    """

    part: str
    reason: str
    prefixes: tuple[str, ...]

    def __str__(self) -> str:
        """One line for people."""
        return f"{self.reason}: {self.part} left out"


@dataclass(frozen=True)
class Facts:
    """What decides which levels a scene needs; the same on all ranks.

    Attributes:
        fields: those with unknowns.
        contact_acts: contact and interface displacement act on each other. If either of J_12 and J_21 is
            zero, as with all cells open, contact needs neither transformation nor Schur complement. Where they act, it
            needs both, even if J_11 is invertible: the Schur complement without Q_r is hard on multigrid. With all
            cells sliding GMRES takes 25 iterations with Q_r, and does not converge in 150 without.
        flow_moves_rock: pressure acts on the mechanics.
        rock_moves_flow: displacements act on the flow.
        fixed_stress: the fixed-stress diagonal is not zero, or not known.
    """

    fields: tuple[str, ...]
    contact_acts: bool
    flow_moves_rock: bool
    rock_moves_flow: bool
    fixed_stress: bool

    @property
    def contact(self) -> bool:
        """Whether there is contact."""
        return "contact" in self.fields

    @property
    def mechanics(self) -> tuple[str, ...]:
        """Fields of mechanics."""
        return tuple(f for f in MECHANICS if f in self.fields)

    @property
    def flow(self) -> tuple[str, ...]:
        """Fields of flow."""
        return tuple(f for f in FLOW if f in self.fields)

    @property
    def published(self) -> bool:
        """Whether these are the equations that the published runs solve, with their absolute tolerance."""
        return self.fields == FIELD_NAMES

    @property
    def needs_transform(self) -> bool:
        """Whether contact has to be eliminated by ContactTransform."""
        return self.contact and self.contact_acts

    @property
    def decoupled(self) -> bool:
        """Whether mechanics and flow do not act on each other at all."""
        return not (self.flow_moves_rock or self.rock_moves_flow)

    @property
    def needs_fixed_stress(self) -> bool:
        """Whether the Schur complement of mechanics differs from the mass block: both must act on each other."""
        both_ways = self.flow_moves_rock and self.rock_moves_flow
        return bool(self.mechanics) and "mass" in self.fields and self.fixed_stress and both_ways

    def for_all_contact_states(self) -> Facts:
        """Facts that hold in all Newton steps of a run: fracture cells open and close, and stick at times."""
        return replace(self, contact_acts=self.contact)

    def or_either(self, other: Facts) -> Facts:
        """What is true here or there, so that a level that was needed once is kept."""
        names = [f.name for f in fields(Facts) if f.name != "fields"]
        return replace(self, **{name: getattr(self, name) or getattr(other, name) for name in names})

    @classmethod
    def of(cls, scene: Scene, comm: MPI.Intracomm) -> Facts:
        """Look at a scene, or at the rows of it that each rank has. Collective.

        Raises:
            SceneError: the material data are impossible.
        """

        def entries(rows: tuple[str, ...], columns: tuple[str, ...]) -> int:
            return sum(
                int(np.count_nonzero(scene.blocks[r, c].data)) for r in rows for c in columns if (r, c) in scene.blocks
            )

        with together(comm):
            coefficients = scene.fixed_stress_coefficients() if "mass" in scene.sizes else None
        counts = np.array(
            [
                entries(("contact",), ("intf_force",)),
                entries(tuple(scene.sizes), ("contact",)) - entries(("contact",), ("contact",)),
                entries(MECHANICS, FLOW),
                entries(FLOW, MECHANICS),
                1 if coefficients is None else int(np.count_nonzero(coefficients[:, 0])),
            ]
        )
        to_force, from_contact, moves_rock, moves_flow, stress = comm.allreduce(counts).tolist()
        return cls(
            fields=tuple(f for f in scene.fields if scene.sizes[f]),
            contact_acts=bool(to_force and from_contact),
            flow_moves_rock=bool(moves_rock),
            rock_moves_flow=bool(moves_flow),
            fixed_stress=bool(stress),
        )


@dataclass(frozen=True)
class Tree:
    """Options of the smallest tree, and what was left out of the canonical one.

    Attributes:
        options: by full name, without the dash, in the order of elimination.
        left_out: parts that are not there, outermost first.
    """

    options: Options
    left_out: tuple[LeftOut, ...]

    def text(self, title: str) -> str:
        """A plain options file, with a comment for each part left out."""
        lines = [f"# {title}", "#"]
        lines += [f"# {part}" for part in self.left_out] or ["# nothing of the canonical tree is left out"]
        lines.append("")
        lines += [f"-{name}" if value is None else f"-{name} {value}" for name, value in self.options.items()]
        return "\n".join(lines) + "\n"


def smallest_tree(canonical: Mapping[str, str | None], facts: Facts) -> Tree:
    """Cut the canonical tree down to what a scene needs.

    Args:
        canonical: options of the file with all levels, by full name (see `petsc_fs.options.parse`).
        facts: about the scene.

    Raises:
        UsageError: the scene has no unknowns.
    """
    if not facts.fields:
        raise UsageError("the scene has no unknowns, there is nothing to solve")
    level_1 = _under(canonical, "qr_", but=("qr_side",))
    level_2 = _under(level_1, "fieldsplit_1_")
    stress = _under(level_2, "fieldsplit_1_")

    node = _flow(_under(stress, "fs_", but=STRESS_OPTIONS), facts.flow)
    if facts.needs_fixed_stress:
        own = {k: v for k, v in stress.items() if not k.startswith("fs_") or k in STRESS_OPTIONS}
        node = {**own, **_put("fs_", _without_ksp(node))}
    members = facts.flow
    if facts.mechanics:
        merged = facts.needs_transform or len(facts.mechanics) > 1
        name = "mechanics" if merged else facts.mechanics[0]
        leaf = _under(level_2, "fieldsplit_mechanics_")
        node = _split(level_2, name, leaf, node, members, exact=facts.decoupled) if members else leaf
        members = (name, *members)
    if facts.contact:
        leaf = _under(level_1, "fieldsplit_contact_")
        node = _split(level_1, "contact", leaf, node, members) if members else leaf
    node = _without_ksp(node)
    outer = {k: v for k, v in canonical.items() if k.startswith(("ksp_", "petsc_fs_"))}
    if not facts.mechanics:
        outer = {k: v for k, v in outer.items() if not k.startswith("petsc_fs_reuse")}
    if not facts.published:
        outer.pop("ksp_atol", None)
    if facts.needs_transform:
        wrapper = {k: canonical[k] for k in ("pc_type", "pc_python_type", "qr_side") if k in canonical}
        node = {**wrapper, **_put("qr_", node)}
    elif len(facts.mechanics) > 1:
        outer["petsc_fs_mat_type"] = "merged"
    return Tree({**outer, **node}, tuple(_left_out(facts)))


def shipped_tree(facts: Facts) -> Tree:
    """The smallest tree cut from the shipped canonical file; see `smallest_tree`."""
    return smallest_tree(canonical_options(), facts)


STRESS_OPTIONS = ("fs_type", "fs_damping")
REST = "qr_fieldsplit_1_"


def _left_out(facts: Facts) -> Iterator[LeftOut]:
    """What the tree for these facts does not have, from the outermost level inwards."""
    if not facts.contact:
        yield LeftOut("Q_r and the first Schur level", "no contact", ("qr_side", "qr_fieldsplit_contact_"))
    elif not facts.contact_acts:
        reason = "contact and interfaces do not act on each other"
        yield LeftOut("Q_r and the exact Schur complement of contact", reason, ("qr_side",))
    if not facts.mechanics:
        prefixes = tuple(
            f"{REST}fieldsplit_{name}" for name in ("mechanics_", "1_fs_type", "1_fs_damping", "1_pc_python")
        )
        yield LeftOut("the second Schur level with fixed stress", "no mechanics", prefixes)
    if not facts.flow:
        yield LeftOut("the second and third Schur levels", "no flow", (f"{REST}fieldsplit_1_",))
    elif facts.mechanics and not facts.needs_fixed_stress:
        if facts.decoupled:
            reason = "mechanics and flow decoupled"
        elif facts.flow_moves_rock and facts.rock_moves_flow:
            reason = "fixed-stress diagonal zero"
        else:
            reason = "mechanics and flow act one way only"
        prefixes = tuple(f"{REST}fieldsplit_1_{name}" for name in (*STRESS_OPTIONS, "pc_python_type"))
        yield LeftOut("fixed stress", reason, prefixes)
    if not facts.published:
        yield LeftOut("the absolute tolerance of the published runs", "not their five equations", ("ksp_atol",))
    if facts.flow == ("mass",):
        prefixes = (f"{REST}fieldsplit_1_fs_fieldsplit_intf_flow_",)
        yield LeftOut("the third Schur level", "no interface flow", prefixes)


def _flow(level_3: Options, fields: tuple[str, ...]) -> Options:
    """The flow part: third level, or the one leaf that there is."""
    if len(fields) == len(FLOW):
        return {"ksp_type": "preonly", **level_3}
    return _under(level_3, f"fieldsplit_{fields[0]}_") if fields else {}


def _split(
    level: Options, name: str, leaf: Options, rest: Options, members: tuple[str, ...], *, exact: bool = False
) -> Options:
    """A level that takes the first field apart from the others, block-diagonal where that is exact."""
    own = {k: v for k, v in level.items() if not k.startswith("fieldsplit_")}
    if exact:
        own = {k: v for k, v in own.items() if not k.startswith("pc_fieldsplit_schur")}
        own["pc_fieldsplit_type"] = "additive"
    own["pc_fieldsplit_0_fields"] = "0"
    own["pc_fieldsplit_1_fields"] = ",".join(str(i + 1) for i in range(len(members)))
    other = members[0] if len(members) == 1 else "1"
    return {**own, **_put(f"fieldsplit_{name}_", leaf), **_put(f"fieldsplit_{other}_", rest)}


def _under(options: Mapping[str, str | None], prefix: str, but: tuple[str, ...] = ()) -> Options:
    """Options with a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in options.items() if k.startswith(prefix) and k not in but}


def _put(prefix: str, options: Options) -> Options:
    return {prefix + k: v for k, v in options.items()}


def _without_ksp(options: Options) -> Options:
    """A node that moved to where no KSP of its own is asked for."""
    return {k: v for k, v in options.items() if k != "ksp_type"}
