"""Error against run time of the default file, the one as published, and a direct solver."""

from dataclasses import replace

from page import Place, draw, short
from petsc_fs.tools.compare import METHOD, SUMMARY, Comparison, fastest, points, summary
from petsc_fs.tools.pages import markdown

FILES = {
    "contact_poromechanics_fast": "default",
    "contact_poromechanics": "as published",
    "direct": "direct solver (MUMPS)",
}
INPUTS = (
    *(f"options/{file}.opts" for file in FILES),
    *(f"petsc_fs/tools/{module}.py" for module in ("compare", "measure", "probe", "reference")),
)
SCENES = ("model1.h5", "model2.h5", "model3.h5")
LARGE = "model3_g1_t1_n2"
"""On which the direct solver takes so long that it is measured in one round."""
SHOWN = ("model2", LARGE)
ACCURACY = 1e-6
TEXT = f"""\
# Error against run time

![Error over seconds of set-up and solve, in 2D and 3D, by three options files](comparison.png)

{{words}}

Seconds of set-up and solve to an error of at most {ACCURACY:.0e}, on one rank, at the tolerance that gets there first:

"""


def make(place: Place) -> str:
    """Measure by `petsc-fs compare`, draw, and write the page."""
    out = place.scratch / "comparison"
    runs = []
    for scenes, rounds in ((SCENES, place.rounds), ((LARGE,), 1)):
        call = ["petsc-fs", "compare", *(str(place.scene(name)) for name in scenes), "--options"]
        call += [*(f"{file}.opts" for file in FILES), "--rtol", "1e-2..1e-12:2", "--repeat", str(rounds)]
        place.run(*call, "--out", str(out))
        runs.append(Comparison.from_json((out / "compare.json").read_text(encoding="utf-8")))
    found = replace(runs[0], cases=runs[0].cases + runs[1].cases, records=runs[0].records + runs[1].records)
    measured = points(found)
    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    words, rows = [], []
    for case in found.cases:
        where = f"{case.dimension}D, {sum(case.sizes.values()):,} unknowns"
        mine = {file: [p for p in measured if (p.scene, p.file) == (case.label, file) and p.ended] for file in FILES}
        first = {file: fastest(run, ACCURACY, "total") for file, run in mine.items()}
        seconds = [f"{short(best.seconds)} s" if best else "no time that was seen" for best in first.values()]
        rows.append([case.label, where, *seconds])
        if case.label in SHOWN:
            curves[where] = {FILES[f]: [(p.seconds["total"].median, p.error) for p in run] for f, run in mine.items()}
            taken = ", ".join(f"{name} {s}" for name, s in zip(FILES.values(), seconds, strict=True))
            words.append(f"In {where}, an error of {ACCURACY:.0e} takes: {taken}.")
    draw(place.docs / "comparison.png", curves, ["seconds, set-up and solve"] * 2, ["error, all fields"] * 2)
    lines = [TEXT.format(words=" ".join(words)), *markdown(("scene", "", *FILES.values()), rows)]
    lines += ["", "## Fastest for which accuracy", "", *markdown(SUMMARY, summary(found, measured)), "", METHOD]
    return "\n".join(lines)
