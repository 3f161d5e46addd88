"""Fields as one: what the joined matrices are, and how they come apart again.

The contract of every PC is in test_pc.
"""

import numpy as np
import pytest
from common import block_of, comm, gathered, load, local_order, scaled_blocks, system_of
from test_pc import LU, inner_matrix, python_pc, said, under

from petsc_fs import nest
from petsc_fs.fields import FLOW, FLUXES, POTENTIALS
from petsc_fs.pc.joined import GROUPS

pytestmark = pytest.mark.mpi


def order(system, fields):
    """Places of the unknowns of some fields, one field after the other, in their joined order: cell by cell."""
    every = local_order(system.layout, fields)  # rank by rank, field by field
    sizes = [system.layout.sizes(f)[0] for f in fields]
    found, start = [], 0
    for own in comm.allgather(sizes):
        mine = np.split(every[start : start + sum(own)], np.cumsum(own)[:-1])
        found.append(np.column_stack(mine).ravel() if len({*own}) == 1 else np.concatenate(mine))
        start += sum(own)
    return np.concatenate(found)


def test_groups_are_those_of_the_table():
    """Which the PCs do not know."""
    assert f"fluxes={','.join(FLUXES)}:potentials={','.join(POTENTIALS)}" == GROUPS


@pytest.mark.parametrize("groups", ["", "flow=intf_flow,mass:heat=energy,intf_fourier,intf_enthalpy"])
def test_groups_are_the_blocks_cell_by_cell(clean, groups):
    """Where fields have the same cells; else one after the other."""
    scene = load("cold2").only(FLOW)
    system = system_of(scene)
    J = scaled_blocks(system, scene)
    chosen = {"joined_groups": groups} if groups else {}
    pc = python_pc(system.J, "Joined", joined_pc_type="none", **chosen)
    P = inner_matrix(pc)
    if groups:
        expected = {"flow": ("intf_flow", "mass"), "heat": ("intf_fourier", "intf_enthalpy", "energy")}
    else:
        expected = {"fluxes": FLUXES[:3], "potentials": POTENTIALS}
    assert nest.field_names(P) == tuple(expected)
    for i, rows in enumerate(expected.values()):
        for j, columns in enumerate(expected.values()):
            whole = np.block([[J[r, c] for c in columns] for r in rows])
            found = P.getNestSubMatrix(i, j)
            assert found.getBlockSizes() == tuple(1 if groups else len(g) for g in (rows, columns))
            np.testing.assert_array_equal(gathered(found), whole[np.ix_(order(system, rows), order(system, columns))])
    pc.destroy()


def test_a_field_alone_keeps_its_name_and_its_matrix(clean):
    system = system_of(load("cold2").only(["intf_flow", "mass", "energy"]))
    pc = python_pc(system.J, "Joined", joined_pc_type="none")
    P = inner_matrix(pc)
    assert nest.field_names(P) == ("intf_flow", "potentials")
    assert P.getNestSubMatrix(0, 0).handle == system.blocks["intf_flow", "intf_flow"].handle
    pc.destroy()


def test_components_are_fields_that_may_overlap(clean):
    """Pressure, then both: the multiplicative split is what two such solves one after the other are."""
    scene = load("cold2").only(POTENTIALS)
    system = system_of(scene)
    splits = {"pc_type": "fieldsplit", "pc_fieldsplit_type": "multiplicative"}
    splits |= {"pc_fieldsplit_0_fields": "0", "pc_fieldsplit_1_fields": "0,1"}
    leaves = under("fieldsplit_mass_", LU) | {"fieldsplit_1_pc_type": "jacobi"}
    kinds = {f"fieldsplit_{name}_ksp_type": "preonly" for name in ("mass", "1")}
    pc = python_pc(system.J, "Joined", **under("joined_", splits | leaves | kinds))
    x = system.b.duplicate()
    x.setArray(np.random.default_rng(4).standard_normal(x.getSize())[slice(*x.getOwnershipRange())])
    y = x.duplicate()
    pc.apply(x, y)
    A, b = gathered(nest.one_matrix(system.J)), np.concatenate(comm.allgather(x.getArray()))
    first, sizes = np.zeros(b.size), comm.allgather([system.layout.sizes(f)[0] for f in POTENTIALS])
    pressure = np.concatenate([np.arange(sum(own)) < own[0] for own in sizes])
    first[pressure] = np.linalg.solve(A[np.ix_(pressure, pressure)], b[pressure])
    expected = first + (b - A @ first) / np.diag(A)
    np.testing.assert_allclose(
        np.concatenate(comm.allgather(y.getArray())), expected, rtol=0, atol=1e-8 * np.abs(expected).max()
    )
    pc.destroy()


@pytest.mark.parametrize("groups", ["fluxes", "a=mass:b=mass,energy", "=mass"])
def test_groups_that_cannot_be_read(clean, groups):
    with pytest.raises(Exception, match=r".*") as caught:
        python_pc(system_of(load("cold2").only(POTENTIALS)).J, "Joined", joined_groups=groups)
    assert "-c_joined_groups: expected NAME=FIELD,FIELD:NAME=FIELD,... of other fields each" in said(caught.value)


def test_one_matrix_has_no_fields_to_join(clean):
    scene = load("flow").only(["mass"])
    assert block_of(scene, "mass", "mass").any()
    with pytest.raises(Exception, match=r".*") as caught:
        python_pc(system_of(scene).blocks["mass", "mass"], "Joined")
    assert "Joined needs a MatNest with a block per field" in said(caught.value)
