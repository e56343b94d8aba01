"""Measures of the reprojection of a table."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_array

from isa_nrsfm._tables import (
    CHECKS,
    LAYOUTS,
    FrameBlocks,
    Layout,
    centred_frames,
    seen_points,
    table_to_tracks,
    unmasked,
    without_half_points,
)
from isa_nrsfm.metrics._shapes import check_same_shape


def inverse_snr(
    X: ArrayLike,
    X_hat: ArrayLike,
    *,
    layout: Layout = "interleaved",
    scale_frames: bool = False,
) -> float:
    r"""
    Compute the energy of the reprojection error relative to that of the table.

    This is :math:`\|W - \hat W\|_F^2 / \|W\|_F^2`, where W and :math:`\hat W` are the
    two tables with every frame centred over its points.

    Parameters
    ----------
    X : array-like of shape (n_frames, 2 * n_points)
        The table. Points with a NaN coordinate were not seen. They are ignored in both
        tables.
    X_hat : array-like of shape (n_frames, 2 * n_points)
        The reprojection. It must be finite at the points seen in `X`.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=False
        Whether to divide each frame of both tables by the RMS of its centred, seen
        coordinates in `X`. Small and large images then have the same weight, as in
        ``AffineNRSfM(scale_frames=True)``.

    Returns
    -------
    float
        The inverse signal-to-noise ratio, a fraction (not percent): 0 for a perfect
        reprojection, 1 if nothing but the centroids is reprojected.

    Raises
    ------
    ValueError
        If the tables differ in shape, have an odd number of columns or infinite
        entries, if a seen point has no reprojection, or if there is no energy to
        compare with: all seen points equal in every frame (with `scale_frames`, in any
        frame where points are seen).

    Examples
    --------
    >>> from isa_nrsfm.metrics import inverse_snr
    >>> X = [[0.0, 0.0, 2.0, 0.0], [5.0, 5.0, 5.0, 7.0]]
    >>> X_hat = [[0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    >>> inverse_snr(X, X_hat)
    0.125
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {LAYOUTS}; got {layout!r}")
    energy, error, seen = frame_energies(X, X_hat, layout)
    if scale_frames:
        used = seen.any(axis=1)
        flat = np.flatnonzero(used & (energy == 0))
        if len(flat):
            raise ValueError(
                f"frames of X whose seen points are all in one place: {len(flat)} of "
                f"{len(energy)} (first: row {flat[0]}). They have no size to scale "
                "them by. Remove them, or use scale_frames=False"
            )
        weights = seen.sum(axis=1)[used] / energy[used]
        energy, error = energy[used] * weights, error[used] * weights
    if not energy.sum() > 0:
        raise ValueError(
            "in each frame of X all seen points are in one place, so that errors "
            "cannot be related to a size. Check how X was read"
        )
    return float(error.sum() / energy.sum())


def frame_energies(
    X: ArrayLike, X_hat: ArrayLike, layout: Layout
) -> tuple[NDArray, NDArray, NDArray]:
    """Return energies of frames and of their errors, and the mask of seen points."""
    checks = CHECKS | {"dtype": np.float64}
    truth = check_array(unmasked(X), input_name="X", **checks)
    fitted = check_array(unmasked(X_hat), input_name="X_hat", **checks)
    check_same_shape("X", truth, "X_hat", fitted)
    both = (table_to_tracks(table, layout).mT for table in (truth, fitted))
    truth, fitted = (without_half_points(rows)[0] for rows in both)
    seen = seen_points(truth)
    lost = seen & ~seen_points(fitted)
    if lost.any():
        rows = np.flatnonzero(lost.any(axis=1))
        raise ValueError(
            f"X_hat lacks points that X shows (NaN): {lost.sum()} in {len(rows)} of "
            f"{len(lost)} frames (first: row {rows[0]}). Fill them in, or make them "
            "NaN in X"
        )

    def energies(truth: NDArray, fitted: NDArray) -> tuple[NDArray, NDArray]:
        """Return the energies of a block of frames, and of their errors."""
        fitted = np.where(seen_points(truth)[:, None], fitted, np.nan)
        truth, fitted = (centred_frames(rows)[0] for rows in (truth, fitted))
        error = np.nansum((truth - fitted) ** 2, axis=(1, 2))
        return np.nansum(truth**2, axis=(1, 2)), error

    blocks = FrameBlocks.of_array(truth, 1024)  # copies that stay in the cache
    return *blocks.joined(energies, fitted), seen
