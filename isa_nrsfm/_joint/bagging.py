"""The mean of joint fits of parts of the points.

Deformation that resembles a rotation shifts the cameras of a joint fit and its depths.
How much depends on its points: fits of others have other errors. Their mean has smaller
ones (bagging: Breiman, "Bagging predictors", Machine Learning, 1996):

1. Five fits each leave out a group of neighbouring points, as in `depth_certainty`.
   They start from the joint fit, and have at most `MOST_DIRECTIONS` of its directions.
2. Fewer points determine the size of the depths less. That of each fit is adjusted by
   regression on a fit of all points with as many directions.
3. The mean of their differences from that fit changes the depths of the joint fit. What
   all frames share of it is left out: the joint fit has it from all points, and means
   of photos of faces that hardly turn would be less accurate.
4. The mean and the principal components of these shapes are the new model.

The errors are those of `depth_certainty` for the joint fit, which are larger.
docs/benchmarks/README.md, "Thresholds", has the errors of both.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import compose, full_rotations
from isa_nrsfm._frames.models import FrameModel
from isa_nrsfm._joint import consensus
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.problem import JointProblem, JointState, Widths
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.uncertainty import N_GROUPS, inlying_rows, neighbours
from isa_nrsfm._joint.whole import LEAST_NOISE, determined
from isa_nrsfm._linalg import centred
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables import spread

# Largest numbers of frames and directions, and steps, and largest squared error of the
# depths by other explanations: docs/benchmarks/README.md, "Thresholds".
MOST_FRAMES, MOST_DIRECTIONS, MOST_STEPS = 600, 24, 50
MOST_DEFORMATION = 0.08


def bagged(
    model: FrameModel, table: ScaledTable, settings: FitSettings, widths: Widths
) -> tuple[FrameModel, Widths] | None:
    """Return the model of the mean of fits of parts of the points, and its widths.

    The given ones are those of a joint fit with calibrated cameras. None without noise,
    as all fits would be equal; if groups have less than two points; with many frames,
    as shapes of a part of them would replace those of all; and if the images have
    another explanation, as fits of parts may have either.
    """
    unique = model.certainty.deformation < MOST_DEFORMATION
    if not unique or len(table.sizes) > MOST_FRAMES:
        return None
    part, fit, w = inlying_rows(model, table.rows, MOST_FRAMES, table.weights)
    n_points = part.shape[2]
    chosen = spread(np.arange(n_points), consensus.MOST_POINTS)
    # A fit with noise ends at its floor or above it, up to rounding.
    exact = model.noise_variance < 0.5 * LEAST_NOISE * np.nanmean(part**2)
    if exact or len(chosen) < 2 * N_GROUPS:
        return None
    n_directions = min(len(model.shapes) - 1, MOST_DIRECTIONS)
    settings = settings._replace(on_step=None)

    def fitted(points: NDArray) -> tuple[NDArray, NDArray]:
        """Return the frames that show enough of the points, and their depths."""
        frames = consensus.frames_showing(part[:, :, points])
        counts = None if w is None else w[np.ix_(frames, points)]
        tracks = JointFrames.of_rows(part[np.ix_(frames, np.arange(2), points)], counts)
        part_widths = widths.of_points(len(points), n_directions)
        problem = JointProblem(tracks, settings, widths=part_widths)
        shapes = centred(model.shapes[: n_directions + 1, :, points])
        state = JointState(shapes, fit.motion[frames], model.noise_variance)
        limits: Any = {"max_iter": MOST_STEPS, "tol": settings.tol}
        state = problem.refined(state, least_noise=LEAST_NOISE, **limits).state
        return frames, centred(problem.depths(state))

    # Depths of the joint fit, and changes of them
    rotations, scales = full_rotations(fit.motion)
    S = compose(model.shapes[0], model.shapes[1:], fit.alpha)
    z = scales[:, None] * np.einsum("ia,iaj->ij", rotations[:, 2], S[:, :, chosen])
    frames, depths = fitted(chosen)
    z[frames] = depths * np.copysign(1.0, np.sum(depths * z[frames]))
    change, count = np.zeros_like(z), np.zeros_like(z)
    groups = neighbours(model.shapes[0][:, chosen])
    for group in range(N_GROUPS):
        kept = np.flatnonzero(groups != group)
        frames, depths = fitted(chosen[kept])
        at = np.ix_(frames, kept)
        reference = centred(z[at])
        size = np.sum(depths * reference) / (np.sum(depths**2) or 1.0)
        change[at] += size * depths - reference
        count[at] += 1
    change = centred(change / np.maximum(count, 1))
    counted = count.any(axis=1, keepdims=True)
    change -= counted * (change.sum(axis=0) / max(counted.sum(), 1))
    change = change @ consensus.interpolation(model.shapes[0], chosen) / scales[:, None]
    S = S + rotations[:, 2, :, None] * change[:, None]
    # The model of the changed shapes
    noise = model.noise_variance
    R = consensus.aligning_rotations(centred(S[:, :, chosen]), noise)
    n_max = min(3 * n_points - 7, consensus.MOST_COMPONENTS)
    shapes, _, remainder = consensus.principal_shapes(
        centred(R.mT @ S), n_max, consensus.LEFT * noise
    )
    problem = JointProblem(JointFrames.of_rows(part, w), settings)
    state = JointState(shapes, fit.motion @ R, noise)
    state, widths = determined(problem, state, None)
    alpha = replace(problem, widths=widths).likelihood(*state).alpha
    return model.with_shapes(state.shapes, noise + remainder, alpha), widths
