"""Shapes of a table without noise, by Gauss-Newton steps on the reprojection residual.

Without noise all that the marginal likelihood asks for is a residual of zero, and the
search for its maximum converges slowly: directions in which the residual is nearly flat
gain only as fast as the noise is small. Here the residual of frames i

    sum_i || W_i - M_i sum_k c_ik B_k ||^2,   c_i = (1, alpha_i),

is minimised itself. It is linear in the shapes: with ``X_i = c_i^T (x) M_i`` (2 x (3K +
3)) and all shapes stacked as b it is ``W_i - X_i b``. Camera and coefficients of a
frame are eliminated: for given shapes the residual is projected off the tangent space
of ``M_i S_i``, spanned by the changes ``dM S_i`` and ``M_i B_k`` (variable projection:
Golub, Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares
problems whose variables separate", 1973, in the form of Kaufman, 1975). With Q_i an
orthonormal basis of it and ``E = sum_i X_i^T X_i`` the steps d of the shapes solve

    (I - sum_i G_i G_i^T + damping I) vec(E^1/2 d) = vec(E^-1/2 sum_i X_i^T P_i R_i),
    G_i = (E^-1/2 X_i^T (x) I) Q_i,   P_i R_i = R_i - Q_i Q_i^T R_i

(Levenberg-Marquardt: Nocedal, Wright, "Numerical optimization", 2006, chapter 10). In
these coordinates the matrix has eigenvalues from 0 to 1, zero for the changes of the
basis that images do not tell: the damping leaves those as they are. The steps go along
with every change of the basis of space and of the shapes.

The rows of the shapes lie in the row space of W, which has no more dimensions than
there are rows of shapes: tables are taken to a basis of it, and the number of points
does not matter. Where points are missing the row space comes from alternating least
squares, and the frames that do not determine their missing points are left out. Without
noise a part of the frames is as good as all, so that only as many are taken as keep a
step short.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from isa_nrsfm._frame_posterior import fit_posterior
from isa_nrsfm._frame_products import FrameTracks

# Multiplications of a step: it takes a part of a second.
STEP_COST = 2e9
MAX_STEPS = 50
# The damping at the start, where it ends, and how it changes with a step.
FIRST_DAMPING = 1e-3
SMALLEST_DAMPING = 1e-14
LARGEST_DAMPING = 1e2
EASED, RAISED = 0.05, 8.0
# A residual whose root mean square is this share of that of the tracks is rounding.
ROUNDING = 1e-15
# A step that lowers the sum of squares by less than this share gains little; two of
# them, one after the other, end the search.
LITTLE = 1e-2
# A change of a frame that others make up for, up to this share, is no direction.
DEPENDENT = 1e-9
# The seen points of a frame determine the others if they keep this share of the energy
# of each direction of the row space.
DETERMINED = 1e-3
# Ridge, relative to the trace, for matrices that can be singular.
RIDGE = 1e-14
COMPLETION_STEPS = 60


class Compressed(NamedTuple):
    """
    Frames in a basis of the row space of their tracks.

    Attributes
    ----------
    rows : ndarray of shape (n_frames, 2, n_directions)
        Tracks, ``W_i V``.
    basis : ndarray of shape (n_points, n_directions)
        V, orthonormal and centred columns.
    frames : ndarray of shape (n_frames,)
        Which of the frames these are.
    """

    rows: NDArray
    basis: NDArray
    frames: NDArray


class FramesAndShapes(NamedTuple):
    """
    Unknowns of the search.

    Attributes
    ----------
    shapes : ndarray of shape (3 * n_shapes, n_directions)
        B_0, ..., B_K, stacked.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    """

    shapes: NDArray
    motion: NDArray
    alpha: NDArray


def fit_without_noise(
    blocks: Sequence[FrameTracks],
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    stiffness: float,
) -> tuple[NDArray, NDArray]:
    """
    Return shapes and cameras that leave as little as possible of tracks.

    Parameters
    ----------
    blocks : sequence of FrameTracks
        The tracks.
    shapes : ndarray of shape (n_shapes, 3, n_points)
        B_0, ..., B_K to start from, close enough for the residual to be small.
    motion : ndarray of shape (2, 3, n_frames)
        Cameras to start from.
    alpha : ndarray of shape (n_components, n_frames)
        Coefficients to start from.
    stiffness : float
        As in `MarginalLikelihood`.

    Returns
    -------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        Shapes, in the basis of greatest marginal likelihood.
    motion : ndarray of shape (2, 3, n_frames)
        Cameras.
    """
    n_shapes, _, n_points = shapes.shape
    size = 3 * n_shapes
    n_frames = int(STEP_COST / (size**4 * (5 + n_shapes)))
    W, seen = _table(blocks)
    table = compressed(W, seen, shapes.reshape(size, n_points), max(n_frames, size))
    V = table.basis
    start = FramesAndShapes(
        shapes.reshape(size, n_points) @ V,
        motion[..., table.frames].transpose(2, 0, 1),
        alpha[:, table.frames].T,
    )
    found = minimise(table.rows, start)
    shapes = (found.shapes @ V.T).reshape(n_shapes, 3, n_points)
    alpha = alpha.copy()
    alpha[:, table.frames] = found.alpha.T
    motion, alpha = _all_frames(W, seen, shapes, motion, alpha)
    return likely_basis(shapes, motion, alpha, stiffness), motion


def compressed(
    W: NDArray, seen: NDArray, shapes: NDArray, n_frames: int
) -> Compressed:
    """
    Return frames in a basis of the row space of their tracks.

    Parameters
    ----------
    W : ndarray of shape (n_frames, 2, n_points)
        Tracks in any place; zero where a point is missing.
    seen : ndarray of shape (n_frames, n_points)
        1.0 for points that are seen, 0.0 for the others.
    shapes : ndarray of shape (n_directions, n_points)
        Rows that nearly span the row space.
    n_frames : int
        The most frames to take, spread over those whose seen points determine the
        others.

    Returns
    -------
    Compressed
        The frames.
    """
    V = np.linalg.qr(shapes.T)[0]
    if seen.all():
        frames = _spread(np.arange(len(W)), n_frames)
        W = W[frames]
    else:
        ones = np.ones((1, len(V)))
        frames = _determined(seen, np.vstack([V.T, ones / np.sqrt(len(V))]))
        frames = _spread(frames, n_frames)
        W = _completed(W[frames], seen[frames], V)
    W = (W - W.mean(axis=2, keepdims=True)).reshape(-1, len(V))
    # Two steps of subspace iteration: what is outside of the row space is tiny.
    for _ in range(2):
        V = np.linalg.qr(W.T @ np.linalg.qr(W @ V)[0])[0]
    V -= V.mean(axis=0)
    return Compressed((W @ V).reshape(len(frames), 2, -1), V, frames)


def _spread(frames: NDArray, n: int) -> NDArray:
    """Return at most n of the frames, at equal distances."""
    places = np.linspace(0, len(frames) - 1, min(n, len(frames)))
    return frames[places.round().astype(int)]


def _determined(seen: NDArray, rows: NDArray) -> NDArray:
    """Return the frames whose seen points determine the coefficients of all rows."""
    gram = (seen @ _squares(rows.T)).reshape(-1, len(rows), len(rows))
    least = np.linalg.eigvalsh(gram)[:, 0]
    return np.flatnonzero(least > DETERMINED)


def _squares(rows: NDArray) -> NDArray:
    """Return the products of all pairs of entries of rows (n, k) as (n, k * k)."""
    return (rows[:, :, None] * rows[:, None]).reshape(len(rows), -1)


def _completed(W: NDArray, seen: NDArray, V: NDArray) -> NDArray:
    """Return tracks with the missing points of the nearest table of low rank."""
    n_points, rank = V.shape
    n_seen = max(2.0 * seen.sum(), 1.0)
    square, filled = np.inf, W
    for _ in range(COMPLETION_STEPS):
        rows = np.hstack([V, np.ones((n_points, 1))])
        gram = (seen @ _squares(rows)).reshape(-1, rank + 1, rank + 1)
        factors = np.linalg.solve(gram, (W @ rows).swapaxes(1, 2)).swapaxes(1, 2)
        model = factors @ rows.T
        previous = square
        filled = np.where(seen[:, None] > 0, W, model)
        square = np.sum((filled - model) ** 2) / n_seen
        if not LITTLE * previous > 0 or square > (1 - LITTLE) * previous:
            break
        # The points of least squares for the coefficients of the frames.
        z, place = factors[..., :rank], factors[..., rank:]
        moments = np.einsum("irk,irl->ikl", z, z).reshape(len(z), -1)
        moments = (seen.T @ moments).reshape(n_points, rank, rank)
        moved = (W - place) * seen[:, None]
        right = np.einsum("irj,irk->jk", moved, z)
        ridge = RIDGE * np.trace(moments, axis1=1, axis2=2).mean() * np.eye(rank)
        V = np.linalg.solve(moments + ridge, right[..., None])[..., 0]
        V = np.linalg.qr(V - V.mean(axis=0))[0]
    return filled


def motion_rows(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return ``X_i = c_i^T (x) M_i`` (n_frames, 2, 3 * n_shapes)."""
    c = np.hstack([np.ones((len(alpha), 1)), alpha])
    rows = c[:, None, :, None] * motion[:, :, None]
    return rows.reshape(len(c), 2, -1)


def frame_tangents(state: FramesAndShapes) -> NDArray:
    """
    Return the derivatives of the images by cameras and coefficients.

    Parameters
    ----------
    state : FramesAndShapes
        Where.

    Returns
    -------
    ndarray of shape (n_frames, 2 * n_directions, 6 + n_components)
        Of ``M_i S_i``, rows one after the other, by the rows of M_i and by alpha_i.
    """
    b, motion, alpha = state
    n_frames, n_components = alpha.shape
    shapes = b.reshape(n_components + 1, 3, -1)
    frame_shapes = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    n_directions = b.shape[1]
    tangents = np.zeros((n_frames, 2, n_directions, 6 + n_components))
    for row in range(2):
        cameras = slice(3 * row, 3 * row + 3)
        tangents[:, row, :, cameras] = frame_shapes.swapaxes(1, 2)
    tangents[..., 6:] = np.einsum("ira,kad->irdk", motion, shapes[1:])
    return tangents.reshape(n_frames, 2 * n_directions, -1)


class _Frames(NamedTuple):
    """Frames at a state: residuals, and what cameras and coefficients do about them."""

    rest: NDArray  # W_i - X_i b (n, 2 n_directions)
    tangent: NDArray  # Q_i (n, 2 n_directions, 6 + K)
    factor: NDArray  # of the tangents, Q_i times it (n, 6 + K, 6 + K)

    @classmethod
    def at(cls, rows: NDArray, state: FramesAndShapes) -> "_Frames":
        """Return the frames with their residual and their tangent space."""
        rest = rows - motion_rows(state.motion, state.alpha) @ state.shapes
        tangents = frame_tangents(state)
        size = np.linalg.norm(tangents, axis=1)
        Q, R = np.linalg.qr(tangents)
        diagonal = np.arange(R.shape[-1])
        kept = np.abs(R[:, diagonal, diagonal]) > DEPENDENT * size
        Q *= kept[:, None]
        R *= kept[..., None]
        R[:, diagonal, diagonal] += ~kept
        return cls(rest.reshape(len(rows), -1), Q, R)

    def moved(self, state: FramesAndShapes, rest: NDArray) -> FramesAndShapes:
        """Return cameras and coefficients after the step that a residual asks for."""
        along = self.tangent.swapaxes(1, 2) @ rest[..., None]
        step = np.linalg.solve(self.factor, along)[..., 0]
        motion = state.motion + step[:, :6].reshape(-1, 2, 3)
        return FramesAndShapes(state.shapes, motion, state.alpha + step[:, 6:])


def minimise(rows: NDArray, start: FramesAndShapes) -> FramesAndShapes:
    """
    Return the state of least residual that Levenberg-Marquardt steps lead to.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_directions)
        Tracks of the frames.
    start : FramesAndShapes
        Where to start.

    Returns
    -------
    FramesAndShapes
        Where it ended. The residual is never larger than that of the start.
    """
    state = start
    energy = float(np.vdot(rows, rows))
    frames = _Frames.at(rows, state)
    square = float(np.vdot(frames.rest, frames.rest))
    damping, small_steps, system = FIRST_DAMPING, 0, None
    for _ in range(MAX_STEPS):
        if square <= ROUNDING**2 * energy or small_steps >= 2 or damping > LARGEST_DAMPING:
            break
        if system is None:
            system = normal_equations(frames, state)
        trial = _stepped(rows, state, frames, system, damping)
        after = _Frames.at(rows, trial)
        reached = float(np.vdot(after.rest, after.rest))
        if not reached < square:
            damping *= RAISED
            continue
        small_steps = small_steps + 1 if reached > (1 - LITTLE) * square else 0
        damping = max(EASED * damping, SMALLEST_DAMPING)
        state, frames, square, system = trial, after, reached, None
    return state


class _System(NamedTuple):
    """Equations of a step of the shapes, frames eliminated."""

    matrix: NDArray  # I - sum_i G_i G_i^T
    slope: NDArray  # E^-1/2 sum_i X_i^T P_i R_i (3 n_shapes, n_directions)
    root: NDArray  # upper triangular factor of E


def normal_equations(frames: _Frames, state: FramesAndShapes) -> _System:
    """Return the equations of a step, as in the head of this module."""
    X = motion_rows(state.motion, state.alpha)
    n_frames, _, size = X.shape
    n_directions = state.shapes.shape[1]
    E = np.tensordot(X, X, axes=([0, 1], [0, 1]))
    E += RIDGE * np.trace(E) * np.eye(size)
    root = np.linalg.cholesky(E).T
    X = solve_triangular(root, X.reshape(-1, size).T, trans="T").T.reshape(X.shape)
    Q, rest = frames.tangent, frames.rest[..., None]
    rest = rest - Q @ (Q.swapaxes(1, 2) @ rest)
    rest = rest.reshape(2 * n_frames, n_directions)
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
    """Return the state after a step of the shapes, and two of the frames."""
    matrix = system.matrix + damping * np.eye(len(system.matrix))
    step = np.linalg.solve(matrix, system.slope.ravel()).reshape(state.shapes.shape)
    step = solve_triangular(system.root, step)
    X = motion_rows(state.motion, state.alpha)
    rest = frames.rest - (X @ step).reshape(len(rows), -1)
    moved = state._replace(shapes=state.shapes + step)
    moved = _better(rows, moved, frames.moved(moved, rest))
    frames = _Frames.at(rows, moved)
    return _better(rows, moved, frames.moved(moved, frames.rest))


def _better(
    rows: NDArray, first: FramesAndShapes, second: FramesAndShapes
) -> FramesAndShapes:
    """Return the cameras and coefficients of each frame that leave less."""
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


def _table(blocks: Sequence[FrameTracks]) -> tuple[NDArray, NDArray]:
    """Return tracks (n_frames, 2, n_points), zero where missing, and what is seen."""
    tracks, seen = [], []
    for block in blocks:
        weighted = block.weighted.transpose(2, 1, 0)
        if block.weights is None:
            tracks.append(weighted)
            seen.append(np.ones(weighted[:, 0].shape))
        else:
            W = block.weights.T[:, None]
            shown = np.broadcast_to(W > 0, weighted.shape)
            tracks.append(
                np.divide(weighted, W, where=shown, out=np.zeros(weighted.shape))
            )
            seen.append(1.0 * (W[:, 0] > 0))
    return np.concatenate(tracks), np.concatenate(seen)


def _all_frames(
    W: NDArray, seen: NDArray, shapes: NDArray, motion: NDArray, alpha: NDArray
) -> tuple[NDArray, NDArray]:
    """Return cameras and coefficients of all frames for given shapes."""
    fit = fit_posterior(W.swapaxes(1, 2), shapes, 0.0, weights=seen, initial=alpha.T)
    known = np.isfinite(fit.alpha).all(axis=1)
    return (
        np.where(known, fit.motion.transpose(1, 2, 0), motion),
        np.where(known, fit.alpha.T, alpha),
    )


def likely_basis(
    shapes: NDArray, motion: NDArray, alpha: NDArray, stiffness: float
) -> NDArray:
    """
    Return the same shapes in the basis of greatest marginal likelihood.

    Without noise it is free to shift the mean shape, and to mix the basis shapes by any
    A: alpha becomes ``A^-1 (alpha - mean)``, and the objective changes by

        n log det(A A^T) + sum_i ||A^-1 (alpha_i - mean)||^2 + stiffness tr(A^T H A)

    with H the sum over the frames of ``<M B_k, M B_l>``. Where the covariance of the
    coefficients is the identity and H is diagonal, A is diagonal, too.

    Parameters
    ----------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        Mean shape and basis shapes.
    motion : ndarray of shape (2, 3, n_frames)
        Cameras.
    alpha : ndarray of shape (n_components, n_frames)
        Coefficients.
    stiffness : float
        As in `MarginalLikelihood`.

    Returns
    -------
    ndarray of shape (n_shapes, 3, n_points)
        Mean shape and basis shapes.
    """
    n_frames = motion.shape[2]
    mean = alpha.mean(axis=1)
    mean_shape = shapes[0] + np.tensordot(mean, shapes[1:], 1)
    rest = alpha - mean[:, None]
    covariance = rest @ rest.T / n_frames
    covariance += RIDGE * np.trace(covariance) * np.eye(len(mean))
    basis = np.tensordot(np.linalg.cholesky(covariance).T, shapes[1:], 1)
    cameras = np.einsum("rai,rbi->ab", motion, motion) / n_frames
    energy, axes = np.linalg.eigh(np.einsum("ab,kaj,lbj->kl", cameras, basis, basis))
    price = stiffness * np.maximum(energy, 0.0)
    scale = np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + 4.0 * price)))
    basis = scale[:, None, None] * np.tensordot(axes.T, basis, 1)
    return np.concatenate([mean_shape[None], basis])
