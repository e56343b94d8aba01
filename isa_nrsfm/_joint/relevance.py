"""How many basis shapes a table supports: those that it determines.

Each basis shape has a prior of its own: its 3J numbers, as the images show them, have
the variance v_k. That variance is estimated (automatic relevance determination: MacKay,
"Bayesian interpolation", 1992; Bishop, "Bayesian PCA", 1999). With the posterior
covariance ``cov B_k``, the coefficients' moments held fixed, and ``C = mean_i M_i^T
M_i`` the iteration is

    g_k = 1 - tr(C cov B_k) / (3J v_k),   v_k <- mean_i ||M_i B_k||^2 / (3J g_k).

g_k is the share of the 3J numbers of B_k that the table determines rather than the
prior. Shapes that fit noise get smaller, and less determined, with each round.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointState, regular
from isa_nrsfm._linalg.vectors import frames_last


def relevant_components(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> int:
    """
    Return the number of relevant basis shapes.

    Parameters
    ----------
    problem : JointProblem
        The frames.
    state : JointState
        A fit with more basis shapes than are expected to be relevant.
    cameras : CameraModel
        How its cameras may move.

    Returns
    -------
    int
        The number.
    """
    n_points = problem.frames.points(state.shapes).shape[2]
    n_numbers = 3 * n_points
    penalty = np.full(len(state.shapes) - 1, problem.penalty)
    determined = np.ones(len(penalty))
    options = problem.options.relevance
    for _ in range(options.rounds):
        part = problem.with_penalty(penalty)
        start = _orthogonal(state)
        state = part.refined(start, cameras, max_iter=options.steps).state
        # g_k and v_k, with penalty = 1 / (v_k n_frames)
        energy, uncertain = _image_energies(part, state, n_points)
        if not energy.any():
            return 0  # nothing deforms
        determined = 1.0 - uncertain * penalty * problem.n_frames / n_numbers
        determined = np.clip(determined, options.smallest, 1.0)
        variance = np.maximum(
            energy / (n_numbers * determined), options.smallest * energy.max()
        )
        penalty = 1.0 / (variance * problem.n_frames)
    return int(np.sum(determined > options.determined))


def _camera_moments(state: JointState) -> NDArray:
    """Return ``C = mean_i M_i^T M_i`` (3, 3)."""
    M = frames_last(state.motion)
    return np.einsum("rai,rbi->ab", M, M) / M.shape[2]


def _orthogonal(state: JointState) -> JointState:
    """Return the same fit with basis shapes whose images are orthogonal on average."""
    basis = state.shapes[1:]
    images = np.einsum(
        "ab,kaj,lbj->kl", _camera_moments(state), basis, basis, optimize=True
    )
    axes = np.linalg.eigh(images)[1][:, ::-1]
    basis = np.tensordot(axes.T, basis, 1)
    return state._replace(shapes=np.concatenate([state.shapes[:1], basis]))


def _image_energies(
    problem: JointProblem, state: JointState, n_points: int
) -> tuple[NDArray, NDArray]:
    """Return ``mean_i ||M_i B_k||^2`` and ``tr(C cov B_k)`` of each basis shape."""
    C, basis = _camera_moments(state), state.shapes[1:]
    energy = np.einsum("ab,kaj,kbj->k", C, basis, basis, optimize=True)
    curvature = problem.likelihood(*state).shape_curvature
    # Posterior covariance of each point: half the Hessian is curvature / s2.
    covariance = state.noise * np.linalg.inv(regular(curvature))
    # One matrix stands for all points where all weights are one.
    total = covariance.sum(axis=0) * (n_points / len(covariance))
    n = len(basis) + 1
    blocks = total.reshape(n, 3, n, 3)[np.arange(1, n), :, np.arange(1, n)]
    return energy, np.einsum("ab,kab->k", C, blocks)
