"""Most probable calibrated camera of frames and their coefficients, by Newton's method.

For each frame by itself, given shapes and noise variance s2, this minimises minus twice
the log marginal likelihood of its camera, with the coefficients integrated out ::

    F(M) = f(M) / s2 + log det(I + H / s2),  f(M) = min_a ||W - M S(a)||^2 + s2 |a|^2,

over scaled rotations ``M(w, l) = exp(l) M exp(hat(w))`` or, where scales are known,
over rotations. With the posterior moments c and E of `coefficient_posterior` the
gradient is, as in expectation maximisation, ``dF/dM = 2 G / s2``, ``G = M A - sum_k c_k
P_k^T``, ``A = sum_kl E_kl B_k B_l^T``. Along the tangents D_c of a camera, ``s2 / 2``
times the Hessian is ::

    tr(D_c A D_d^T) + <G, D_cd> - sum_kl <D_c, F_k> Q_kl <D_d, F_l>,

with ``F_k = M (B_k S^T + S B_k^T) - P_k^T``, ``Q = (H + s2 I)^-1`` and the second
derivative D_cd of the camera. This is exact but for the log determinant, whose second
derivative is replaced by the bound that A contains. Steps (`damped_newton`) are damped
by ``tr(D_c A D_d^T)``.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import (
    CalibratedCameras,
    nearest_calibrated,
    tangent_curvature,
)
from isa_nrsfm._frames.coefficients import (
    CoefficientPosterior,
    coefficient_posterior,
)
from isa_nrsfm._frames.damped_newton import State, descend, newton_step
from isa_nrsfm._frames.options import FRAME_OPTIONS, Damping, FrameOptions
from isa_nrsfm._frames.point_sums import FLAT, FrameSums, ShapeProducts, with_one
from isa_nrsfm._frames.search import FoundFrames
from isa_nrsfm._linalg.packed_symmetric import (
    inverse3,
    invert_positive,
    pair_indices,
    unpack3,
    unpacked,
)
from isa_nrsfm._linalg.vectors import frames_first, frames_last, in_lanes

# The least noise variance, as a share of the energy of a frame.
RIDGE = 1e-13


class CalibratedSearch:
    """
    The search for calibrated cameras of frames, for given shapes.

    Parameters
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred.
    scaled : bool
        Whether cameras have a scale of their own (weak perspective) or the scale one
        (orthographic).
    options : FrameOptions
        What steers the search.

    Attributes
    ----------
    shared : ShapeProducts
        The shapes, turned to the principal axes of the mean shape.
    options : FrameOptions
        What steers the search.
    first_steps : int
        The largest number of steps there is: no second round is needed.
    """

    def __init__(
        self,
        shapes: NDArray,
        scaled: bool,
        options: FrameOptions = FRAME_OPTIONS,
        misfit: float = 1.0,
    ):
        self.options, self.first_steps = options, options.max_steps
        self.misfit = misfit
        self._models = CalibratedCameras(scaled, options.largest_turn)
        axes, size, _ = np.linalg.svd(shapes[0], full_matrices=False)
        self._axes = axes
        turned = np.ascontiguousarray(axes.T @ shapes)
        turned[0, size <= FLAT * size[0]] = 0.0
        self.shared = ShapeProducts(turned)

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) of the search for the original shapes."""
        return motion @ self._axes.T

    def turns(self, covariance: NDArray) -> NDArray:
        """Return covariances of rotation vectors (n, 3, 3) for the original shapes."""
        return self._axes @ covariance @ self._axes.T

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        n_points: float,
        initial: NDArray,
        max_steps: int,
        covariances: bool = True,
    ) -> FoundFrames:
        """
        Return the minima that frames reach from given coefficients.

        Parameters
        ----------
        products : FrameSums
            Sums of the frames for the shapes in `shared`.
        variance : ndarray of shape (n_frames,)
            Noise variances.
        n_points : float
            Not used.
        initial : ndarray of shape (n_frames, n_components)
            Coefficients that give the first cameras. These are near the affine cameras
            of least squares for the shapes with these coefficients.
        max_steps : int
            The most steps.
        covariances : bool, default=True
            Whether covariances are wanted.

        Returns
        -------
        FoundFrames
            The minima.
        """
        problem = self._problem(products, variance)
        M = _first_cameras(problem, np.ascontiguousarray(initial.T))
        M, converged = descend(problem, problem.evaluate(M), max_steps)
        M, better, reached = _better_reversed(problem, M, max_steps)
        converged[better] = reached[better]
        return _found(problem, M, converged, covariances, self.misfit)

    def reversed_cameras(
        self, products: FrameSums, noise: float, motion: NDArray
    ) -> tuple[NDArray, NDArray]:
        """
        Search from the cameras reversed in depth, too, and return the better cameras.

        Parameters
        ----------
        products : FrameSums
            Sums of the frames for the shapes in `shared`.
        noise : float
            Noise variance.
        motion : ndarray of shape (n_frames, 2, 3)
            Cameras that see the shapes as they were given.

        Returns
        -------
        motion : ndarray of shape (n_frames, 2, 3)
            The better cameras.
        better : ndarray of bool, shape (n_frames,)
            Which of them are new.
        """
        M = frames_last(motion @ self._axes)
        problem = self._problem(products, np.full(len(motion), noise))
        # The cameras may not be at their minimum yet. Compare minima with minima.
        n_steps = self.options.reversed_steps
        M, _ = descend(problem, problem.evaluate(M), n_steps)
        M, better, _ = _better_reversed(problem, M, n_steps)
        motion = motion.copy()
        motion[better] = self.cameras(frames_first(M[:, :, better]))
        return motion, better

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (n_frames, 2, 3) by a few steps from coefficients of zero."""
        problem = self._problem(products, variance)
        zero = np.zeros((self.shared.n_components, len(variance)))
        M = _first_cameras(problem, zero)
        M, _ = descend(problem, problem.evaluate(M), self.options.rough_steps)
        return frames_first(M)

    def _problem(self, products: FrameSums, variance: NDArray) -> "CalibratedProblem":
        """Return the objectives of frames."""
        return calibrated_problem(products, variance, self._models, self.options)


class CalibratedProblem(NamedTuple):
    """
    The objectives of n frames as functions of their cameras (2, 3, n).

    Attributes
    ----------
    products : FrameSums
        Sums of the frames for the shapes.
    noise : ndarray of shape (n,)
        s2, not zero.
    cameras : CalibratedCameras
        Their model.
    options : FrameOptions
        What steers the search.
    """

    products: FrameSums
    noise: NDArray
    cameras: CalibratedCameras
    options: FrameOptions

    @property
    def energy(self) -> NDArray:
        """``||W||^2 + s2`` (n,)."""
        return self.products.energy + self.noise

    @property
    def damping(self) -> Damping:
        """How steps are damped."""
        return self.options.calibrated

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        products = self.products.take(frames)
        return self._replace(products=products, noise=self.noise[frames])

    def evaluate(self, M: NDArray) -> State:
        """Return ``s2 F`` and its derivatives at M (2, 3, n)."""
        return _state(self, M, _posterior(self, M))

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """
        Return damped Newton steps (p, n), and the damping (n,).

        It is raised until the damped matrix is positive definite.
        """
        rule, damping = self.damping, damping.copy()
        step, positive = newton_step(state, damping)
        failing = in_lanes(np.flatnonzero(~positive))
        while len(failing):
            damping[failing] = np.maximum(rule.raised * damping[failing], rule.first)
            step[:, failing], positive = newton_step(
                state.take(failing), damping[failing]
            )
            still = ~positive & (damping[failing] < rule.largest)
            failing = in_lanes(np.unique(failing[still]))
        return self.cameras.limited(step), damping

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras after steps."""
        return self.cameras.moved(M, step)


def calibrated_problem(
    products: FrameSums,
    variance: NDArray,
    cameras: CalibratedCameras,
    options: FrameOptions = FRAME_OPTIONS,
) -> CalibratedProblem:
    """
    Return the objectives of frames, with a noise that is not zero.

    Parameters
    ----------
    products : FrameSums
        Sums of the frames for the shapes.
    variance : ndarray of shape (n_frames,)
        Noise variances.
    cameras : CalibratedCameras
        Model of the cameras.
    options : FrameOptions
        What steers the search.

    Returns
    -------
    CalibratedProblem
        The objectives.
    """
    noise = np.maximum(variance, RIDGE * products.energy)
    noise = np.where(noise > 0, noise, 1.0)
    return CalibratedProblem(products, noise, cameras, options)


def _first_cameras(problem: CalibratedProblem, alpha: NDArray) -> NDArray:
    """
    Return calibrated cameras (2, 3, n) near the affine ones for alpha (K, n).

    Of two candidates for each frame, the nearest camera and that of `_completed`, the
    one with the lower objective is taken.
    """
    products = problem.products
    c = with_one(alpha)
    seen = np.einsum("ki,kari->rai", c, products.cross)  # W S^T
    # Affine cameras of least squares, M = W S^T (S S^T)^-1
    T = products.gram.products(c)
    inverse = inverse3(0.5 * np.einsum("ki,kpi->pi", c, T))
    affine = frames_first(np.einsum("rbi,bai->rai", seen, inverse))
    starts = [nearest_calibrated(affine), _completed(affine)]
    if not problem.cameras.scaled:
        starts = [(rows, np.ones(len(rows))) for rows, _ in starts]
    first, other = (
        frames_last(scales[:, None, None] * rows) for rows, scales in starts
    )
    values = [_value(problem, _posterior(problem, each)) for each in (first, other)]
    return np.where(values[1] < values[0], other, first)


def _completed(affine: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return orthonormal rows and scales from the first two columns of affine cameras.

    The cameras (n, 2, 3) belong to the principal axes of the mean shape. For thin
    objects their third column, of the thinnest axis, is not determined. The first two
    are ``U diag(s_1, s_2) V^T``. In a scaled rotation they go with the third column
    ``+- sqrt(s_1^2 - s_2^2) u_2``. Its sign is taken from the affine camera.
    """
    U, values, Vt = np.linalg.svd(affine[:, :, :2])
    scale = np.where(values[:, 0] > 0, values[:, 0], 1.0)
    cosine = values[:, 1] / scale
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    depth = sine[:, None] * U[:, :, 1]
    sign = np.where(np.einsum("ir,ir->i", depth, affine[:, :, 2]) < 0, -1.0, 1.0)
    block = (U * np.stack([np.ones_like(cosine), cosine], axis=1)[:, None]) @ Vt
    return np.concatenate([block, (sign[:, None] * depth)[..., None]], axis=2), scale


def _reversed(M: NDArray) -> NDArray:
    """
    Return cameras (2, 3, n) that see the mean shape reversed in depth.

    The images of a flat object do not change when it is reflected at its plane. Those
    of other objects change the less the thinner they are (Necker reversal). The plane
    is taken perpendicular to the thinnest axis of the mean shape, the last one: the
    third column changes its sign.
    """
    return M * np.array([1.0, 1.0, -1.0])[:, None]


def _better_reversed(
    problem: CalibratedProblem, M: NDArray, max_steps: int
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the better cameras (2, 3, n) of those given and of minima from reversed ones.

    Also returned are which of them are new (n,), and which searches converged (n,).
    """
    value = _value(problem, _posterior(problem, M))
    limit = value - problem.options.equal * problem.energy
    start = problem.evaluate(_reversed(M))
    other, converged = descend(problem, start, max_steps, limit)
    better = _value(problem, _posterior(problem, other)) < limit
    return np.where(better, other, M), better, converged


def _value(problem: CalibratedProblem, posterior: CoefficientPosterior) -> NDArray:
    """Return ``s2 F`` (n,)."""
    return posterior.objective + problem.noise * posterior.log_determinant


def _posterior(problem: CalibratedProblem, M: NDArray) -> CoefficientPosterior:
    """Return the posterior of the coefficients for cameras (2, 3, n)."""
    return coefficient_posterior(problem.products, M, problem.noise)


def _coupling(
    problem: CalibratedProblem, M: NDArray, posterior: CoefficientPosterior
) -> NDArray:
    """Return ``<D_c, F_k>`` (p, K, n)."""
    products = problem.products
    T = unpack3(products.gram.products(posterior.c)[1:])
    F = np.einsum("rbi,kbai->krai", M, T)
    F -= products.cross[1:].swapaxes(1, 2)
    D = problem.cameras.tangents(M)
    return np.einsum("crai,krai->cki", D, F)


def _curvature(
    M: NDArray, A: NDArray, G: NDArray, gradient: NDArray
) -> tuple[NDArray, NDArray]:
    """
    Return ``tr(D_c A D_d^T)`` and ``<G, D_cd>``, packed (n_pairs, n).

    The arrays are M and G (2, 3, n), A (6, n), packed, and the gradient
    ``<G, D_c>`` (n_parameters, n).
    """
    turns, across, scale = tangent_curvature(M, A)
    # D_cd = (e_c m_d + e_d m_c) / 2 - m d_cd for rotations, row by row.
    mixed = np.einsum("rai,rbi->abi", G, M)
    trace = np.einsum("aai->i", mixed)
    bent = 0.5 * (mixed + mixed.swapaxes(0, 1)) - trace * np.eye(3)[:, :, None]
    xx, yy, zz, xy, xz, yz = turns
    if len(gradient) == 3:  # no scales
        first = np.stack([xx, xy, xz, yy, yz, zz])
        second = np.stack(
            [bent[0, 0], bent[0, 1], bent[0, 2], bent[1, 1], bent[1, 2], bent[2, 2]]
        )
        return first, second
    first = np.stack([xx, xy, xz, across[0], yy, yz, across[1], zz, across[2], scale])
    second = np.stack(
        [
            bent[0, 0], bent[0, 1], bent[0, 2], gradient[0],
            bent[1, 1], bent[1, 2], gradient[1],
            bent[2, 2], gradient[2],
            trace,
        ]
    )  # fmt: skip
    return first, second


def _state(
    problem: CalibratedProblem, M: NDArray, posterior: CoefficientPosterior
) -> State:
    """
    Return ``s2 F`` and its derivatives at M (2, 3, n), whose posterior is given.

    See the docstring on top.
    """
    noise, cameras = problem.noise, problem.cameras
    A = problem.products.gram.moments(posterior.second_moments(noise))
    G = np.einsum("rbi,bai->rai", M, unpack3(A))
    G -= np.einsum("ki,kari->rai", posterior.c, problem.products.cross)
    gradient = cameras.gradient(M, G)
    definite, bent = _curvature(M, A, G, gradient)
    # - sum_kl <D_c, F_k> Q_kl <D_d, F_l>
    Q = -unpacked(posterior.inverse)[1:, 1:]
    coupling = _coupling(problem, M, posterior)
    through = np.einsum("kli,cli->cki", Q, coupling)
    hessian = definite + bent
    rows, columns = pair_indices(cameras.n_parameters)
    hessian -= np.einsum("pki,pki->pi", through[rows], coupling[columns])
    value = _value(problem, posterior)
    return State(M, value, -gradient, definite, hessian)


def _found(
    problem: CalibratedProblem,
    M: NDArray,
    converged: NDArray,
    covariances: bool,
    misfit: float,
) -> FoundFrames:
    """Return the minima of a search from their cameras (2, 3, n)."""
    noise, n = problem.noise, M.shape[-1]
    posterior = _posterior(problem, M)
    spreads = np.empty((n, 0, 0)), np.full((n, 3, 3), np.nan)
    if covariances:
        wide = problem._replace(noise=misfit * noise)
        spreads = _covariances(wide, M, _posterior(wide, M))
    return FoundFrames(
        frames_first(M),
        posterior.alpha.T,
        *spreads,
        posterior.objective,
        np.maximum(posterior.residual(noise), 0.0),
        converged,
    )


def _covariances(
    problem: CalibratedProblem, M: NDArray, posterior: CoefficientPosterior
) -> tuple[NDArray, NDArray]:
    """Return the covariances of coefficients (n, K, K) and of rotations (n, 3, 3).

    The cameras M (2, 3, n) are at a minimum.
    """
    noise = problem.noise
    state = _state(problem, M, posterior)
    # Covariance of the coefficients with the uncertainty of the camera, by the inverse
    # of the joint Hessian of both: s2 (Q + Q C^T Y^-1 C Q). C is the coupling, and Y
    # the Hessian by the camera with the coefficients eliminated.
    Q = -unpacked(posterior.inverse)[1:, 1:]
    through = np.einsum("kli,cli->kci", Q, _coupling(problem, M, posterior))
    inverse, _, positive = invert_positive(state.hessian)
    bad = in_lanes(np.flatnonzero(~positive))
    if len(bad):
        inverse[:, bad] = invert_positive(state.definite[:, bad])[0]
    inverse = unpacked(inverse)
    covariance = Q + np.einsum("kci,cdi,ldi->kli", through, inverse, through)
    covariance = unpacked(noise * covariance[pair_indices(len(Q))])  # symmetric
    return frames_first(covariance), frames_first(noise * inverse[:3, :3])
