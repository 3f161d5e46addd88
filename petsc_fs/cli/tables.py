"""Text that people read: tables of the command line, made with rich."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from petsc_fs import memory
from petsc_fs.fields import FIELD
from petsc_fs.scene import Scene, contact_state_counts
from petsc_fs.tools.contraction import FORMULAS, Contraction, summary

if TYPE_CHECKING:
    from petsc_fs.io.sequence import Contents

WIDTH = 100
RUN_PHASES = {
    "transfer": "transfer to and from PETSc",
    "setup": "set-up of the preconditioner",
    "solve": "Krylov method",
    "output": "output (files)",
    "other": "other (PorePy: residuals, line search)",
}
"""What the phases of a run are called in its table, where the name of the phase does not say it."""
PHASES = (("read", "read_seconds"), ("set-up", "setup_seconds"), ("solve", "solve_seconds"))


def solve_table(scene: Scene, report: dict[str, Any]) -> str:
    """One table on a solve: fields, sizes, residuals and errors, and below what it took."""
    errors = report["error_by_field"]
    table = Table()
    for heading in ("field", "unknowns", "true residual", *(["error"] if errors else [])):
        table.add_column(heading, justify="left" if heading == "field" else "right")
    for name, size in report["fields"].items():
        row = [name, f"{size:,}", f"{report['residual_by_field'][name]:.2e}"]
        table.add_row(*row, *([f"{errors[name]:.2e}"] if errors else []))
    table.add_section()
    total = [f"{sum(report['fields'].values()):,}", f"{report['true_relative_residual']:.2e}"]
    table.add_row("all", *total, *([""] if errors else []))
    verdict = "converged" if report["converged"] else "NOT CONVERGED"
    if report["limited_by_rounding"]:
        verdict += ", to the limit of rounding"
    lines = [
        f"{verdict}: true residual {report['true_relative_residual']:.2e}, tolerance {report['tolerance']:.2e}",
        f"{report['iterations']} iterations ({report['reason']}) by "
        f"{report['options_file'] or 'the smallest solver for the scene'}"
        f" on {report['ranks']} rank{'s' if report['ranks'] > 1 else ''}",
        *report["left_out"],
        *report.get("notes", ()),
        ", ".join(f"{what} {report[key]:.3f} s" for what, key in PHASES),
        memory.text(report["memory_bytes"]),
    ]
    return "\n".join([_title(scene, report["scene"]), _text(table) + "\n".join(lines)])


def run_table(summary: dict[str, Any]) -> str:
    """What a run of a model took, by phase."""
    seconds = summary["seconds"]
    table = Table()
    table.add_column("phase")
    table.add_column("seconds", justify="right")
    table.add_column("share", justify="right")
    for name, value in seconds.items():
        if name == "total":
            table.add_section()
        table.add_row(RUN_PHASES.get(name, name), f"{value:.2f}", f"{100 * value / (seconds['total'] or 1):.0f} %")
    newton, ranks, missed = summary["newton_steps"], summary["ranks"], summary["not_converged"]
    per_step = summary["iterations"] / (newton or 1)
    states = ", ".join(f"{n} {state}" for state, n in summary["contact_states"].items())
    lines = [
        f"{summary['time_steps']} time steps"
        + (f" ({summary['time_step_cuts']} cut)" if summary["time_step_cuts"] else "")
        + f", {newton} Newton steps, {summary['iterations']} Krylov iterations ({per_step:.1f} per Newton step)"
        + f" on {ranks} rank{'s' if ranks > 1 else ''}",
        *([f"{missed} linear solves did NOT CONVERGE"] if missed else []),
        *([f"contact at the last Newton step: {states}"] if states else []),
        *summary["notes"],
        f"written to {summary['folder']}: {', '.join(summary['files'])}",
    ]
    unknowns = f" ({summary['unknowns']:,} unknowns)" if summary["unknowns"] else ""
    return "\n".join([f"{summary['model']}{unknowns}", _text(table) + "\n".join(lines)])


def replay_table(report: dict[str, Any]) -> str:
    """One row per step of a replayed sequence, and below what all of it took."""
    records = report["steps"]
    known = any(record["iterations_in_run"] is not None for record in records)
    table = Table()
    numbers = ("step", "time", "Newton", "Krylov", *(["in run"] if known else []))
    for heading in (*numbers, "true residual", "set-up s", "solve s"):
        table.add_column(heading, justify="right")
    contact = any(record["contact_states"] for record in records)
    table.add_column("st./sl./open" if contact else "", justify="right")
    for record in records:
        in_run = record["iterations_in_run"]
        table.add_row(
            str(record["step"]),
            str(record["time_step_index"]),
            str(record["newton_index"]),
            str(record["iterations"]) + ("" if record["converged"] else " !"),
            *(["" if in_run is None else str(in_run)] if known else []),
            f"{record['true_relative_residual']:.2e}",
            f"{record['setup_seconds']:.3f}",
            f"{record['solve_seconds']:.3f}",
            "/".join(map(str, record["contact_states"].values())),
        )
    missed = sum(not record["converged"] for record in records)
    totals, ranks = report["totals"], report["ranks"]
    lines = [
        f"{len(records)} of {report['steps_in_sequence']} steps: "
        + (f"{missed} NOT CONVERGED (!)" if missed else "all converged"),
        f"{totals['iterations']} iterations by {report['options_file'] or 'the smallest solver for the sequence'}"
        f" on {ranks} rank{'s' if ranks > 1 else ''}",
        *report["left_out"],
        ", ".join(f"{what} {totals[key]:.3f} s" for what, key in PHASES),
    ]
    return "\n".join([f"{report['sequence']}: {report['model']}", _text(table) + "\n".join(lines)])


def sequence_table(name: str, contents: Contents) -> str:
    """The steps of a sequence."""
    table = Table()
    for heading in ("step", "time", "Newton", "unknowns", "entries", "Krylov in the run"):
        table.add_column(heading, justify="right")
    contact = any(step.contact_states for step in contents.steps)
    table.add_column("st./sl./open" if contact else "", justify="right")
    for step in contents.steps:
        table.add_row(
            str(step.index),
            str(step.time_step_index),
            str(step.newton_index),
            f"{sum(step.sizes.values()):,}",
            f"{step.entries:,}",
            str(step.run.get("iterations", "")),
            "/".join(map(str, step.contact_states.values())),
        )
    fields = ", ".join(f"{field} {size:,}" for field, size in contents.steps[0].sizes.items())
    lines = [
        f"fields: {fields}",
        *([] if contents.complete else ["incomplete: the run that wrote it was interrupted or failed"]),
        "petsc-fs inspect --step K shows one step",
    ]
    count = len(contents.steps)
    title = f"{name}: {contents.model or 'sequence'}, {count} step{'s' if count > 1 else ''}"
    return "\n".join([title, _text(table) + "\n".join(lines)])


def inspect_table(scene: Scene) -> str:
    """Fields, blocks with their magnitudes, contact states and what is known beside the matrix."""
    fields = Table()
    for heading in ("field", "J_ij", "unknowns", "block size", "unknown", "equation", "|rhs|"):
        fields.add_column(heading, justify="right" if heading in ("unknowns", "block size", "|rhs|") else "left")
    for name in scene.fields:
        field = FIELD[name]
        fields.add_row(
            name,
            str(field.index),
            f"{scene.sizes[name]:,}",
            str(scene.block_size(name)),
            field.unknown,
            field.equation,
            f"{np.linalg.norm(scene.rhs[name]):.1e}",
        )
    blocks = Table()
    blocks.add_column("")
    for name in scene.fields:
        blocks.add_column(name, justify="right")
    for r in scene.fields:
        blocks.add_row(r, *(_block_text(scene, r, c) for c in scene.fields))
    lines = []
    if scene.contact_state is not None:
        counts = contact_state_counts(scene.contact_state)
        lines.append("contact states: " + ", ".join(f"{n} {state}" for state, n in counts.items()))
    known = [
        f"cell centres ({', '.join(scene.cell_centers)})" if scene.cell_centers else "",
        f"cell volumes ({', '.join(scene.cell_volumes)})" if scene.cell_volumes else "",
        "material data" if scene.material is not None else "",
        "reference solution" if scene.reference else "",
    ]
    lines.append("known: " + (", ".join(k for k in known if k) or "nothing beside the matrix"))
    units = ", ".join(f"{k} = {v:g}" for k, v in scene.metadata.units.items() if v != 1)
    lines.append("unit scaling: " + (units or "SI"))
    producers = ", ".join(f"{k} {v}" for k, v in scene.metadata.producers.items())
    lines.append("made by: " + (producers or "unknown"))
    heading = "entries of each block, and the least and greatest |a_ij|; '.' is an empty block"
    return "\n".join([_title(scene, ""), _text(fields) + heading, _text(blocks) + "\n".join(lines)])


def contraction_table(found: Contraction) -> str:
    """The terms of the convergence condition, which of them dominates, and what the scene does not meet."""
    table = Table()
    for heading in ("term", "formula", "cells", "least", "median", "greatest", "at (m)", "in theorem"):
        table.add_column(heading, justify="left" if heading in ("term", "formula", "at (m)") else "right")
    for name, formula in FORMULAS.items():
        value = f"{found.theorem[name]:.1e}" if name in found.theorem else "not known"
        table.add_row(name, formula, *_spread(found.terms.get(name), found), value)
    lines = []
    if found.demand is not None:
        lines.append(f"sum of the terms: {found.demand:.2e} Pa/m")
    if found.stiffness is not None:
        lines.append("4 G D: between {:.2e} and {:.2e} Pa/m".format(*found.stiffness))
    lines.append(f"condition: {found.verdict}" + (f"; {found.dominant} dominates" if found.dominant else ""))
    if found.rate is not None:
        lines.append(f"where it holds, every iteration reduces the error at least by the factor {found.rate:.3f}")
    heading = "convergence condition of fixed stress: 4 G D ≥ sum of the terms, in Pa/m"
    parts = [heading, _text(table) + "\n".join(lines)]
    if found.slip.size:
        violations = Table()
        for heading in ("", "cells", "least", "median", "greatest", "at (m)"):
            violations.add_column(heading, justify="left" if heading in ("", "at (m)") else "right")
        for heading, values in (
            ("slip of sticking cells, m", found.slip),
            ("c slip / friction bound", found.slip_over_bound),
            ("Coulomb mismatch ε of sliding cells, Pa", found.mismatch),
            ("ε / |y|", found.mismatch_over_trial),
        ):
            violations.add_row(heading, *_spread(values, found))
        parts += ["against its assumptions", _text(violations).rstrip("\n")]
    return "\n".join([*parts, *(f"- {note}" for note in found.notes)])


def _spread(values: NDArray[np.float64] | None, found: Contraction) -> tuple[str, ...]:
    """Number of cells that have a value, least, median and greatest, and the place of the greatest."""
    numbers = None if values is None else summary(values)
    if values is None or numbers is None:
        return ("0", "", "", "", "")
    *sizes, cell = numbers
    at = "" if found.centers is None else ", ".join(f"{x:.0f}" for x in found.centers[cell])
    return (str(np.count_nonzero(~np.isnan(values))), *(f"{x + 0.0:.1e}" for x in sizes), at)


def _block_text(scene: Scene, r: str, c: str) -> str:
    block = scene.blocks.get((r, c))
    if block is None or not block.data.size:
        return "."
    sizes = np.abs(block.data)
    nonzero = sizes[sizes > 0]
    least = nonzero.min() if nonzero.size else 0.0
    return f"{block.data.size:,}\n{least:.0e} .. {sizes.max():.0e}"


def _title(scene: Scene, name: str) -> str:
    meta = scene.metadata
    step = f", time step {meta.time_step_index}, Newton step {meta.newton_index}" if meta.time_step_index >= 0 else ""
    label = ": ".join(t for t in (name, meta.model or "scene") if t)
    return f"{label} ({scene.dimension}D{step})"


def _text(table: Table) -> str:
    console = Console(file=io.StringIO(), width=WIDTH, color_system=None)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]
