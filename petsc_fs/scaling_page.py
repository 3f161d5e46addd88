"""Page on strong scaling: what was measured, and what the model makes of it on many ranks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from petsc_fs import scaling_model as model
from petsc_fs.errors import UsageError
from petsc_fs.files import write_text
from petsc_fs.scaling import (
    Case,
    Progress,
    Run,
    Settings,
    by_case,
    measure,
    median,
    read_hierarchies,
    solve,
    write_csv,
)
from petsc_fs.scaling_plot import plot

STATISTICS = "pc_hypre_boomeramg_print_statistics"
LEAVES = ("fieldsplit_1_fieldsplit_mechanics_", "fieldsplit_1_fieldsplit_1_fs_fieldsplit_mass_")
"""Multigrids of the canonical tree, in the order in which they are set up, below -qr_."""

MANY = (1, 1_000, 100_000)
PER_RANK = 20_000
"""Unknowns per rank of the second table of the model."""


def hierarchies(case: Case, settings: Settings) -> tuple[model.Hierarchy, model.Hierarchy]:
    """Levels of the multigrids of mechanics and of mass, as hypre prints them at set-up, on one rank.

    Raises:
        UsageError: the run failed, or the options file has not these two multigrids.
    """
    options = [word for leaf in LEAVES for word in (f"-qr_{leaf}{STATISTICS}", "1")]
    alone = Case(case.scene, case.options_file, 1)
    outcome, printed = solve(alone, settings, [*options, "-ksp_max_it", "1"])
    found = read_hierarchies(printed)
    if outcome or len(found) != len(LEAVES):
        raise UsageError(f"{alone}: expected two multigrids, found {len(found)} {outcome}".rstrip())
    from petsc_fs import cli, hdf5

    dimension = hdf5.read_sizes(cli.find_scene(case.scene))[0]
    mechanics, mass = ([model.Level(*level) for level in levels] for levels in found)
    return model.Hierarchy(mechanics, dimension, dimension), model.Hierarchy(mass, 1, dimension)


def profile(runs: Sequence[Run], mechanics: model.Hierarchy, mass: model.Hierarchy) -> model.Profile:
    """What the model needs to know, from runs of one scene, options file and partition on one rank and more.

    Work is that of one rank, in seconds of the processor. Messages, exchanges and collectives are those on the
    most ranks; the halo is what a rank sends there in one exchange.

    Raises:
        UsageError: a run on one rank, or one on several, is missing.
    """
    alone = [run for run in runs if run.ranks == 1 and run.outcome == "ok"]
    most = max((run.ranks for run in runs if run.outcome == "ok"), default=1)
    several = [run for run in runs if run.ranks == most and run.outcome == "ok"]
    if not alone or most == 1:
        raise UsageError("the model needs runs on one rank and on more")
    one, many = _typical(alone), _typical(several)
    preconditioner, vectors = one.preconditioner_seconds, one.krylov_seconds
    seconds = {
        model.VECTORS: vectors,
        model.PRODUCTS: max(0.0, one.solve_seconds - preconditioner - vectors),
        model.MECHANICS: one.mechanics_seconds,
        model.MASS: max(0.0, preconditioner - one.mechanics_seconds),
    }
    dimension, exchanges = one.dimension, many.exchanges or 1
    surface = (many.unknowns / most) ** ((dimension - 1) / dimension)
    return model.Profile(
        dimension=dimension,
        unknowns=one.unknowns,
        small=one.small_unknowns,
        seconds={part: min(1.0, one.processor_share) * value / one.iterations for part, value in seconds.items()},
        vector_reductions=many.krylov_reductions / many.iterations,
        other_reductions=(many.reductions - many.krylov_reductions) / many.iterations,
        exchanges=exchanges / many.iterations,
        halo=many.message_bytes / most / exchanges / surface,
        mechanics=mechanics,
        mass=mass,
    )


def _typical(runs: Sequence[Run]) -> Run:
    """The run with the median solve."""
    middle = median(runs, "solve_seconds")
    return next(run for run in runs if run.solve_seconds == middle)


def measured_table(runs: Sequence[Run]) -> list[str]:
    """Medians of the repetitions of each case, in Markdown."""
    lines = [
        "| scene | unknowns | options | partition | ranks | iterations | set-up s | solve s | bytes per unknown "
        "| peak of all ranks | messages | sent | collectives | processor share |",
        f"{'|---' * 14}|",
    ]
    for (scene, file, partition, ranks), same in by_case(runs).items():
        start = [Path(scene).stem, "", Path(file).stem or "smallest", partition if ranks > 1 else "", str(ranks)]
        worked = [run for run in same if run.outcome == "ok"]
        if not worked:
            lines.append(f"| {' | '.join([*start, same[0].outcome, *[''] * 8])} |")
            continue
        start[1] = f"{worked[0].unknowns:,}"
        values = [
            f"{median(worked, 'iterations'):.0f}" + ("" if all(run.converged for run in worked) else " (not met)"),
            f"{median(worked, 'setup_seconds'):.2f}",
            f"{median(worked, 'solve_seconds'):.2f}",
            f"{median(worked, 'bytes_per_unknown'):,.0f}",
            _size(median(worked, "peak_bytes")),
            f"{median(worked, 'messages'):,.0f}",
            _size(median(worked, "message_bytes")),
            f"{median(worked, 'reductions'):,.0f}",
            f"{100 * median(worked, 'processor_share'):.0f} %",
        ]
        lines.append(f"| {' | '.join([*start, *values])} |")
    return lines


def model_table(measured: model.Profile, machine: model.Machine, unknowns_per_rank: float | None = None) -> list[str]:
    """Milliseconds of one iteration by part of the tree on `MANY` ranks, in Markdown.

    Args:
        measured: see `profile`.
        machine: computed for.
        unknowns_per_rank: the mesh is refined to that many; None for the measured mesh.
    """
    columns = []
    for ranks in MANY:
        factor = 1.0 if unknowns_per_rank is None else unknowns_per_rank * ranks / measured.unknowns
        columns.append(model.predict(model.grown(measured, factor), machine, ranks))
    lines = [f"| part | {' | '.join(f'{n:,} rank' + 's' * (n > 1) for n in MANY)} |", "|---" * (len(MANY) + 1) + "|"]
    for part in columns[0]:
        lines.append(f"| {part} | {' | '.join(_milliseconds(costs[part]) for costs in columns)} |")
    lines.append(f"| **all** | {' | '.join(_milliseconds(model.total(costs)) for costs in columns)} |")
    return lines


def _milliseconds(cost: model.Cost) -> str:
    return f"{1e3 * cost.total:.3g} ({1e3 * cost.work:.3g} work)"


def _size(size: float) -> str:
    from petsc_fs.memory import in_units

    return in_units(size)


def write(
    runs: Sequence[Run], measured: tuple[str, model.Profile] | None, machine: model.Machine, target: Path, picture: str
) -> None:
    """Write the page.

    Args:
        runs: from `petsc_fs.scaling.measure`.
        measured: case that the model starts from, and its profile; None for a page without the model.
        machine: that the model computes for.
        target: page to write, in Markdown.
        picture: path of the picture as seen from there.

    Raises:
        UsageError: the file cannot be written.
    """
    lines = [
        "# Strong scaling",
        "",
        "Written by `scripts/scaling`. Each row is the median of its repetitions, each of which ran in processes of",
        "its own; cases took turns. Bytes per unknown are resident memory less that of interpreter and libraries.",
        "Messages, bytes and collectives are those of the solve as PETSc's log counts them, without what hypre sends",
        "within its cycles. The share of the processor is that which each rank got; where it is well below 100 %,",
        "seconds say little.",
        "",
        *measured_table(runs),
        "",
        f"![Seconds, iterations, memory and messages over ranks]({picture})",
        "",
    ]
    if measured is not None:
        lines += _model_section(*measured, machine)
    write_text(target, "\n".join(lines))


def _model_section(case: str, measured: model.Profile, machine: model.Machine) -> list[str]:
    """What the model says, with the numbers that went in."""
    levels = [(name, h.levels) for name, h in (("mechanics", measured.mechanics), ("mass", measured.mass))]
    complexity = "; ".join(
        f"{name} {len(v)} levels with {', '.join(f'{level.rows:,.0f}' for level in v)} rows, operator complexity "
        f"{sum(level.entries for level in v) / v[0].entries:.2f}"
        for name, v in levels
    )
    per_rank = PER_RANK * MANY[-1] / measured.unknowns
    return [
        "## On a thousand and a hundred thousand ranks: a model",
        "",
        f"From {case}. `petsc_fs.scaling_model` has the formulas.",
        "",
        "Measured on one rank, in microseconds of the processor per unknown and iteration: "
        + ", ".join(f"{part} {1e6 * s / measured.unknowns:.2f}" for part, s in measured.seconds.items())
        + ".",
        f"Measured on the most ranks, per iteration: {measured.vector_reductions:.1f} collectives for dot products, "
        f"{measured.other_reductions:.1f} others",
        "(in a product with a MatNest `VecGetSubVector` asks all ranks whether each part is contiguous), and "
        f"{measured.exchanges:.1f} exchanges,",
        "in each of which a rank with n unknowns sends "
        f"{measured.halo:.1f} n^({measured.dimension - 1}/{measured.dimension}) bytes.",
        f"Multigrid: {complexity}.",
        f"The machine: latency {machine.latency * 1e6:g} µs, {machine.bandwidth / 1e6:g} MB/s per rank, "
        "cores as fast as the one measured on.",
        "",
        f"Milliseconds per iteration, the same scene ({measured.unknowns:,.0f} unknowns):",
        "",
        *model_table(measured, machine),
        "",
        f"Milliseconds per iteration, the mesh refined to {PER_RANK:,} unknowns per rank:",
        "",
        *model_table(measured, machine, PER_RANK),
        "",
        "What a part takes beyond its share of perfectly divided work exceeds all such work from",
        "",
        *_limits(measured, machine, "the same scene"),
        *_limits(model.grown(measured, per_rank), machine, f"a mesh of {measured.unknowns * per_rank:,.0f} unknowns"),
        "",
        *_levels(model.grown(measured, per_rank), machine),
        "",
    ]


def _limits(measured: model.Profile, machine: model.Machine, what: str) -> list[str]:
    found = [
        f"{part} at {ranks:,} ranks (most of it {model.predict(measured, machine, ranks)[part].heaviest})"
        for part, ranks in model.limits(measured, machine)
    ]
    return [f"- {what}: {'; '.join(found) or 'nothing up to 16 million ranks'}."]


def _levels(measured: model.Profile, machine: model.Machine) -> list[str]:
    """Which levels of the multigrid of mechanics take the time."""
    ranks = MANY[-1]
    slowest = model.slowest_levels(measured, machine, ranks)[:3]
    rows = measured.mechanics.levels
    text = ", ".join(f"level {k} with {rows[k].rows:,.0f} rows {1e3 * seconds:.2f} ms" for k, seconds in slowest)
    return [f"On {ranks:,} ranks with {PER_RANK:,} unknowns each the slowest levels of mechanics are {text}."]


def study(
    chosen: Sequence[Case],
    settings: Settings,
    repetitions: int,
    *,
    machine: model.Machine,
    out: Path,
    progress: Progress,
) -> bool:
    """Measure cases; write a table, a picture and a page, whose model starts from the last case.

    Args:
        chosen: see `petsc_fs.scaling.cases`.
        settings: how they are run.
        repetitions: of each case.
        machine: that the model computes for.
        out: path of the three files without suffix.
        progress: called with a line for each run.

    Returns:
        Whether every run worked.

    Raises:
        UsageError: a file cannot be written, or the model lacks a run.
    """
    runs = measure(chosen, settings, repetitions, progress)
    write_csv(runs, out.with_suffix(".csv"))
    picture = plot(runs, out.with_suffix(".png"))
    last = chosen[-1]
    measured = None
    if last.ranks > 1:
        scene = Path(last.scene).name
        base = [
            run
            for run in runs
            if (run.scene, run.options_file) == (scene, last.options_file)
            and (run.ranks == 1 or run.partition == last.partition)
        ]
        measured = (str(last), profile(base, *hierarchies(last, settings)))
    write(runs, measured, machine, out.with_suffix(".md"), picture.name)
    return all(run.outcome == "ok" for run in runs)
