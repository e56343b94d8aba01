"""Number of basis shapes that a table determines.

The images of the 3J coordinates of each basis shape have a prior variance v_k, which is
estimated (automatic relevance determination: MacKay, "Bayesian interpolation", 1992;
Bishop, "Bayesian PCA", 1999). With the posterior covariance ``cov B_k``, the
coefficients' moments held fixed, and ``C = mean_i M_i^T M_i`` the iteration is

    g_k = 1 - tr(C cov B_k) / (3J v_k),   v_k <- mean_i ||M_i B_k||^2 / (3J g_k).

g_k is the share of the 3J numbers of B_k that the table determines rather than the
prior. Shapes that fit noise get smaller, and less determined, with each round.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointState, regular
from isa_nrsfm._linalg.small_matrices import frames_last


def relevant_components(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> int:
    """Return the number of relevant basis shapes of a fit with more of them."""
    n_points = problem.frames.points(state.shapes).shape[2]
    n_numbers, n_frames = 3 * n_points, problem.frames.n_frames
    penalty = np.full(len(state.shapes) - 1, problem.penalty)
    determined = np.ones(len(penalty))
    for _ in range(3):
        part = replace(problem, penalty=penalty)
        # Basis shapes whose images are orthogonal on average
        axes = np.linalg.eigh(_image_moments(state)[1])[1][:, ::-1]
        basis = np.tensordot(axes.T, state.shapes[1:], 1)
        shapes = np.concatenate([state.shapes[:1], basis])
        start = state._replace(shapes=shapes)
        tol = part.settings.tol
        state = part.refined(start, cameras, max_iter=30, tol=tol).state
        C, images = _image_moments(state)
        energy = np.diagonal(images)
        if not energy.any():
            return 0  # nothing deforms
        # Posterior covariance of each point: half the Hessian is curvature / s2.
        curvature = part.likelihood(*state).shape_curvature
        covariance = state.noise * np.linalg.inv(regular(curvature))
        # If all weights are one, one matrix is valid for all points.
        total = covariance.sum(axis=0) * (n_points / len(covariance))
        total = total.reshape(len(shapes), 3, len(shapes), 3)
        uncertain = np.einsum("ab,kakb->k", C, total)[1:]
        # g_k and v_k, with penalty = 1 / (v_k n_frames)
        determined = 1.0 - uncertain * penalty * n_frames / n_numbers
        determined = np.maximum(determined, 1e-9)
        variance = np.maximum(energy / (n_numbers * determined), 1e-9 * energy.max())
        penalty = 1.0 / (variance * n_frames)
    return int(np.sum(determined > problem.settings.options.determined))


def _image_moments(state: JointState) -> tuple[NDArray, NDArray]:
    """Return ``C = mean_i M_i^T M_i`` and the moments ``mean_i <M_i B_k, M_i B_l>``."""
    M, basis = frames_last(state.motion), state.shapes[1:]
    C = np.einsum("rai,rbi->ab", M, M) / M.shape[2]
    return C, np.einsum("ab,kaj,lbj->kl", C, basis, basis, optimize=True)
