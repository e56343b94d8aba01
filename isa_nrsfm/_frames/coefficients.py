"""Posterior of the coefficients of frames whose cameras are known.

Let ``c = (1, a)`` with the prior ``a ~ N(0, I)`` and noise of variance s2. The
posterior of a is normal, with ::

    Q = (H + s2 I)^-1,  mean Q (q - h),  covariance s2 Q,

where ``H_kl = <M B_k, M B_l>`` for k, l >= 1, ``h_k = H_k0`` and ``q_k = <P_k^T, M>``
(Bishop, "Pattern recognition and machine learning", 2006, section 12.2). Frames are the
last index of all arrays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import FrameSums, camera_gram, with_one
from isa_nrsfm._linalg.small_matrices import diagonal_of, packed_rows, sweep, unpacked


class CoefficientPosterior(NamedTuple):
    """Posterior of the coefficients of frames.

    c (n_shapes, I): one, and the posterior means of the coefficients. inverse (n_pairs,
    I): minus Q, packed; its row and column of the mean shape are void. objective (I,):
    ``min_a ||W - M S(a)||^2 + s2 |a|^2``. log_determinant (I,): ``log det(I + H /
    s2)``. image_energy (K, I): ``H_kk``, the energy of the images of the basis shapes.
    """

    c: NDArray
    inverse: NDArray
    objective: NDArray
    log_determinant: NDArray
    image_energy: NDArray

    @property
    def alpha(self) -> NDArray:
        """Means of the coefficients (n_components, n_frames)."""
        return self.c[1:]

    def residual(self, noise: NDArray | float) -> NDArray:
        """Return ``||W - M S||^2`` at the means."""
        return self.objective - noise * np.einsum("ki,ki->i", self.alpha, self.alpha)

    def spread(self, noise: NDArray | float) -> NDArray:
        """Return ``tr(H s2 Q) = s2 (K - s2 tr Q)``, the image's posterior variance."""
        diagonal = diagonal_of(self.inverse)[1:]
        return noise * (len(diagonal) + noise * self.inverse[diagonal].sum(axis=0))

    def covaried(self, vectors: NDArray) -> NDArray:
        """Return ``sum_l Q_kl v_l`` of vectors (K, p, I)."""
        negative = unpacked(self.inverse[len(self.c) :])
        return -np.einsum("kli,lpi->kpi", negative, vectors)

    def second_moments(self, noise: NDArray | float) -> NDArray:
        """Return ``E = c c^T + diag(0, s2 Q)``, packed (n_pairs, n_frames)."""
        n_shapes = len(self.c)
        moments = np.empty_like(self.inverse)
        moments[:n_shapes] = 0.0
        np.multiply(self.inverse[n_shapes:], -noise, out=moments[n_shapes:])
        for k, row in enumerate(packed_rows(moments)):
            row += self.c[k] * self.c[k:]
        return moments


def coefficient_posterior(
    products: FrameSums, M: NDArray, noise: NDArray | float, *, refined: bool = False
) -> CoefficientPosterior:
    """Return the posterior of the coefficients of frames for cameras M (2, 3, n).

    If `refined`, a step of iterative refinement keeps rounding errors small where they
    are divided by a tiny noise variance.
    """
    H = products.gram.energies(camera_gram(M))
    seen = np.einsum("kari,rai->ki", products.cross, M)
    n_shapes = len(seen)
    diagonal = diagonal_of(H)[1:]
    image_energy = H[diagonal]
    # [[||W - M B_0||^2, (q - h)^T], [q - h, H + s2 I]], packed. The sweep operator
    # replaces it by [[objective, mean^T], [mean, -Q]].
    H[diagonal] += noise
    H[0] += products.energy - 2 * seen[0]
    H[1:n_shapes] = seen[1:] - H[1:n_shapes]
    equations = H.copy() if refined else None
    log_determinant, _ = sweep(H, 1)
    objective, alpha = H[0], H[1:n_shapes]
    if equations is not None:
        # Iterative refinement with the residual of the normal equations
        left = equations[1:n_shapes] - _product(equations[n_shapes:], alpha)
        alpha -= _product(H[n_shapes:], left)
        objective -= np.einsum("ki,ki->i", alpha, left)
    return CoefficientPosterior(
        with_one(alpha),
        H,
        np.maximum(objective, 0.0),  # less is rounding errors
        log_determinant - len(alpha) * np.log(noise),
        image_energy,
    )


def _product(packed: NDArray, vectors: NDArray) -> NDArray:
    """Return the products of packed symmetric matrices with vectors (k, n)."""
    return np.einsum("kli,li->ki", unpacked(packed), vectors)
