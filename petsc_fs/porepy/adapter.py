# mypy: disable-error-code="import-untyped"
"""From a PorePy model to a scene, and from a solution per field back to PorePy's order.

The equation system of the model is asked which unknown and which equation lives on which grid;
no order of blocks is assumed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
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
    "interface_fourier_flux_variable": "intf_fourier",
    "interface_enthalpy_flux_variable": "intf_enthalpy",
    "well_flux_variable": "well_flow",
    "well_enthalpy_flux_variable": "well_enthalpy",
    "pressure_variable": "mass",
    "enthalpy_variable": "energy",
    "temperature_variable": "energy",
}
"""Attribute in which a PorePy model keeps the name of an unknown, to the field of the unknown; of two for the same
field the first one that the model has."""

EQUATIONS = {
    "normal_fracture_deformation_equation": ("contact", slice(0, 1)),
    "tangential_fracture_deformation_equation": ("contact", slice(1, None)),
    "interface_force_balance_equation": ("intf_force", slice(None)),
    "momentum_balance_equation": ("momentum", slice(None)),
    "interface_darcy_flux_equation": ("intf_flow", slice(None)),
    "interface_fourier_flux_equation": ("intf_fourier", slice(None)),
    "interface_enthalpy_flux_equation": ("intf_enthalpy", slice(None)),
    "well_flux_equation": ("well_flow", slice(None)),
    "well_enthalpy_flux_equation": ("well_enthalpy", slice(None)),
    "mass_balance_equation": ("mass", slice(None)),
    "energy_balance_equation": ("energy", slice(None)),
}
"""Name of an equation in PorePy, to its field and the components of a cell that it provides."""

Places = dict[Any, Indices]
"""Per grid rows or columns of PorePy's matrix, (cells, unknowns of a cell)."""
MATERIAL = ("biot_coefficient", "fluid_compressibility", "shear_modulus", "lame_lambda")
"""Laws without which a model with mechanics has no analytic fixed-stress diagonal."""


class Adapter:
    """Maps between one PorePy model and the fields of its scenes.

    Within a field, grids come by descending dimension and otherwise in the order of the
    mixed-dimensional grid; a vector field lists all components of a cell before the next cell.
    Contact rows and columns are normal first, then tangential; PorePy's tractions are in the local
    basis of the fracture with the normal last. An unknown that is not in the table becomes a field `other_NAME`, with
    the equation of its grids that is called alike, or else the first one that is left.

    The maps are computed once, and again only if unknowns, equations or grids have changed.

    Args:
        model: any PorePy model, after `prepare_simulation`.

    Raises:
        LayoutError: unknowns and equations do not pair up.
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
            cell_centers=self._of_cells(lambda g: g.cell_centers.T),
            cell_volumes=self._of_cells(lambda g: g.cell_volumes),
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
        fields = self._pairs(variables, equations)
        position = {g: i for i, g in enumerate([*self.model.mdg.subdomains(), *self.model.mdg.interfaces()])}
        self._grids: dict[str, list[Any]] = {}
        self._rows: dict[str, Indices] = {}
        self._columns: dict[str, Indices] = {}
        for name in in_order(fields):
            rows, columns = fields[name]
            grids = sorted(columns, key=lambda g: (-g.dim, position[g]))
            self._grids[name] = grids
            self._rows[name] = np.concatenate([rows[g].ravel() for g in grids])
            self._columns[name] = np.concatenate([columns[g].ravel() for g in grids])
        self._structure = structure

    def _pairs(
        self, variables: list[tuple[str, Any, Indices]], equations: Mapping[str, Mapping[Any, Indices]]
    ) -> dict[str, tuple[Places, Places]]:
        """Rows and columns of each field, by the table, and those of what is left by grids and names."""
        columns: dict[str, Places] = {}
        for variable, grid, dofs in variables:
            if dofs.size:
                columns.setdefault(variable, {})[grid] = dofs
        rows: dict[str, Places] = {}
        offset = 0
        for equation in self.model.equation_system.equations:
            parts = equations[equation]
            rows[equation] = {g: offset + local for g, local in parts.items() if local.size}
            offset += sum(local.size for local in parts.values())
        found: dict[str, tuple[Places, Places]] = {}
        for attribute, field in VARIABLES.items():
            name = getattr(self.model, attribute, None)
            if name not in columns or field in found:
                continue
            own = {e: part for e, (f, part) in EQUATIONS.items() if f == field and e in rows}
            bs, places = self._block_size(field), columns[name]
            here = {g: np.full((g.num_cells, bs), -1, dtype=np.int64) for g in places}
            fits = all(dofs.size == here[g].size for g, dofs in places.items())
            for (grid, numbers), part in ((item, part) for e, part in own.items() for item in rows[e].items()):
                if grid not in here or here[grid][:, part].size != numbers.size:
                    fits = False
                else:
                    here[grid][:, part] = numbers.reshape(grid.num_cells, -1)
            if fits and all((numbers >= 0).all() for numbers in here.values()):
                found[field] = here, {g: dofs.reshape(-1, bs) for g, dofs in places.items()}
                del columns[name]
                for equation in own:
                    del rows[equation]
        if "contact" in found:
            found["contact"] = found["contact"][0], {g: np.roll(c, 1, axis=1) for g, c in found["contact"][1].items()}
        return found | _others(rows, columns)

    def _block_size(self, name: str) -> int:
        return FIELD[name].block_size(self.model.nd)

    def _of_cells(self, data: Callable[[Any], Floats]) -> dict[str, Floats]:
        """Data of the cells of each field; of others for each unknown, left out where they are not in cells."""
        found = {}
        for field, grids in self._grids.items():
            count, more = divmod(self._rows[field].size, self._block_size(field) * sum(g.num_cells for g in grids))
            if not more:
                found[field] = np.repeat(np.concatenate([data(g) for g in grids]), count, axis=0)
        return found

    def _material(self) -> Material | None:
        """Data of the fixed-stress diagonals; the Biot coefficient of a model without mechanics is 0."""
        model, subdomains = self.model, self._grids["mass"]
        moving = "momentum" in self._grids
        if not all(hasattr(model, law) for law in MATERIAL[0 if moving else 1 : 4 if moving else 2]):
            return None

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


def _others(rows: dict[str, Places], columns: dict[str, Places]) -> dict[str, tuple[Places, Places]]:
    """Unknowns with the equations of as many rows on the same grids, those first whose names have most in common.

    Raises:
        LayoutError: some are left.
    """
    left = {(e, g): index for e, places in rows.items() for g, index in places.items()}
    found: dict[str, tuple[Places, Places]] = {}

    def likeness(variable: str, equation: str) -> int:
        return 2 if variable in equation else int(variable.rpartition("_")[2] in equation)

    wanted = [(v, g, index) for v, places in columns.items() for g, index in places.items()]
    for alike in (2, 1, 0):
        for variable, grid, index in list(wanted):
            fitting = [k for k, r in left.items() if k[1] is grid and r.size == index.size]
            fitting = [k for k in fitting if likeness(variable, k[0]) >= alike]
            if fitting:
                mine, theirs = found.setdefault("other_" + re.sub(r"\W", "_", variable), ({}, {}))
                mine[grid], theirs[grid] = left.pop(fitting[0]), index
                wanted.remove((variable, grid, index))
    if wanted or left:
        unknowns, equations = (", ".join(sorted({k[0] for k in part})) or "none" for part in (wanted, left))
        raise LayoutError(
            "unknowns and equations of the model do not pair up, grid by grid; left are the unknowns "
            f"{unknowns} and the equations {equations}"
        )
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
        LayoutError: unknowns and equations of the model do not pair up.
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
