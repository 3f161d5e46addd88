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


def survey(target: Path, ranks: Sequence[int], mpiexec: Path, progress: Callable[[str], None]) -> None:
    """Run `solve` for each pair, each in its own process, and write a Markdown table.

    Args:
        target: page to write.
        ranks: numbers of ranks.
        mpiexec: program that starts ranks.
        progress: called with a line for each solve.
    """
    rows = []
    for scene in sorted(SCENES.glob("*.h5")):
        for file in options.shipped():
            if not file.fits(hdf5.read_sizes(scene)[1]) or scene.stem in file.not_for:
                continue
            reports = [_solve(scene, file.path, n, mpiexec) for n in ranks]
            progress(f"{scene.stem} {file.path.stem}: {[r['iterations'] for r in reports]}")
            rows.append((scene, file, reports))
    headings = ["scene", "unknowns", "options file"]
    headings += [f"{what}, {n} rank{'s' if n > 1 else ''}" for n in ranks for what in ("iterations", "true residual")]
    lines = [
        "# Iterations on the bundled scenes",
        "",
        "Every shipped options file on every bundled scene that it is for, written by `scripts/iterations`. The true",
        "residual is that of the untransformed system, relative to the right-hand side; ¹ marks solves that",
        "end at the limit of rounding, ² those that met the absolute tolerance of the published runs (1e-15).",
        "",
        f"| {' | '.join(headings)} |",
        f"|{'---|' * len(headings)}",
    ]
    for scene, file, reports in rows:
        cells = [scene.stem, f"{sum(reports[0]['fields'].values()):,}", f"`{file.path.name}`"]
        for report in reports:
            mark = "¹" if report["limited_by_rounding"] else "²" if "ATOL" in report["reason"] else ""
            cells += [str(report["iterations"]), f"{report['true_relative_residual']:.1e}{mark}"]
        lines.append(f"| {' | '.join(cells)} |")
    versions = rows[0][2][0]["versions"]
    lines += ["", f"PETSc {versions['petsc']}, petsc_fs {versions['petsc_fs']}."]
    write_text(target, "\n".join(lines) + "\n")


def _solve(scene: Path, file: Path, ranks: int, mpiexec: Path) -> dict[str, Any]:
    """Report of one solve in its own process."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [str(mpiexec), "-n", str(ranks), sys.executable, "-m", "petsc_fs", "solve", str(scene)]
        command += ["-options_file", str(file), "--report", str(report)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr}")
        result: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))
        return result
