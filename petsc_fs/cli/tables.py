"""Text that people read: tables in plain characters, for 80 columns."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from petsc_fs import memory
from petsc_fs.fields import FIELD
from petsc_fs.scene import Scene, contact_state_counts

if TYPE_CHECKING:
    from petsc_fs.io.sequence import Contents

WIDTH = 80
RUN_PHASES = {
    "transfer": "transfer to and from PETSc",
    "setup": "set-up of the preconditioner",
    "solve": "Krylov method",
    "output": "output (files)",
    "other": "other (PorePy: residuals, line search)",
}
"""What the phases of a run are called in its table, where the name of the phase does not say it."""
PHASES = (("read", "read_seconds"), ("set-up", "setup_seconds"), ("solve", "solve_seconds"))


def table(headings: Sequence[str], rows: Iterable[Sequence[object]], left: str = "0") -> str:
    """Columns under headings, to the right but for those whose numbers are in `left`; an empty row is a rule."""
    texts = [[str(cell) for cell in row] for row in (headings, *rows)]
    used = [k for k in range(len(headings)) if any(row[k] for row in texts if row)]
    widths = {k: max(len(row[k]) for row in texts if row) for k in used}

    def line(row: Sequence[str]) -> str:
        cells = (row[k].ljust(widths[k]) if str(k) in left else row[k].rjust(widths[k]) for k in used)
        return "  ".join(cells).rstrip()

    rule = "-" * (sum(widths.values()) + 2 * len(used) - 2)
    return "\n".join([line(texts[0]), rule, *(line(row) if row else rule for row in texts[1:])])


def wrapped(lines: Iterable[str]) -> str:
    """Lines, each broken where it is too long, but not between a number and its unit."""
    kept = (re.sub(r"(\d) (?=[KMG]?i?B\b|s\b)", "\\1\xa0", line) for line in lines)
    filled = (textwrap.fill(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in kept)
    return "\n".join(filled).replace("\xa0", " ")


def solve_table(report: dict[str, Any]) -> str:
    """One table on a solve: fields, sizes, residuals and errors, and below the verdict and what it took."""
    residuals, backward, errors = (
        report.get(f"{name}_by_field") or {} for name in ("residual", "backward_error", "error")
    )
    estimates = {} if errors else report.get("estimated_error_by_field") or {}
    rows: list[Sequence[object]] = [
        (f, f"{n:,}", *(_number(found.get(f)) for found in (residuals, backward, errors or estimates)))
        for f, n in report["fields"].items()
    ]
    total = sum(report["fields"].values())
    rows += [(), ("all", f"{total:,}", _number(report["true_relative_residual"]), "", "")]
    headings = [
        "field",
        "unknowns",
        "residual",
        "backward error",
        "error" if errors else "error, estimated" if estimates else "",
    ]
    source = report["options_file"] or "the smallest solver for the scene"
    lines = [
        report["verdict"],
        f"{report['iterations']} iterations ({report['reason']}) by {source}{_on(report['ranks'])}",
        *report["left_out"],
        *report.get("notes", ()),
        _seconds(report),
        memory.text(report["memory_bytes"]),
    ]
    return "\n".join([wrapped([_title(report, report["scene"])]), "", table(headings, rows), "", wrapped(lines)])


def sequence_table(report: dict[str, Any]) -> str:
    """One row per step of a sequence that was solved, and below what all of it took."""
    records = report["steps"]
    rows = [
        (
            *(record[name] for name in ("step", "time_step_index", "newton_index")),
            f"{record['iterations']}{'' if record['converged'] else ' !'}",
            "" if record["iterations_in_run"] is None else record["iterations_in_run"],
            *(_number(record["true_relative_residual"]), f"{record['setup_seconds']:.3f}"),
            *(f"{record['solve_seconds']:.3f}", "/".join(map(str, record["contact_states"].values()))),
        )
        for record in records
    ]
    known = any(row[4] != "" for row in rows)
    contact = any(row[-1] for row in rows)
    headings = ["step", "time", "Newton", "Krylov", "in run" if known else "", "residual", "set-up s", "solve s"]
    missed = [record for record in records if not record["converged"]]
    source = report["options_file"] or "the smallest solver for the sequence"
    lines = [
        f"{len(records)} of {report['steps_in_sequence']} steps: "
        + (f"{len(missed)} NOT CONVERGED (!)" if missed else "all converged"),
        *(f"step {record['step']}: {record['verdict']}" for record in missed),
        f"{report['totals']['iterations']} iterations by {source}{_on(report['ranks'])}",
        *report["left_out"],
        _seconds(report["totals"]),
        memory.text(report["memory_bytes"]),
    ]
    body = table([*headings, "st./sl./open" if contact else ""], rows, left="")
    return "\n".join([wrapped([f"{report['sequence']}: {report['model']}"]), "", body, "", wrapped(lines)])


def run_table(summary: dict[str, Any]) -> str:
    """What a run of a model took, by phase."""
    seconds = summary["seconds"]
    rows: list[Sequence[object]] = []
    for name, value in seconds.items():
        share = f"{100 * value / (seconds['total'] or 1):.0f} %"
        rows += [*([()] if name == "total" else []), (RUN_PHASES.get(name, name), f"{value:.2f}", share)]
    newton, missed = summary["newton_steps"], summary["not_converged"]
    per_step = summary["iterations"] / (newton or 1)
    states = ", ".join(f"{n} {state}" for state, n in summary["contact_states"].items())
    cuts = f" ({summary['time_step_cuts']} cut)" if summary["time_step_cuts"] else ""
    lines = [
        f"{summary['time_steps']} time steps{cuts}, {newton} Newton steps, {summary['iterations']} Krylov iterations"
        f" ({per_step:.1f} per Newton step){_on(summary['ranks'])}",
        *([f"{missed} linear solves did NOT CONVERGE"] if missed else []),
        *([f"contact at the last Newton step: {states}"] if states else []),
        *summary["notes"],
        f"written to {summary['folder']}: {', '.join(summary['files'])}",
    ]
    unknowns = f" ({summary['unknowns']:,} unknowns)" if summary["unknowns"] else ""
    body = table(["phase", "seconds", "share"], rows)
    return "\n".join([f"{summary['model']}{unknowns}", "", body, "", wrapped(lines)])


def contents_table(name: str, contents: Contents) -> str:
    """The steps of a sequence."""
    rows = [
        (
            *(step.index, step.time_step_index, step.newton_index, f"{sum(step.sizes.values()):,}"),
            *(f"{step.entries:,}", step.run.get("iterations", ""), "/".join(map(str, step.contact_states.values()))),
        )
        for step in contents.steps
    ]
    headings = ["step", "time", "Newton", "unknowns", "entries", "Krylov in the run"]
    body = table([*headings, "st./sl./open" if any(row[-1] for row in rows) else ""], rows, left="")
    lines = [
        "fields: " + ", ".join(f"{field} {size:,}" for field, size in contents.steps[0].sizes.items()),
        *([] if contents.complete else ["incomplete: the run that wrote it was interrupted or failed"]),
        "petsc-fs inspect --step K shows one step",
    ]
    count = len(contents.steps)
    title = f"{name}: {contents.model or 'sequence'}, {count} step{'s' if count > 1 else ''}"
    return "\n".join([title, "", body, "", wrapped(lines)])


def scene_table(scene: Scene) -> str:
    """Fields, blocks with their magnitudes, contact states and what is known beside the matrix."""
    headings = ["field", "unknowns", "J_ij", "block", "|rhs|", "unknown", "equation"]
    rows = [
        (
            *(name, f"{scene.sizes[name]:,}", FIELD[name].index, scene.block_size(name)),
            *(f"{np.linalg.norm(scene.rhs[name]):.1e}", FIELD[name].unknown, FIELD[name].equation),
        )
        for name in scene.fields
    ]
    # unknowns and equations are too long for the width
    fields = [table(headings[:5], [row[:5] for row in rows]), *(f"{row[0]}: {row[5]}; {row[6]}" for row in rows)]
    blocks: list[tuple[str, ...]] = []
    for r in scene.fields:
        cells = [_block_text(scene, r, c) for c in scene.fields]
        blocks += [(r, *(entries for entries, _ in cells)), ("", *(sizes for _, sizes in cells))]
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
    about = {"dimension": scene.dimension} | vars(scene.metadata)
    matrix = table(["", *scene.fields], blocks)
    return "\n".join([wrapped([_title(about, "")]), "", *fields, "", heading, matrix, "", wrapped(lines)])


def _block_text(scene: Scene, r: str, c: str) -> tuple[str, str]:
    block = scene.blocks.get((r, c))
    if block is None or not block.data.size:
        return ".", ""
    sizes = np.abs(block.data)
    nonzero = sizes[sizes > 0]
    least = nonzero.min() if nonzero.size else 0.0
    return f"{block.data.size:,}", f"{least:.0e}..{sizes.max():.0e}"


def _title(about: dict[str, Any], name: str) -> str:
    step = f", time step {about['time_step_index']}, Newton step {about['newton_index']}"
    label = ": ".join(t for t in (name, about["model"] or "scene") if t)
    return f"{label} ({about['dimension']}D{step if about['time_step_index'] >= 0 else ''})"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2e}"


def _seconds(report: dict[str, Any]) -> str:
    return ", ".join(f"{what} {report[key]:.3f} s" for what, key in PHASES)


def _on(ranks: int) -> str:
    return f" on {ranks} rank{'s' if ranks > 1 else ''}"
