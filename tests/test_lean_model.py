"""The lean discretisation gives the Jacobian of PorePy's own, from less."""

import numpy as np
import pytest

pytestmark = pytest.mark.porepy


@pytest.mark.parametrize("name", ["model3", "flow", "contact"])
def test_the_jacobian_is_the_same(name: str, monkeypatch: pytest.MonkeyPatch):
    pp = pytest.importorskip("porepy")
    from petsc_fs.porepy import lean_model
    from petsc_fs.porepy.models import make_model

    monkeypatch.setattr(lean_model, "MAX_MEMORY", 2e6)
    systems, kept = [], []
    for mixins in ((), (lean_model.LeanModel,)):
        model = make_model(name, refinement=0.25 if name == "model3" else 1.0, mixins=mixins)
        model.prepare_simulation()
        model.before_nonlinear_loop()
        model.before_nonlinear_iteration()
        model.assemble_linear_system()
        systems.append(model.linear_system)
        kept.append(
            sum(
                getattr(matrix, "nnz", 0)
                for _, data in model.mdg.subdomains(return_data=True)
                for matrices in data.get(pp.DISCRETIZATION_MATRICES, {}).values()
                for matrix in matrices.values()
            )
        )
    (J, b), (lean_J, lean_b) = systems
    size = abs(J).max(axis=1).toarray().ravel()
    assert (abs(J - lean_J).max(axis=1).toarray().ravel() <= 1e-10 * size).all()
    np.testing.assert_allclose(lean_b, b, atol=1e-10 * np.abs(b).max())
    assert kept[1] < 0.85 * kept[0]
