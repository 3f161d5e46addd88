"""Seconds, memory and iterations in unknowns and ranks, and a model of many ranks."""

import math
import re
from statistics import median

import numpy as np

from page import Place, draw, span, unknowns
from petsc_fs.tools.measure import grown, seconds_of
from petsc_fs.tools.pages import markdown

DEFAULT, DIRECT = "contact_poromechanics_fast.opts", "direct.opts"
INPUTS = (f"options/{DEFAULT}", f"options/{DIRECT}", "petsc_fs/tools/measure.py", "petsc_fs/tools/probe.py")
SCENES = {
    "2D": ("model1.h5", "model1_g10_t1_n1", "model1_g25_t1_n1"),
    "3D": ("model3.h5", "model3_g0.5_t1_n1", "model3_g1_t1_n2", "model3_g2_t1_n0"),
}
DIRECT_SCENES = ("model1.h5", "model1_g10_t1_n1", "model3.h5", "model3_g0.5_t1_n1")
"""Of a size that a direct solver factors in seconds."""
RANKS = (1, 2)
LARGE = 20_000
COUNTED = "model3_g2_t1_n0"
"""What the model is made of."""
MULTIGRIDS = "mechanics_component_", "1_fs_fieldsplit_mass_"
LATENCY, BANDWIDTH = 2e-6, 5e8
"""Of a message, in seconds, and of a rank, in bytes a second: round numbers of a large machine."""
MANY = tuple(4**k for k in range(10))
TABLE = (1, 64, 4096, 262144)
SHARE = 20_000
"""Unknowns of a rank, where the grid is refined with the number of ranks."""
EXCHANGES, NEIGHBOURS = 4, 26
"""Of a level of multigrid in a cycle: relaxation down and up, restriction, interpolation; ranks around a cube."""
TEXT = f"""\
# Scaling

Seconds of set-up and solve by `{DEFAULT}` grow as the power {{powers[default, 2D]}} of the number of
unknowns in 2D and {{powers[default, 3D]}} in 3D, with {{iterations[2D]}} and {{iterations[3D]}} iterations; those of
`{DIRECT}` as the power {{powers[direct solver, 2D]}} and {{powers[direct solver, 3D]}}. Two ranks take {{two}} times
the seconds of one, for scenes of more than {LARGE:,} unknowns.

![Seconds over unknowns, and milliseconds of an iteration over ranks by the model below](scaling.png)

Each solve ran in a process of its own, all in turns, in rounds (here {{rounds}}); numbers are medians, seconds by the
clock and of the slowest rank, memory what all ranks together grow by in set-up and solve.

"""
MODEL = f"""

## Many ranks: a model

An iteration on R ranks is taken to last

    W/R + E (m a + h (n/R)^(2/3) / b) + c a log2(R) + {EXCHANGES} L m a

with W seconds of work, n unknowns, E exchanges between neighbours, each of h bytes per unknown of a face, and c
collectives outside of multigrid, L levels of its hierarchies, m = min(R - 1, {NEIGHBOURS}) neighbours,
a = {LATENCY * 1e6:g} µs for a message and b = {BANDWIDTH / 1e6:g} MB/s of a rank, as of a large machine. Ranks that
wait and messages that overlap are left out: it says what binds first, not how long a run takes.

Measured on one rank, {{scene}}: n = {{n:,}}, W = {{work:.3g}} ms. Counted by PETSc on two ranks: E = {{E:.0f}},
h = {{h:.1f}}, c = {{c:.0f}}, most of them in products with a MatNest, where `VecGetSubVector` asks all ranks whether
each part is contiguous. Counted by hypre: L = {{L}}, in {{hierarchies}} hierarchies. Milliseconds of an iteration:

"""


def make(place: Place) -> str:
    """Measure, and write the page."""
    found = place.measured([*SCENES["2D"], *SCENES["3D"]], [DEFAULT], RANKS)
    found |= place.measured(DIRECT_SCENES, [DIRECT])
    sizes = {scene: unknowns(place.scene(scene)) for scene, _, _ in found}
    rows, curves, iterations, two = [], {}, {}, []
    for (scene, ranks, file), runs in found.items():
        n, dimension = sizes[scene], "2D" if scene in SCENES["2D"] else "3D"
        setup, solve, total = (median(seconds_of(r)[what] for r in runs) for what in ("setup", "solve", "total"))
        if ranks == 1:
            curves.setdefault(f"{'default' if file == DEFAULT else 'direct solver'}, {dimension}", []).append(
                (n, total)
            )
        if file == DEFAULT:
            iterations.setdefault(dimension, []).append(runs[0]["iterations"])
        if ranks == 2 and n > LARGE:
            one = found[scene, 1, file]
            two.append(median(seconds_of(b)["total"] / seconds_of(a)["total"] for a, b in zip(one, runs, strict=True)))
        about = [scene, f"{n:,}", "default" if file == DEFAULT else "direct", ranks, runs[0]["iterations"]]
        mib = median(map(grown, runs)) / 2**20
        rows.append([*about, f"{setup:.3g}", f"{solve:.3g}", f"{1e6 * total / n:.0f}", f"{mib:,.0f}"])
    one = found[COUNTED, 1, DEFAULT]
    work = median(seconds_of(r)["solve"] / r["iterations"] for r in one)
    parts, words = model(place, sizes[COUNTED], work)
    seconds = "seconds, set-up and solve"
    panels = {"set-up and solve, one rank": curves, f"an iteration, {sizes[COUNTED]:,} unknowns": parts}
    draw(place.docs / "scaling.png", panels, ("unknowns", "ranks"), (seconds, "milliseconds"))
    powers = {name: f"{np.polyfit(*np.log(points).T, 1)[0]:.2f}" for name, points in curves.items()}
    text = TEXT.format(
        powers=powers,
        iterations={d: f"{min(numbers)} to {max(numbers)}" for d, numbers in iterations.items()},
        two=span(two),
        rounds=place.rounds,
    )
    headings = ("scene", "unknowns", "file", "ranks", "iterations", "set-up, s", "solve, s", "µs per unknown", "MiB")
    return "\n".join([text, *markdown(headings, rows, numbers=True), words])


def model(place: Place, n: int, work: float) -> tuple[dict[str, list[tuple[float, float]]], str]:
    """Milliseconds of an iteration over ranks, by part, and what the page says of it."""
    log = place.scratch / "log"
    printed = [f"-qr_fieldsplit_1_fieldsplit_{name}pc_hypre_boomeramg_print_statistics" for name in MULTIGRIDS]
    call = ["mpiexec", "-n", "2", "petsc-fs", "solve", str(place.scene(COUNTED)), "-log_view", f":{log}"]
    said = place.run(*call, *(word for option in printed for word in (option, "1")))
    levels = [int(number) for number in re.findall(r"Num levels = (\d+)", said)]
    events = {words[0]: words for line in log.read_text(encoding="utf-8").splitlines() if (words := line.split())}
    messages, length, collectives = map(float, events["KSPSolve"][7:10])
    applied = int(events["PCApply"][1])
    E, c, h = messages / 2 / applied, collectives / applied, length / (n / 2) ** (2 / 3)

    def parts(ranks: int, size: float, seconds: float, depth: float) -> dict[str, float]:
        m = min(ranks - 1, NEIGHBOURS)
        return {
            "work": seconds / ranks,
            "exchanges": E * (m * LATENCY + (ranks > 1) * h * (size / ranks) ** (2 / 3) / BANDWIDTH),
            "collectives": c * LATENCY * math.log2(ranks),
            "multigrid's messages": EXCHANGES * depth * m * LATENCY,
        }

    fixed = {ranks: parts(ranks, n, work, sum(levels)) for ranks in MANY}
    refined = {
        ranks: parts(ranks, ranks * SHARE, work * ranks * SHARE / n, sum(levels) * math.log(ranks * SHARE, n))
        for ranks in MANY
    }
    rows = [[part, *(f"{1e3 * fixed[ranks][part]:.3g}" for ranks in TABLE)] for part in fixed[1]]
    rows.append([f"all, {n:,} unknowns", *(f"{1e3 * sum(fixed[ranks].values()):.3g}" for ranks in TABLE)])
    rows.append([f"all, {SHARE:,} a rank", *(f"{1e3 * sum(refined[ranks].values()):.3g}" for ranks in TABLE)])
    curves = {part: [(ranks, 1e3 * fixed[ranks][part]) for ranks in MANY if fixed[ranks][part]] for part in fixed[1]}
    words = MODEL.format(scene=COUNTED, n=n, work=1e3 * work, E=E, h=h, c=c, L=sum(levels), hierarchies=len(levels))
    return curves, "\n".join([words, *markdown(["ranks", *(f"{ranks:,}" for ranks in TABLE)], rows, numbers=True)])
