"""Shapes of a table without noise, by Gauss-Newton steps on the reprojection residual.

Without noise the marginal likelihood is greatest where the residual is zero. A gradient
method on the likelihood converges slowly there: it is badly conditioned along
directions that hardly change the images. Here the residual itself,

    sum_i || W_i - M_i sum_k c_ik B_k ||^2,   c_i = (1, alpha_i),

is minimised. With ``X_i = c_i^T (x) M_i`` (2 x (3K + 3)) and all shapes stacked as b
(3K + 3 rows) the residual of a frame is ``R_i = W_i - X_i b``. Camera and coefficients
of a frame are eliminated: its residual is projected off the tangent space of
``M_i S_i``, ``S_i = sum_k c_ik B_k``. That space is spanned by ``dM S_i`` and ``M_i
B_k`` (variable projection: Golub, Pereyra, "The differentiation of
pseudo-inverses and nonlinear least squares problems whose variables separate", 1973;
the derivative of the projector is left out, as by Kaufman, "A variable projection
method for solving separable nonlinear least squares problems", 1975). Let Q_i be an
orthonormal basis of that space, ``P_i R_i = R_i - Q_i Q_i^T R_i`` the projected
residual and ``E = sum_i X_i^T X_i``. A step d of the shapes solves

    (I - sum_i G_i G_i^T + damping I) vec(E^1/2 d) = vec(E^-1/2 sum_i X_i^T P_i R_i),
    G_i = (E^-1/2 X_i^T (x) I) Q_i

(Levenberg-Marquardt: Nocedal, Wright, "Numerical optimization", 2006, chapter 10). Any
square root of E will do: the code takes its Cholesky factor. The matrix without the
damping has eigenvalues from 0 to 1. They are zero for changes of the basis that leave
the images as they are: the damping suppresses those. The steps are equivariant: they
do not depend on the basis of space or of the shapes.

The rows of the shapes lie in the row space of W, which has at most as many dimensions
as the shapes have rows. The tracks are given in a basis of it, so that the number of
points does not matter. Where points are missing the row space comes from alternating
least squares over frames whose seen points determine the others. Without noise some of
the frames tell as much as all: their number is limited by the cost of a step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.point_sums import FrameTracks
from isa_nrsfm._frames.posterior import SEARCHES, fit_posterior, fit_prepared
from isa_nrsfm._frames.projection import stacked_motion
from isa_nrsfm._joint.likely_basis import likely_basis
from isa_nrsfm._joint.options import JOINT_OPTIONS, NoiseFreeOptions
from isa_nrsfm._linalg.rounding import OF_DISTANCES, OF_PRODUCTS, OF_SUMS
from isa_nrsfm._linalg.vectors import frames_first, frames_last
from isa_nrsfm._tables.blocks import FrameBlocks


class FramesAndShapes(NamedTuple):
    """
    Unknowns of the search.

    Attributes
    ----------
    shapes : ndarray of shape (3 * n_shapes, n_directions)
        b: B_0, ..., B_K in the basis of the row space, stacked.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    """

    shapes: NDArray
    motion: NDArray
    alpha: NDArray


def fit_without_noise(
    blocks: FrameBlocks,
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    penalty: NDArray | float,
    cameras: CameraModel,
    options: NoiseFreeOptions = JOINT_OPTIONS.noise_free,
) -> tuple[NDArray, NDArray] | None:
    """
    Return shapes and cameras that leave as little as possible of tracks.

    Parameters
    ----------
    blocks : FrameBlocks
        Blocks of FrameTracks. Points with a weight below one half count as missing, the
        others alike.
    shapes : ndarray of shape (n_shapes, 3, n_points)
        B_0, ..., B_K to start from, close enough for the residual to be small.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras to start from.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients to start from.
    penalty : float or ndarray of shape (n_components,)
        As in `MarginalLikelihood`.
    cameras : CameraModel
        The cameras that are allowed.
    options : NoiseFreeOptions
        How steps are made.

    Returns
    -------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        Shapes, in the basis of greatest marginal likelihood.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras. Those of frames whose points do not determine one are as they came.

    Notes
    -----
    None is returned in two cases: if a step with enough frames to determine the shapes
    would cost too much, or if too few frames determine their missing points.
    """
    n_shapes, _, n_points = shapes.shape
    b = shapes.reshape(3 * n_shapes, n_points)
    # Frames to fit: as many as the cost of a step allows
    n_frames = int(options.step_cost / (len(b) ** 4 * (5 + n_shapes)))
    if n_frames < len(b):
        return None
    W, frames = complete_frames(blocks, b, n_frames, options)
    if len(frames) < min(len(b), len(alpha)):
        return None
    # Gauss-Newton steps in a basis V of the row space
    rows, V = compressed(W, b)
    start = FramesAndShapes(b @ V, motion[frames], alpha[frames])
    found = minimise(rows, start, cameras, options)
    shapes = (found.shapes @ V.T).reshape(shapes.shape)
    # Cameras and coefficients of all frames for these shapes
    alpha = alpha.copy(order="F")  # sums over the frames are over rows of memory
    alpha[frames] = found.alpha
    # The fit of a frame takes coefficients of usual sizes. Those of a basis shape that
    # is nothing but rounding errors may be as large as numbers can be.
    size = np.abs(alpha).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    shapes[1:] *= size[:, None, None]
    alpha /= size
    fitted = partial(
        _fitted, shapes=shapes, camera=cameras.name, counted=options.counted
    )
    motion, alpha = _all_frames(blocks, fitted, motion, alpha)
    return likely_basis(shapes, motion, alpha, penalty), motion


def complete_frames(
    blocks: FrameBlocks,
    shapes: NDArray,
    n_frames: int,
    options: NoiseFreeOptions = JOINT_OPTIONS.noise_free,
) -> tuple[NDArray, NDArray]:
    """
    Return some frames with their missing points filled in, and which ones they are.

    Parameters
    ----------
    blocks : FrameBlocks
        Blocks of FrameTracks.
    shapes : ndarray of shape (n_rows, n_points)
        Rows that nearly span the row space of the tracks.
    n_frames : int
        About how many frames to take, spread over all that determine their missing
        points.
    options : NoiseFreeOptions
        Which points count, and how missing ones are filled in.

    Returns
    -------
    W : ndarray of shape (n_chosen, 2, n_points)
        Tracks, centred over all points.
    frames : ndarray of shape (n_chosen,)
        The numbers of these frames.
    """
    V = np.linalg.qr(shapes.T)[0]
    share = n_frames / blocks.n_frames
    chosen = partial(_chosen, V=V, share=share, options=options)
    tracks, masks, frames = [], [], []
    for part, found in zip(blocks.slices, blocks.map(chosen), strict=True):
        W, seen, places = found
        tracks.append(W)
        masks.append(seen)
        frames.append(part.start + places)
    W = np.concatenate(tracks)
    if masks[0] is not None:
        seen = np.concatenate(masks)
        if len(W) and not seen.all():
            W = _completed(W, seen, V, options)
        W = W - W.mean(axis=2, keepdims=True)
    return W, np.concatenate(frames)


def _chosen(
    block: FrameTracks, V: NDArray, share: float, options: NoiseFreeOptions
) -> tuple[NDArray, NDArray | None, NDArray]:
    """Return tracks, seen points and numbers of evenly spread frames of a block."""
    W, seen = _tracks_of(block, options.counted)
    usable = np.arange(len(W))
    if seen is not None and not seen.all():
        usable = _determined(seen, V, options.determined)
    n = min(len(usable), int(np.ceil(share * len(W))))
    frames = usable[np.linspace(0, len(usable) - 1, n).round().astype(int)]
    return W[frames], None if seen is None else seen[frames], frames


def _tracks_of(block: FrameTracks, counted: float) -> tuple[NDArray, NDArray | None]:
    """
    Return tracks (n_frames, 2, n_points) and which points are seen.

    Missing points are zero. The second array (n_frames, n_points) is 1.0 for seen
    points and 0.0 for others. It is None for frames without weights, which may be given
    by directions instead of points. Points with at least the weight counted are seen.
    """
    weighted = block.weighted.transpose(2, 1, 0)
    if block.weights is None:
        return weighted, None
    weights = block.weights.T
    seen = weights >= counted
    factor = np.where(seen, 1.0 / np.where(seen, weights, 1.0), 0.0)
    return factor[:, None] * weighted, 1.0 * seen


def _determined(seen: NDArray, V: NDArray, least_eigenvalue: float) -> NDArray:
    """Return the frames whose seen points determine their position and factors of V."""
    n_points = len(V)
    rows = np.hstack([V, np.full((n_points, 1), n_points**-0.5)])
    gram = (seen @ _squares(rows)).reshape(len(seen), rows.shape[1], -1)
    least = np.linalg.eigvalsh(gram)[:, 0]
    return np.flatnonzero(least > least_eigenvalue)


def _squares(rows: NDArray) -> NDArray:
    """Return the products of all pairs of entries of rows (n, k) as (n, k * k)."""
    return (rows[:, :, None] * rows[:, None]).reshape(len(rows), -1)


def _completed(
    W: NDArray, seen: NDArray, V: NDArray, options: NoiseFreeOptions
) -> NDArray:
    """
    Return tracks with missing points from a low rank fit, by alternating least squares.

    The model of a frame is ``z_i V^T`` plus its position. W is (n_frames, 2, n_points),
    zero where a point is missing, seen (n_frames, n_points), and V (n_points, rank) the
    row space to start from.
    """
    n_points, rank = V.shape
    n_seen = max(2.0 * seen.sum(), 1.0)
    square, filled, little = np.inf, W, options.little
    for _ in range(options.completion_steps):
        # Coefficients z_i and positions of the frames for given V
        rows = np.hstack([V, np.ones((n_points, 1))])
        gram = (seen @ _squares(rows)).reshape(-1, rank + 1, rank + 1)
        # A ridge: if the rank of W is lower, a column of V is arbitrary.
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        gram += OF_PRODUCTS * size * np.eye(rank + 1)
        factors = np.linalg.solve(gram, (W @ rows).swapaxes(1, 2)).swapaxes(1, 2)
        # Residual of the seen points, and convergence test
        model = factors @ rows.T
        previous = square
        filled = np.where(seen[:, None] > 0, W, model)
        square = np.sum((filled - model) ** 2) / n_seen
        if not little * previous > 0 or square > (1 - little) * previous:
            break
        # V for given coefficients z_i and positions
        z, place = factors[..., :rank], factors[..., rank:]
        moments = np.einsum("irk,irl->ikl", z, z).reshape(len(z), -1)
        moments = (seen.T @ moments).reshape(n_points, rank, rank)
        moved = (W - place) * seen[:, None]
        right = np.einsum("irj,irk->jk", moved, z)
        size = np.trace(moments, axis1=1, axis2=2).mean()
        ridge = OF_PRODUCTS * size * np.eye(rank)
        V = np.linalg.solve(moments + ridge, right[..., None])[..., 0]
        V = np.linalg.qr(V - V.mean(axis=0))[0]
    return filled


def compressed(W: NDArray, shapes: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return tracks in a basis of their row space.

    Parameters
    ----------
    W : ndarray of shape (n_frames, 2, n_points)
        Complete tracks, centred.
    shapes : ndarray of shape (n_rows, n_points)
        Rows that nearly span the row space.

    Returns
    -------
    rows : ndarray of shape (n_frames, 2, n_directions)
        ``W_i V``.
    V : ndarray of shape (n_points, n_directions)
        The basis, orthonormal columns.
    """
    flat = W.reshape(-1, W.shape[2])
    V = np.linalg.qr(shapes.T)[0]
    # Subspace iteration: two rounds do, as the part of W outside of the span is tiny.
    for _ in range(2):
        V = np.linalg.qr(flat.T @ np.linalg.qr(flat @ V)[0])[0]
    return W @ V, V


def motion_rows(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return ``X_i = c_i^T (x) M_i`` (n_frames, 2, 3 * n_shapes), frames first."""
    return stacked_motion(motion, alpha).reshape(len(alpha), 2, -1)


def frame_tangents(state: FramesAndShapes, cameras: CameraModel) -> NDArray:
    """
    Return the derivatives of the images by cameras and coefficients.

    Parameters
    ----------
    state : FramesAndShapes
        The state at which they are taken.
    cameras : CameraModel
        The cameras that are allowed.

    Returns
    -------
    ndarray of shape (n_frames, 2 * n_directions, n_parameters + n_components)
        The derivatives of ``M_i S_i``, its two rows one after the other, by the
        parameters of M_i and by alpha_i.
    """
    b, motion, alpha = state
    n_frames, n_components = alpha.shape
    shapes = b.reshape(n_components + 1, 3, -1)
    frame_shapes = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    n_directions = b.shape[1]
    D = cameras.tangents(frames_last(motion))
    by_camera = np.einsum("crai,iad->irdc", D, frame_shapes)
    by_alpha = np.einsum("ira,kad->irdk", motion, shapes[1:])
    tangents = np.concatenate([by_camera, by_alpha], axis=3)
    return tangents.reshape(n_frames, 2 * n_directions, -1)


class _Frames(NamedTuple):
    """Residuals of frames at a state, and the QR factors of their tangents."""

    rest: NDArray  # R_i = W_i - X_i b (n, 2 n_directions)
    tangent: NDArray  # Q_i (n, 2 n_directions, n_parameters + K)
    factor: NDArray  # triangular factor: tangents = Q_i factor_i
    cameras: CameraModel

    @classmethod
    def at(
        cls, rows: NDArray, state: FramesAndShapes, cameras: CameraModel
    ) -> "_Frames":
        """Return the frames with their residual and tangents; rows (n, 2, n_dirs)."""
        rest = rows - motion_rows(state.motion, state.alpha) @ state.shapes
        tangents = frame_tangents(state, cameras)
        size = np.linalg.norm(tangents, axis=1)
        Q, R = np.linalg.qr(tangents)
        # Dependent tangents: their columns of Q are zero, their steps are zero, too.
        diagonal = np.arange(R.shape[-1])
        kept = np.abs(R[:, diagonal, diagonal]) > OF_DISTANCES * size
        Q *= kept[:, None]
        R *= kept[..., None]
        R[:, diagonal, diagonal] += ~kept
        return cls(rest.reshape(len(rows), -1), Q, R, cameras)

    def moved(self, state: FramesAndShapes, rest: NDArray) -> FramesAndShapes:
        """
        Return the state after a Gauss-Newton step of cameras and coefficients.

        It is the least squares solution for a residual, rest (n, 2 n_directions).
        """
        along = self.tangent.swapaxes(1, 2) @ rest[..., None]
        step = np.linalg.solve(self.factor, along)[..., 0]
        n = self.cameras.n_parameters
        turns = self.cameras.limited(step[:, :n].T)
        M = self.cameras.moved(frames_last(state.motion), turns)
        alpha = state.alpha + step[:, n:]
        return FramesAndShapes(state.shapes, frames_first(M), alpha)


def minimise(
    rows: NDArray,
    start: FramesAndShapes,
    cameras: CameraModel,
    options: NoiseFreeOptions = JOINT_OPTIONS.noise_free,
) -> FramesAndShapes:
    """
    Minimise the residual by Levenberg-Marquardt steps.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_directions)
        Tracks of the frames.
    start : FramesAndShapes
        The first iterate.
    cameras : CameraModel
        The cameras that are allowed.
    options : NoiseFreeOptions
        Steps and damping.

    Returns
    -------
    FramesAndShapes
        The last iterate. Its residual is never larger than that of the start.
    """
    state = start
    energy = float(np.vdot(rows, rows))
    frames = _Frames.at(rows, state, cameras)
    square = float(np.vdot(frames.rest, frames.rest))
    damping, small_steps, system = options.first_damping, 0, None
    for _ in range(options.max_steps):
        # Convergence tests
        if square <= OF_SUMS**2 * energy or small_steps == 2:
            break
        if damping > options.largest_damping:
            break
        if system is None:
            system = normal_equations(frames, state)
        # Trial step: refused, with more damping, unless it lowers the residual
        trial = _stepped(rows, state, frames, system, damping)
        after = _Frames.at(rows, trial, cameras)
        reached = float(np.vdot(after.rest, after.rest))
        if not reached < square:
            damping *= options.raised
            continue
        small = reached > (1 - options.little) * square
        small_steps = small_steps + 1 if small else 0
        damping = max(options.eased * damping, options.smallest_damping)
        state, frames, square, system = trial, after, reached, None
    return state


class _System(NamedTuple):
    """Normal equations of a step of the shapes, cameras and coefficients eliminated."""

    matrix: NDArray  # I - sum_i G_i G_i^T, rows and columns as the raveled slope
    slope: NDArray  # E^-1/2 sum_i X_i^T P_i R_i (3 n_shapes, n_directions)
    root: NDArray  # upper triangular, root^T root = E: stands for E^1/2


def normal_equations(frames: _Frames, state: FramesAndShapes) -> _System:
    """Return the normal equations of a step, as in the docstring of this module."""
    X = motion_rows(state.motion, state.alpha)
    n_frames, _, size = X.shape
    n_directions = state.shapes.shape[1]
    E = np.tensordot(X, X, axes=([0, 1], [0, 1]))
    E += OF_PRODUCTS * np.trace(E) * np.eye(size)
    root = np.linalg.cholesky(E).T
    # X_i E^-1/2
    X = solve_triangular(root, X.reshape(-1, size).T, trans="T").T.reshape(X.shape)
    # Projected residuals P_i R_i
    Q, rest = frames.tangent, frames.rest[..., None]
    rest = rest - Q @ (Q.swapaxes(1, 2) @ rest)
    rest = rest.reshape(2 * n_frames, n_directions)
    # G_i of all frames beside each other
    G = X.swapaxes(1, 2) @ Q.reshape(n_frames, 2, -1)
    G = G.reshape(n_frames, size * n_directions, -1).swapaxes(0, 1)
    G = G.reshape(size * n_directions, -1)
    matrix = np.eye(len(G)) - G @ G.T
    return _System(matrix, X.reshape(-1, size).T @ rest, root)


def _stepped(
    rows: NDArray,
    state: FramesAndShapes,
    frames: _Frames,
    system: _System,
    damping: float,
) -> FramesAndShapes:
    """Return the state after a damped step of the shapes, and two of each frame."""
    matrix = system.matrix + damping * np.eye(len(system.matrix))
    step = np.linalg.solve(matrix, system.slope.ravel()).reshape(state.shapes.shape)
    step = solve_triangular(system.root, step)
    # Residual after the step of the shapes, cameras and coefficients held
    X = motion_rows(state.motion, state.alpha)
    rest = frames.rest - (X @ step).reshape(len(rows), -1)
    moved = state._replace(shapes=state.shapes + step)
    moved = _better(rows, moved, frames.moved(moved, rest))
    # Gauss-Newton step of each frame, shapes held
    frames = _Frames.at(rows, moved, frames.cameras)
    return _better(rows, moved, frames.moved(moved, frames.rest))


def _better(
    rows: NDArray, first: FramesAndShapes, second: FramesAndShapes
) -> FramesAndShapes:
    """Return for each frame the camera and coefficients of the smaller residual."""
    left = [
        np.sum((rows - motion_rows(s.motion, s.alpha) @ s.shapes) ** 2, axis=(1, 2))
        for s in (first, second)
    ]
    better = left[1] < left[0]
    return FramesAndShapes(
        first.shapes,
        np.where(better[:, None, None], second.motion, first.motion),
        np.where(better[:, None], second.alpha, first.alpha),
    )


def _all_frames(
    blocks: FrameBlocks, fitted: Callable[..., Any], motion: NDArray, alpha: NDArray
) -> tuple[NDArray, NDArray]:
    """
    Return motion (n_frames, 2, 3) and alpha (n_frames, K) of all frames.

    The function fitted returns cameras and coefficients of a block.
    """
    motion, alpha = np.copy(motion), np.copy(alpha)
    fits = blocks.map(fitted, alpha.copy())
    for part, (cameras, coefficients) in zip(blocks.slices, fits, strict=True):
        known = np.isfinite(coefficients).all(axis=1)
        frames = np.arange(part.start, part.stop)[known]
        motion[frames] = cameras[known]
        alpha[frames] = coefficients[known]
    return motion, alpha


def _fitted(
    block: FrameTracks,
    initial: NDArray,
    shapes: NDArray,
    camera: str,
    counted: float,
) -> tuple[NDArray, NDArray]:
    """Return cameras (n, 2, 3) and coefficients of a block; initial (n, K)."""
    W, seen = _tracks_of(block, counted)
    if seen is None:
        fit = fit_prepared(block, SEARCHES[camera](shapes), 0.0, initial=initial)
    else:
        tracks = W.swapaxes(1, 2)
        fit = fit_posterior(
            tracks, shapes, 0.0, camera=camera, weights=seen, initial=initial
        )
    return fit.motion, fit.alpha
