"""The mean of fits without each of five groups of neighbouring points.

A joint fit follows deformation that resembles a rotation: cameras and depths have errors
in common, which depend on the points. Fits of different points have different errors
of this kind, and their mean has smaller ones (bagging: Breiman, "Bagging predictors",
Machine Learning, 1996). Each fit starts from that of all points, with one group of
neighbours left out, as in the jackknife of `uncertainty`. The mean depths, and the
images of the fit of all points, are shapes whose principal components are the new model.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._frames.models import FrameMap, FrameModel, spread_starts
from isa_nrsfm._joint.common_depths import aligning_rotations
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.problem import JointProblem, JointState, Widths
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.uncertainty import inlying_rows, neighbours
from isa_nrsfm._joint.whole import LEAST_NOISE, determined
N_GROUPS = 5
from isa_nrsfm._linalg.small_matrices import centred
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import FrameBlocks, spread
from isa_nrsfm._tables.tracks import FEWEST_POINTS
import os
MOST_FRAMES = int(os.environ.get("MF", 1000))
MOST_STEPS = int(os.environ.get("MS", 100))
LEFT = float(os.environ.get("LEFT", 0.01))
DIRS = int(os.environ.get("DIRS", 99))
MOST_COMPONENTS = 60


def mean_of_parts(
    model: FrameModel, table: ScaledTable, settings: FitSettings, widths: Widths
) -> tuple[FrameModel, Widths]:
    """Return the model of the mean of fits of parts of the points, and its widths."""
    from isa_nrsfm._joint.consensus import principal_shapes
    part, fit, w = inlying_rows(model, table.rows, MOST_FRAMES, table.weights)
    rotations, scales = full_rotations(fit.motion)
    S = model.shapes[0] + np.tensordot(fit.alpha, model.shapes[1:], 1)
    n_points = S.shape[2]
    z = centred((scales[:, None, None] * rotations[:, 2:] @ S)[:, 0])
    groups = neighbours(model.shapes[0])
    total, count = np.zeros_like(z), np.zeros_like(z)

    def problem_of(frames: NDArray, kept: NDArray) -> JointProblem:
        rows = part[frames][:, :, kept]
        blocks = FrameBlocks.of_array(rows, len(rows))
        counts = None if w is None else w[np.ix_(frames, kept)]
        data = JointFrames.from_points(blocks, bool(np.isfinite(rows).all()), counts)
        return JointProblem(data, settings._replace(on_step=None))

    base = z
    rel = bool(os.environ.get("REL")) and DIRS < len(model.shapes) - 1
    for group in ([-1] if rel else []) + list(range(N_GROUPS)):
        kept = groups != group
        seen = np.isfinite(part[:, :, kept]).all(axis=1).sum(axis=1)
        frames = np.flatnonzero(seen >= FEWEST_POINTS)
        n_dirs = min(DIRS, len(model.shapes) - 1)
        own = widths.of_points(int(kept.sum()), n_dirs)
        problem = replace(problem_of(frames, kept), widths=own)
        state = JointState(
            centred(model.shapes[:n_dirs + 1, :, kept]), fit.motion[frames], model.noise_variance
        )
        state = problem.refined(
            state, least_noise=LEAST_NOISE, max_iter=MOST_STEPS, tol=settings.tol
        ).state
        depths = centred(state.depths(problem.likelihood(*state).alpha))
        at = np.ix_(frames, kept)
        if group == -1:
            base = z.copy()
            base[at] = depths * np.copysign(1.0, np.sum(depths * z[at]))
            continue
        depths *= np.copysign(1.0, np.sum(depths * z[at]))
        total[at] += depths + np.mean(base[at] - depths, axis=1, keepdims=True)
        count[at] += 1
    mean = np.where(count > 0, total / np.maximum(count, 1), base)
    change = np.zeros_like(S)
    change[:, 2] = centred(mean - base)
    S = S + rotations.mT @ change / scales[:, None, None]
    chosen = spread(np.arange(n_points), 100)
    R = aligning_rotations(centred(S[:, :, chosen]), model.noise_variance)
    shapes, alpha, rest = principal_shapes(
        centred(R.mT @ S), min(MOST_COMPONENTS, 3 * n_points - 7), LEFT * model.noise_variance
    )
    every = np.ones(n_points, dtype=bool)
    problem = problem_of(np.arange(len(part)), every)
    state = JointState(shapes, fit.motion @ R, model.noise_variance)
    state, widths = determined(problem, state, None)
    if os.environ.get("PR"):
        state, widths = determined(problem, state, widths)
        n = len(widths.variances)
        state, widths = determined(problem, state, widths)
    alpha = replace(problem, widths=widths).likelihood(*state).alpha
    model = replace(
        model, shapes=state.shapes, noise_variance=model.noise_variance + rest,
        starts=spread_starts(alpha, 8), gauge=FrameMap.identity(len(state.shapes) - 1),
    )
    return model, widths
