"""Errors of a fit with calibrated cameras, by leaving out groups of its points.

Unmodelled deformation is correlated between neighbouring points and between frames, and
part of it resembles a rotation. A posterior covariance with independent noise is
therefore too small. The delete-a-group jackknife (Efron and Stein, The Annals of
Statistics, 1981) needs no model of the noise: from fits without each of g groups of
neighbouring points the variance of an estimate t is ::

    (g - 1) / g sum_g (t_g - t)^2.

These fits do not have the prior of the extents, which would hide uncertain depths.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import CAMERAS, full_rotations
from isa_nrsfm._frames.models import NOT_ESTIMATED, DepthCertainty, PosteriorFrames
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import EXTENT_WEIGHT, MarginalLikelihood
from isa_nrsfm._joint.problem import JOINT_OPTIONS
from isa_nrsfm._joint.quasi_newton import JointState, refine_joint
from isa_nrsfm._joint.sample_posterior import inlying_rows
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import FEWEST_POINTS

# Groups have equal size. With k-means groups the errors are half too large.
N_GROUPS = 5
# Largest number of steps of a fit, and its convergence tolerance. 30 steps understate
# the errors of undetermined depths. A tolerance of 1e-6 changes determined ones by less
# than 2 %; 1e-2 understates undetermined ones.
MOST_STEPS, TOL = 100, 1e-3
# Largest numbers of frames and points of the fits. With 100 frames one deviation
# changed from 12 to 19 %. Points are assigned to groups in cubic time.
MOST_FRAMES, MOST_POINTS = 200, 200
# Floor of the noise variance of the fits, as a share of the mean square. Without noise,
# surplus basis shapes leave the depth undetermined, and fits stay near their start.
# Errors were then 30 times the deviation, with this floor 5 times. With a noise of 0.1
# %, the floor changes no deviation by more than a third.
LEAST_NOISE = 1e-6


def depth_certainty(
    frames: PosteriorFrames, rows: FrameBlocks, weights: NDArray | None = None
) -> DepthCertainty:
    """Estimate the errors of a fit from some of its frames (I, 2, J), if enough.

    Weights (I, J) are numbers of observations, by default one.
    """
    n_frames, n_points = rows.n_frames, frames.shapes.shape[2]
    chosen = np.linspace(0, n_frames - 1, min(n_frames, MOST_FRAMES)).astype(int)
    part = np.asarray(rows.take(chosen), dtype=np.float64)
    w = None if weights is None else weights[chosen]
    part, fit = inlying_rows(frames, part, w)
    points = np.linspace(0, n_points - 1, min(n_points, MOST_POINTS)).astype(int)
    part, mean_shape = part[:, :, points], frames.shapes[0][:, points]
    left_out = [neighbours(mean_shape) == group for group in range(N_GROUPS)]
    seen = np.asarray(np.isfinite(part).all(axis=1))
    least = np.min([seen[:, ~group].sum(axis=1) for group in left_out], axis=0)
    known = np.isfinite(fit.motion).all(axis=(1, 2)) & (least >= FEWEST_POINTS)
    if known.sum() < 2:
        return NOT_ESTIMATED
    w = None if w is None else w[np.ix_(known, points)]
    shapes, motion = frames.shapes[:, :, points], fit.motion[known]
    refit = partial(_Refit, frames, part[known], w, shapes, motion)
    whole = refit(np.ones(len(points), dtype=bool))
    errors = [refit(~group).errors(whole) for group in left_out]
    total, turns, variances = (
        (N_GROUPS - 1) / N_GROUPS * np.sum(terms, axis=0)
        for terms in zip(*errors, strict=True)
    )
    # Each point is left out of one of the fits
    variances *= N_GROUPS / (N_GROUPS - 1)
    nearest = cdist(frames.shapes[0].T, mean_shape.T).argmin(axis=1)
    # Rotations out of the image plane, and their residuals of a regression on alpha.
    mean_view = Rotation.from_matrix(whole.rotations).mean()
    turning = (Rotation.from_matrix(whole.rotations) * mean_view.inv()).as_rotvec()
    predictors = np.column_stack([np.ones(len(turning)), whole.alpha])
    rest = turning[:, :2] - predictors @ np.linalg.lstsq(predictors, turning[:, :2])[0]
    freedom = max(len(rest) - predictors.shape[1], 1)
    return DepthCertainty(
        float(np.sqrt(total)),
        float(np.sqrt(np.sum(rest**2) / freedom)),
        turns,
        variances[nearest],
    )


def neighbours(points: NDArray) -> NDArray:
    """Assign points (3, n_points) to groups of equal size around distant points."""
    centred = points.T - points.mean(axis=1)
    centres = [np.argmax(np.sum(centred**2, axis=1))]
    while len(centres) < N_GROUPS:
        centres.append(np.argmax(cdist(centred, centred[centres]).min(axis=1)))
    sizes = np.full(N_GROUPS, len(centred) // N_GROUPS)
    sizes[: len(centred) % N_GROUPS] += 1
    places = np.repeat(np.arange(N_GROUPS), sizes)
    squares = cdist(centred, centred[centres][places], "sqeuclidean")
    return places[linear_sum_assignment(squares)[1]]


class _Refit:
    """A fit of some of the points, by a few steps from the fit of all points."""

    def __init__(
        self,
        frames: PosteriorFrames,
        rows: NDArray,
        weights: NDArray | None,
        shapes: NDArray,
        motion: NDArray,
        kept: NDArray,
    ):
        rows, self.kept = rows[:, :, kept], kept
        shapes = shapes[:, :, kept] - shapes[:, :, kept].mean(axis=2, keepdims=True)
        blocks = FrameBlocks.of_array(rows, len(rows))
        if weights is None:
            part = JointFrames.from_points(blocks, bool(np.isfinite(rows).all()))
        else:
            part = JointFrames.from_repeated(blocks, weights[:, kept])
        n_numbers, energy = part.totals
        penalty = part.basis_penalty(JOINT_OPTIONS.basis_std)
        likelihood = MarginalLikelihood(part, penalty, EXTENT_WEIGHT * kept.all())
        noise = max(frames.noise_variance, LEAST_NOISE * energy / n_numbers)
        least_noise = min(noise * n_numbers / energy, JOINT_OPTIONS.least_noise)
        state = refine_joint(
            likelihood,
            JointState(shapes, motion, noise),
            CAMERAS[frames.camera],
            least_noise=least_noise,
            max_iter=MOST_STEPS,
            tol=TOL,
        ).state
        self.rotations, scales = full_rotations(state.motion)
        self.alpha = likelihood.coefficients(*state)
        z = np.einsum("ia,kaj->ikj", self.rotations[:, 2], state.shapes)
        z = scales[:, None] * (z[:, 0] + np.einsum("ik,ikj->ij", self.alpha, z[:, 1:]))
        self.depths = z - z.mean(axis=1, keepdims=True)

    def errors(self, whole: "_Refit") -> tuple[float, NDArray, NDArray]:
        """Compute squared differences from the fit of all points.

        Relative square of the depths; mean products of the rotation vectors (3, 3);
        mean squares of the depths (n_points,).
        """
        z = whole.depths[:, self.kept]
        z = z - z.mean(axis=1, keepdims=True)
        mirror = np.array([1.0, 1.0, np.sign(np.sum(self.depths * z))])
        off = mirror[2] * self.depths - z
        points = np.zeros(len(self.kept))
        points[self.kept] = np.mean(off**2, axis=0)
        # Rotations up to a common rotation of the object
        turned = Rotation.from_matrix(mirror[:, None] * self.rotations * mirror)
        rotations = Rotation.from_matrix(whole.rotations)
        w = (turned * (turned.inv() * rotations).mean() * rotations.inv()).as_rotvec()
        turns = w.T @ w / len(w)
        turns[2, :2] = turns[:2, 2] = 0.0  # the mirror image has the other sign
        return float(np.sum(off**2) / np.sum(z**2)), turns, points
