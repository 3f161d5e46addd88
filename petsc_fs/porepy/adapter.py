# mypy: disable-error-code="import-untyped"
"""From a PorePy model to a scene, and from a solution per field back to PorePy's order.

The equation system of the model is asked which unknown and which equation lives on which grid;
no order of blocks is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import petsc_fs
from petsc_fs.csr import CSR
from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.fields import FIELD, in_order
from petsc_fs.porepy import require_porepy
from petsc_fs.scene import Material, Metadata, Scene

pp = require_porepy()

from scipy.sparse import csr_matrix  # noqa: E402

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

STICKING, SLIDING, OPEN = range(3)

VARIABLES = {
    "contact_traction_variable": "contact",
    "interface_displacement_variable": "intf_force",
    "displacement_variable": "momentum",
    "interface_darcy_flux_variable": "intf_flow",
    "pressure_variable": "mass",
}
"""Attribute in which a PorePy model keeps the name of an unknown, to the field of the unknown."""

EQUATIONS = {
    "normal_fracture_deformation_equation": ("contact", slice(0, 1)),
    "tangential_fracture_deformation_equation": ("contact", slice(1, None)),
    "interface_force_balance_equation": ("intf_force", slice(None)),
    "momentum_balance_equation": ("momentum", slice(None)),
    "interface_darcy_flux_equation": ("intf_flow", slice(None)),
    "mass_balance_equation": ("mass", slice(None)),
}
"""Name of an equation in PorePy, to its field and the components of a cell that it provides."""


class Adapter:
    """Maps between one PorePy model and the fields of its scenes.

    Within a field, grids come by descending dimension and otherwise in the order of the
    mixed-dimensional grid; a vector field lists all components of a cell before the next cell.
    Contact rows and columns are normal first, then tangential; PorePy's tractions are in the local
    basis of the fracture with the normal last.

    The maps are computed once, and again only if unknowns, equations or grids have changed.

    Args:
        model: any PorePy model made of (some of) contact mechanics, momentum balance and
            single-phase flow, after `prepare_simulation`.

    Raises:
        LayoutError: the model has an unknown or equation that belongs to no field, or the unknowns
            and equations of a field do not live on the same grids.
        SceneError: the model is not prepared.
    """

    def __init__(self, model: Any) -> None:
        if not hasattr(model, "equation_system"):
            raise SceneError("the model has no equation system yet: call model.prepare_simulation() first")
        self.model = model
        self._structure: Any = None
        self._cut = _Cut()
        self._refresh()

    @property
    def rows(self) -> dict[str, Indices]:
        """Per field the rows of its equations in PorePy's matrix."""
        self._refresh()
        return self._rows

    @property
    def columns(self) -> dict[str, Indices]:
        """Per field the columns of its unknowns in PorePy's matrix."""
        self._refresh()
        return self._columns

    def grids(self, field: str) -> list[Any]:
        """The subdomains or mortar grids that a field lives on, in the order of its cells."""
        self._refresh()
        return self._grids[field]

    def scene(self) -> Scene:
        """The current linear system of the model, in the units of the model.

        Raises:
            SceneError: the model has assembled no linear system yet.
            LayoutError: the linear system is not that of all equations and unknowns.
        """
        model = self.model
        if getattr(model, "linear_system", None) is None:
            raise SceneError(
                "the model has no linear system yet: call model.assemble_linear_system(), or take the "
                "scene from within a Newton step"
            )
        matrix, rhs = model.linear_system
        n = sum(index.size for index in self.columns.values())
        if matrix.shape != (n, n):
            raise LayoutError(
                f"the linear system of the model is {matrix.shape[0]} x {matrix.shape[1]}, but its equation "
                f"system has {n} unknowns; take the scene from the full system, before any reduction"
            )
        matrix = matrix.tocsr()  # of the model itself if it is in rows already: without zeros the same matrix
        if (matrix.data == 0).any():
            matrix.eliminate_zeros()
        rhs, cells = np.asarray(rhs, dtype=np.float64), {f: self._grids[f] for f in self._rows}
        scene = Scene(
            dimension=model.nd,
            sizes={f: rows.size for f, rows in self._rows.items()},
            blocks=self._cut.blocks(matrix, self._rows, self._columns),
            rhs={f: rhs[rows] for f, rows in self._rows.items()},
            cell_centers={f: np.concatenate([g.cell_centers.T for g in gs]) for f, gs in cells.items()},
            cell_volumes={f: np.concatenate([g.cell_volumes for g in gs]) for f, gs in cells.items()},
            cell_dimension=_dimensions(cells["mass"]) if "mass" in cells else None,
            contact_state=contact_state(model, cells["contact"]) if "contact" in cells else None,
            material=self._material() if "mass" in cells else None,
            metadata=self._metadata(),
        )
        if not (np.isfinite(matrix.data).all() and np.isfinite(rhs).all()):
            scene.validate()  # names row and field; what else it looks at is right by construction
        return scene

    def to_porepy(self, solution: Mapping[str, Floats]) -> Floats:
        """A vector of unknowns in PorePy's order, as `solve_linear_system` returns it.

        Args:
            solution: per field (size,) in the order of the scene.

        Raises:
            LayoutError: a field is missing or has the wrong length.
        """
        columns = self.columns
        result = np.empty(sum(index.size for index in columns.values()))
        for name, index in columns.items():
            found = np.shape(solution[name]) if name in solution else "nothing"
            if found != index.shape:
                raise LayoutError(f"{name}: expected {index.size} values, found {found}")
            result[index] = solution[name]
        return result

    def from_porepy(self, vector: Floats) -> dict[str, Floats]:
        """Per field the part of a vector of unknowns in PorePy's order; undoes `to_porepy`."""
        return {name: np.asarray(vector)[index] for name, index in self.columns.items()}

    def _refresh(self) -> None:
        """Compute the maps if the equation system is not the one they were made for."""
        system = self.model.equation_system
        # The grids themselves are kept, not their ids: an id can be used again.
        variables = [(v.name, v.domain, system.dofs_of([v])) for v in system.variables]
        equations = system._equation_image_space_composition
        structure = (
            [(name, grid, dofs.size) for name, grid, dofs in variables],
            [(name, grid, rows.size) for name in system.equations for grid, rows in equations[name].items()],
        )
        if structure == self._structure:
            return
        self._check_supported(structure)
        columns = self._find_columns(variables)
        rows = self._find_rows(equations)
        self._grids: dict[str, list[Any]] = {}
        self._rows: dict[str, Indices] = {}
        self._columns: dict[str, Indices] = {}
        position = {g: i for i, g in enumerate([*self.model.mdg.subdomains(), *self.model.mdg.interfaces()])}
        for name in in_order({*columns, *rows}):
            if columns.get(name, {}).keys() != rows.get(name, {}).keys():
                raise LayoutError(
                    f"{name}: {len(columns.get(name, {}))} grids have the unknown, "
                    f"{len(rows.get(name, {}))} the equation; they must be the same grids"
                )
            grids = sorted(columns[name], key=lambda g: (-g.dim, position[g]))
            self._grids[name] = grids
            self._rows[name] = np.concatenate([rows[name][g].ravel() for g in grids])
            self._columns[name] = np.concatenate([columns[name][g].ravel() for g in grids])
            if (self._rows[name] < 0).any():
                raise LayoutError(f"{name}: the model has only some of the equations of this field")
        self._structure = structure

    def _names(self) -> dict[str, str]:
        """Name of an unknown in this model, to its field."""
        return {getattr(self.model, a): f for a, f in VARIABLES.items() if hasattr(self.model, a)}

    def _check_supported(self, structure: tuple[list[Any], list[Any]]) -> None:
        known = self._names()
        variables = sorted({name for name, _, size in structure[0] if size and name not in known})
        equations = sorted({name for name, _, size in structure[1] if size and name not in EQUATIONS})
        found = [
            f"{what} {', '.join(names)}" for what, names in (("unknowns", variables), ("equations", equations)) if names
        ]
        if found:
            raise LayoutError(
                f"the model has {' and '.join(found)}, which are not supported; supported are the unknowns "
                f"{', '.join(known)} and the equations {', '.join(EQUATIONS)}"
            )

    def _block_size(self, name: str) -> int:
        return FIELD[name].block_size(self.model.nd)

    def _find_columns(self, variables: list[tuple[str, Any, Indices]]) -> dict[str, dict[Any, Indices]]:
        """Per field and grid the columns, (cells, block size)."""
        known = self._names()
        found: dict[str, dict[Any, Indices]] = {}
        for variable, grid, dofs in variables:
            if not dofs.size:
                continue
            name = known[variable]
            bs = self._block_size(name)
            if dofs.size != grid.num_cells * bs:
                raise LayoutError(
                    f"{name}: {dofs.size} unknowns on a grid of {grid.num_cells} cells, expected {bs} per cell"
                )
            per_cell: Indices = dofs.reshape(grid.num_cells, bs)
            if name == "contact":
                per_cell = np.roll(per_cell, 1, axis=1)
            found.setdefault(name, {})[grid] = per_cell
        return found

    def _find_rows(self, equations: Mapping[str, Mapping[Any, Indices]]) -> dict[str, dict[Any, Indices]]:
        """Per field and grid the rows, (cells, block size); -1 where there is no equation."""
        found: dict[str, dict[Any, Indices]] = {}
        offset = 0
        for equation in self.model.equation_system.equations:
            for grid, local in equations[equation].items():
                if not local.size:
                    continue
                name, components = EQUATIONS[equation]
                shape = (grid.num_cells, self._block_size(name))
                here = found.setdefault(name, {}).setdefault(grid, np.full(shape, -1, dtype=np.int64))
                width = here[:, components].shape[1]
                if local.size != grid.num_cells * width:
                    raise LayoutError(
                        f"{name}: {equation} has {local.size} rows on a grid of {grid.num_cells} cells, "
                        f"expected {width} per cell"
                    )
                here[:, components] = (offset + local).reshape(grid.num_cells, width)
            offset += sum(local.size for local in equations[equation].values())
        return found

    def _material(self) -> Material:
        """Data of the fixed-stress diagonals; the Biot coefficient of a model without mechanics is 0."""
        model, subdomains = self.model, self._grids["mass"]
        moving = "momentum" in self._grids

        def elastic(name: str) -> float | Floats:
            return _per_cell(model, getattr(model, name), subdomains) if moving else solid(model, name)

        porosity = "reference_porosity" if hasattr(model, "reference_porosity") else "porosity"
        density = model.fluid.density if hasattr(model.fluid, "reference_component") else model.fluid_density
        jump = np.zeros(sum(sd.num_cells for sd in subdomains))
        if "contact" in self._grids:
            fractures = self._grids["contact"]
            opening = _normal_jump(model, fractures)
            start = np.cumsum([0] + [sd.num_cells for sd in subdomains])
            at = np.cumsum([0] + [sd.num_cells for sd in fractures])
            for k, sd in enumerate(fractures):
                first = start[subdomains.index(sd)]
                jump[first : first + sd.num_cells] = opening[at[k] : at[k + 1]]
        return Material(
            shear_modulus=elastic("shear_modulus"),
            lame_lambda=elastic("lame_lambda"),
            biot_coefficient=_per_cell(model, model.biot_coefficient, subdomains) if moving else 0.0,
            porosity=_per_cell(model, getattr(model, porosity), subdomains),
            fluid_compressibility=_per_cell(model, model.fluid_compressibility, subdomains),
            fluid_density=_per_cell(model, density, subdomains),
            normal_jump=jump,
            time_step=float(model.time_manager.dt),
        )

    def _metadata(self) -> Metadata:
        model = self.model
        return Metadata(
            model=getattr(model, "scene_name", type(model).__name__),
            time_step_index=int(model.time_manager.time_index),
            newton_index=int(model.nonlinear_solver_statistics.num_iteration),
            time=float(model.time_manager.time),
            units={name: float(getattr(model.units, name)) for name in ("m", "s", "kg")},
            producers={
                "porepy": str(pp.__version__),
                "petsc_fs": str(getattr(petsc_fs, "__version__", "unknown")),
            },
        )


class _Cut:
    """Cuts PorePy's matrix into blocks, and remembers where the entries of each are.

    The rows of a field that have the pattern of the Newton step before, as those of momentum always do, are cut by one
    copy of values per block.
    """

    def __init__(self) -> None:
        self._known: dict[str, tuple[Any, Any, dict[str, CSR]]] = {}

    def blocks(
        self, matrix: Any, rows: Mapping[str, Indices], columns: Mapping[str, Indices]
    ) -> dict[tuple[str, str], CSR]:
        """The blocks that have entries, with increasing columns.

        Args:
            matrix: in compressed rows; entries given twice are summed, in place.
            rows: per field those of the matrix.
            columns: likewise.
        """
        found: dict[tuple[str, str], CSR] = {}
        for r, index in rows.items():
            own = _rows(matrix, index)
            known = self._known.get(r)
            if known is None or not all(map(np.array_equal, known[:2], own[:2])):
                n = index.size, matrix.shape[1]
                numbered = csr_matrix((np.arange(own.indices.size), own.indices, own.indptr), n)
                parts = {c: numbered[:, index] for c, index in columns.items()}
                for part in parts.values():
                    part.sort_indices()
                if not all(part.has_canonical_format for part in parts.values()):
                    matrix.sum_duplicates()
                    return self.blocks(matrix, rows, columns)
                places = {c: CSR(p.indptr.astype(np.int64), p.indices, p.data) for c, p in parts.items() if p.nnz}
                known = self._known[r] = own.indptr, own.indices.copy(), places
            found |= {(r, c): CSR(at.indptr, at.indices, own.data[at.data]) for c, at in known[2].items()}
        return found


def _rows(matrix: Any, index: Indices) -> CSR:
    """Some rows of a matrix; without a copy of entries where they follow each other."""
    if index.size and (np.diff(index) == 1).all():
        indptr = matrix.indptr[index[0] : index[-1] + 2]
        entries = slice(indptr[0], indptr[-1])
        return CSR(indptr - indptr[0], matrix.indices[entries], matrix.data[entries])
    own = matrix[index]
    return CSR(own.indptr, own.indices, own.data)


def scene_from_model(model: Any) -> Scene:
    """The current linear system of a PorePy model as a scene; see `Adapter`.

    Raises:
        LayoutError: the model has unknowns or equations that belong to no field.
        SceneError: the model has no linear system yet.
    """
    return Adapter(model).scene()


def contact_state(model: Any, fractures: list[Any]) -> NDArray[np.int8]:
    """State of each fracture cell at the current Newton iterate: 0 sticking, 1 sliding, 2 open.

    A cell is open if -t_n < c ([u]_n - gap), else sliding if |t_tau + c d[u]_tau| > max(b, 0), with
    the friction bound b and the increment d over the time step: the branches that the maxima in
    PorePy's contact equations take.

    Args:
        model: with contact mechanics.
        fractures: subdomains; their cells are counted in this order.
    """
    normal = model.normal_component(fractures)
    tangential = model.tangential_component(fractures)
    jump = tangential @ model.displacement_jump(fractures)
    slip = evaluate(model, pp.ad.time_increment(jump))
    traction = evaluate(model, tangential @ model.contact_traction(fractures))
    t_n = evaluate(model, normal @ model.contact_traction(fractures))
    gap = evaluate(model, model.fracture_gap(fractures))
    c = evaluate(model, model.contact_mechanics_numerical_constant(fractures))
    bound = evaluate(model, model.friction_bound(fractures))
    per_cell = (t_n.size, model.nd - 1)
    trial = np.linalg.norm(traction.reshape(per_cell) + np.reshape(c, (-1, 1)) * slip.reshape(per_cell), axis=1)
    is_open = -t_n < c * (_normal_jump(model, fractures) - gap)
    state = np.where(trial > np.maximum(bound, 0), SLIDING, STICKING)
    return np.where(is_open, OPEN, state).astype(np.int8)


def evaluate(model: Any, operator: Any) -> Any:
    """Value of an AD operator at the current iterate, with any supported PorePy."""
    system = model.equation_system
    return system.evaluate(operator) if hasattr(system, "evaluate") else operator.value(system)


def solid(model: Any, name: str) -> float:
    """A solid constant of a model, with any supported PorePy."""
    value = getattr(model.solid, name)
    return float(value() if callable(value) else value)


def _normal_jump(model: Any, fractures: list[Any]) -> Floats:
    """Normal component of the displacement jump per fracture cell; positive where it opens."""
    operator = model.normal_component(fractures) @ model.displacement_jump(fractures)
    return np.asarray(evaluate(model, operator), dtype=np.float64)


def _per_cell(model: Any, operator: Any, subdomains: list[Any]) -> float | Floats:
    """Value of a constitutive law: one number if it is the same everywhere, else one per cell.

    The law is evaluated grid by grid, because PorePy's own order of grids need not be this one.
    """
    values = [np.asarray(evaluate(model, operator([sd])), dtype=np.float64) for sd in subdomains]
    if all(v.ndim == 0 for v in values) and len({float(v) for v in values}) == 1:
        return float(values[0])
    return np.concatenate([np.broadcast_to(v, sd.num_cells) for v, sd in zip(values, subdomains, strict=True)])


def _dimensions(grids: list[Any]) -> NDArray[np.int64]:
    """Dimension of the subdomain of each cell."""
    return np.repeat([g.dim for g in grids], [g.num_cells for g in grids]).astype(np.int64)
