"""Iterations and residuals of every options file on every bundled scene it claims, as a page."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from petsc_fs import hdf5, options
from petsc_fs.files import write_text

SCENES = Path(__file__).parent / "scenes"
CONTIGUOUS = "contiguous"


def survey(target: Path, ranks: Sequence[int], mpiexec: Path, progress: Callable[[str], None]) -> None:
    """Run `solve` for each pair, each in its own process, and write a Markdown table.

    Args:
        target: page to write.
        ranks: numbers of ranks; on more than one both with the partition that `solve` chooses and without any.
        mpiexec: program that starts ranks.
        progress: called with a line for each pair.
    """
    runs = [(n, "auto") for n in ranks] + [(n, CONTIGUOUS) for n in ranks if n > 1]
    rows = []
    for scene in sorted(SCENES.glob("*.h5")):
        for file in options.shipped():
            if not file.fits(hdf5.read_sizes(scene)[1]) or scene.stem in file.not_for:
                continue
            reports = [_solve(scene, file.path, n, kind, mpiexec) for n, kind in runs]
            progress(f"{scene.stem} {file.path.stem}: {[r['iterations'] for r in reports]}")
            rows.append((scene, file, reports))
    headings = ["scene", "unknowns", "options file"]
    headings += [f"{n} rank{'s' if n > 1 else ''}{f', {kind}' if kind == CONTIGUOUS else ''}" for n, kind in runs]
    lines = [
        "# Iterations on the bundled scenes",
        "",
        "Every shipped options file on every bundled scene that it is for, written by `scripts/iterations`. On several",
        "ranks cells are partitioned as `solve` does it without further options (`-petsc_fs_partition auto`: recursive",
        "coordinate bisection of the rock, everything else beside it), or, in the last columns, each field is cut into",
        "contiguous chunks of the file. The true residual is that of the untransformed system, relative to the",
        "right-hand side, and the largest of the row; ¹ marks solves that end at the limit of rounding, ² those that",
        "met the absolute tolerance of the published runs (1e-15).",
        "",
        f"| {' | '.join([*headings, 'true residual'])} |",
        f"|{'---|' * (len(headings) + 1)}",
    ]
    for scene, file, reports in rows:
        cells = [scene.stem, f"{sum(reports[0]['fields'].values()):,}", f"`{file.path.name}`"]
        cells += [str(report["iterations"]) for report in reports]
        worst = max(reports, key=lambda report: report["true_relative_residual"])
        residual = f"{worst['true_relative_residual']:.1e}"
        mark = "¹" if worst["limited_by_rounding"] else "²" if "ATOL" in worst["reason"] else ""
        lines.append(f"| {' | '.join([*cells, residual + mark])} |")
    versions = rows[0][2][0]["versions"]
    lines += ["", f"PETSc {versions['petsc']}, petsc_fs {versions['petsc_fs']}."]
    write_text(target, "\n".join(lines) + "\n")


def _solve(scene: Path, file: Path, ranks: int, kind: str, mpiexec: Path) -> dict[str, Any]:
    """Report of one solve in its own process."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [str(mpiexec), "-n", str(ranks), sys.executable, "-m", "petsc_fs", "solve", str(scene)]
        command += ["-options_file", str(file), "-petsc_fs_partition", kind, "--report", str(report)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr}")
        result: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
        return result
