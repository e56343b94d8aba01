"""Weights of points: numbers of observations, zero where points are missing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array

from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.sources import is_read_later, unmasked
from isa_nrsfm._tables.tracks import seen_points

# Largest weight of a point: sums of weighted squares stay far from overflow.
LARGEST_WEIGHT = 1e100


def weighted_rows(
    rows: FrameBlocks, point_weight: Any
) -> tuple[FrameBlocks, tuple[NDArray, ...]]:
    """Return rows (n, 2, J) with NaN for points of weight zero, and the weights (n, J).

    Weights of missing points are zero. There are none if all visible ones are one.
    """
    weights = checked_weights(point_weight, (rows.n_frames, rows.empty.shape[2]))
    visible = rows.derive(_visible_rows, weights)
    visible.empty = rows.empty
    seen = visible.joined(seen_points)
    weights = np.where(seen, weights, 0.0)
    return visible, () if (weights == seen).all() else (weights,)


def check_weightable(X: Any, joint: bool, loss: str) -> None:
    """Raise if weights of points are not supported by a fit, or for a table."""
    if not joint:
        raise ValueError(
            "point_weight needs a fit with refinement='joint', because the refinement "
            "of the paper has no weights. Set refinement='joint', or set points of low "
            "weight to NaN"
        )
    if loss != "linear":
        raise ValueError(
            "point_weight needs loss='linear', because robust losses find weights of "
            f"their own; got loss={loss!r}. Set loss='linear', or set points of low "
            "weight to NaN"
        )
    if is_read_later(X):
        raise ValueError(
            "point_weight needs a table in memory, because weights are not read block "
            f"by block; got a {type(X).__name__}. Give a NumPy array or a dataframe, "
            "or no point_weight"
        )


def checked_weights(point_weight: Any, shape: tuple[int, int]) -> NDArray:
    """Return the weights of points as an array of a given shape, or raise."""
    weights = check_array(
        unmasked(point_weight),
        dtype=np.float64,
        order="C",
        input_name="point_weight",
        ensure_min_samples=0,
    )
    if weights.shape != shape:
        raise ValueError(
            f"point_weight must have a row for each frame and a column for each point, "
            f"the shape {shape}; got {weights.shape}"
        )
    wrong = (weights < 0) | (weights > LARGEST_WEIGHT)
    if wrong.any():
        row, point = np.argwhere(wrong)[0]
        raise ValueError(
            f"point_weight must be between 0 and {LARGEST_WEIGHT:g}, because a weight "
            f"is a number of observations; got {weights[row, point]:g} in row {row}, "
            f"point {point}. Give points without information the weight 0"
        )
    return weights


def _visible_rows(rows: NDArray, weights: NDArray) -> NDArray:
    """Return rows (n, 2, J) with NaN for points whose weight (n, J) is zero."""
    return np.where(weights[:, None] == 0, rows.dtype.type(np.nan), rows)


def check_weights(weights: NDArray, n_components: int, camera: str | None) -> None:
    """Refuse weights (I, J) that are fewer observations than frames have unknowns.

    The unknowns are camera, position and coefficients. Measured for 20 points and K =
    2: the error of the shapes is 0.75 % if the weights of a frame are 49 coordinates,
    0.89 % for 7, and 17 % for 5.
    """
    n_unknowns = n_components + (8 if camera == "affine" else 6)
    mean = float(weights.sum(axis=1).mean())
    if 2.0 * mean < n_unknowns:
        raise ValueError(
            f"the weights of a frame add up to {mean:.3g} observations on average, "
            f"fewer than the {n_unknowns / 2:g} that its camera and n_components="
            f"{n_components} coefficients need. Multiply point_weight by a number, so "
            "that points with the least noise have weights of about one"
        )
