"""What makes the default file fast, and what was tried and lost."""

from statistics import median

from page import Place
from petsc_fs.tools.measure import seconds_of
from petsc_fs.tools.pages import markdown

DEFAULT, HEAT = "contact_poromechanics_fast.opts", "contact_thermoporomechanics_fast.opts"
INPUTS = ("options/contact_*.opts", "petsc_fs/tools/measure.py", "petsc_fs/tools/probe.py")
SCENES = ("model3_g1_t1_n2", "model3.h5", "model2.h5", "model1.h5")
"""The largest first: solves of the others find everything loaded."""
BELOW = "-qr_fieldsplit_1_fieldsplit_"
MECHANICS = f"{BELOW}mechanics_"
AMG = f"{MECHANICS}component_pc_hypre_boomeramg_"
MASS = f"{BELOW}1_fs_fieldsplit_mass_pc_hypre_boomeramg_"
COARSE = "coarsen_type Falgout {0}interp_type classical {0}P_max 0"
SYMMETRIC = "relax_type_all symmetric-SOR/Jacobi"
AT_ONCE = f"{MECHANICS}pc_hypre_"

WON = {
    "the file again, to see what differences mean": "-ksp_rtol 1e-10",
    "displacements all at once, by a multigrid with the same options": (
        f"-qr_mechanics_mat_type hypre {MECHANICS}pc_type hypre {AT_ONCE}type boomeramg "
        + " ".join(f"{AT_ONCE}boomeramg_{o}" for o in ("coarsen_type PMIS", "interp_type ext+i", "P_max 4"))
        + f" {AT_ONCE}boomeramg_relax_type_all SOR/Jacobi -petsc_fs_allow_unused *component_*,*mechanics_pc_python_type"
    ),
    "components without couplings between them (block Jacobi)": f"{MECHANICS}component_order none",
    "from the first component to the last": f"{MECHANICS}component_order forward",
    "Falgout's coarsening, classical interpolation of all entries": AMG + COARSE.format(f"{AMG}"),
    "Gauss-Seidel forward and backward": AMG + SYMMETRIC,
    "both of these for pressure": f"{MASS}{COARSE.format(MASS)} {MASS}{SYMMETRIC}",
    "a restart after 30 iterations": "-ksp_gmres_restart 30",
    "multigrid of mechanics with all entries": f"{MECHANICS}component_drop 0",
    "multigrid of pressure with all entries": f"{BELOW}1_fs_drop 0",
    "fixed stress as published for fractures, too": f"{BELOW}1_fs_fractures 0",
}
"""Each thing that makes the file fast, taken back."""
LOST = {
    "entries under 2 % of the diagonal left out": f"{MECHANICS}component_drop 0.02",
    "entries under 3 %": f"{MECHANICS}component_drop 0.03",
    "entries under 1 % left out for pressure": f"{BELOW}1_fs_drop 0.01",
    "fixed stress of fractures twice the algebraic value": f"{BELOW}1_fs_fractures 2",
    "two cycles": f"{AMG}max_iter 2",
    "two sweeps down and up": f"{AMG}grid_sweeps_all 2",
    "interpolation with 3 entries a row": f"{AMG}P_max 3",
    "with 6": f"{AMG}P_max 6",
    "a strong threshold of 0.1": f"{AMG}strong_threshold 0.1",
    "of 0.5": f"{AMG}strong_threshold 0.5",
    "Falgout's coarsening alone": f"{AMG}coarsen_type Falgout",
    "HMIS": f"{AMG}coarsen_type HMIS",
    "an aggressive level": f"{AMG}agg_nl 1",
    "Chebyshev relaxation": f"{AMG}relax_type_all Chebyshev",
    "relaxation in the order of rows": f"{AMG}no_CF",
    "full factors of the two outer Schur complements": (
        "-qr_pc_fieldsplit_schur_fact_type full -qr_fieldsplit_1_pc_fieldsplit_schur_fact_type full"
    ),
    "Gram-Schmidt without refinement": "-ksp_gmres_cgs_refinement_type refine_never",
    "components solved exactly": (
        f"{MECHANICS}component_pc_type lu {MECHANICS}component_pc_factor_mat_solver_type mumps "
        "-petsc_fs_allow_unused *component_pc_hypre*"
    ),
}
"""Changes that gain nothing, or not everywhere."""
FILES = (
    "contact_poromechanics",
    "contact_poromechanics_gamg",
    "contact_poromechanics_left",
    "contact_poromechanics_direct",
)
HOT = ("contact_thermoporomechanics", "contact_thermoporomechanics_cpr", "contact_thermoporomechanics_gamg")


TEXT = """\
# What was tried for the fast files

`contact_poromechanics_fast.opts` solves the systems of `contact_poromechanics.opts` in less time, see
[speed.md](speed.md), and so do `poromechanics_fast.opts`, `flow_fast.opts` and `contact_mechanics_fast.opts` for
fewer fields. What they gain on scenes of yours says

    petsc-fs compare SCENE... --base contact_poromechanics.opts --options contact_poromechanics_fast.opts --repeat 5

In the tables a row is a change of the default file, and a cell the iterations and the ratio of its seconds for set-up
and solve, of the processor, to those of the default in the same round, of {rounds} rounds the median; the heads have
the iterations of the default.

## What won

Each of these is taken back alone:

{won}

1. **One displacement component after the other** (`ComponentSweep`). Rows of elasticity are long in 3D, and most of
   their entries couple different components. Multigrids of the scalar blocks on the diagonal do without, and their
   coarse operators stay sparse. Block Gauss-Seidel multiplies with one triangle beside the diagonal, which gets most
   of the couplings back. PCFIELDSPLIT of type multiplicative does the same arithmetic, but stores the whole matrix
   once more, multiplies with more of it, and needs options for each component. No copy of the block of mechanics is
   made: its components are taken out of the blocks of J and handed to hypre in its own storage; where a rank has few
   rows of mechanics, messages cost more than copies, and they become one matrix each.
2. **A sparser hierarchy**: PMIS coarsening, extended+i interpolation of few entries a row, for pressure as well.
3. **One Gauss-Seidel sweep forward** instead of forward and backward: GMRES needs no symmetric preconditioner.
4. **A longer restart**: vectors are little beside the matrix in 3D.
5. **Cells along a space-filling curve** (`-petsc_fs_ordering`, by itself on large parts). Grid generators number
   cells almost at random, and where the vectors of a product do not fit into caches, each entry of a sparse matrix
   may wait for memory. Morton's curve needs nothing but centres of cells; recursive bisection and reverse
   Cuthill-McKee gain no more. The published file gains from it as well ([speed.md](speed.md)); the scenes above are
   too small for it.
6. **Multigrid without small entries** (`-component_drop`, `-fs_drop`), which are added to the diagonal. In 2D there
   are too few for the copy to pay; matrices that would keep more than half of their entries stay as they are.
7. **Fractures that open** (`-fs_fractures`). By the cubic law fractures conduct as the cube of their opening, which
   follows their pressure; the published coefficient of fixed stress leaves that out, and a multiple of the algebraic
   value, which is computed anyway, takes its place. The scenes above, without the cubic law, do not notice; runs by
   it take fewer iterations.

With heat, pressure and temperature come last. On `cold2.h5`, beside `contact_thermoporomechanics_fast.opts`:

{heat}

## What lost

{lost}

Other files:

{files}

- Couplings between components without small entries: left out, GMRES stalls on a scene in 2D; added to the coupling
  of the cell with itself, set-up costs what the solve gains.
- Ways around the systems on which multigrid amplifies what it should damp, as on networks of many fractures: rows of
  interfaces where sliding leaves entries larger than the diagonal, and components that are not positive. Other
  coarsening, interpolation, relaxation and damping, exact local solves on interfaces and a layer of cells, interface
  rows multiplied by the inverses of their diagonal blocks, mean and jump of displacements, axes along each fracture:
  each mends some scenes and spoils or slows others.
- A Galerkin correction on the range of the gradient of pressure, after the sweep or beside it: nothing.
- Single options for the coupled multigrid gain less than the list above; a sweep over such options
  ([sweep.md](sweep.md)) finds files that are for scenes like its own.
- Other storage for products with J, BAIJ or SELL: the conversion costs as much as all products of a solve gain.
- GAMG as it is for the components does not converge. With Gauss-Seidel for a smoother and thresholds it does; that is
  `contact_poromechanics_gamg.opts`, for a PETSc without hypre.
- A larger coarsest level, to save the messages of small levels: it is solved by dense elimination, which takes
  longer.
- With heat, equations of temperature divided by the width of fractures, as arXiv:2505.04247 does: as many iterations
  to a small residual, and then more for the last digits in every field.
- PCCOMPOSITE for two stages: in PETSc 3.18 it keeps the first matrix that it sees. Splits that overlap do the same.
- Hierarchies kept from matrix to matrix: contact changes in nearly every Newton step. Never built anew, some solve
  stagnates; built anew by rules, they gain nothing to rely on.

## What binds

- Gauss-Seidel, which cannot run ahead of its own results, moves the larger part of the bytes.
- In a product with a MatNest `VecGetSubVector` asks all ranks whether each part is contiguous, and makes a vector:
  most of the collectives, see [scaling](scaling.md).
- Reading a scene is for the most part decompression. Files with the filter `lzf` (`petsc_fs.io.hdf5.write(...,
  compression="lzf")`) are a little larger and are read faster.
"""


def make(place: Place) -> str:
    """Measure, and write the page."""
    changes = {words: f"{DEFAULT} {options}" for words, options in (WON | LOST).items()}
    files = {f"`{file}.opts`": f"{file}.opts" for file in FILES}
    found = place.measured(SCENES, [DEFAULT, *changes.values(), *files.values()], batch=True, may_fail=True)
    hot = {f"`{file}.opts`": f"{file}.opts" for file in HOT}
    hot["`-fs_heat energy`"] = f"{HEAT} {BELOW}1_fs_heat energy"
    found |= place.measured(["cold2.h5"], [HEAT, *hot.values()], batch=True, may_fail=True)

    def table(variants: dict[str, str], scenes: tuple[str, ...] = SCENES, base: str = DEFAULT) -> str:
        def cell(scene: str, variant: str) -> str:
            runs, others = found[scene, 1, variant], found[scene, 1, base]
            if any(r["kind"] != "converged" for r in runs):
                return ", ".join(sorted({r["kind"] for r in runs} - {"converged"})).replace("_", " ")
            ratios = [
                seconds_of(r, "cpu")["total"] / seconds_of(b, "cpu")["total"] for r, b in zip(runs, others, strict=True)
            ]
            return f"{runs[0]['iterations']}, {median(ratios):.2f}"

        heads = [f"{s}: {found[s, 1, base][0]['iterations']}" for s in scenes]
        rows = [[words, *(cell(scene, variant) for scene in scenes)] for words, variant in variants.items()]
        return "\n".join(markdown(["", *heads], rows, numbers=True))

    return TEXT.format(
        rounds=place.rounds,
        won=table({words: changes[words] for words in WON}),
        lost=table({words: changes[words] for words in LOST}),
        files=table(files),
        heat=table(hot, ("cold2.h5",), HEAT),
    )
