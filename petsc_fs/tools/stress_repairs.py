"""What makes solvers cope with extreme scenes, each turned off and on by options: `petsc-fs stress --repairs`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

REPAIRED = "contact_poromechanics.opts"
"""The file that repairs are tried on."""


@dataclass(frozen=True)
class Repair:
    """A change of the solver, before and after.

    Attributes:
        name: of it, in a few words.
        why: what it is for.
        before: options without it.
        after: options with it; empty where it is the default.
    """

    name: str
    why: str
    before: Mapping[str, str | None] = field(default_factory=dict)
    after: Mapping[str, str | None] = field(default_factory=dict)


NO_REPAIR = {"petsc_fs_error_factor": "0", "petsc_fs_scaling": "none", "petsc_fs_restarts": "0"}
FIXED_STRESS = "qr_fieldsplit_1_fieldsplit_1_"
MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_pc_hypre_boomeramg_"
LADDER = ("regularize", "iterations", "smoother", "cycles", "direct_mechanics", "direct_mass", "monolithic")
"""Rungs of -petsc_fs_fallback."""

REPAIRS = (
    Repair("all three below", "the published configuration, judged by its residual alone", before=NO_REPAIR),
    Repair(
        "estimated errors", "an answer whose residual is small only because another field hides its own",
        before={"petsc_fs_error_factor": "0"},
    ),
    Repair(
        "scaling of rows", "a field that hides in the norm of the residual", before={"petsc_fs_scaling": "none"}
    ),
    Repair(
        "restarts", "a recursive residual that has run ahead of the true one", before={"petsc_fs_restarts": "0"}
    ),
    Repair("scaling always", "the same as scaling of rows, from the start", after={"petsc_fs_scaling": "always"}),
    Repair(
        "longer recurrence", "convergence that is lost where GMRES starts again after 30 iterations",
        after={"ksp_gmres_restart": "90"},
    ),
    Repair(
        "orthogonality", "Gram-Schmidt that loses it", before={"ksp_gmres_cgs_refinement_type": "refine_never"}
    ),
    Repair(
        "full fixed stress", "weights of fixed stress that are too small", after={f"{FIXED_STRESS}fs_damping": "1"}
    ),
    Repair(
        "two cycles of multigrid", "multigrid for displacements that is too weak",
        after={f"{MECHANICS}max_iter": "2"},
    ),
    Repair(
        "strong threshold of the paper", "coarsening along weak couplings",
        after={f"{MECHANICS}strong_threshold": "0.7"},
    ),
    Repair(
        "fallback", "stronger preconditioners in turn for what has not converged",
        after={"petsc_fs_fallback": ",".join(LADDER)},
    ),
)  # fmt: skip
"""All of them; what they come to is in docs/stress.md."""


def label(values: Mapping[str, str | None]) -> str:
    """What stands behind the name of the file."""
    return "".join(f" -{name}" + (f" {value}" if value else "") for name, value in values.items())


def variants() -> dict[str, dict[str, str | None]]:
    """Label to options of everything that has to be run, the plain file with an empty label among them."""
    found: dict[str, dict[str, str | None]] = {"": {}}
    for repair in REPAIRS:
        for values in (repair.before, repair.after):
            found.setdefault(label(values), dict(values))
    return found
