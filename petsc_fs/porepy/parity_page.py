"""The page on parity: Markdown from the results that `petsc_fs.porepy.parity` keeps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from petsc_fs import markdown
from petsc_fs.porepy.cases import CASES
from petsc_fs.porepy.parity import (
    RUNS,
    Agreement,
    History,
    Measured,
    Results,
    compare,
    mean_iterations,
    published,
    states_text,
)


def report(results: Results) -> str:
    """The page on parity, in Markdown; all its numbers come from the results."""
    origin, reference = published()
    own = {name: results["petsc_fs"][name] for name in RUNS if name in results["petsc_fs"]}
    rerun = {name: results["published_code"][name] for name in RUNS if name in results["published_code"]}
    models = {name: measured for name, measured in own.items() if not name.startswith("richardson")}
    richardson = {name: measured for name, measured in own.items() if name not in models}
    parts = [
        "# Parity with the published code",
        "<!-- Written by scripts/parity from parity.json; do not edit. -->",
        f'"Published" is: {origin}. "petsc_fs" is `petsc_fs.porepy.FieldSplitSolver` on one rank in '
        "PorePy models of the same set-up, with Newton running on its iterative solutions. Krylov iterations are "
        "PETSc's iteration number, which is one less than the length of the residual history that the published "
        "code keeps; means are over all linear solves of a run.",
        "## Models 1 to 3\n\n`options/contact_poromechanics.opts`: GMRES to a relative residual of 1e-10, "
        "multigrid and ILU(0).",
        _model_table(models, reference),
        "## Fixed-stress Richardson\n\nModel 1 at refinement 1 with restricted physics, "
        "`options/fixed_stress_richardson.opts`. K_n is the normal stiffness of the fracture, F its friction "
        "coefficient.",
        _model_table(richardson, reference),
    ]
    if rerun:
        parts += ["## The same linear systems", _same_systems_text(rerun), _same_systems_table(rerun)]
    parts += [
        "## Newton step by Newton step",
        (STEPS + (RERUN if rerun else "")).strip(),
        _steps_table(own, rerun, reference),
    ]
    differences = list(_first_differences(own, rerun, reference))
    if differences:
        parts.append("First difference of each run from the published one:\n\n" + "\n".join(differences))
    parts += ["## How it was run", _how(own, rerun)]
    return "\n\n".join(parts) + "\n"


def _model_table(runs: Mapping[str, Measured], reference: Mapping[str, History]) -> str:
    rows = []
    for name, measured in runs.items():
        ours, theirs = measured.history, reference[name]
        difference = mean_iterations(ours) - mean_iterations(theirs)
        rows.append(
            [
                _title(name),
                f"{measured.unknowns:,}",
                _newton(ours),
                _newton(theirs),
                f"{mean_iterations(ours):.2f}",
                f"{mean_iterations(theirs):.2f}",
                f"{difference:+.2f}",
                "yes" if abs(difference) <= RUNS[name].tolerance else "NO",
            ]
        )
    allowed = {RUNS[name].tolerance for name in runs}
    within = f"within {allowed.pop():g}" if len(allowed) == 1 else "within"
    headings = ["run", "unknowns", "Newton steps", "published", "mean Krylov", "published", "difference", within]
    return table(headings, rows)


def _title(name: str) -> str:
    parameters = RUNS[name].parameters
    if name.startswith("richardson"):
        return f"K_n = {parameters.normal_stiffness:g}, F = {parameters.friction:g}"
    return f"{RUNS[name].model}, refinement {parameters.refinement:g}"


def _newton(history: History) -> str:
    """Mean number of Newton steps a time step, and the number in each."""
    counts = [len(step) for step in history]
    return f"{np.mean(counts):.2f} ({' '.join(map(str, counts))})"


def _same_systems_text(rerun: Mapping[str, Measured]) -> str:
    solves = sum(len(step) for measured in rerun.values() for step in measured.again)
    differences = [d for measured in rerun.values() for d in _again_differences(measured)]
    equal = sum(d == 0 for d in differences)
    return (
        "The published code was run with its own PorePy, its own preconditioner and its own Newton iteration, and "
        "each of its linear systems was solved a second time by petsc_fs: the same matrix and right-hand side, so "
        f"nothing but the solver differs. Of {solves} systems {equal} took the same number of iterations, and "
        f"{sum(abs(d) <= 1 for d in differences)} differ by at most one; the largest difference is "
        f"{max(map(abs, differences))}."
    )


def _again_differences(measured: Measured) -> list[int]:
    """Iterations of petsc_fs minus those of the published code, system by system."""
    pairs = zip(measured.again, measured.history, strict=True)
    return [n - row[0] for again, step in pairs for n, row in zip(again, step, strict=True)]


def _same_systems_table(rerun: Mapping[str, Measured]) -> str:
    rows = []
    for name, measured in rerun.items():
        differences = _again_differences(measured)
        rows.append(
            [
                _title(name),
                str(len(differences)),
                f"{mean_iterations(measured.history):.2f}",
                f"{np.mean([n for step in measured.again for n in step]):.2f}",
                str(sum(d == 0 for d in differences)),
                str(max(map(abs, differences))),
            ]
        )
    headings = ["run", "systems", "published code", "petsc_fs", "equal counts", "largest difference"]
    return table(headings, rows)


STEPS = """\
Contact states are compared as numbers of sticking, sliding and open cells, Newton step by Newton step from the start
of each time step. "Starts" are the first Newton steps of the time steps, "later" the other ones that both runs have,
"ends" the last Newton steps of the time steps.

Starts say little: a cell that slid at the end of a time step sits on its friction bound, to within rounding and the
tolerance of Newton's iteration, so that whether it sticks or slides as the next time step begins is chance. Later
steps differ because the linear solutions do, within their tolerance, and with them a cell near the edge of a contact
state; from there on the two runs are at different iterates. petsc_fs parts company with itself in the same way where
it solves to another tolerance (`scripts/parity RUN -ksp_rtol 1e-12 --results FILE.json`).
"""

RERUN = """
The last columns compare with the published code run again, on the machine of this page, and that with the published
counts: the agreement to expect of a perfect copy.
"""


def _steps_table(own: Mapping[str, Measured], rerun: Mapping[str, Measured], reference: Mapping[str, History]) -> str:
    headings = ["run", "petsc_fs, published"]
    if rerun:
        headings += ["petsc_fs, rerun", "rerun, published"]
    rows = []
    for name, measured in own.items():
        row = [_title(name), _equal(compare(measured.history, reference[name]))]
        if name in rerun:
            row.append(_equal(compare(measured.history, rerun[name].history)))
            row.append(_equal(compare(rerun[name].history, reference[name])))
        rows.append(row + [""] * (len(headings) - len(row)))
    return table(headings, rows)


def _equal(agreement: Agreement) -> str:
    parts = {"starts": agreement.starts, "later": agreement.later, "ends": agreement.ends}
    return ", ".join(f"{label} {equal}/{total}" for label, (equal, total) in parts.items())


def _first_differences(
    own: Mapping[str, Measured], rerun: Mapping[str, Measured], reference: Mapping[str, History]
) -> Iterator[str]:
    for name, measured in own.items():
        found = compare(measured.history, reference[name])
        if found.first is None:
            yield f"- {_title(name)}: none, all contact states and Newton steps are equal."
            continue
        ours, theirs = (states_text(s) if s else "none (converged)" for s in found.first_states)
        text = (
            f"- {_title(name)}: time step {found.first[0]}, Newton step {found.first[1]}: {ours}; published: {theirs}"
        )
        if name in rerun:
            t, n = found.first
            step = rerun[name].history[t - 1]
            text += f"; published code run again: {states_text(step[n][1:]) if n < len(step) else 'none (converged)'}"
        yield text + "."


def _how(own: Mapping[str, Measured], rerun: Mapping[str, Measured]) -> str:
    lines = [
        "- `scripts/parity RUN...` makes the runs and adds their results to `docs/parity.json`; "
        "`scripts/parity --write docs/parity.md` writes this page from them.",
        "- `scripts/parity --published-code DIR RUN...` runs the published code in DIR with the PorePy that Python "
        "finds, and solves its systems again.",
        "- Set-up: " + "; ".join(f"{name}: {_loads(name)}" for name in ("model1", "model2", "model3")) + ".",
    ]
    for label, runs in (("petsc_fs", own), ("The published code", rerun)):
        for text in sorted({versions_text(m.versions) for m in runs.values()}):
            lines.append(f"- {label} ran with {text}, on one rank.")
    for label, runs in (("the runs of petsc_fs", own), ("the second solves of the published code's systems", rerun)):
        if runs:
            total = sum(len(step) for m in runs.values() for step in m.history)
            missed = sum(m.unconverged for m in runs.values())
            lines.append(f"- In {label}, {total - missed} of {total} solves met the tolerance in the true residual.")
    return "\n".join(lines)


def _loads(name: str) -> str:
    case = CASES[name]
    loads = f"{case.traction:g} Pa traction, {case.shear:g} Pa shear, {case.pressure_ratio:g} times the pressure east"
    return f"{loads}, {case.time_steps} steps of {case.time_step:g} s"


def versions_text(found: Mapping[str, str]) -> str:
    """Programs and their versions in words."""
    return ", ".join(f"{program} {version}" for program, version in found.items())


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    return "\n".join(markdown.table(headings, rows, numbers=True))
