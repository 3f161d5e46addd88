# mypy: disable-error-code="has-type"
# mypy: disallow-subclassing-any=False
"""PorePy's equation system with less to do in each Newton step, and with help from waiting ranks.

- What is affine in the unknowns, such as the balance of momentum of elastic rock, is evaluated again only when what it
  is made of has changed; otherwise its values are a product with the Jacobian that is there.
- Large grids are discretised by all ranks: each does its part of the cells by PorePy's own discretisation around
  `specified_nodes`, which gives the numbers that it gives for the whole grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petsc_fs.partition import bisect
from petsc_fs.porepy import require_porepy
from petsc_fs.server import Client

require_porepy()

import porepy as pp  # noqa: E402
from scipy.sparse import vstack  # noqa: E402

AD_UTILS = pp.ad.ad_utils if hasattr(pp.ad, "ad_utils") else pp.ad._ad_utils  # after, and up to PorePy 1.11
MergedOperator = AD_UTILS.MergedOperator

Floats = NDArray[np.float64]
OF_GRIDS = {getattr(pp.ad, name) for name in ("Divergence", "Projection") if hasattr(pp.ad, name)}
"""Operators that change with the grids alone."""
OF_VALUES = {pp.ad.Scalar, pp.ad.DenseArray, pp.ad.TimeDependentDenseArray, pp.ad.SparseArray}
SUMS, PRODUCTS = ("add", "sub"), ("mul", "rmul", "matmul", "rmatmul")
QUOTIENTS = ("div", "rdiv", "pow", "rpow")
UNKNOWNS = {pp.ad.Variable, pp.ad.MixedDimensionalVariable}

SHARED = {pp.Biot, pp.Mpsa, pp.Mpfa}
"""Discretisations that take `specified_nodes`."""
SMALLEST_PART = 500
"""Cells that a rank should have to discretise for work to be shared out."""
SPECIFIED = {"specified_cells", "specified_faces", "specified_nodes"}
"""Parameters by which a discretisation is that of a part already."""


class EquationSystem(pp.ad.EquationSystem):
    """`porepy.ad.EquationSystem`, with the same answers.

    Args:
        mdg: the grids.
        keep: whether affine parts of equations are kept.
        client: of the server whose ranks help to discretise; None where there is none.
    """

    def __init__(self, mdg: Any, *, keep: bool = True, client: Client | None = None) -> None:
        super().__init__(mdg)
        self._keep, self._client = keep, client
        self._seen: list[Any] = []
        self._short: dict[str, Any] = {}
        self._kept: dict[str, list[Kept]] = {}

    def assemble(
        self, evaluate_jacobian: bool = True, equations: Any = None, variables: Any = None, state: Floats | None = None
    ) -> Any:
        """As PorePy does, affine parts of equations from what is kept."""
        if not self._keep:
            return super().assemble(evaluate_jacobian, equations, variables, state)
        now = list(self._equations.values())
        if len(now) != len(self._seen) or any(a is not b for a, b in zip(now, self._seen, strict=True)):
            self._seen, self._short, self._kept = now, {}, {}
            for name, equation in self._equations.items():
                self._kept[name] = []
                self._short[name] = _replaced(equation, self._kept[name])
        x = self.get_variable_values(iterate_index=0) if state is None else state.copy()
        for name in self._parse_equations(equations):
            for part in self._kept[name]:
                part.update(self, x, evaluate_jacobian)
        whole, self._equations = self._equations, self._short
        try:
            return super().assemble(evaluate_jacobian, equations, variables, state)
        finally:
            self._equations = whole

    def discretize(self, equations: Any = None) -> None:
        """As PorePy does, large grids on all ranks."""
        if self._client is None or self._client.comm.size == 1:
            super().discretize(equations)
            return
        found: list[Any] = []
        for name in self._parse_equations(equations):
            found += self._recursive_discretization_search(self._equations[name], [])
        for discretization, grids in AD_UTILS.uniquify_discretization_list(found).items():
            own = [g for g in grids if not self._discretize_together(self._client, discretization, g)]
            AD_UTILS.discretize_from_list({discretization: own}, self.mdg)

    def _discretize_together(self, client: Client, discretization: Any, grid: Any) -> bool:
        """Discretise a grid on all ranks, if that can be and pays; whether it was."""
        ranks = client.comm.size
        # Of a plane in space a part has other axes than the whole, and signs with them.
        embedded = grid.dim < self.mdg.dim_max()
        if type(discretization) not in SHARED or embedded or grid.num_cells < SMALLEST_PART * ranks:
            return False
        data, keyword = self.mdg.subdomain_data(grid), discretization.keyword
        parameters = data[pp.PARAMETERS][keyword]
        owners = bisect(grid.cell_centers.T, np.ones(grid.num_cells), ranks)
        parts = [Part(type(discretization), keyword, grid, parameters, owners, r) for r in range(ranks)]
        rows = [part.rows() for part in parts]
        if hasattr(grid, "periodic_face_map") or SPECIFIED & parameters.keys() or len(rows[0]) < 4:
            return False
        pieces = client.share(Part.discretize, parts)
        order = {size: np.argsort(np.concatenate([own[size] for own in rows])) for size in rows[0]}
        data[pp.DISCRETIZATION_MATRICES][keyword].update(_joined(pieces, order))
        return True


class Part(NamedTuple):
    """A rank's part in the discretisation of a grid.

    Attributes:
        discretization: class of PorePy.
        keyword: of its parameters.
        grid: all of it.
        parameters: of the whole grid.
        owners: (cells,) rank of each cell.
        rank: that this is for.
    """

    discretization: type
    keyword: str
    grid: Any
    parameters: dict[str, Any]
    owners: NDArray[np.int64]
    rank: int

    def rows(self) -> dict[int, NDArray[np.int64]]:
        """Numbers of the rank's rows, for each size that a matrix of this grid may have: components of faces or cells.

        Of faces between two ranks the lower one has the rows.
        """
        grid = self.grid
        owners = np.full(grid.num_faces, np.iinfo(np.int64).max)
        cells = np.repeat(np.arange(grid.num_cells), np.diff(grid.cell_faces.indptr))
        np.minimum.at(owners, grid.cell_faces.indices, self.owners[cells])
        numbers: dict[int, NDArray[np.int64]] = {}
        for of in (owners, self.owners):
            own = np.flatnonzero(of == self.rank)
            for size in (1, grid.dim):
                numbers[of.size * size] = np.asarray((own[:, None] * size + np.arange(size)).ravel(), dtype=np.int64)
        return numbers

    def discretize(self) -> Matrices:
        """The rank's rows of all matrices, by name."""
        nodes = np.flatnonzero(self.grid.cell_nodes() @ (self.owners == self.rank))
        data: dict[str, Any] = {
            pp.PARAMETERS: {self.keyword: self.parameters | {"specified_nodes": nodes}},
            pp.DISCRETIZATION_MATRICES: {self.keyword: {}},
        }
        self.discretization(self.keyword).discretize(self.grid, data)
        return _own(data[pp.DISCRETIZATION_MATRICES][self.keyword], self.rows())


Matrices = dict[str, Any]
"""Sparse matrices by name; coupling terms have a dictionary for each name."""


def _own(matrices: Matrices, rows: dict[int, NDArray[np.int64]]) -> Matrices:
    return {
        name: _own(found, rows) if isinstance(found, dict) else found.tocsr()[rows[found.shape[0]]]
        for name, found in matrices.items()
    }


def _joined(pieces: Sequence[Matrices], order: dict[int, NDArray[np.int64]]) -> Matrices:
    whole: Matrices = {}
    for name, first in pieces[0].items():
        parts = [piece[name] for piece in pieces]
        if isinstance(first, dict):
            whole[name] = _joined(parts, order)
        else:
            stacked = vstack(parts, format="csr")
            whole[name] = stacked[order[stacked.shape[0]]]
    return whole


class Terms(NamedTuple):
    """What an operator that is affine in the unknowns is made of.

    Attributes:
        is_constant: whether it has no unknowns.
        coefficients: operators that its Jacobian depends on.
        others: operators that only its value depends on.
    """

    is_constant: bool
    coefficients: list[Any]
    others: list[Any]


def _terms(operator: Any) -> Terms | None:
    """What an operator is made of; None if it is not affine in the unknowns, or not known to be."""
    kind, operation = type(operator), operator.operation.name
    if operator.is_leaf():
        if kind in UNKNOWNS and not (operator.is_previous_time or operator.is_previous_iterate):
            return Terms(False, [], [])
        known = kind in UNKNOWNS | OF_GRIDS | OF_VALUES or kind is MergedOperator
        return Terms(True, [], [operator]) if known else None
    parts = [_terms(child) for child in operator.children]
    terms = [part for part in parts if part is not None]
    varying = [part for part in terms if not part.is_constant]
    coefficients = [leaf for part in terms for leaf in part.coefficients]
    others = [leaf for part in terms for leaf in part.others]
    found = None
    if len(terms) < len(parts):
        pass
    elif operation in SUMS or kind.__name__ == "ProjectionList":
        found = Terms(not varying, coefficients, others)
    elif not varying and operation in (*PRODUCTS, *QUOTIENTS):
        found = Terms(True, coefficients, others)
    elif len(varying) == 1 and (operation in PRODUCTS or (operation == "div" and not terms[0].is_constant)):
        factors = [leaf for part in terms if part.is_constant for leaf in part.others]
        found = Terms(False, coefficients + factors, varying[0].others)
    return found


class Kept(pp.ad.Operator):
    """A part A x + c of an equation, by A and the values that it had when it was evaluated last."""

    def __init__(self, operator: Any, terms: Terms) -> None:
        super().__init__(name=operator.name)
        self._operator, self._terms = operator, terms
        self._ad: Any = None
        self._x_then = self._values_then = np.empty(0)
        self._coefficients: list[Any] = []
        self._others: list[Any] = []
        self._checksum = 0.0

    def _key(self) -> str:
        return f"kept {id(self)}"

    def update(self, system: Any, x: Floats, derivative: bool) -> None:
        """Take the values that belong to unknowns x.

        Args:
            system: the equation system.
            x: all unknowns.
            derivative: whether `parse` returns them with A; then matrices are looked at for other entries, too.
        """
        coefficients, others = ([_content(leaf, system.mdg) for leaf in part] for part in self._terms[1:])
        checksum = _checksum(coefficients) if derivative or self._ad is None else self._checksum
        fits = self._ad is not None and self._ad.jac.shape[1] == x.size and checksum == self._checksum
        if not (fits and _same(coefficients, self._coefficients)):
            self._ad = _evaluate(self._operator, system, x, True)
            self._values = self._ad.val
        elif not _same(others, self._others):
            self._values = _evaluate(self._operator, system, x, False)
        else:
            self._values = self._values_then + self._ad.jac @ (x - self._x_then)  # not A x + c, which would cancel
            self._derivative = derivative
            return
        self._x_then, self._values_then = x, self._values
        self._coefficients, self._others, self._checksum, self._derivative = coefficients, others, checksum, derivative

    def parse(self, mdg: Any) -> Any:
        """The values, as PorePy asks for them."""
        if not self._derivative:
            return self._values
        self._ad.val = self._values
        return self._ad


def _evaluate(operator: Any, system: Any, x: Floats, derivative: bool) -> Any:
    """Values of an operator, with derivatives or without; PorePy 1.10 has it as methods of operators."""
    if hasattr(system, "evaluate"):
        return system.evaluate(operator, derivative, x)
    return (operator.value_and_jacobian if derivative else operator.value)(system, x)


def _replaced(operator: Any, kept: list[Kept]) -> Any:
    """An operator with its affine parts replaced; these are added to a list.

    Those without discretisation stay: they are small, and contact conditions compare what they give with zero.
    """
    terms = _terms(operator)
    if operator.is_leaf() or (terms is not None and terms.is_constant):
        return operator
    if terms is not None and any(type(leaf) is MergedOperator for leaf in terms.coefficients):
        kept.append(Kept(operator, terms))
        return kept[-1]
    children = [_replaced(child, kept) for child in operator.children]
    if all(a is b for a, b in zip(children, operator.children, strict=True)):
        return operator
    changed = copy(operator)
    changed.children = children
    return changed


def _content(leaf: Any, mdg: Any) -> Any:
    """What tells whether an operator has changed: its values, or the matrices that it is made of."""
    if type(leaf) in OF_GRIDS:
        return None
    if type(leaf) is not MergedOperator:
        found = leaf.parse(mdg)
        return found.copy() if isinstance(found, np.ndarray) else found
    name, inner = getattr(leaf._discr, f"{leaf._discretization_matrix_key}_matrix_key"), leaf._inner_physics_key
    found = []
    for grid in leaf.domains:
        data = mdg.interface_data(grid) if isinstance(grid, pp.MortarGrid) else mdg.subdomain_data(grid)
        matrices = data[pp.DISCRETIZATION_MATRICES][leaf._physics_key][name]
        found.append(matrices if inner is None else matrices[inner])
    return found


def _checksum(contents: Sequence[Any]) -> float:
    matrices = (m for found in contents for m in (found if isinstance(found, list) else [found]))
    return sum(float(m.data.sum()) for m in matrices if hasattr(m, "format"))


def _same(now: Sequence[Any], before: Sequence[Any]) -> bool:
    """Whether contents are equal: numbers by value, matrices as objects."""
    for a, b in zip(now, before, strict=True):
        if isinstance(a, list):
            if not _same(a, b):
                return False
        elif a is not b and not (isinstance(a, float | int | np.ndarray) and np.array_equal(a, b)):
            return False
    return True
