"""Where the joint refinement starts, and how stiff the shapes have to be for it.

With free affine cameras a basis shape ``B_k + V B_0`` can hardly be told from B_k: the
cameras absorb the difference, but for terms of second order in the deformation. Where
the shapes move much and the model is not exact, as in motion capture, these terms hold
mostly what the model leaves out, and the most likely shapes are far from the true ones.
The cameras betray it: true ones are close to turned and scaled orthographic ones, in
some metric of space, which the fit does not know of. Where the cameras of the rigid fit
are far from that, a fit that pays for what its basis shapes move in the images is tried
first, and taken if it brings them nearer. Otherwise the free fit is taken, unless its
cameras are much farther from orthographic ones than those of the rigid fit.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.parallel import _threadpool_controller_decorator

from isa_nrsfm._camera import rigid_cameras
from isa_nrsfm._factorisation import Factorisation, orientations
from isa_nrsfm._frame_fit import RigidFrames, compose, project
from isa_nrsfm._frame_posterior import fit_posterior
from isa_nrsfm._joint_refinement import JointResult, JointState, refine_joint
from isa_nrsfm._marginal_likelihood import MarginalLikelihood
from isa_nrsfm._metric import anisotropy
from isa_nrsfm._robust import ROUNDING, median_noise, robust_weights
from isa_nrsfm._tracks import seen_points

# Price of the basis shapes, per unit of the energy that they move in an image whose
# coordinates have mean square one, where the shapes have to be stiff.
STIFFNESS = 300.0
# Rigid cameras whose anisotropy is below this leave nothing to mend.
ISOTROPIC = 0.15
# So many starts are enough for them: the fits have one optimum in practice.
ISOTROPIC_STARTS = 2
# The stiff fit is taken where it brings the anisotropy below this share of it, and
# where the free fit brings it above this multiple, unless the noise of the stiff fit is
# so many times that of the free one.
CLEARLY_LESS = 0.95
DRIFTED = 1.5
TOO_STIFF = 4.0
# A stiff fit that leaves more than this share of what a rigid one leaves does not move.
STILL_MOVING = 0.5
# With more frames than that the first steps are made on so many of them, the next ones
# on so many times more, and the last ones on all.
SAMPLE_FRAMES = 600
GROWTH = 4
# Steps of the fit of frames that then brings the cameras of all frames close.
ALIGNING_STEPS = 2
# In tables with fewer coordinates than this several starts are tried.
SMALL_TABLE = 150_000
N_RANDOM_STARTS = 6
# Tables of few frames are refined to this share of the tolerance: it costs little, and
# the noise of many points can be small enough to need it.
POLISH = 0.01
FEW_FRAMES = 2000
# Leading directions of the lifted motion per basis shape that these starts mix.
DIRECTIONS = 4
# Added to the diagonal of the rigid cameras' Gram matrices, relative to the trace.
LIFTING_RIDGE = 0.02
# Rounds of reweighting for a robust loss, and the change of the weights that ends them.
REWEIGHTINGS = 20
SETTLED_WEIGHTS = 1e-2
# Share of what the rigid fit leaves that counts as noise at the start.
FIRST_NOISE = 0.3


class JointFit(NamedTuple):
    """
    Result of the joint refinement of a table.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        B_0, ..., B_K, centred, in coordinates in which alpha is drawn from N(0, I).
    alpha : ndarray of shape (n_frames, n_components)
        Means of the coefficients in these coordinates.
    noise_variance : float
        Variance of the noise of a coordinate, for the degrees of freedom that cameras
        and shapes leave.
    stiffness : float
        What was paid for the energy that the basis shapes move in the images.
    history : ndarray of shape (n_iter + 1,)
        The objective at the start and after each step.
    gradient_norm : float
        As in `JointResult`.
    converged : bool
        Whether the refinement has converged.
    """

    shapes: NDArray
    alpha: NDArray
    noise_variance: float
    stiffness: float
    history: NDArray
    gradient_norm: float
    converged: bool


# The products are of small blocks: more threads would wait for each other.
@_threadpool_controller_decorator(limits=1, user_api="blas")
def fit_jointly(
    tracks: NDArray,
    outliers: NDArray,
    W: NDArray,
    factors: Factorisation,
    paper_shapes: NDArray,
    *,
    loss: str,
    stiffness: float | None,
    random_state: np.random.RandomState,
    max_iter: int,
    tol: float,
) -> JointFit:
    """
    Start and run the joint refinement.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Centred tracks, each divided by the size of its frame; NaN where missing.
    outliers : ndarray of bool, shape (n_frames, n_points)
        Points that are left out at first; a robust loss takes them in again.
    W : ndarray of shape (2 * n_frames, n_points)
        Measurement matrix, completed where points are missing or outliers.
    factors : Factorisation
        Of W.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes of the paper's pipeline.
    loss : {"linear", "huber", "cauchy"}
        How points count that are far from the model.
    stiffness : float or None
        What to pay for the energy that the basis shapes move in the images; None to
        choose between nothing and `STIFFNESS`.
    random_state : RandomState
        Draws the additional starts of small tables.
    max_iter : int
        The most steps.
    tol : float
        As in `refine_joint`.

    Returns
    -------
    JointFit
        The fit of lowest objective for the stiffness that is given or chosen.
    """
    seen = seen_points(tracks)
    used = seen & ~outliers
    problem = _Problem(W, tracks, None if used.all() else used * 1.0, max_iter, tol)
    small = W.size < SMALL_TABLE
    problems = [problem] if small else _growing(problem, factors)
    sample = problems[0]
    starts = _starts(sample, factors, paper_shapes, random_state if small else None)
    rigid = _Rigid.of(sample.W, factors)
    best, price = _best(sample, starts, rigid, stiffness)
    best = _finished(best, problems, price)
    if stiffness is None and price == 0 and rigid.ratio(best) > DRIFTED:
        stiff = sample.best(starts[:ISOTROPIC_STARTS], STIFFNESS)
        stiff = _finished(stiff, problems, STIFFNESS)
        if stiff.state.noise < TOO_STIFF * best.state.noise:
            best, price = stiff, STIFFNESS
    noise, n_fitted = best.state.noise, 0
    if loss != "linear":
        # The scale of the noise is that of the residual with the coefficients fitted.
        best, noise = _reweighted(problem, best, loss, price)
        n_fitted = len(paper_shapes) - 1
    shapes = best.state.shapes
    noise *= _freedom_correction(seen, len(shapes), n_fitted)
    return JointFit(
        shapes - shapes.mean(axis=2, keepdims=True),
        best.alpha,
        max(noise, ROUNDING**2),
        price,
        best.history,
        best.gradient_norm,
        best.converged,
    )


class _Rigid(NamedTuple):
    """What the rigid fit says about the stiffness of shapes."""

    anisotropy: float  # of its cameras
    noise: float  # what it leaves, a coordinate

    @classmethod
    def of(cls, W: NDArray, factors: Factorisation) -> Self:
        """Return the cameras' anisotropy, and what the rigid shape leaves of W."""
        cameras = anisotropy(factors.rigid_motion.reshape(-1, 2, 3))
        return cls(cameras, float(np.mean(_rigid_rest(W, factors) ** 2)))

    def ratio(self, result: JointResult) -> float:
        """Return the anisotropy of a refinement's cameras relative to these."""
        cameras = anisotropy(result.state.motion.transpose(2, 0, 1))
        return cameras / self.anisotropy if self.anisotropy > 0 else 1.0


def _rigid_rest(W: NDArray, factors: Factorisation) -> NDArray:
    """Return what a measurement matrix has beside its projection to the rigid shape."""
    shape = factors.rigid_shape
    return W - W @ np.linalg.pinv(shape, rcond=1e-10) @ shape


def _best(
    problem: "_Problem",
    starts: list[NDArray],
    rigid: _Rigid,
    stiffness: float | None,
) -> tuple[JointResult, float]:
    """Return the best refinement and its stiffness, chosen if none is given."""
    if stiffness is not None:
        return problem.best(starts, stiffness), stiffness
    if rigid.anisotropy > ISOTROPIC:
        stiff = problem.best(starts, STIFFNESS)
        if (
            rigid.ratio(stiff) < CLEARLY_LESS
            and stiff.state.noise < STILL_MOVING * rigid.noise
        ):
            return stiff, STIFFNESS
        return problem.best(starts, 0.0), 0.0
    return problem.best(starts[:ISOTROPIC_STARTS], 0.0), 0.0


def _finished(
    result: JointResult, problems: list["_Problem"], stiffness: float
) -> JointResult:
    """Return the refinement, of all frames and to the end, of one of the first part."""
    for problem in problems[1:] or problems:
        state = result.state
        if problem is not problems[0]:
            state = problem.aligned(state)
        few = problem is problems[-1] and len(problem.tracks) <= FEW_FRAMES
        share = POLISH if few else 1.0
        result = problem.refined(state, stiffness, tol=share * problem.tol)
    return result


def _growing(problem: "_Problem", factors: Factorisation) -> list["_Problem"]:
    """Return problems of more and more of the frames, the last of all."""
    n_frames = len(problem.tracks)
    order = _by_rigidity(problem.W, factors)
    problems: list[_Problem] = []
    n = SAMPLE_FRAMES
    while n < (n_frames if not problems else n_frames / 2):
        problems.append(problem.take(_spread(order, n)))
        n *= GROWTH
    return [*problems, problem]


def _by_rigidity(W: NDArray, factors: Factorisation) -> NDArray:
    """Return the frames from the most to the least rigid one."""
    rest = _rigid_rest(W, factors).reshape(len(W) // 2, -1)
    return np.argsort(np.sum(rest**2, axis=1), kind="stable")


def _spread(order: NDArray, n: int) -> NDArray:
    """Return n of the frames at equal distances in an order."""
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]


def _starts(
    problem: "_Problem",
    factors: Factorisation,
    paper_shapes: NDArray,
    random_state: np.random.RandomState | None,
) -> list[NDArray]:
    """Return shapes to start from, and some random ones with a generator."""
    n_components = len(paper_shapes) - 1
    n_mixed = DIRECTIONS * n_components
    directions = lifted_directions(
        factors, n_components if random_state is None else n_mixed
    )
    lifted = lifted_shapes(factors, directions[:, :n_components])
    starts = [problem.likelier(problem.scaled(paper_shapes), lifted)]
    if random_state is not None:
        for _ in range(N_RANDOM_STARTS):
            random = random_state.normal(size=(directions.shape[1], n_components))
            mixing = np.linalg.qr(random)[0]
            starts.append(lifted_shapes(factors, directions @ mixing))
    return starts


def _reweighted(
    problem: "_Problem", result: JointResult, loss: str, stiffness: float
) -> tuple[JointResult, float]:
    """Return the refinement with weights of a robust loss, and the noise variance."""
    tracks = problem.tracks
    seen = seen_points(tracks)
    weights = np.zeros(seen.shape)
    for _ in range(REWEIGHTINGS):
        shapes, motion, _ = result.state
        stacked = shapes.transpose(0, 2, 1)
        model = project(
            compose(stacked[0], stacked[1:], result.alpha),
            motion.transpose(2, 0, 1),
            np.zeros(2),
        )
        rest = np.where(seen[..., None], tracks - model, 0.0)
        counted = problem.weights if problem.weights is not None else seen * 1.0
        position = np.einsum("ij,ijc->ic", counted, rest)
        rest -= (position / counted.sum(axis=1, keepdims=True))[:, None]
        distance = np.linalg.norm(rest, axis=2)
        deviation = max(median_noise(distance[seen]), ROUNDING)
        previous, weights = weights, np.zeros(seen.shape)
        weights[seen] = robust_weights(loss, distance[seen] / deviation)
        if np.abs(weights - previous).max() < SETTLED_WEIGHTS:
            break
        problem = _Problem(problem.W, tracks, weights, problem.max_iter, problem.tol)
        result = problem.refined(result.state, stiffness)
    return result, deviation**2


def _freedom_correction(seen: NDArray, n_shapes: int, n_fitted: int) -> float:
    """
    Return numbers seen divided by the degrees of freedom of the residual.

    Each frame has a camera and a position, eight unknowns; the shapes have three each a
    point, but for the affinity and the mixing. Coefficients that have been integrated
    out take none, those that are fitted to a frame take one each. At least a tenth of
    the numbers counts as free.
    """
    n_frames, n_points = seen.shape
    n_seen = 2.0 * seen.sum()
    unknowns = (
        (8 + n_fitted) * n_frames + 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    )
    return float(n_seen / max(n_seen - unknowns, 0.1 * n_seen))


def lifted_directions(factors: Factorisation, n_directions: int) -> NDArray:
    """
    Return the principal directions of the lifted non-rigid motion.

    The motion of a frame, ``M'_i ~ M_0^i L_i``, is lifted to space by the rigid camera
    (with a little ridge): L_i (3, n_signals) are numbers that do not depend on the
    viewpoint, as far as the rigid camera tells it.

    Parameters
    ----------
    factors : Factorisation
        Rigid and non-rigid factors.
    n_directions : int
        The most directions that are wanted.

    Returns
    -------
    ndarray of shape (3 * n_signals, n_directions)
        Eigenvectors of ``sum_i vec L_i vec L_i^T`` as columns, by decreasing
        eigenvalue, times the root mean square of their coefficients, which have a third
        moment that is not negative; zeros where there are not as many.
    """
    rigid = factors.rigid_motion.reshape(-1, 2, 3)
    motion = factors.motion.reshape(len(rigid), 2, -1)
    gram = rigid @ rigid.transpose(0, 2, 1)
    size = np.trace(gram, axis1=1, axis2=2)
    size = np.where(size > 0, size, 1.0)
    gram = gram + LIFTING_RIDGE * size[:, None, None] * np.eye(2)
    lifted = (rigid.transpose(0, 2, 1) @ np.linalg.solve(gram, motion)).reshape(
        len(rigid), -1
    )
    energy, directions = np.linalg.eigh(lifted.T @ lifted / len(lifted))
    directions = directions[:, ::-1] * np.sqrt(np.maximum(energy[::-1], 0.0))
    directions = directions[:, :n_directions]
    directions = directions * orientations(directions.T @ lifted.T)
    missing = max(n_directions - directions.shape[1], 0)
    return np.pad(directions, [(0, 0), (0, missing)])


def lifted_shapes(factors: Factorisation, directions: NDArray) -> NDArray:
    """
    Return the shapes that belong to directions of the lifted motion.

    Parameters
    ----------
    factors : Factorisation
        Rigid and non-rigid factors.
    directions : ndarray of shape (3 * n_signals, n_components)
        Scaled directions, as of `lifted_directions`.

    Returns
    -------
    ndarray of shape (n_components + 1, 3, n_points)
        The rigid shape and a basis shape for each direction, one standard deviation of
        its coefficient.
    """
    basis = directions.T.reshape(directions.shape[1], 3, -1) @ factors.signals
    return np.concatenate([factors.rigid_shape[None], basis])


class _Problem:
    """The joint refinement of some frames, from given shapes."""

    def __init__(
        self,
        W: NDArray,
        tracks: NDArray,
        weights: NDArray | None,
        max_iter: int,
        tol: float,
    ):
        self.W, self.tracks, self.weights = W, tracks, weights
        self.max_iter, self.tol = max_iter, tol

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        W = self.W.reshape(len(self.tracks), 2, -1)[frames].reshape(-1, self.W.shape[1])
        weights = None if self.weights is None else self.weights[frames]
        return type(self)(W, self.tracks[frames], weights, self.max_iter, self.tol)

    def start(self, shapes: NDArray) -> JointState:
        """Return shapes with the cameras of a rigid fit, and part of what it leaves."""
        motion = rigid_cameras(self.W, shapes[0].T)
        rest = self.W - motion.reshape(-1, 3) @ shapes[0]
        noise = FIRST_NOISE * float(np.mean(rest**2))
        return JointState(shapes, motion.transpose(1, 2, 0), noise)

    def scaled(self, shapes: NDArray) -> NDArray:
        """Return shapes whose coefficients, with rigid cameras, have unit variance."""
        frames = RigidFrames(shapes[0].T, shapes[1:].transpose(0, 2, 1))
        tracks = self.W.reshape(len(self.tracks), 2, -1).transpose(0, 2, 1)
        size = frames.fit(tracks, np.ones(len(tracks))).alpha.std(axis=0)
        return np.concatenate([shapes[:1], size[:, None, None] * shapes[1:]])

    def aligned(self, state: JointState) -> JointState:
        """Return a state with cameras close to the best for its shapes and noise."""
        shapes = state.shapes - state.shapes.mean(axis=2, keepdims=True)
        fit = fit_posterior(
            self.tracks,
            shapes,
            state.noise,
            weights=self.weights,
            max_steps=ALIGNING_STEPS,
        )
        return JointState(shapes, fit.motion.transpose(1, 2, 0), state.noise)

    def likelier(self, *starts: NDArray) -> NDArray:
        """Return the shapes that are more likely to start with."""
        likelihood = MarginalLikelihood(self.tracks, self.weights, 0.0)
        return min(starts, key=lambda shapes: likelihood(*self.start(shapes)).value)

    def best(self, starts: list[NDArray], stiffness: float) -> JointResult:
        """Return the best of the joint refinements from some shapes."""
        results = [self.refined(self.start(shapes), stiffness) for shapes in starts]
        return min(results, key=lambda result: result.history[-1])

    def refined(
        self, state: JointState, stiffness: float, tol: float | None = None
    ) -> JointResult:
        """Return the joint refinement of a state."""
        return refine_joint(
            MarginalLikelihood(self.tracks, self.weights, stiffness),
            state,
            max_iter=self.max_iter,
            tol=self.tol if tol is None else tol,
        )
