"""Seconds, memory and iterations of the file as published, beside those of the default file."""

from statistics import median

from page import Place, span, spread, unknowns
from petsc_fs.tools.measure import grown, seconds_of
from petsc_fs.tools.pages import markdown

PUBLISHED, DEFAULT = "contact_poromechanics.opts", "contact_poromechanics_fast.opts"
INPUTS = (f"options/{PUBLISHED}", f"options/{DEFAULT}", "petsc_fs/tools/measure.py", "petsc_fs/tools/probe.py")
NATURAL = f"{PUBLISHED} -petsc_fs_ordering natural"
SCENES = ("model1_g10_t1_n1", "model1_g25_t1_n1", "model2_g25_t1_n1", "model3_g1_t1_n2", "model3_g2_t1_n0")
RANKS = (1, 2)
NATURAL_SCENES = ("model1_g25_t1_n1", "model2_g25_t1_n1", "model3_g1_t1_n2")
NAMES = {DEFAULT: "default", PUBLISHED: "published", NATURAL: "published, natural order"}
HEADINGS = (
    *("scene", "unknowns", "ranks", "file", "iterations", "matrices, s", "set-up with them, s", "solve, s"),
    *("times the default", "without matrices", "MiB"),
)
TEXT = f"""\
# Speed beside the published configuration

Set-up and solve by `{PUBLISHED}`, the paper's practical algorithm as published, take {{all}} times as long as by
the default, `{DEFAULT}`: {{one}} times on one rank, {{two}} times on two. Without the building of
PETSc's matrices, which is the same for both, it is {{without}} times, and memory grows {{memory}} times as much.

Both get what petsc_fs does for any file: cells along a space-filling curve on large parts, rows of each field times a
power of two, and corrections until the verdict is that the solution is one, to the tolerance of the files, 1e-10. With
cells in the order of the grid (`-petsc_fs_ordering natural`), as in the published code, the published file takes
{{natural}} times as long as the default.

Each solve ran in a process of its own, all in turns, in rounds (here {{rounds}}); numbers are medians, and in brackets
stand the least and the greatest ratio of seconds of the same round. Seconds are by the clock and of the slowest rank.
Memory is what all ranks together grow by in set-up and solve, beside the scene.

"""


def make(place: Place) -> str:
    """Measure, and write the page."""
    rows = []
    times: dict[tuple[str, int], list[float]] = {}  # medians of the ratios of seconds, by file and ranks
    without, memory = [], []
    for scenes, files, ranks in ((SCENES, (DEFAULT, PUBLISHED), RANKS), (NATURAL_SCENES, (DEFAULT, NATURAL), (1,))):
        found = place.measured(scenes, files, ranks)
        for (scene, n, file), runs in found.items():
            mine, base = ([seconds_of(r) for r in found[scene, n, name]] for name in (file, DEFAULT))
            ratios = [m["total"] / b["total"] for m, b in zip(mine, base, strict=True)]
            bare = [(m["total"] - m["build"]) / (b["total"] - b["build"]) for m, b in zip(mine, base, strict=True)]
            times.setdefault((file, n), []).append(median(ratios))
            if file == PUBLISHED:
                without.append(median(bare))
                memory.append(median(map(grown, runs)) / median(map(grown, found[scene, n, DEFAULT])))
            phases = [f"{median(s[phase] for s in mine):.3g}" for phase in ("build", "setup", "solve")]
            ends = [spread(ratios), spread(bare), f"{median(map(grown, runs)) / 2**20:,.0f}"]
            about = [scene, f"{unknowns(place.scene(scene)):,}", n, NAMES[file], runs[0]["iterations"]]
            rows.append([*about, *phases, *ends])
    text = TEXT.format(
        all=span(times[PUBLISHED, 1] + times[PUBLISHED, 2]),
        one=span(times[PUBLISHED, 1]),
        two=span(times[PUBLISHED, 2]),
        natural=span(times[NATURAL, 1]),
        without=span(without),
        memory=span(memory),
        rounds=place.rounds,
    )
    return text + "\n".join(markdown(HEADINGS, rows, numbers=True))
