"""Densities of the energy of a subspace, the statistical model of ISA."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator


class SubspaceDensity(Protocol):
    """Density of FastISA: F(u) ~ log p and its first two derivatives."""

    def log_density(self, energy: NDArray) -> NDArray:
        """Return F(u)."""
        ...

    def derivatives(self, energy: NDArray) -> tuple[NDArray, NDArray]:
        """Return F'(u) and F''(u)."""
        ...


class SqrtDensity(BaseEstimator):
    """
    The heavy-tailed density ``F(u) = -sqrt(u + eps)`` of a subspace's energy u.

    Up to a constant, ``F`` is the logarithm of the density of a point of the subspace.
    The energy u is the squared norm of the point. Sources have unit variance.

    Parameters
    ----------
    eps : float, default=0.1
        Smoothing of the density at the origin. Must be positive.

    References
    ----------
    A. Hyvarinen, U. Koster, "FastISA: A fast fixed-point algorithm for independent
    subspace analysis", ESANN 2006.

    Examples
    --------
    >>> from isa_nrsfm.isa import SqrtDensity
    >>> float(SqrtDensity(eps=0.25).log_density(2.0))
    -1.5
    """

    def __init__(self, eps: float = 0.1):
        self.eps = eps

    def log_density(self, energy: NDArray) -> NDArray:
        """
        Return F(u).

        Parameters
        ----------
        energy : ndarray
            The energies u, non-negative.

        Returns
        -------
        ndarray
            F at each energy.
        """
        return -np.sqrt(energy + self._checked_eps())

    def derivatives(self, energy: NDArray) -> tuple[NDArray, NDArray]:
        """
        Return the first two derivatives g = F' and g' = F''.

        Parameters
        ----------
        energy : ndarray
            The energies u, non-negative.

        Returns
        -------
        g : ndarray
            F' at each energy.
        dg : ndarray
            F'' at each energy.
        """
        root = 1.0 / np.sqrt(energy + self._checked_eps())
        return -0.5 * root, 0.25 * root**2 * root

    def _checked_eps(self) -> float:
        """Return eps, or raise an error if it is not positive."""
        if not self.eps > 0:
            raise ValueError(f"eps must be above zero; got {self.eps}")
        return self.eps
