"""Most probable camera and coefficients of frames, by Newton's method.

**Affine cameras.** For each frame by itself, with weights ``w_ij`` (zero for missing
points), shapes ``S(a) = B_0 + sum_k a_k B_k`` and noise variance s2 this minimises

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

**Calibrated cameras.** Shapes and noise variance s2 are given. For each frame by
itself, this minimises minus twice the log marginal likelihood of its camera, with the
coefficients integrated out ::

    F(M) = f(M) / s2 + log det(I + H / s2),  f(M) = min_a ||W - M S(a)||^2 + s2 |a|^2,

over scaled rotations ``M(w, l) = exp(l) M exp(hat(w))`` or, where scales are known,
over rotations. With the posterior moments c and E of `coefficient_posterior` the
gradient is, as in expectation maximisation, ``dF/dM = 2 G / s2``, ``G = M A - sum_k c_k
P_k^T``, ``A = sum_kl E_kl B_k B_l^T``. Along the tangents D_c of a camera, ``s2 / 2``
times the Hessian is ::

    tr(D_c A D_d^T) + <G, D_cd> - sum_kl <D_c, F_k> Q_kl <D_d, F_l>,

with ``F_k = M (B_k S^T + S B_k^T) - P_k^T``, ``Q = (H + s2 I)^-1`` and the second
derivative D_cd of the camera. This is exact except for the log determinant: its second
derivative is replaced by the bound that A contains. Steps are damped by
``tr(D_c A D_d^T)``.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    CalibratedCameras,
    CameraModel,
    nearest_calibrated,
)
from isa_nrsfm._frames.point_sums import (
    FLAT,
    TWICE,
    CoefficientPosterior,
    FrameSums,
    affine_cameras,
    camera_gram,
    coefficient_posterior,
    seen_changes,
    whitened,
    with_one,
)
from isa_nrsfm._frames.search import FrameProblem, FrameSearch, State, scale_of
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    ROWS,
    diagonal_of,
    frames_first,
    frames_last,
    of_frames,
    packed_products,
    padded,
    pair_indices,
    solve_positive,
    unpack3,
    unpacked,
)


class AffineSearch(FrameSearch):
    """The search for affine cameras of shapes (K + 1, 3, J), which it whitens."""

    first_steps = 5
    rough_steps = 2

    def __init__(self, shapes: NDArray):
        super().__init__(*whitened(np.ascontiguousarray(shapes)), CAMERAS["affine"])

    def start(self, problem: FrameProblem, alpha: NDArray) -> NDArray:
        """Return coefficients (K, n) after a step with the cameras held."""
        T, _, M, _ = affine_cameras(problem[0], with_one(alpha))
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
        noise, inverse = problem[1], self.evaluate(problem, alpha).inverse()
        return noise * inverse, np.full((3, 3, len(noise)), np.nan)


def _held(
    problem: FrameProblem, alpha: NDArray, T: NDArray, M: NDArray
) -> tuple[NDArray, NDArray]:
    """Return packed ``H + s2 I`` (n_pairs, n) and minus half the gradient (K, n).

    T and the cameras M come from `affine_cameras` for alpha (K, n).
    """
    (products, noise), Q = problem, camera_gram(M)
    held = products.gram.energies(Q)[len(T) :]
    held[diagonal_of(held)] += noise
    # sum_l H_kl c_l = <B_k S^T + S B_k^T, M^T M> / 2
    slope = np.einsum("kari,rai->ki", products.cross[1:], M)
    slope -= np.einsum("kpi,pi->ki", T[1:], 0.5 * TWICE[:, None] * Q)
    slope -= noise * alpha
    return held, slope


# Maps cameras, in the axes of the mean shape, to their depth reversals. Reflecting a
# flat object at its plane does not change its images. The thinner an
# object is, the less its images change (Necker reversal).
REVERSED = np.array([1.0, 1.0, -1.0])[:, None]
# A search from a reversed camera that comes nearer than this share of its first
# distance returns to where it came from: docs/benchmarks/README.md, "Thresholds".
SAME_WELL = 0.1
# The reversed camera is not tried if the objective rises by more than this multiple of
# itself on the way there: docs/benchmarks/README.md, "Thresholds".
LARGE_RISE = 20.0


class CalibratedSearch(FrameSearch):
    """The search for calibrated cameras of shapes (K + 1, 3, J), rows centred.

    Its coordinates are the principal axes of the mean shape, the thinnest one last.
    Cameras are `scaled` (weak perspective) or have the scale one (orthographic).
    """

    model: CalibratedCameras

    def __init__(self, shapes: NDArray, scaled: bool):
        axes, size, _ = np.linalg.svd(shapes[0], full_matrices=False)
        turned = axes.T @ shapes
        turned[0, size <= FLAT * size[0]] = 0.0
        super().__init__(turned, axes.T, CalibratedCameras(scaled))

    def reversed_cameras(
        self, products: FrameSums, noise: float, motion: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return the better of cameras (n, 2, 3) and reversed ones, and their mask."""
        M = frames_last(motion @ self.space.T)
        problem = self.problem(products, np.full(len(motion), noise))
        # The cameras may not be at their minimum yet: compare minima with minima. With
        # 3, 6 and 12 steps 22, 7 and 1 % of reversed frames of motion capture remain.
        n_steps = 6
        M, _ = self.descend(problem, self.evaluate(problem, M), n_steps)
        # Shapes that are not fitted yet can explain a reversed frame well: try all.
        value, every = _value(problem, _posterior(problem, M)), np.arange(len(motion))
        M, better, _ = self._better_reversed(problem, M, value, every, n_steps)
        motion = motion.copy()
        motion[better] = frames_first(M[:, :, better]) @ self.space
        return motion, better

    def reversals(
        self, products: FrameSums, noise: float, motion: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return the minima from reversed cameras (n, 2, 3) and alpha (n, K) there.

        The third result (n,) is the rise of -2 log L from the given cameras.
        """
        M, n_steps = frames_last(motion @ self.space.T), 30
        problem = self.problem(products, np.full(len(motion), noise))
        value = _value(problem, _posterior(problem, M))
        M, _ = self.descend(problem, self.evaluate(problem, M * REVERSED), n_steps)
        posterior = _posterior(problem, M)
        rise = (_value(problem, posterior) - value) / noise
        return frames_first(M) @ self.space, posterior.alpha.T, rise

    def start(self, problem: FrameProblem, alpha: NDArray) -> NDArray:
        """Return calibrated cameras (2, 3, n) near the affine ones for alpha (K, n).

        The better of the nearest and the `_completed` camera is taken.
        """
        M = affine_cameras(problem[0], with_one(alpha))[2]
        starts = calibrated_starts(self.model, M)
        values = [_value(problem, _posterior(problem, start)) for start in starts]
        return np.where(values[1] < values[0], *starts[::-1])

    def evaluate(self, problem: FrameProblem, position: NDArray) -> State:
        """Return ``s2 F`` and its derivatives at M (2, 3, n)."""
        return self._derivatives(problem, position, _posterior(problem, position))[0]

    def _derivatives(
        self, problem: FrameProblem, M: NDArray, posterior: CoefficientPosterior
    ) -> tuple[State, NDArray]:
        """Return the state at M (2, 3, n), and ``Q C`` (K, p, n), C = <D_c, F_k>."""
        products, noise = problem
        A = products.gram.moments(posterior.second_moments(noise))
        G = np.einsum("rbi,bai->rai", M, unpack3(A))
        G -= np.einsum("ki,kari->rai", posterior.c, products.cross)
        gradient, definite = self.model.gradient(M, G), self.model.curvature(M, A)
        # Second derivatives <G, D_cd>. Of two rotations, row by row,
        # D_cd = (e_c m_d + e_d m_c) / 2 - m d_cd. With the scale D_c4 = D_c, D_44 = M.
        mixed = np.einsum("rai,rbi->abi", G, M)
        second = np.empty((len(gradient), *gradient.shape))
        second[:3, :3] = 0.5 * (mixed + mixed.swapaxes(0, 1))
        second[:3, :3] -= np.einsum("aai->i", mixed) * np.eye(3)[:, :, None]
        second[3:], second[:, 3:] = gradient, gradient[:, None]
        # The coefficients follow: - sum_kl <D_c, F_k> Q_kl <D_d, F_l>
        F = _changes(products, M, posterior)
        coupling = np.einsum("crai,krai->kci", self.model.tangents(M), F)
        through = posterior.covaried(coupling)
        hessian = definite + second[pair_indices(len(gradient))]
        hessian -= packed_products(through.swapaxes(0, 1), coupling.swapaxes(0, 1))
        value = _value(problem, posterior)
        return State(M, value, -gradient, definite, hessian), through

    def solution(
        self, problem: FrameProblem, position: NDArray, converged: NDArray, n_steps: int
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras (2, 3, n), coefficients (K, n) and objectives (n,).

        Cameras are replaced by minima from reversed ones if these are lower.
        """
        posterior = _posterior(problem, position)
        if n_steps:
            value = _value(problem, posterior)
            rise = _rise(problem, position, posterior)
            tried = np.flatnonzero(~(rise > LARGE_RISE * value))
            position, better, reached = self._better_reversed(
                problem, position, value, tried, n_steps
            )
            converged[better] = reached[better]
            if better.any():
                posterior = _posterior(problem, position)
        return position, posterior.alpha, posterior.objective

    def covariances(
        self, problem: FrameProblem, M: NDArray, alpha: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return the covariances of coefficients (K, K, n) and of rotations (3, 3, n).

        They come from the inverse joint Hessian ``s2 (Q + Q C^T Y^-1 C Q)``. C is the
        coupling, Y the Hessian by the camera with the coefficients eliminated.
        """
        noise, posterior = problem[1], _posterior(problem, M)
        state, through = self._derivatives(problem, M, posterior)
        inverse = state.inverse()
        widened = np.einsum("kci,cdi->kdi", through, inverse)
        covariance = np.einsum("kdi,ldi->kli", widened, through)
        covariance -= unpacked(posterior.inverse[len(posterior.c) :])
        covariance = 0.5 * (covariance + covariance.swapaxes(0, 1))
        return noise * covariance, noise * inverse[:3, :3]

    def _better_reversed(
        self,
        problem: FrameProblem,
        M: NDArray,
        value: NDArray,
        tried: NDArray,
        max_steps: int,
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras (2, 3, n), or minima from reversed ones where these are lower.

        Cameras M have the objectives value (n,); the indices of those to reverse are
        `tried`. Also returns masks (n,) of replaced cameras and of searches that
        converged.
        """
        limit = value - 1e-10 * scale_of(problem)
        cameras, (better, converged) = M.copy(), np.zeros((2, len(value)), dtype=bool)
        tried = padded(tried)
        if len(tried):
            problem, M, limit = of_frames((problem, M, limit), tried)
            start = self.evaluate(problem, M * REVERSED)
            # The reversed camera and M differ in the third column.
            radius = SAME_WELL * 2.0 * np.hypot(M[0, 2], M[1, 2])
            known = M, limit, radius
            other, converged[tried] = self.descend(problem, start, max_steps, known)
            better[tried] = lower = _value(problem, _posterior(problem, other)) < limit
            cameras[..., tried] = np.where(lower, other, M)
        return cameras, better, converged


def calibrated_starts(model: CameraModel, M: NDArray) -> list[NDArray]:
    """Return the nearest and the `_completed` cameras of affine cameras M (2, 3, n)."""
    rows, scales = nearest_calibrated(frames_first(M))
    starts = (frames_last(rows), scales), _completed(M)
    return [scale * rows if model.scaled else rows for rows, scale in starts]


def _completed(M: NDArray) -> tuple[NDArray, NDArray]:
    """Return orthonormal rows and scales from the first two columns of affine cameras.

    The third column of cameras (2, 3, n) belongs to the thinnest axis. For thin objects
    it is not determined. The first two, N, have singular values s_1 and s_2. In a
    scaled rotation of scale s_1 the third, z, has ``z z^T = s_1^2 I - N N^T``, and
    here the sign of the affine camera.
    """
    N, third = M[:, :2], M[:, 2]
    (p, r), q = (N**2).sum(axis=1), (N[0] * N[1]).sum(axis=0)
    half = 0.5 * (p - r)
    height = np.hypot(half, q)
    scale = np.sqrt(0.5 * (p + r) + height)
    scale = np.where(scale > 0, scale, 1.0)
    # The larger entry of z, and the other one from their product -q, without cancelling
    large = np.sqrt(height + np.abs(half))
    small = np.divide(-q, large, where=large > 0, out=np.zeros_like(q))
    z = np.where(half > 0, (small, large), (large, small)) / scale
    z = np.where((z * third).sum(axis=0) < 0, -z, z)
    N = np.where(p + r > 0, N / scale, np.eye(2)[..., None])
    return np.concatenate([N, z[:, None]], axis=1), scale


def _rise(
    problem: FrameProblem, M: NDArray, posterior: CoefficientPosterior
) -> NDArray:
    """Return the least rise (n,) of the objective on the way to the reversed camera.

    A reversal turns the third column z of M (2, 3, n) over. On the way ``<z', z> = 0``.
    The objective of affine cameras is there higher by at least ``|z|^2 / <e, Y^-1 e>``,
    ``e = (0, 0, z) / |z|``, in the quadratic approximation with half the Hessian Y.
    This neglects the gradient at M, and Y bounds the log determinant from above.
    """
    (products, noise), K, n = problem, len(posterior.alpha), M.shape[2]
    F = _changes(products, M, posterior).reshape(K, 6, n)
    A = products.gram.moments(posterior.second_moments(noise))
    Y = -packed_products(posterior.covaried(F).swapaxes(0, 1), F.swapaxes(0, 1))
    # A for each row of the camera: the diagonal 3x3 blocks of the packed 6x6 matrix
    places = unpacked(np.arange(len(Y)))
    Y[places[:3, :3][ROWS, COLUMNS]] += A
    Y[places[3:, 3:][ROWS, COLUMNS]] += A
    z = (M * (REVERSED < 0)).reshape(6, n)
    square = np.einsum("pi,pi->i", z, z)
    e = z / np.sqrt(np.where(square > 0, square, 1.0))
    steps, definite = solve_positive(Y, e)
    definite &= square > 0
    variance = np.where(definite, np.einsum("pi,pi->i", e, steps), 1.0)
    return np.where(definite, square / variance, 0.0)


def _changes(
    products: FrameSums, M: NDArray, posterior: CoefficientPosterior
) -> NDArray:
    """Return ``F_k`` (K, 2, 3, n) for cameras M (2, 3, n)."""
    return seen_changes(products.cross, products.gram.products(posterior.c), M)


def _value(problem: FrameProblem, posterior: CoefficientPosterior) -> NDArray:
    """Return ``s2 F`` (n,)."""
    return posterior.objective + problem[1] * posterior.log_determinant


def _posterior(problem: FrameProblem, M: NDArray) -> CoefficientPosterior:
    """Return the posterior of the coefficients for cameras (2, 3, n)."""
    products, noise = problem
    return coefficient_posterior(products, M, noise)
