"""Held-out cases of `petsc-fs stress`: drawn at random, after all thresholds had been chosen on the others.

Models with random parameters, all at once, inside the ranges that `docs/limits.md` trusts, around random fractures; and
scenes under random transformations. They are drawn by number, so that nobody has picked them, and none is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from petsc_fs.scene import Scene
from petsc_fs.tools.stress_cases import (
    Recipe,
    StressCase,
    exported,
    in_units,
    lame,
    load,
    opening,
    scaled,
    scattered,
    with_material,
)

SEED = 20250131
MODELS = 12
TRANSFORMED = 14
GROUP = "held out"
BASES = (
    "model1.h5", "model2.h5", "model3.h5", "biot.h5", "flow.h5", "contact.h5", "three_planes", "thirty_fractures",
    "acute_crossing", "lognormal", "near_touching", "friction_0.1", "cubic_law",
)  # fmt: skip
"""What is transformed: bundled scenes and exported ones."""


def _draw_model(number: int) -> Recipe:
    random = np.random.default_rng([SEED, number])

    def power(low: float, high: float) -> float:
        return float(f"{10.0 ** random.uniform(low, high):.3g}")

    def between(low: float, high: float) -> float:
        return float(f"{random.uniform(low, high):.3g}")

    parameters = {
        "friction": between(0.0, 1.5),
        "normal_stiffness": power(5, 20),
        "fracture_permeability": str(random.choice(["unit", "cubic", "constant"])),
    }
    stiffness, ratio, width = power(8, 13), between(0.05, 0.49), power(-6, -2)
    rock = {
        **lame(ratio, stiffness),
        **opening(width),
        "permeability": power(-18, -8),
        "normal_permeability": power(-12, 2),
        "biot_coefficient": between(0.05, 1.0),
        "fluid_compressibility": power(-11, -8),
    }
    traction = power(6, 7.5)
    case: dict[str, Any] = {
        "time_step": power(0, 8),
        "traction": traction,
        "shear": float(f"{traction * random.uniform(0, 0.3):.3g}"),
        "pressure_ratio": between(1, 20),
    }
    case["fractures"] = tuple(_segment(random) for _ in range(int(random.integers(1, 4))))
    changed = parameters | {"shear_modulus": stiffness, "Poisson's ratio": ratio, "aperture": width}
    changed |= {k: v for k, v in rock.items() if k in ("permeability", "biot_coefficient")}
    words = ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in changed.items())
    return Recipe(
        hard=f"{words}, time step {case['time_step']:g} s",
        group=GROUP,
        model="model2",
        refinement=0.6,
        step=(1, int(random.integers(1, 3))),
        parameters=parameters,
        rock=rock,
        case=case,
    )


def _segment(random: np.random.Generator) -> tuple[float, float, float, float]:
    """A fracture 0.2 to 0.6 of the domain long, inside it."""
    while True:
        x, y, angle, length = (*random.uniform(0.1, 0.9, 2), random.uniform(0, np.pi), random.uniform(0.2, 0.6))
        end = np.array([x + length * np.cos(angle), y + length * np.sin(angle)])
        if 0.1 < end.min() and end.max() < 0.9:
            return tuple(round(float(v), 2) for v in (x, y, *end))  # type: ignore[return-value]


HELD_OUT: dict[str, Recipe] = {f"held_out_model_{k:02}": _draw_model(k) for k in range(MODELS)}
"""Name of an exported scene to what it is made by."""


def transform(scene: Scene, number: int) -> Scene:
    """A scene with two or three random changes."""
    names, random = _chosen(number)
    for name in names:
        scene = CHANGES[name](scene, random)
    return scene


def changes(number: int) -> list[str]:
    """What `transform` does, in words."""
    return _chosen(number)[0]


def _chosen(number: int) -> tuple[list[str], np.random.Generator]:
    """The changes of a case by name, and the random numbers to make them with."""
    random = np.random.default_rng([SEED, 1000 + number])
    shuffled = random.permutation(list(CHANGES)).tolist()
    return shuffled[: int(random.integers(2, 4))], random


def _units(scene: Scene, random: np.random.Generator) -> Scene:
    kg, m, s = 10.0 ** random.uniform((0, -3, 0), (10, 3, 7))
    return in_units(scene, kg=float(kg), m=float(m), s=float(s))


def _rows(scene: Scene, random: np.random.Generator) -> Scene:
    return scaled(scene, rows={f: float(10.0 ** random.uniform(-4, 4)) for f in scene.fields})


def _columns(scene: Scene, random: np.random.Generator) -> Scene:
    return scaled(scene, columns={f: float(10.0 ** random.uniform(-6, 6)) for f in scene.fields})


def _scattered_rows(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    return scattered(scene, name, decades=float(random.uniform(1, 5)), seed=int(random.integers(2**31)))


def _scattered_columns(scene: Scene, random: np.random.Generator) -> Scene:
    name = str(random.choice(scene.fields))
    cells = scene.sizes[name] // scene.block_size(name)
    factors = 10.0 ** (random.uniform(1, 3) * (random.random(cells) - 0.5))
    return scaled(scene, columns={name: np.repeat(factors, scene.block_size(name))})


def _rhs(scene: Scene, random: np.random.Generator) -> Scene:
    rhs = {f: random.standard_normal(v.size) * (np.linalg.norm(v) or 1.0) for f, v in scene.rhs.items()}
    return replace(scene, rhs=rhs, reference={})


def _rhs_scaled(scene: Scene, random: np.random.Generator) -> Scene:
    factor = float(10.0 ** random.uniform(-60, 60))
    return replace(scene, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


def _material(scene: Scene, random: np.random.Generator) -> Scene:
    if scene.material is None:
        return scene
    factor = float(10.0 ** random.uniform(-1, 1))
    return with_material(scene, shear_modulus=factor, lame_lambda=factor)


CHANGES: dict[str, Callable[[Scene, np.random.Generator], Scene]] = {
    "random units": _units,
    "equations of each field times a number over 8 decades": _rows,
    "unknowns of each field times a number over 12 decades": _columns,
    "equations of one field scattered over 1 to 5 decades": _scattered_rows,
    "unknowns of one field scattered over 1 to 3 decades": _scattered_columns,
    "random right-hand side": _rhs,
    "right-hand side times a number over 120 decades": _rhs_scaled,
    "stiffness that fixed stress is told off by up to 10": _material,
}


def _transformed(base: str, number: int) -> Scene:
    return transform(load(base), number)


def held_out() -> list[StressCase]:
    """All held-out cases."""
    models = [exported(name, recipe, held_out=True) for name, recipe in HELD_OUT.items()]
    for k in range(TRANSFORMED):
        base = BASES[k % len(BASES)]
        models.append(
            StressCase(
                name=f"held_out_{base.removesuffix('.h5')}_{k:02}",
                group=GROUP,
                hard="; ".join(changes(k)),
                source=f"{base}, transform",
                make=partial(_transformed, base, k),
                held_out=True,
            )
        )
    return models
