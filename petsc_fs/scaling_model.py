"""What an iteration costs on many ranks: a model of work, surfaces, messages and collectives.

The time of one iteration is the sum over the parts of the solver tree, each of which takes on R ranks

    T(R) = W / A + m a + v / b + c a ceil(log2 R)

with W the measured seconds of the part on one rank, A the ranks that have work in it, m the messages that
a rank sends one after the other, v the bytes it sends, c the collectives, a the latency of a message and b
the bandwidth of a rank. Ranks are taken to be cubes of equal numbers of cells, messages of one exchange to
be sent one by one, and nothing to overlap; a real machine differs from each of these. So the model says
which part limits first and at about how many ranks, not how long a run takes to ten per cent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

NUMBER = 8
"""Bytes of a number."""

CYCLE_EXCHANGES = 5
"""Halo exchanges of a V-cycle on each level: smoothing down, residual, restriction, interpolation, smoothing up."""

VECTORS, PRODUCTS, MECHANICS, MASS, SMALL = (
    "GMRES vectors",
    "products with J and with the off-diagonal blocks",
    "multigrid of mechanics",
    "multigrid of mass",
    "contact and interface flow",
)


@dataclass(frozen=True)
class Machine:
    """A parallel computer, in round numbers of today's.

    Attributes:
        latency: a, seconds for a short message.
        bandwidth: b, bytes per second that one rank sends; the ranks of a node share its network.
        speed: of a core, as a multiple of the one measured on.
    """

    latency: float = 2e-6
    bandwidth: float = 5e8
    speed: float = 1.0


@dataclass(frozen=True)
class Level:
    """A level of a multigrid hierarchy: rows of its matrix and their entries."""

    rows: float
    entries: float


@dataclass(frozen=True)
class Hierarchy:
    """Levels of a multigrid, finest first.

    Attributes:
        levels: see `Level`.
        block: unknowns of a cell.
        dimension: D of the mesh.
    """

    levels: Sequence[Level]
    block: int
    dimension: int


@dataclass(frozen=True)
class Profile:
    """What has been measured of one scene and options file.

    Attributes:
        dimension: D of the rock.
        unknowns: of the system.
        small: of these, on fractures and their walls.
        seconds: of one iteration on one rank: of the GMRES vectors, of the products, of the solves with
            mechanics and contact, and of all else.
        vector_reductions: collectives of one iteration for dot products and norms.
        other_reductions: all others that PETSc's log counts in one iteration.
        exchanges: halo exchanges of one iteration outside of multigrid.
        halo: bytes a rank sends in one exchange, over the number of unknowns per rank to the power (D - 1) / D.
        mechanics: multigrid of mechanics.
        mass: multigrid of mass.
    """

    dimension: int
    unknowns: float
    small: float
    seconds: Mapping[str, float]
    vector_reductions: float
    other_reductions: float
    exchanges: float
    halo: float
    mechanics: Hierarchy
    mass: Hierarchy


@dataclass(frozen=True)
class Cost:
    """Seconds that a part of the tree takes in one iteration."""

    work: float
    latency: float = 0.0
    volume: float = 0.0
    collectives: float = 0.0

    @property
    def communication(self) -> float:
        """Seconds that are no work."""
        return self.latency + self.volume + self.collectives

    @property
    def heaviest(self) -> str:
        """Kind of the largest overhead; ranks without work where there is no communication."""
        kinds = {"latency": self.latency, "volume": self.volume, "collectives": self.collectives}
        return max(kinds, key=lambda kind: kinds[kind]) if self.communication else "ranks without work"

    @property
    def total(self) -> float:
        """Seconds in all."""
        return self.work + self.communication

    def __add__(self, other: Cost) -> Cost:
        """Sum, kind by kind."""
        return Cost(
            self.work + other.work,
            self.latency + other.latency,
            self.volume + other.volume,
            self.collectives + other.collectives,
        )


def predict(profile: Profile, machine: Machine, ranks: int) -> dict[str, Cost]:
    """Seconds of one iteration by part of the solver tree.

    - GMRES vectors: W / R and the measured dot products, each a collective;
    - products: W / R, the measured number of exchanges with all `neighbours` and the halo of a cube, and
      the collectives beside the dot products, which PETSc's MatNest asks for in each product;
    - multigrid of mechanics and of mass: see `cycle`;
    - contact and interface flow: the small fields live on a surface, whose cells only R^((D-1)/D) ranks own:
      W / R^((D-1)/D), with W their share of the unknowns in the seconds of all. Their messages are among those
      of the products.

    The seconds of mechanics and contact and those of all else, which are measured together, are told apart by
    unknowns.

    Args:
        profile: measured.
        machine: computed for.
        ranks: R.
    """
    d = profile.dimension
    seconds = {part: value / machine.speed for part, value in profile.seconds.items()}
    small = sum(seconds.values()) * profile.small / profile.unknowns
    multigrid = seconds[MECHANICS] + seconds[MASS]
    share = 1 - min(1.0, small / multigrid) if multigrid else 0.0
    active = min(ranks, int(profile.unknowns))
    per_rank = profile.unknowns / active
    sends = neighbours(active, 1.0, per_rank, d) * profile.exchanges
    bytes_sent = profile.halo * per_rank ** ((d - 1) / d) * profile.exchanges if ranks > 1 else 0.0
    return {
        VECTORS: Cost(
            seconds[VECTORS] / active, collectives=profile.vector_reductions * collective(machine.latency, ranks)
        ),
        PRODUCTS: Cost(
            seconds[PRODUCTS] / active,
            sends * machine.latency,
            bytes_sent / machine.bandwidth,
            profile.other_reductions * collective(machine.latency, ranks),
        ),
        MECHANICS: cycle(profile.mechanics, share * seconds[MECHANICS], machine, ranks),
        MASS: cycle(profile.mass, share * seconds[MASS], machine, ranks),
        SMALL: Cost((1 - share) * multigrid / ranks ** ((d - 1) / d)),
    }


def cycle(multigrid: Hierarchy, seconds: float, machine: Machine, ranks: int) -> Cost:
    """One V-cycle: the sum of its levels, and on the coarsest one a collective that gathers it everywhere.

    A level with n rows and z entries of the Z of all levels takes W z / (Z min(R, n / block)) of work and
    `CYCLE_EXCHANGES` exchanges, each with the ranks and the volume that the stencil of z / n entries reaches,
    see `neighbours` and `halo`.

    Args:
        multigrid: its levels.
        seconds: W, of one cycle on one rank.
        machine: computed for.
        ranks: R.
    """
    return sum((level_cost(multigrid, k, seconds, machine, ranks) for k in range(len(multigrid.levels))), Cost(0))


def level_cost(multigrid: Hierarchy, k: int, seconds: float, machine: Machine, ranks: int) -> Cost:
    """One level of a V-cycle, see `cycle`."""
    levels, block, dimension = multigrid.levels, multigrid.block, multigrid.dimension
    level, entries = levels[k], sum(lev.entries for lev in levels)
    cells = level.rows / block
    active = max(1, min(ranks, int(cells)))
    stencil = level.entries / level.rows / block  # cells
    work = seconds * level.entries / entries / active
    if k == len(levels) - 1:
        return Cost(
            work,
            volume=level.rows * NUMBER / machine.bandwidth if ranks > 1 else 0.0,
            collectives=collective(machine.latency, ranks),
        )
    reach = radius(stencil, dimension)
    sends = neighbours(active, reach, cells / active, dimension)
    return Cost(
        work,
        CYCLE_EXCHANGES * sends * machine.latency,
        CYCLE_EXCHANGES * halo(active, reach, cells / active, dimension) * block * NUMBER / machine.bandwidth,
    )


def collective(latency: float, ranks: int) -> float:
    """Seconds of a collective of few numbers: a ceil(log2 R)."""
    return latency * math.ceil(math.log2(ranks))


def radius(stencil: float, dimension: int) -> float:
    """Cells from the middle of a cube of so many cells to its faces: (s^(1/D) - 1) / 2, at least 1."""
    return max(1.0, (math.pow(stencil, 1 / dimension) - 1) / 2)


def neighbours(ranks: int, reach: float, cells: float, dimension: int) -> float:
    """Ranks that a cube of cells exchanges with: (1 + 2 ceil(r / L))^D - 1 with L = cells^(1/D), at most R - 1."""
    side = math.pow(max(cells, 1e-300), 1 / dimension)
    return min(ranks - 1.0, math.pow(1 + 2 * math.ceil(reach / side), dimension) - 1)


def halo(ranks: int, reach: float, cells: float, dimension: int) -> float:
    """Cells around a cube of cells: (L + 2 r)^D - L^D, at most all cells of the other ranks."""
    side = math.pow(cells, 1 / dimension)
    return min((ranks - 1) * cells, math.pow(side + 2 * reach, dimension) - cells)


def total(costs: Mapping[str, Cost]) -> Cost:
    """Sum of the parts."""
    return sum(costs.values(), Cost(0))


def limits(profile: Profile, machine: Machine, most: int = 2**24) -> list[tuple[str, int]]:
    """For each part the least power of two of ranks at which its overhead exceeds all work shared out perfectly.

    Overhead is what the part takes beyond its work on one rank over R: communication, and ranks without work.

    Returns:
        Name and ranks, the part that limits first in front; parts that never do up to `most` are missing.
    """
    serial = {name: cost.work for name, cost in predict(profile, machine, 1).items()}
    found: dict[str, int] = {}
    ranks = 2
    while ranks <= most:
        perfect = sum(serial.values()) / ranks
        for name, cost in predict(profile, machine, ranks).items():
            if name not in found and cost.total - serial[name] / ranks > perfect:
                found[name] = ranks
        ranks *= 2
    return sorted(found.items(), key=lambda item: item[1])


def slowest_levels(profile: Profile, machine: Machine, ranks: int) -> list[tuple[int, float]]:
    """Levels of the multigrid of mechanics by the seconds they take in a cycle, the slowest first."""
    seconds = predict(profile, machine, 1)[MECHANICS].work
    count = len(profile.mechanics.levels)
    costs = [level_cost(profile.mechanics, k, seconds, machine, ranks).total for k in range(count)]
    return sorted(enumerate(costs), key=lambda item: -item[1])


def grown(profile: Profile, factor: float) -> Profile:
    """The same problem with so many times the cells: a finer mesh of the same domain.

    Work and matrices grow with the cells, small fields with their power (D - 1) / D, and multigrid gets coarser
    levels by the ratio of its last two until the last is no larger than it was.
    """
    power = (profile.dimension - 1) / profile.dimension

    def refined(multigrid: Hierarchy) -> Hierarchy:
        measured = multigrid.levels
        result = [Level(level.rows * factor, level.entries * factor) for level in measured]
        while len(measured) > 1 and result[-1].rows > measured[-1].rows:
            rows, entries = (
                result[-1].rows * measured[-1].rows / measured[-2].rows,
                result[-1].entries * measured[-1].entries / measured[-2].entries,
            )
            result.append(Level(rows, min(entries, rows**2)))
        return replace(multigrid, levels=result)

    return replace(
        profile,
        unknowns=profile.unknowns * factor,
        small=profile.small * factor**power,
        seconds={part: value * factor for part, value in profile.seconds.items()},
        mechanics=refined(profile.mechanics),
        mass=refined(profile.mass),
    )
