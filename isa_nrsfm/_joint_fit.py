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

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.parallel import _threadpool_controller_decorator

from isa_nrsfm._camera import rigid_cameras
from isa_nrsfm._factorisation import Factorisation, orientations
from isa_nrsfm._frame_blocks import FrameBlocks
from isa_nrsfm._frame_fit import RigidFrames, compose, project, stacked_motion
from isa_nrsfm._frame_posterior import approximate_cameras
from isa_nrsfm._frame_products import FrameTracks
from isa_nrsfm._joint_frames import JointFrames
from isa_nrsfm._joint_refinement import (
    NOISE_FLOOR,
    JointResult,
    JointState,
    refine_joint,
    regular,
)
from isa_nrsfm._marginal_likelihood import MarginalLikelihood, totals
from isa_nrsfm._metric import anisotropy
from isa_nrsfm._robust import ROUNDING, median_noise, robust_weights
from isa_nrsfm._sampling import SMALL_TABLE, Sample, rigid_energy
from isa_nrsfm._tracks import seen_points

# Price of the basis shapes, per unit of the energy that they move in an image whose
# coordinates have mean square one, where the shapes have to be stiff.
STIFFNESS = 300.0
# Rigid cameras whose anisotropy is below this leave nothing to mend.
ISOTROPIC = 0.15
# So many starts are enough for them: the fits have one optimum in practice. Of frames
# that are a sample the first one is: what the next ones change is more.
ISOTROPIC_STARTS = 2
# The steps on a sample end at this share of what its shapes explain by chance alone, a
# unit of the objective for each number, if it is above the tolerance.
BY_CHANCE = 0.03
# The stiff fit is taken where it brings the anisotropy below this share of it, and
# where the free fit brings it above this multiple, or makes the cameras see so many
# times more of the thinnest direction of the mean shape than the rigid ones do; unless
# the noise of the stiff fit is so many times that of the free one.
CLEARLY_LESS = 0.95
DRIFTED = 1.5
DEEPER = 3.0
TOO_STIFF = 4.0
# A stiff fit that leaves more than this share of what a rigid one leaves does not move.
STILL_MOVING = 0.5
# Complete frames with more points than that, and than so many times the rows of all
# shapes, are given by directions. So many times at most the directions of a step in all
# points are added.
MANY_POINTS = 200
WIDE = 8
WIDENINGS = 20
# Singular values of shapes below this share of the largest are rounding errors.
FLAT = 1e-12
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
    alpha : ndarray of shape (n_chosen, n_components)
        Means of the coefficients in these coordinates, of the frames of the sample.
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
    frames : JointFrames
        The frames as they were fitted in the end.
    """

    shapes: NDArray
    alpha: NDArray
    noise_variance: float
    stiffness: float
    history: NDArray
    gradient_norm: float
    converged: bool
    frames: JointFrames


# The products are of small blocks: more threads would wait for each other.
@_threadpool_controller_decorator(limits=1, user_api="blas")
def fit_jointly(
    rows: FrameBlocks,
    n_seen: NDArray,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    *,
    outliers: NDArray | None = None,
    loss: str,
    stiffness: float | None,
    random_state: np.random.RandomState,
    max_iter: int,
    tol: float,
    on_step: Callable[[], None] | None = None,
) -> JointFit:
    """
    Start and run the joint refinement.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), centred and each divided by its size;
        NaN where a point is missing.
    n_seen : ndarray of int, shape (n_frames,)
        Number of points that each frame shows.
    sample : Sample
        The frames that the first steps are made on.
    factors : Factorisation
        Of their measurement matrix.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes of the paper's pipeline.
    outliers : ndarray of bool, shape (n_frames, n_points), optional
        Points that are left out at first and that a robust loss takes in again; to be
        given with such a loss.
    loss : {"linear", "huber", "cauchy"}
        How points count that are far from the model.
    stiffness : float or None
        What to pay for the energy that the basis shapes move in the images; None to
        choose between nothing and `STIFFNESS`.
    random_state : RandomState
        Draws the additional starts of small tables.
    max_iter : int
        The most steps.
    tol, on_step
        As in `refine_joint`.

    Returns
    -------
    JointFit
        The fit of lowest objective for the stiffness that is given or chosen.
    """
    n_shapes, _, n_points = paper_shapes.shape
    complete = bool((n_seen == n_points).all())
    many = n_points > max(WIDE * 3 * n_shapes, MANY_POINTS)
    wide = complete and loss == "linear" and many
    if wide:
        frames = JointFrames.along(rows, _directions(factors))
    elif loss == "linear":
        frames = JointFrames.of_points(rows, complete)
    else:
        used = seen_points(rows.whole().transpose(0, 2, 1))
        if outliers is not None:
            used &= ~outliers
        weights = None if used.all() else used * 1.0
        frames = JointFrames.of_points(rows, complete, weights)
    chosen = _SampleRows.of(sample.W, frames)
    by_chance = BY_CHANCE * frames.coordinates(paper_shapes).size
    problems = [
        _Problem(
            frames.take(part),
            chosen,
            max_iter,
            max(tol, by_chance / len(part)),
            on_step,
        )
        for part in sample.parts
    ]
    problem = _Problem(frames, chosen, max_iter, tol, on_step)
    problems.append(problem)
    first = problems[0]
    small = sample.W.size < SMALL_TABLE
    starts = _starts(first, factors, paper_shapes, random_state if small else None)
    rigid = _Rigid.of(chosen, frames.coordinates(factors.rigid_shape), factors)
    n_isotropic = ISOTROPIC_STARTS if first is problem else 1
    best, price = _best(first, starts, n_isotropic, rigid, stiffness)
    free, stiff = stiffness is None and price == 0, None
    if free and rigid.drifted(best):
        stiff = first.best(starts[:n_isotropic], STIFFNESS)
        if stiff.state.noise < TOO_STIFF * best.state.noise:
            best, price = stiff, STIFFNESS
    best = _finished(best, problems, price)
    if free and price == 0 and rigid.drifted(best):
        stiff = stiff or first.best(starts[:n_isotropic], STIFFNESS)
        stiff = _finished(stiff, problems, STIFFNESS)
        if stiff.state.noise < TOO_STIFF * best.state.noise:
            best, price = stiff, STIFFNESS
    if wide:
        best, problem = _widened(best, problem, rows, price)
    noise, n_fitted = best.state.noise, 0
    if loss != "linear":
        # The scale of the noise is that of the residual with the coefficients fitted.
        best, noise = _reweighted(problem, rows, used, best, loss, price)
        n_fitted = n_shapes - 1
    shapes = problem.frames.points(best.state.shapes)
    state = best.state._replace(shapes=first.frames.coordinates(shapes))
    if sample.parts:
        state = state._replace(motion=state.motion[:, :, sample.parts[0]])
    noise *= _freedom_correction(n_seen, n_points, n_shapes, n_fitted)
    return JointFit(
        shapes - shapes.mean(axis=2, keepdims=True),
        first.coefficients(state),
        max(noise, ROUNDING**2),
        price,
        best.history,
        best.gradient_norm,
        best.converged,
        problem.frames,
    )


def _directions(factors: Factorisation) -> NDArray:
    """Return orthonormal directions (n_directions, n_points) of all factors."""
    shapes = np.concatenate([factors.rigid_shape, factors.signals])
    shapes = shapes[shapes.any(axis=1)]
    return shapes / np.linalg.norm(shapes, axis=1, keepdims=True)


def _widened(
    result: JointResult, problem: "_Problem", rows: FrameBlocks, stiffness: float
) -> tuple[JointResult, "_Problem"]:
    """
    Return the refinement in all points of one along some directions, and its problem.

    The shapes that the frames ask for, with cameras and coefficients as they are, are
    those of a step of expectation maximisation. Together with those of before they give
    the directions for the next refinement, until there is nothing to gain.
    """
    tol = problem.final_tol
    for _ in range(WIDENINGS):
        state = result.state
        before = problem.frames.points(state.shapes)
        passed = problem.likelihood(stiffness)(*state)
        curvature = regular(passed.shape_curvature)[0]
        pulled = sum(
            rows.map(_pulled, state.motion.transpose(2, 0, 1), passed.alpha.T)
        ).reshape(len(curvature), -1)
        after = np.linalg.solve(curvature, pulled)
        change = after - before.reshape(after.shape)
        gain = float(np.vdot(change, curvature @ change)) / state.noise
        if gain < tol * problem.frames.n_frames:
            break
        both = np.concatenate([after, before.reshape(after.shape)])
        _, size, directions = np.linalg.svd(both, full_matrices=False)
        frames = JointFrames.along(rows, directions[size > FLAT * size[0]])
        problem = problem.of(frames)
        shapes = frames.coordinates(after.reshape(before.shape))
        refined = problem.refined(state._replace(shapes=shapes), stiffness, tol)
        history = np.concatenate([result.history, refined.history])
        result = refined._replace(history=history)
    return result, problem


def _pulled(rows: NDArray, motion: NDArray, alpha: NDArray) -> NDArray:
    """Return ``sum_i (c_i (x) M_i)^T W_i`` of a block."""
    return stacked_motion(motion, alpha).T @ rows.reshape(2 * len(rows), -1)


class _Rigid(NamedTuple):
    """What the rigid fit says about the stiffness of shapes."""

    anisotropy: float  # of its cameras
    noise: float  # what it leaves, a coordinate
    depth: float  # as of `_depth`

    @classmethod
    def of(cls, rows: "_SampleRows", shape: NDArray, factors: Factorisation) -> Self:
        """Return the cameras' anisotropy, and what the rigid shape leaves of rows."""
        motion = factors.rigid_motion.reshape(-1, 2, 3)
        depth = _depth(motion, factors.rigid_shape)
        return cls(anisotropy(motion), rows.rigid_noise(shape), depth)

    def ratio(self, result: JointResult) -> float:
        """Return the anisotropy of a refinement's cameras relative to these."""
        cameras = anisotropy(result.state.motion.transpose(2, 0, 1))
        return cameras / self.anisotropy if self.anisotropy > 0 else 1.0

    def drifted(self, result: JointResult) -> bool:
        """Tell whether a refinement's cameras are far from these."""
        shapes, motion, _ = result.state
        depth = _depth(motion.transpose(2, 0, 1), shapes[0])
        return self.ratio(result) > DRIFTED or 0 < DEEPER * self.depth < depth


def _depth(motion: NDArray, shape: NDArray) -> float:
    """Return the least singular value of the images ``M_i B_0``, for a frame."""
    R = np.asarray(np.linalg.qr(shape.T, mode="r"))
    seen = (motion @ R.T).reshape(-1, len(R))
    return float(np.linalg.svd(seen, compute_uv=False)[-1] / np.sqrt(len(motion)))


class _SampleRows(NamedTuple):
    """The measurement matrix of a sample, in the coordinates of the frames."""

    W: NDArray
    energy: float  # of all points
    n_numbers: int

    @classmethod
    def of(cls, W: NDArray, frames: JointFrames) -> Self:
        """Return the rows of a measurement matrix (2 * n_frames, n_points)."""
        return cls(frames.coordinates(W), float(np.vdot(W, W)), W.size)

    @property
    def least_noise(self) -> float:
        """The least noise variance, a share of the mean square."""
        return NOISE_FLOOR * self.energy / self.n_numbers

    def rigid_noise(self, shape: NDArray) -> float:
        """Return the mean square that a rigid shape, in coordinates, leaves."""
        rows = self.W.reshape(len(self.W) // 2, 2, -1)
        outside = max(self.energy - float(np.vdot(rows, rows)), 0.0)
        return (outside + float(rigid_energy(rows, shape).sum())) / self.n_numbers


def _best(
    problem: "_Problem",
    starts: list[NDArray],
    n_isotropic: int,
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
    return problem.best(starts[:n_isotropic], 0.0), 0.0


def _finished(
    result: JointResult, problems: list["_Problem"], stiffness: float
) -> JointResult:
    """Return the refinement, of all frames and to the end, of one of the first part."""
    for problem in problems[1:] or problems:
        state = result.state
        if problem is not problems[0]:
            state = problem.aligned(state)
        tol = problem.final_tol if problem is problems[-1] else problem.tol
        result = problem.refined(state, stiffness, tol)
    return result


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
    problem: "_Problem",
    rows: FrameBlocks,
    used: NDArray,
    result: JointResult,
    loss: str,
    stiffness: float,
) -> tuple[JointResult, float]:
    """Return the refinement with weights of a robust loss, and the noise variance."""
    tracks = rows.whole().transpose(0, 2, 1)
    seen = seen_points(tracks)
    counted, weights = used * 1.0, np.zeros(seen.shape)
    for _ in range(REWEIGHTINGS):
        shapes, motion, _ = result.state
        stacked = shapes.transpose(0, 2, 1)
        model = project(
            compose(stacked[0], stacked[1:], problem.coefficients(result.state)),
            motion.transpose(2, 0, 1),
            np.zeros(2),
        )
        rest = np.where(seen[..., None], tracks - model, 0.0)
        position = np.einsum("ij,ijc->ic", counted, rest)
        rest -= (position / counted.sum(axis=1, keepdims=True))[:, None]
        distance = np.linalg.norm(rest, axis=2)
        deviation = max(median_noise(distance[seen]), ROUNDING)
        previous, weights = weights, np.zeros(seen.shape)
        weights[seen] = robust_weights(loss, distance[seen] / deviation)
        if np.abs(weights - previous).max() < SETTLED_WEIGHTS:
            break
        problem = problem.of(JointFrames.of_points(rows, False, weights))
        counted = weights
        result = problem.refined(result.state, stiffness, problem.tol)
    return result, deviation**2


def _freedom_correction(
    n_seen: NDArray, n_points: int, n_shapes: int, n_fitted: int
) -> float:
    """
    Return numbers seen divided by the degrees of freedom of the residual.

    Each frame has a camera and a position, eight unknowns; the shapes have three each a
    point, but for the affinity and the mixing. Coefficients that have been integrated
    out take none, those that are fitted to a frame take one each. At least a tenth of
    the numbers counts as free.
    """
    n_frames, n_numbers = len(n_seen), 2.0 * n_seen.sum()
    unknowns = (
        (8 + n_fitted) * n_frames + 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    )
    return float(n_numbers / max(n_numbers - unknowns, 0.1 * n_numbers))


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
        frames: JointFrames,
        rows: _SampleRows,
        max_iter: int,
        tol: float,
        on_step: Callable[[], None] | None,
    ):
        self.frames, self.rows = frames, rows
        self.max_iter, self.tol, self.on_step = max_iter, tol, on_step

    @property
    def final_tol(self) -> float:
        """The tolerance of the last steps: with few frames they cost little."""
        return self.tol * (POLISH if self.frames.n_frames <= FEW_FRAMES else 1.0)

    def of(self, frames: JointFrames) -> Self:
        """Return the problem of the same frames in other coordinates or weights."""
        return type(self)(frames, self.rows, self.max_iter, self.tol, self.on_step)

    def start(self, shapes: NDArray) -> JointState:
        """Return shapes with the cameras of a rigid fit, and part of what it leaves."""
        shapes = self.frames.coordinates(shapes)
        motion = rigid_cameras(self.rows.W, shapes[0].T)
        noise = FIRST_NOISE * self.rows.rigid_noise(shapes[0])
        noise = max(noise, self.rows.least_noise)
        return JointState(shapes, motion.transpose(1, 2, 0), noise)

    def scaled(self, shapes: NDArray) -> NDArray:
        """Return shapes whose coefficients, with rigid cameras, have unit variance."""
        known = self.frames.coordinates(shapes).transpose(0, 2, 1)
        size = RigidFrames(known[0], known[1:]).of_rows(self.rows.W)[1].std(axis=0)
        return np.concatenate([shapes[:1], size[:, None, None] * shapes[1:]])

    def aligned(self, state: JointState) -> JointState:
        """Return a state with cameras close to the best for its shapes and noise."""
        shapes = state.shapes
        if self.frames.directions is None:
            shapes = shapes - shapes.mean(axis=2, keepdims=True)
        aligned = partial(_aligned_cameras, shapes=shapes, noise=state.noise)
        motion = self.frames.blocks.joined(aligned)
        return JointState(shapes, motion.transpose(1, 2, 0), state.noise)

    @cached_property
    def totals(self) -> tuple[float, float]:
        """Number of coordinates that the frames show, and their energy."""
        return totals(self.frames.blocks)

    def likelihood(self, stiffness: float) -> MarginalLikelihood:
        """Return the objective."""
        return MarginalLikelihood(self.frames.blocks, stiffness, self.totals)

    def coefficients(self, state: JointState) -> NDArray:
        """Return the means of the coefficients (n_frames, n_components)."""
        return self.likelihood(0.0).coefficients(*state)

    def likelier(self, *starts: NDArray) -> NDArray:
        """Return the shapes that are more likely to start with."""
        likelihood = self.likelihood(0.0)
        return min(starts, key=lambda shapes: likelihood(*self.start(shapes)).value)

    def best(self, starts: list[NDArray], stiffness: float) -> JointResult:
        """Return the best of the joint refinements from some shapes."""
        results = [
            self.refined(self.start(shapes), stiffness, self.tol) for shapes in starts
        ]
        return min(results, key=lambda result: result.history[-1])

    def refined(self, state: JointState, stiffness: float, tol: float) -> JointResult:
        """Return the joint refinement of a state."""
        return refine_joint(
            self.likelihood(stiffness),
            state,
            max_iter=self.max_iter,
            tol=tol,
            on_step=self.on_step,
        )


def _aligned_cameras(
    block: list[FrameTracks], shapes: NDArray, noise: float
) -> NDArray:
    """Return cameras (n_frames, 2, 3) close to the best for given shapes."""
    return np.concatenate([approximate_cameras(part, shapes, noise) for part in block])
