# mypy: disable-error-code="import-untyped", disallow-subclassing-any=False
"""PorePy's discretisation without the parts that these models never use, for large grids.

Half of what PorePy keeps of a poromechanical discretisation in 3D never reaches the Jacobian: the
reconstruction of displacements on faces, which serves post-processing, and the response to body forces on
the fluid, which are zero here. What is left is computed in pieces of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from petsc_fs.porepy import require_porepy

require_porepy()

import porepy as pp  # noqa: E402

MAX_MEMORY = 3e8
"""PorePy's estimate, in numbers, of what the discretisation of one piece of the grid may need.

This is about 20,000 tetrahedra, and 1.5 GB."""

BODY_FORCES = ("vector_source", "bound_pressure_vector_source")


class LeanModel(pp.SolutionStrategy):
    """Mixin, before the model's other bases; the Jacobian is the same to rounding.

    For models without gravity that do not post-process displacements on faces.
    """

    def set_discretization_parameters(self) -> None:
        """Ask for discretisation in pieces."""
        super().set_discretization_parameters()
        keywords = {getattr(self, name, None) for name in ("stress_keyword", "darcy_keyword")}
        for _, data in self.mdg.subdomains(return_data=True):
            for keyword in keywords & set(data.get(pp.PARAMETERS, ())):
                data[pp.PARAMETERS][keyword]["partition_arguments"] = {"max_memory": MAX_MEMORY}

    def discretize(self) -> None:
        """Discretise, and drop the response to body forces."""
        from scipy.sparse import csr_matrix

        with _without_face_displacements():
            super().discretize()
        for _, data in self.mdg.subdomains(return_data=True):
            for matrices in data.get(pp.DISCRETIZATION_MATRICES, {}).values():
                for name in BODY_FORCES:
                    if name in matrices:
                        matrices[name] = csr_matrix(matrices[name].shape)


@contextmanager
def _without_face_displacements() -> Iterator[None]:
    """Have MPSA reconstruct zero displacements on faces within a block."""
    original = pp.Mpsa._reconstruct_displacement
    pp.Mpsa._reconstruct_displacement = _reconstruct_nothing
    try:
        yield
    finally:
        pp.Mpsa._reconstruct_displacement = original


def _reconstruct_nothing(self: Any, sd: Any, subcell_topology: Any, eta: float | None = None) -> tuple[Any, Any]:
    """Empty matrices of the shapes of `Mpsa._reconstruct_displacement`: from subcell gradients, and from cells."""
    import numpy as np
    from scipy.sparse import csr_matrix

    subcells = np.unique(np.vstack((subcell_topology.cno, subcell_topology.nno)), axis=1).shape[1]
    rows = sd.dim * subcell_topology.num_subfno_unique
    return csr_matrix((rows, sd.dim**2 * subcells)), csr_matrix((rows, sd.dim * sd.num_cells))
