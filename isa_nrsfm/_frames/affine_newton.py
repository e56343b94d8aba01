"""Most probable affine camera and coefficients of frames, by Newton's method.

For each frame by itself, with weights ``w_ij`` (zero for missing points), shapes ``S(a)
= B_0 + sum_k a_k B_k`` and noise variance s2 this minimises

    f(M, t, a) = sum_j w_ij || m_ij - M S_j(a) - t ||^2 + s2 |a|^2,

the negative log posterior times ``2 s2``, where a has the prior N(0, I). Position and
camera are eliminated. With ``A = S S^T`` and ``Y = W S^T``, points and shapes centred
over the points that the frame sees, the camera is ``M = Y A^-1`` and

    f(a) = ||W||^2 - <M, Y> + s2 |a|^2.

Write ``P_k = B_k W^T``, ``H_kl = <M B_k, M B_l>`` and c = (1, a). Half the gradient is
``s2 a_k + sum_l H_kl c_l - <P_k^T, M>``. Half the Hessian is the Schur complement

    H_kl + s2 d_kl - <F_k A^-1, F_l>,  F_k = M (B_k S^T + S B_k^T) - P_k^T.

The first step uses ``H + s2 I`` instead, half the Hessian for a fixed camera, so that f
decreases. The others are Newton steps, damped by ``H + s2 I``.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import (
    TWICE,
    affine_cameras,
    camera_gram,
    seen_changes,
    whitened,
    with_one,
)
from isa_nrsfm._frames.search import FrameProblem, FrameSearch, State
from isa_nrsfm._linalg.small_matrices import (
    diagonal_of,
    packed_products,
    solve_positive,
)


class AffineSearch(FrameSearch):
    """The search for affine cameras of shapes (K + 1, 3, J), which it whitens."""

    first_steps = 5
    rough_steps = 2

    def __init__(self, shapes: NDArray):
        super().__init__(*whitened(np.ascontiguousarray(shapes)))

    def start(self, problem: FrameProblem, alpha: NDArray) -> NDArray:
        """Return coefficients (K, n) after a step with the cameras held."""
        T, _, M, _ = affine_cameras(problem.products, with_one(alpha))
        return alpha + solve_positive(*_held(problem, alpha, T, M))[0]

    def evaluate(self, problem: FrameProblem, position: NDArray) -> State:
        """Return ``f(a) - ||W||^2`` and its derivatives at alpha (K, n)."""
        products, noise = problem
        T, inverse, M, explained = affine_cameras(products, with_one(position))
        value = noise * np.einsum("ki,ki->i", position, position) - explained
        held, slope = _held(problem, position, T, M)
        F = seen_changes(products.cross, T, M)
        FA = np.einsum("krai,abi->krbi", F, inverse)
        shape = len(F), 6, len(noise)
        schur = held - packed_products(FA.reshape(shape), F.reshape(shape))
        return State(position, value, slope, held, schur)

    def solution(
        self, problem: FrameProblem, position: NDArray, converged: NDArray, n_steps: int
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras (2, 3, n), coefficients (K, n) and objectives (n,)."""
        products, noise = problem
        _, _, M, explained = affine_cameras(products, with_one(position))
        square = noise * np.einsum("ki,ki->i", position, position)
        return M, position, products.energy - explained + square

    def covariances(
        self, problem: FrameProblem, M: NDArray, alpha: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return the covariances of coefficients (K, K, n), and NaN for rotations."""
        inverse = self.evaluate(problem, alpha).inverse()
        return problem.noise * inverse, np.full((3, 3, len(problem.noise)), np.nan)


def _held(
    problem: FrameProblem, alpha: NDArray, T: NDArray, M: NDArray
) -> tuple[NDArray, NDArray]:
    """Return packed ``H + s2 I`` (n_pairs, n) and minus half the gradient (K, n).

    T and the cameras M come from `affine_cameras` for alpha (K, n).
    """
    Q = camera_gram(M)
    held = problem.products.gram.energies(Q)[len(T) :]
    held[diagonal_of(held)] += problem.noise
    # sum_l H_kl c_l = <B_k S^T + S B_k^T, M^T M> / 2
    slope = np.einsum("kari,rai->ki", problem.products.cross[1:], M)
    slope -= np.einsum("kpi,pi->ki", T[1:], 0.5 * TWICE[:, None] * Q)
    slope -= problem.noise * alpha
    return held, slope
