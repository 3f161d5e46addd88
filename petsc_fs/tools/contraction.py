r"""What the paper's convergence theorem says about one linear system.

The theorem (theorem:convergence) is about the sequential fixed-stress scheme. It asks (assumption:coercivity) that

    4 G D  >=  coupling + normal + mismatch + friction,  each in Pa/m, with

    coupling = lambda / (c_fc alpha^2) (1/M + c_f phi)               c_fc = a_0 c_f
    normal   = 2 / beta_B                                            closed cells
    mismatch = 2 c epsilon / (|y| + epsilon)                         sliding cells
    friction = 2 F |y| / ((|y| + epsilon) beta_B)                    sliding cells

where each maximum and each minimum over the cells is taken by itself, and y, epsilon, beta_B are those of
eq:auxiliary_coefficients: y = lambda_tau + c d[u]_tau, epsilon the mismatch in Coulomb's law, beta_B the derivative of
the gap by the normal traction. D is the product of the constants in Korn's and the trace inequality. The factor 2 of
the last three terms is that of the theorem's proof and of corollary:1; eq:convergence_condition prints 2 lambda, which
has another unit.

The scheme then contracts by q = 1 / (lambda beta) or better in every iteration, in the norms of the volumetric stress
alpha p - lambda div u in the rock and of its counterpart in the fracture, as both factors of the theorem,
1 / (lambda beta)^2 and chi^2 / (beta beta_c), are q^2, with lambda beta = 1 + lambda / alpha^2 (1/M + c_f phi).

Nearly all of this stands in the matrix. The linearised contact conditions of a cell (eq:contact_linearized) are

    D d(lambda) + C d[u] = r,   D from J_11,   C from J_12 and the jump operator, which is J_21 transposed and scaled:

    closed    D_nn = c beta_B,  C_nn = -c                            beta_B = -D_nn / C_nn
    sticking  D_tn = -F c d[u]_tau,  C_tt = b c,  r = -b c d[u]_tau  d[u]_tau = -r / C_tt
    sliding   D_tn = -F y,  C_tt / c - D_tt = |y| I,  y.C_tt.y = -c epsilon |y|^2

so that no friction coefficient, stiffness or traction need be stored. D itself is bracketed (`korn_trace`) by the
softest way in which the rock lets the fractures open or slip.

The condition is sufficient, not necessary. The proof bounds the normal term in magnitude, although it is a spring
that holds the walls (d(lambda)_n d[u]_n >= 0 with the jump of the contact conditions), so that stiff fractures count
against the condition but not against the scheme.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError, SolveError
from petsc_fs.scene import CSR, Scene, diagonal_blocks, gather_rows
from petsc_fs.tools.reference import factors, one_block, rows_of

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Value = TypeVar("Value")

NOISE = 1e-12
"""Entries of the contact rows below this part of their row's largest are rounding."""

SLIP = 1e-8
"""Slip of sticking cells below this part of b / c is rounding of what Newton left."""

POWER_STEPS = 200
POWER_RTOL = 1e-4
"""Of the power iteration for the softest mode of the fractures."""

FORMULAS = {
    "coupling": "λ (1/M + c_f φ) / (c_fc α²)",
    "normal": "2 / β_B",
    "mismatch": "2 c ε / (|y| + ε)",
    "friction": "2 F |y| / ((|y| + ε) β_B)",
}
"""Terms on the right-hand side of eq:convergence_condition."""

VIOLATIONS = {
    "sticking_slip_m": "slip of sticking cells, m",
    "sticking_slip_over_bound": "c slip / friction bound",
    "coulomb_mismatch_pa": "Coulomb mismatch eps, Pa",
    "coulomb_mismatch_over_trial": "eps / |y|",
}
"""What the theorem assumes to vanish, by name and in words."""


@dataclass(frozen=True, kw_only=True)
class ContactRows:
    """The numbers in the linearised contact conditions, per fracture cell, in the units of the scene.

    NaN stands where one does not belong to the state of a cell; what neither sticks nor slides is free tangentially.
    """

    closed: Mask
    sticking: Mask
    sliding: Mask
    area: Floats  # of the cells
    constant: float  # c, traction per length; NaN if no cell is closed
    beta_b: Floats  # on closed cells; 0 without elastic closure (K_n = 0)
    slip: Floats  # |d[u]_tau| of sticking cells, which assumption:sticking_ut_zero wants to vanish
    bound: Floats  # friction bound b of sticking cells, a traction
    trial: Floats  # |y| of sliding cells, a traction
    mismatch: Floats  # epsilon of sliding cells, a traction: y . lambda_tau / |y| - b
    friction: Floats  # Coulomb coefficient, on sliding cells and on sticking ones that slip
    jump: CSR  # (rows of intf_force, contact unknowns) columns are those of J_21 over traction unit and area


@dataclass(frozen=True, kw_only=True)
class Contraction:
    """The convergence condition of one scene, in SI units; NaN stands where a value does not apply to a cell."""

    terms: dict[str, Floats] = field(default_factory=dict)  # per name in FORMULAS that is known, Pa/m per fracture cell
    theorem: dict[str, float] = field(default_factory=dict)  # the same with extrema over cells as the theorem has them
    stiffness: tuple[float, float] | None = None  # lower and upper bound of 4 G D in Pa/m
    rate: float | None = None  # contraction factor q that the theorem promises
    violations: dict[str, Floats] = field(default_factory=dict)  # per name in VIOLATIONS; empty without contact rows
    friction: Floats | None = None  # Coulomb coefficient as far as rows hold it
    centers: Floats | None = None  # (fracture cells, 3) in m
    notes: tuple[str, ...] = ()  # assumptions that the scene does not meet, and what could not be evaluated, in words

    @property
    def demand(self) -> float | None:
        """Right-hand side of the condition in Pa/m; None where a term is missing."""
        return sum(self.theorem.values()) if set(self.theorem) == set(FORMULAS) else None

    @property
    def dominant(self) -> str | None:
        """Largest term of the condition; None if none is positive."""
        positive = {name: value for name, value in self.theorem.items() if value > 0}
        return max(positive, key=lambda name: positive[name]) if positive else None

    @property
    def verdict(self) -> str:
        """One of "holds", "fails", "undecided" (between the bounds of 4 G D) and "not evaluated".

        A known part of the right-hand side that is too large by itself decides, too.
        """
        if self.demand == 0:
            return "holds"
        if self.stiffness is None:
            return "not evaluated"
        low, high = self.stiffness
        if sum(self.theorem.values()) > high:
            return "fails"
        if self.demand is None:
            return "not evaluated"
        return "holds" if self.demand <= low else "undecided"

    def to_json(self) -> str:
        """Everything but the values per cell, as JSON; what is infinite or unknown is null."""
        data = {
            "condition": "4 G D >= " + " + ".join(FORMULAS.values()),
            "units": "Pa/m",
            "verdict": self.verdict,
            "dominant": self.dominant,
            "4GD": self.stiffness,
            "right_hand_side": self.demand,
            "rate": self.rate,
            "terms": {
                name: {"formula": FORMULAS[name], "theorem": self.theorem[name], **self.summary(values)}
                for name, values in self.terms.items()
            },
            "violations": {name: self.summary(self.violations.get(name)) for name in VIOLATIONS},
            "friction_coefficient": self.summary(self.friction),
            "notes": self.notes,
        }
        strict = json.loads(json.dumps(data), parse_constant=lambda name: None)
        return json.dumps(strict, indent=2) + "\n"

    def summary(self, values: Floats | None) -> dict[str, Any]:
        """Number of cells that have a value; least, median and greatest one, cell and place of the greatest."""
        known = np.zeros(0) if values is None else values[~np.isnan(values)]
        if values is None or not known.size:
            return {"cells": 0}
        cell = int(np.nanargmax(values))
        at = None if self.centers is None else self.centers[cell].tolist()
        spread = {"min": float(known.min()), "median": float(np.median(known)), "max": float(known.max())}
        return {"cells": known.size, **spread, "max_cell": cell, "max_at_m": at}


def evaluate(scene: Scene) -> Contraction:
    """The terms of the theorem's condition, and how far the scene is from its assumptions.

    Local, for whole scenes. What the scene cannot tell is missing from the result, and named in its notes.
    """
    notes = _geometry_notes(scene)
    length, stress = _units(scene)
    contact = bool(scene.sizes.get("contact"))
    theorem: dict[str, float] = {} if contact else dict.fromkeys(FORMULAS, 0.0)
    terms: dict[str, Floats] = {}
    facts: dict[str, Any] = {}

    def known(what: str, compute: Callable[..., Value], *given: Any) -> Value | None:
        try:
            return compute(scene, *given)
        except SceneError as e:
            notes.append(f"{what} not evaluated: {e}")
            return None

    rows = known("contact terms", contact_rows) if contact else None
    if rows is not None:
        notes += _contact_notes(rows)
        terms, theorem = contact_terms(rows)
        relative = rows.slip * rows.constant / rows.bound, rows.mismatch / rows.trial
        violations = rows.slip * length, relative[0], rows.mismatch * stress, relative[1]
        facts = {"violations": dict(zip(VIOLATIONS, violations, strict=True)), "friction": rows.friction}
    stiffness = rate = None
    if scene.material is None:
        notes.append("coupling term, 4 G D and rate not evaluated: the scene has no material data")
    else:
        rate = known("rate", contraction_rate)
        coupling = known("coupling term", coupling_term) if contact else None
        if coupling is not None:
            terms, theorem = {"coupling": coupling, **terms}, {"coupling": float(np.max(coupling)), **theorem}
        if rows is not None:
            stiffness = known("4 G D", korn_trace, rows)
    scale = stress / length
    if "contact" in scene.cell_centers:
        facts["centers"] = scene.cell_centers["contact"] * length
    if stiffness is not None:
        facts["stiffness"] = (stiffness[0] * scale, stiffness[1] * scale)
    facts |= {"terms": {name: values * scale for name, values in terms.items()}, "rate": rate, "notes": tuple(notes)}
    return Contraction(theorem={name: value * scale for name, value in theorem.items()}, **facts)


def contact_rows(scene: Scene) -> ContactRows:
    """Read eq:contact_linearized off the blocks J_11, J_12, J_21 and the right-hand side.

    Raises:
        SceneError: there is no contact, cell volumes are missing, or the rows are not of this kind: the
            two walls of a fracture cell must each be one interface cell, as on matching grids.
    """
    if not {"contact", "intf_force"} <= set(scene.sizes):
        raise SceneError("the scene has no contact")
    if "contact" not in scene.cell_volumes:
        raise SceneError("the scene has no areas of the fracture cells (cell_volumes of contact)")
    dim, cells = scene.dimension, scene.sizes["contact"] // scene.dimension
    area = scene.cell_volumes["contact"]
    jump, unit = _jump_operator(scene, area)
    D = _cell_blocks(scene, "contact") / unit
    C = _jump_derivative(scene, jump)
    r = scene.rhs["contact"].reshape(cells, dim)

    size = np.abs(C).max(axis=2) + unit * np.abs(D).max(axis=2)
    closed = np.abs(C[:, 0, 0]) > NOISE * size[:, 0]
    slope = np.einsum("nii->n", C[:, 1:, 1:]) / (dim - 1)
    # The rows of a free cell are those of lambda_tau = 0, which the walls do not enter.
    on_walls = np.abs(C[:, 1:, 1:]).max(axis=(1, 2)) > 0
    traction = unit * np.abs(D[:, 1:, 1:]).max(axis=(1, 2))
    free = ~on_walls & (np.abs(D[:, 1:, 0]).max(axis=1) == 0)
    sticking = ~free & (traction <= NOISE * size[:, 1:].max(axis=1))
    sliding = ~free & ~sticking

    constants = -C[closed, 0, 0]
    constant = float(np.median(constants)) if constants.size else float("nan")
    if constants.size and not (constant > 0 and np.allclose(constants, constant, rtol=1e-6)):
        raise SceneError("the normal contact conditions have not one and the same positive constant c")

    values = {name: np.full(cells, np.nan) for name in "beta_b slip bound trial mismatch friction".split()}
    values["beta_b"][closed] = np.maximum(-D[closed, 0, 0] / C[closed, 0, 0], 0)
    # c d(lambda) / d(t) is a number, as t = lambda / unit: with c per length, tractions come in units of `unit`.
    at, slip = sticking, values["slip"]
    slip[at] = np.linalg.norm(r[at, 1:], axis=1) / np.abs(slope[at])
    values["bound"][at] = slope[at] / constant * unit
    moving = at & (slip * constant > SLIP * np.abs(slope) / constant)
    values["friction"][moving] = unit * np.linalg.norm(D[moving, 1:, 0], axis=1) / (constant * slip[moving])
    at = sliding
    Dt, Ct = D[at, 1:, 1:] * unit, C[at, 1:, 1:]
    # C_tt / c - D_tt = |y| I, whatever lambda_tau is.
    size_y = np.einsum("nii->n", Ct / constant - Dt) / (dim - 1)
    direction = -unit * D[at, 1:, 0]
    push = np.linalg.norm(direction, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = direction / push[:, None]
        values["friction"][at] = push / size_y
    values["trial"][at] = size_y * unit
    values["mismatch"][at] = -np.einsum("ni,nij,nj->n", along, Ct, along) / constant * unit
    kinds = {"closed": closed, "sticking": sticking, "sliding": sliding}
    return ContactRows(**kinds, **values, area=area, constant=constant * unit, jump=jump)


def contact_terms(rows: ContactRows) -> tuple[dict[str, Floats], dict[str, float]]:
    """Contact terms of the condition per cell, and with the theorem's extrema, in the units of the scene.

    A negative mismatch, which helps, counts as none in the theorem's term. Terms of states that no cell is in are zero.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        resistance = rows.trial + rows.mismatch
        normal = 2 / rows.beta_b
        mismatch = 2 * rows.constant * rows.mismatch / resistance
        friction = 2 * rows.friction * rows.trial / (resistance * rows.beta_b)
        terms = {"normal": normal, "mismatch": mismatch, "friction": friction}
        theorem = dict.fromkeys(terms, 0.0)
        if rows.closed.any():
            theorem["normal"] = float(2 / np.nanmin(rows.beta_b))
        if rows.sliding.any():
            least = np.nanmin(resistance)
            worst = max(float(np.nanmax(rows.mismatch)), 0.0)
            theorem["mismatch"] = float(2 * rows.constant * worst / least)
            push = np.nanmax(rows.friction * rows.trial)
            # Friction acts through the normal traction, which a cell that is open normally does not have.
            theorem["friction"] = float(push / least) * theorem["normal"]
    return terms, theorem


def coupling_term(scene: Scene) -> Floats:
    """Coupling term lambda / (c_fc alpha^2) (1/M + c_f phi) per fracture cell, in the units of the scene.

    The reference aperture a_0 in c_fc = a_0 c_f is the normal jump [u]_n, by which the paper replaces it where it says
    that gamma_c and l_frac (eq:fixed_stress_coefs) are equivalent. A cell that is not open, [u]_n <= 0, has an infinite
    term.

    Raises:
        SceneError: material data or cell dimensions are missing, or fracture cells of `mass` and `contact` differ.
    """
    data = _rock_data(scene)
    if scene.cell_dimension is None:
        raise SceneError("the scene has no cell_dimension")
    fracture = scene.cell_dimension == scene.dimension - 1
    cells = scene.sizes["contact"] // scene.dimension
    centers = [scene.cell_centers.get(name) for name in ("contact", "mass")]
    if np.count_nonzero(fracture) != cells:
        raise SceneError(f"{cells} fracture cells have tractions, {np.count_nonzero(fracture)} have a pressure")
    if centers[0] is not None and centers[1] is not None:
        extent = np.ptp(centers[1], axis=0).max()
        if not np.allclose(centers[0], centers[1][fracture], rtol=0, atol=1e-8 * extent):
            raise SceneError("fracture cells come in different order in contact and mass")
    lame, alpha, c_f, jump, storage = (
        data[k][fracture]
        for k in ("lame_lambda", "biot_coefficient", "fluid_compressibility", "normal_jump", "storage")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        term = lame * storage / (np.maximum(jump, 0) * c_f * alpha**2)
    return np.where(np.isnan(term), np.inf, term)


def contraction_rate(scene: Scene) -> float:
    """Factor q = 1 / (lambda beta) = 1 / (1 + lambda / alpha^2 (1/M + c_f phi)); the worst cell of the rock.

    It is 0 where alpha is: flow then does not feel the rock. It is that of the scheme with stabilisation
    alpha^2 / lambda in the rock and gamma_c in fractures. A SceneError where material data are missing.
    """
    data = _rock_data(scene)
    rock = slice(None) if scene.cell_dimension is None else scene.cell_dimension == scene.dimension
    lame, alpha, storage = (data[k][rock] for k in ("lame_lambda", "biot_coefficient", "storage"))
    return float(np.max(alpha**2 / (alpha**2 + lame * storage), initial=0.0))


def korn_trace(scene: Scene, rows: ContactRows) -> tuple[float, float]:
    """Lower and upper bound of 4 G D, in the units of the scene (traction per length).

    D is the largest number with |eps(u)|^2 >= D |[u]|^2 over the fractures, for all u that the boundary
    conditions admit. The energy of the rock is E = 2 G |eps|^2 + lambda |div u|^2, and in d dimensions
    2 G |eps|^2 <= E <= (2 G + d lambda) |eps|^2. With k the least E / |[u]|^2, therefore,
    2 k / (1 + d lambda / (2 G)) <= 4 G D <= 2 k. Here 1/k is the largest eigenvalue of the compliance of the
    fractures, from tractions on both walls to the jump: a power iteration with direct solves of the discrete
    momentum and interface force balance, which finds 1/k from below to about `POWER_RTOL`.

    Raises:
        SceneError: there is no momentum balance or material, or the walls can move without force.
    """
    data = _rock_data(scene)
    if "momentum" not in scene.sizes or scene.cell_dimension is None:
        raise SceneError(f"the scene has no {'cell_dimension' if 'momentum' in scene.sizes else 'momentum balance'}")
    rock = scene.cell_dimension == scene.dimension
    softness = _largest_compliance(scene, rows)
    ratio = scene.dimension * data["lame_lambda"][rock] / (2 * data["shear_modulus"][rock])
    return float(2 / softness / (1 + ratio.max())), 2 / softness


def _largest_compliance(scene: Scene, rows: ContactRows) -> float:
    """Largest |[u]| / |traction| over all tractions on the walls of the fractures, norms in L2."""
    fields = ("intf_force", "momentum")
    jump, row_of = rows.jump, rows_of(rows.jump)
    root = np.sqrt(np.repeat(rows.area, scene.dimension))
    x: Floats = np.random.default_rng(0).standard_normal(root.size)
    largest = 0.0
    try:
        with factors(one_block(scene, fields)) as (inverse, _):
            for _step in range(POWER_STEPS):
                force = np.zeros(sum(scene.sizes[f] for f in fields))
                np.add.at(force, row_of, jump.data * (root * x / np.linalg.norm(x))[jump.indices])
                opening = np.bincount(jump.indices, jump.data * inverse(force)[row_of], root.size)
                x = np.asarray(root * opening, dtype=np.float64)
                before, largest = largest, float(np.linalg.norm(x))
                if not np.isfinite(largest):
                    raise SceneError("the walls of the fractures can move without force")
                if largest - before <= POWER_RTOL * largest:
                    break
    except SolveError as e:
        raise SceneError(f"momentum and interface force balance: {e}") from e
    if largest == 0:
        raise SceneError("tractions do not move the walls of the fractures")
    return largest


def _jump_operator(scene: Scene, area: Floats) -> tuple[CSR, float]:
    """J_21 over area and traction unit, and this unit: the jump of u_j is the transpose times u_j, up to its sign."""
    dim = scene.dimension
    block = scene.blocks.get(("intf_force", "contact"))
    cells = scene.sizes["contact"] // dim
    if block is None:
        raise SceneError("block (intf_force, contact) is empty")
    per_unknown = np.repeat(area, dim)
    squares = np.bincount(block.indices, block.data**2, cells * dim)
    rows = rows_of(block)
    significant = np.abs(block.data) > NOISE * np.sqrt(squares)[block.indices]
    walls = np.unique(np.column_stack([block.indices // dim, rows // dim])[significant], axis=0)
    units = np.sqrt(squares / 2) / per_unknown
    unit = float(np.median(units))
    one_to_one = np.array_equal(walls[:, 0], np.repeat(np.arange(cells), 2))
    if not (one_to_one and unit > 0 and np.allclose(units, unit, rtol=1e-6)):
        raise SceneError("a fracture cell has not exactly two interface cells of its own size")
    return CSR(block.indptr, block.indices, block.data / (unit * per_unknown[block.indices])), unit


def _jump_derivative(scene: Scene, jump: CSR) -> Floats:
    """(cells, D, D) derivative of the contact conditions by the jump, oriented so that closed cells have C_nn < 0.

    J_12 = C B with the jump operator B, and B B^T = 2 I, so that C = J_12 B^T / 2.
    """
    dim = scene.dimension
    cells = scene.sizes["contact"] // dim
    block = scene.blocks.get(("contact", "intf_force"))
    C = np.zeros((cells, dim, dim))
    if block is None:
        return C
    row_of = rows_of(block)
    at, counts = gather_rows(jump.indptr, block.indices)
    rows, columns = np.repeat(row_of, counts), jump.indices[at]
    values = np.repeat(block.data, counts) * jump.data[at] / 2
    own = rows // dim == columns // dim
    if np.abs(values[~own]).max(initial=0) > NOISE * np.abs(values).max(initial=0):
        raise SceneError("contact conditions reach beyond the walls of their own fracture cell")
    np.add.at(C, (rows[own] // dim, rows[own] % dim, columns[own] % dim), values[own])
    normal = C[:, 0, 0]
    return -C if normal[np.argmax(np.abs(normal))] > 0 else C


def _cell_blocks(scene: Scene, name: str) -> Floats:
    block = scene.blocks.get((name, name))
    bs = scene.block_size(name)
    return np.zeros((scene.sizes[name] // bs, bs, bs)) if block is None else diagonal_blocks(block, bs)


def _rock_data(scene: Scene) -> dict[str, Floats]:
    """Material per mass cell, and `storage` 1/M + c_f phi with 1/M = (alpha - phi)(1 - alpha) / (lambda + 2 G / 3)."""
    if scene.material is None or "mass" not in scene.sizes:
        raise SceneError("the scene has no material data")
    cells = scene.sizes["mass"]
    data = {k: np.broadcast_to(np.asarray(v, dtype=np.float64), cells) for k, v in scene.material.cell_data().items()}
    alpha, phi = data["biot_coefficient"], data["porosity"]
    bulk = data["lame_lambda"] + 2 * data["shear_modulus"] / 3
    if not (bulk > 0).all():
        raise SceneError("lambda + 2 G / 3 is not positive everywhere")
    data["storage"] = (alpha - phi) * (1 - alpha) / bulk + data["fluid_compressibility"] * phi
    return data


def _units(scene: Scene) -> tuple[float, float]:
    """Units of length and of stress of the scene, in SI."""
    units = scene.metadata.units
    m, s, kg = (units.get(name, 1.0) for name in ("m", "s", "kg"))
    return m, kg / (m * s**2)


def _geometry_notes(scene: Scene) -> list[str]:
    notes = []
    if scene.cell_dimension is not None and (scene.cell_dimension < scene.dimension - 1).any():
        notes.append("the theorem is for a single fracture; this scene has intersections")
    if scene.material is not None:
        for name in ("shear_modulus", "lame_lambda", "biot_coefficient"):
            value = np.asarray(getattr(scene.material, name))
            if value.ndim and not np.allclose(value, value.flat[0]):
                notes.append(f"the theorem is for a homogeneous rock (assumption:1); {name} varies")
    if not scene.sizes.get("contact"):
        notes.append("no fracture with contact: the condition is empty, and the scheme contracts without one")
    else:
        notes.append("a scene does not show whether permeabilities are constant, as the theorem assumes")
    return notes


def _contact_notes(rows: ContactRows) -> list[str]:
    notes = []
    if stiff := np.count_nonzero(rows.beta_b == 0):
        notes.append(f"closed cells without elastic closure (K_n = 0), which the analysis does not cover: {stiff}")
    if slipping := np.count_nonzero(rows.slip > SLIP * rows.bound / rows.constant):
        notes.append(f"sticking cells that have slipped, against assumption:sticking_ut_zero: {slipping}")
    if not rows.closed.any() and (rows.sticking | rows.sliding).any():
        notes.append("no cell is closed, so that the constant c, and with it |y| and epsilon, remain unknown")
    return notes
