"""The fixed-stress coefficients of the paper, extended to fractures (eq:fixed_stress_coefs)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError
from petsc_fs.scene import Scene


def analytic_coefficients(scene: Scene) -> NDArray[np.float64] | None:
    """What the fixed-stress diagonal is made of, for the mass rows held here.

    With cell volume V, fluid density rho and time step dt, the diagonal for damping exponent t is
    `first * second ** t`, where

    - rock: first = l_min V rho / dt, second = l_mat / l_min, with l_mat = alpha^2 / (2 G / D + lambda)
      and l_min = alpha^2 / (4 G + 2 lambda);
    - fractures: first = l_frac V rho / dt, second = 1, with
      l_frac = [u]_n alpha^2 c_f / (lambda (1/M + phi c_f)), 1/M = (alpha - phi)(1 - alpha) / (lambda + 2 G / 3);
      and c_f / (1/M + phi c_f) = 1 / phi where neither rock nor fluid stores anything;
    - intersections: 0, as they do not touch the momentum balance.

    The paper has t = 1; its published code has t = 0.6.

    Local: does not communicate.

    Returns:
        (mass rows, 2), or None where the scene lacks material data, cell volumes or cell dimensions.

    Raises:
        SceneError: the coefficients are not finite.
    """
    m = scene.material
    if m is None or "mass" not in scene.cell_volumes or scene.cell_dimension is None:
        return None
    rows = scene.cell_dimension.size
    G, lame, alpha, phi, c_f, rho, jump = (
        np.broadcast_to(np.asarray(value, dtype=np.float64), rows) for value in m.cell_data().values()
    )
    scale = scene.cell_volumes["mass"] * rho / m.time_step
    first, second = np.zeros(rows), np.ones(rows)
    rock = scene.cell_dimension == scene.dimension
    fracture = scene.cell_dimension == scene.dimension - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        l_min = alpha**2 / (4 * G + 2 * lame)
        first[rock] = (l_min * scale)[rock]
        second[rock] = ((4 * G + 2 * lame) / (2 * G / scene.dimension + lame))[rock]
        inverse_biot_modulus = (alpha - phi) * (1 - alpha) / (lame + 2 * G / 3)
        storage = inverse_biot_modulus + phi * c_f
        share = np.where(storage == 0, 1 / phi, c_f / storage)  # without any storage its limit for 1/M = 0, c_f -> 0
        l_frac = jump * alpha**2 * share / lame
        first[fracture] = (l_frac * scale)[fracture]
    result = np.column_stack([first, second])
    if not np.isfinite(result).all():
        raise SceneError(
            "material: the fixed-stress coefficients are not finite (G, lambda and 1/M + phi c_f must not "
            "vanish); correct the material data, or leave it out and use -fs_type algebraic"
        )
    return result
