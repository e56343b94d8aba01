"""The density of a subspace's energy and its derivatives."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.optimize import approx_fprime, check_grad
from sklearn.base import clone

from isa_nrsfm.isa import SqrtDensity

ENERGIES = [0.0, 1e-6, 0.1, 1.0, 3.0, 50.0, 1e4]


@pytest.mark.parametrize("eps", [0.01, 0.1, 2.0])
@pytest.mark.parametrize("energy", ENERGIES)
class TestDerivatives:
    def test_first(self, eps, energy):
        density = SqrtDensity(eps=eps)
        error = check_grad(
            lambda u: density.log_density(u)[0],
            lambda u: density.derivatives(u)[0],
            np.array([energy]),
            epsilon=1e-6 * (energy + eps),
        )
        assert error < 1e-5 * abs(density.derivatives(energy)[0])

    def test_second(self, eps, energy):
        density = SqrtDensity(eps=eps)
        step = 1e-6 * (energy + eps)
        numerical = approx_fprime(
            np.array([energy]), lambda u: density.derivatives(u)[0][0], step
        )
        assert_allclose(density.derivatives(energy)[1], numerical[0], rtol=1e-5)


class TestSqrtDensity:
    def test_by_hand(self):
        g, dg = SqrtDensity(eps=0.25).derivatives(np.array([2.0]))
        assert_allclose(SqrtDensity(eps=0.25).log_density(2.0), -1.5)
        assert_allclose(g, -1 / 3)
        assert_allclose(dg, 1 / (4 * 1.5**3))

    @pytest.mark.parametrize("eps", [0.0, -0.5, np.nan])
    def test_eps_must_be_positive(self, eps):
        density = SqrtDensity(eps=eps)
        for method in (density.log_density, density.derivatives):
            refused(f"eps must be above zero; got {eps}", method, np.ones(3))

    def test_is_a_parameter_like_any_other(self):
        assert clone(SqrtDensity(eps=0.3)).get_params() == {"eps": 0.3}
