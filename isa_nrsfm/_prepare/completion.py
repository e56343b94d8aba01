"""Completion of tracks with missing points by a low-rank model of the table.

Each row of the measurement matrix is modelled as ``w = B^T z + t 1 + noise`` over its
seen points. The coefficients have the prior z ~ N(0, I), the translation t has none,
and the noise has one variance everywhere. This is probabilistic principal component
analysis (Tipping and Bishop 1999) with missing values (Ilin and Raiko 2010). B has the
rank of the factorisation, 3K + 3. It is found by EM, which starts from the principal
axes of the table with zeros for missing points.

The posterior covariance of z depends on a row only through its *pattern*, the set of
its seen points. It is computed once for each pattern.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from isa_nrsfm._linalg import OF_DIFFERENCES, OF_STEPS, centred, unpacked
from isa_nrsfm._tables import FrameBlocks, point_patterns, representative_frames

# Low-rank model of the rows of a measurement matrix: B (rank, n_points), rows centred,
# and the noise variance of a coordinate
Model = tuple[NDArray, float]


def complete_rows(
    rows: FrameBlocks, n_points: int, n_components: int, model_frames: int
) -> FrameBlocks:
    """Fill in the missing points of centred rows (I, 2, J) by their posterior means.

    These are exact for tables of rank 3K + 3 without noise if each frame shows at least
    3K + 4 points. With fewer points the prior fills the gap.
    """
    # With many points, fewer frames are enough.
    n_sample = int(np.clip(300 * model_frames // n_points, 200, model_frames))
    sample = rows.take(representative_frames(rows, n_sample))
    model = completion_model(sample, 3 * n_components + 3)
    return rows.derive(partial(filled_in, model=model))


def completion_model(
    rows: NDArray, rank: int, tol: float = 0.02, max_iter: int = 200
) -> Model:
    """
    Fit the low-rank model to frames (I, 2, J) by EM, to a relative tolerance `tol`.

    Later steps mostly fit the noise.
    """
    frames = _frames(rows)
    # Centred points have n_points - 1 directions, of which the noise needs one.
    model = _principal_axes(frames[0], max(1, min(rank, rows.shape[2] - 2)))
    for step in range(max_iter):
        _, before = model
        model, mean_square = _em_step(model, *frames)
        if mean_square < 1e-20 or (step > 0 and model[1] > (1.0 - tol) * before):
            break
    return model


def filled_in(rows: NDArray, model: Model) -> NDArray:
    """Return frames (n_frames, 2, n_points), NaN filled in by the model, centred."""
    z, t, *_ = _posterior(*_frames(rows), *model)
    return centred(np.where(np.isnan(rows), z @ model[0] + t, rows))


def _frames(rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return rows (n_frames, 2, n_points), zero where not seen, and their patterns.

    A pattern (n_patterns, n_points) is 1.0 where a point is seen, otherwise 0.0. The
    last array is the index (n_frames,) of the pattern of each frame.
    """
    seen = ~np.isnan(rows).any(axis=1)
    patterns, pattern = point_patterns(seen)
    return np.where(seen[:, None], rows, 0.0), patterns.astype(float), pattern


def _principal_axes(rows: NDArray, rank: int) -> Model:
    """Return the model of rows (n_frames, 2, n_points) by principal components."""
    W = rows.reshape(-1, rows.shape[2])
    n_rows, n_points = W.shape
    is_wide = n_points > n_rows
    moment = (W @ W.T if is_wide else W.T @ W) / n_rows
    size = len(moment)
    values, axes = eigh(moment, subset_by_index=[max(size - rank, 0), size - 1])
    if is_wide:
        axes = W.T @ (axes / np.sqrt(n_rows * np.maximum(values, OF_STEPS)))
    remainder = (np.trace(moment) - values.sum()) / n_points
    # EM cannot move directions of zero variance.
    variances = np.maximum(values, 1e-3 * max(values[-1], OF_STEPS))
    B = (axes * np.sqrt(variances)).T
    return centred(B), max(remainder, 1e-6 * values[-1], OF_STEPS)


def _posterior(
    rows: NDArray, patterns: NDArray, pattern: NDArray, B: NDArray, noise: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the posterior of coefficients z and translations t.

    The means of z (n_frames, 2, rank) and t (n_frames, 2, 1), the covariance of z
    (n_patterns, rank, rank), and that of z with -t (n_patterns, rank), both over the
    noise variance.

    Let B_c be the seen columns of B, its rows centred over them, and the ridge the
    noise variance, bounded below so that matrices can be inverted. Then ``C = (B_c
    B_c^T + ridge I)^-1`` is the posterior covariance over the noise variance, and ``z =
    w B^T C``, ``t = -z . mean(B)`` are the posterior means.
    """
    rank = len(B)
    upper = np.triu_indices(rank)
    sums = patterns @ B.T
    means = sums / patterns.sum(axis=1)[:, None]
    # B_c B_c^T for each pattern. Centring integrates the translation out.
    gram = _symmetric(patterns @ (B[upper[0]] * B[upper[1]]).T)
    gram -= sums[:, :, None] * means[:, None]
    gram[:, range(rank), range(rank)] += max(noise, OF_STEPS)
    covariance = np.linalg.inv(gram)
    cross = (covariance @ means[:, :, None])[:, :, 0]
    z = (rows @ B.T) @ covariance[pattern]
    return z, -(z @ means[pattern][:, :, None]), covariance, cross


def _em_step(
    model: Model, rows: NDArray, patterns: NDArray, pattern: NDArray
) -> tuple[Model, float]:
    """Return the model after one step of EM, and the mean square residual before it."""
    (n_frames, _, n_points), (B, variance) = rows.shape, model
    rank, noise = len(B), max(variance, OF_STEPS)
    upper = np.triu_indices(rank)
    z, t, covariance, cross = _posterior(rows, patterns, pattern, *model)
    # E step: residuals, E[z z^T] of each frame, packed, and E[(w - t) z] of each point
    visible = patterns[pattern]
    moved = (rows - t) * visible[:, None]
    energy = float(np.sum((moved - (z @ B) * visible[:, None]) ** 2))
    squares = z.swapaxes(1, 2) @ z + 2.0 * noise * covariance[pattern]
    squares = squares[:, upper[0], upper[1]]
    products = moved.reshape(-1, n_points).T @ z.reshape(-1, rank)
    products += visible.T @ (2.0 * noise * cross[pattern])
    # M step: least squares for each point. A point that is seen in fewer rows than the
    # rank needs the ridge. The translation takes the mean of the points.
    moments = _symmetric(visible.T @ squares)
    moments[:, range(rank), range(rank)] += OF_DIFFERENCES * n_frames
    B = np.linalg.solve(moments, products[..., None])[..., 0].T
    B -= B.mean(axis=1, keepdims=True)
    # Rescale so that the mean of E[z z^T] is I, as in the prior: parameter expansion,
    # which makes EM faster (Liu, Rubin and Wu 1998).
    mean_square = unpacked(squares.mean(axis=0) / 2)
    B = np.linalg.cholesky(mean_square).T @ B
    # Noise variance: residual energy over degrees of freedom. This is the fixed point
    # of EM's own step for the variance (MacKay 1992). The parameters of a row are its
    # translation and the coefficients that its points determine, rather than the prior.
    determined = rank - noise * np.trace(covariance, axis1=1, axis2=2)
    n_numbers = 2.0 * visible.sum()
    freedom = n_numbers - 2.0 * np.sum(determined[pattern] + 1.0)
    variance = energy / max(freedom, 0.02 * n_numbers)
    return (B, variance), energy / n_numbers


def _symmetric(packed: NDArray) -> NDArray:
    """Return symmetric matrices (n, k, k) from upper triangles (n, n_pairs)."""
    return unpacked(packed.T).transpose(2, 0, 1)
