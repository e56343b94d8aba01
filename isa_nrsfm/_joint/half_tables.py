"""What random halves of a table change of a fit, without new fits.

A sum over the groups of a table changes by ``sum_g h_g x_g`` for the groups with h_g =
1, counted twice, and without those with h_g = -1. The rows h of a Hadamard matrix are
orthogonal: two of these halves differ as much as two independent tables of the full
size (McCarthy, "Pseudo-replication: half samples", 1969, with balanced half samples).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from isa_nrsfm._frames.camera_models import distances, residuals, stacked_motion
from isa_nrsfm._frames.models import FrameModel
from isa_nrsfm._linalg.small_matrices import centred
from isa_nrsfm._prepare.robust import frame_weights, robust_sizes
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import spread
from isa_nrsfm._tables.tracks import seen_points

# Groups are divided into 15 parts at random, which 15 halves have or have not.
SIGNS = hadamard(16)[1:, 1:]
# Change of converged shapes over that of one step of expectation maximisation:
# docs/stability.md, "How it is estimated".
PER_STEP = 4.0
# Numbers of frames and points by which the gauges of halves are compared.
MOST_FRAMES, MOST_POINTS = 5000, 500


class HalfTables(NamedTuple):
    """Shapes of halves of a table, and frames of it, before the gauge.

    shapes (n_halves, n, 3, J). halves (n_halves, I): whether a half has a frame.
    motion (I, 2, 3), alpha (I, n - 1). kind: further arguments of `independent_gauge`.
    """

    shapes: NDArray
    halves: NDArray
    motion: NDArray
    alpha: NDArray
    kind: tuple[Any, ...]


def half_tables(
    table: ScaledTable,
    model: FrameModel,
    motion: NDArray,
    alpha: NDArray,
    inverse: NDArray,
    groups: NDArray | None,
    kind: tuple[Any, ...],
) -> HalfTables | None:
    """Return the halves of a table; None if it has fewer than four groups.

    inverse (3 n, 3 n): that of the information on a point. groups (n_rows,): numbers.
    """
    units = np.arange(len(alpha))
    if groups is not None:
        units = np.unique(groups[table.shown], return_inverse=True)[1]
    if units.max() < 3:
        return None
    part = (np.random.RandomState(0).permutation(units.max() + 1) % len(SIGNS))[units]
    shapes, n_shapes = model.shapes, len(model.shapes)

    def scores(
        rows: NDArray, part: NDArray, motion: NDArray, alpha: NDArray, *given: NDArray
    ) -> NDArray:
        """Return ``sum_i X_i^T r_i`` over the frames of each part."""
        seen = seen_points(rows)
        w = given[0] if given else seen.astype(float)
        rest = residuals(rows, shapes, motion, alpha)
        rest[~np.broadcast_to(seen[:, None], rest.shape)] = 0.0
        mean = np.einsum("irj,ij->ir", rest, w) / w.sum(axis=1)[:, None]
        if model.loss != "linear":
            off = distances(rows, shapes, motion, mean, alpha)
            deviation = np.sqrt(model.noise_variance)
            w = seen * frame_weights(model.loss, off, deviation, robust_sizes(rows))
        rest = (rest - mean[:, :, None]) * w[:, None]
        X = stacked_motion(motion, alpha).reshape(*rest.shape[:2], -1)
        chosen = [part == number for number in range(len(SIGNS))]
        return np.stack(
            [np.tensordot(X[i], rest[i], axes=((0, 1), (0, 1))) for i in chosen]
        )

    weights = () if table.weights is None else (table.weights,)
    total = sum(table.rows.map(scores, part, motion, alpha, *weights))
    steps = inverse @ np.tensordot(SIGNS, total, 1)
    # Mixtures of the shapes themselves are left to the gauge.
    flat, steps = shapes.reshape(n_shapes, -1), steps.reshape(len(SIGNS), n_shapes, -1)
    steps = PER_STEP * (steps - steps @ np.linalg.pinv(flat) @ flat)
    points = spread(np.arange(shapes.shape[2]), MOST_POINTS)
    moved = (shapes + steps.reshape(-1, *shapes.shape))[..., points]
    frames = spread(np.arange(len(alpha)), MOST_FRAMES)
    halves = SIGNS[:, part[frames]] > 0
    return HalfTables(centred(moved), halves, motion[frames], alpha[frames], kind)
