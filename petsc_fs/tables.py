"""Text that people read: tables of the command line, made with rich."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from petsc_fs.fields import FIELD
from petsc_fs.scene import Scene, contact_state_counts

WIDTH = 100
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
        ", ".join(f"{what} {report[key]:.3f} s" for what, key in PHASES),
    ]
    return "\n".join([_title(scene, report["scene"]), _text(table) + "\n".join(lines)])


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
