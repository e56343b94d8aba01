"""Metric upgrade of cameras that see a deforming shape, and its Euclidean shapes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._frames.camera_models import compose, full_rotations, nearest_calibrated
from isa_nrsfm._linalg import OF_DIFFERENCES, procrustes
from isa_nrsfm._tables import of_all_rows
from isa_nrsfm.calibration._metric import MetricFit, refine_metric
from isa_nrsfm.calibration._metric_upgrade import (
    fit_metric,
    quality,
    symmetric_upgrade,
    usable_frames,
)


class DeformationMetric(NamedTuple):
    """
    The upgrade of affine cameras that see a deforming shape.

    Attributes
    ----------
    Q : ndarray of shape (3, 3)
        The upgrade of the mean shape: symmetric and positive definite, as in
        `MetricUpgrade`.
    strain : ndarray of shape (n_components, 3, 3)
        E_k, symmetric with trace zero, for one unit of coefficient k: ``M_i Q exp(sum_k
        alpha_ik E_k / 2)`` is nearly two rows of a scaled rotation.
    residual : float
        Root mean square residual of the cameras with the strain, see `MetricUpgrade`.
    condition_number : float
        Condition number of the metric, see `MetricUpgrade`.
    """

    Q: NDArray
    strain: NDArray
    residual: float
    condition_number: float


class EuclideanFrames(NamedTuple):
    """
    Euclidean shapes of frames and the weak-perspective cameras that see them.

    The image of frame i is ``scales_i * shapes_i @ rotations_i[:2].T + translation``.

    Attributes
    ----------
    shapes : ndarray of shape (n_frames, n_points, 3)
        Shapes, each turned to be as near as possible to the mean shape.
    rotations : ndarray of shape (n_frames, 3, 3)
        Rotations, of determinant one: the pose of the object in each frame.
    scales : ndarray of shape (n_frames,)
        Scales of the cameras.
    """

    shapes: NDArray
    rotations: NDArray
    scales: NDArray


def deformation_metric(motion: ArrayLike, alpha: ArrayLike) -> DeformationMetric:
    r"""
    Find the coordinates of space in which cameras of a deforming shape are Euclidean.

    Affine cameras can absorb part of the deformation. To first order, the basis shape
    :math:`B_k + V B_0` gives the same images as :math:`B_k`, with cameras :math:`M_i (I
    - \alpha_{ik} V)`. The rows of such cameras are not orthogonal, which determines V
    up to rotations and scales. The matrix Q of `metric_upgrade` therefore becomes ``Q
    exp(sum_k alpha_ik E_k / 2)`` for frame i. The strains E_k are symmetric with trace
    zero.

    Parameters
    ----------
    motion : array-like of shape (n_frames, 2, 3)
        Affine cameras, such as `AffineNRSfM.motion_`. Cameras that are zero or NaN are
        ignored.
    alpha : array-like of shape (n_frames, n_components)
        Coefficients of the frames, such as `AffineNRSfM.alpha_`, in units of their
        standard deviation.

    Returns
    -------
    DeformationMetric
        Named tuple of Q, strain, residual and condition_number.

    Raises
    ------
    ValueError
        If the arrays are not of the shapes above or have infinite entries, or if the
        cameras together see fewer than three directions of space.

    Warns
    -----
    UserWarning
        If the condition number is above 50, as in `metric_upgrade`.

    See Also
    --------
    euclidean_frames : Shapes, rotations and scales of frames.

    Notes
    -----
    The sum of the squared weak-perspective residuals plus a ridge times the squared
    norm of the strains is minimised. The ridge is the ratio of two variances, that of
    the residuals and that of the entries of the strains. Both are assumed to be
    normally distributed. The variances are estimated by maximising the evidence
    (MacKay, "Bayesian interpolation", Neural Computation 4, 1992), with at most
    :math:`0.3^2` for the strains. Few frames, or cameras that are not weak-perspective
    ones, lead to small strains.
    """
    cameras, weights, _ = usable_frames(motion, alpha)
    fit = fit_strain(cameras, weights, fit_metric(cameras, "weak_perspective"))
    # The symmetric Q is the fitted one times a rotation, which turns the strains.
    turn, Q = symmetric_upgrade(fit[0][0], cameras)
    strain = turn @ fit[0][1:] @ turn.T
    return DeformationMetric(Q, strain, *quality(*fit, len(cameras)))


def euclidean_frames(
    metric: DeformationMetric,
    motion: ArrayLike,
    alpha: ArrayLike,
    mean_shape: ArrayLike,
    basis: ArrayLike,
) -> EuclideanFrames:
    """
    Return Euclidean shapes, rotations and scales of frames.

    The result of a frame does not depend on the other frames.

    Parameters
    ----------
    metric : DeformationMetric
        Result of `deformation_metric` for the table that the shapes were fitted to.
    motion : array-like of shape (n_frames, 2, 3)
        Affine cameras of these or other frames, for example from
        `AffineNRSfM.decompose`.
    alpha : array-like of shape (n_frames, n_components)
        Their coefficients.
    mean_shape : array-like of shape (n_points, 3)
        Mean shape in the space of the affine cameras.
    basis : array-like of shape (n_components, n_points, 3)
        Basis shapes in that space.

    Returns
    -------
    EuclideanFrames
        Named tuple of shapes, rotations and scales; NaN for frames whose camera is NaN
        or zero. ``scales_i * shapes_i @ rotations_i[:2].T`` is the image of the shape
        ``mean_shape + sum_k alpha_ik basis_k`` in the affine camera.

    Raises
    ------
    ValueError
        If the shapes of the arrays are inconsistent.

    Notes
    -----
    Three steps lead from an affine shape to a Euclidean one.

    1. The metric of the frame is applied. Eigenvalues of its strain are limited to one;
       only unusual coefficients, or a failed fit, exceed that.
    2. The camera is now nearly a scaled rotation. The smallest stretch in the image
       plane that makes it exact is moved from the camera to the shape.
    3. The shape is rotated to be as near as possible to the mean shape. Images do
       not determine whether the object or the camera turned, nor how much of a rotation
       is deformation.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.calibration import deformation_metric, euclidean_frames
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.metrics import mean_shape_error_3d
    >>> faces = make_face_tracks(n_frames=100, n_components=2, random_state=0)
    >>> model = AffineNRSfM(n_components=2, random_state=0).fit(faces.data)
    >>> metric = deformation_metric(model.motion_, model.alpha_)
    >>> frames = euclidean_frames(
    ...     metric, model.motion_, model.alpha_, model.mean_shape_, model.basis_
    ... )
    >>> mean_shape_error_3d(faces.shapes, frames.shapes, convention="frame") < 0.02
    True
    """
    cameras, weights, usable = usable_frames(motion, alpha, least=0)
    mean = np.asarray(mean_shape, dtype=np.float64)
    # The metric of each frame. Unusual coefficients stretch no direction by more than
    # exp(1 / 2).
    stretch, axes = np.linalg.eigh(np.tensordot(weights, metric.strain, 1))
    growth = np.exp(np.clip(stretch, -1.0, 1.0) / 2)
    Q = metric.Q @ (axes * growth[:, None]) @ axes.mT
    cameras = cameras @ Q
    shapes = compose(mean, np.asarray(basis, dtype=np.float64), weights)
    shapes = shapes @ np.linalg.inv(Q).mT
    # A camera is a stretch times rows of a rotation. In the axes of the image, the
    # stretch is moved to the shape, and the scaled rotation remains.
    rows, scales = nearest_calibrated(cameras)
    shapes = shapes + shapes @ rows.mT @ (cameras / scales[:, None, None] - rows)
    # The rotation nearest to the mean shape.
    mean = (mean - mean.mean(axis=0)) @ np.linalg.inv(metric.Q).T
    turns = procrustes(shapes.mT @ mean)
    parts = shapes @ turns, full_rotations(rows)[0] @ turns, scales
    return EuclideanFrames(*(of_all_rows(values, usable) for values in parts))


def fit_strain(cameras: NDArray, alpha: NDArray, rigid: MetricFit) -> MetricFit:
    """Return the metric with strains, with the ridge of maximal evidence.

    Starts without strains. Usable cameras are (I, 2, 3), coefficients (I, K).
    """
    rigid_metric, cost, curvature = rigid
    size, n_equations = len(curvature), 2 * len(cameras)
    noise = max(cost / n_equations, OF_DIFFERENCES**2)
    # Larger strains than these are taken for errors of the affine cameras.
    variance = most_variance = 0.3**2
    metric = np.concatenate([rigid_metric, np.zeros((alpha.shape[1], 3, 3))])
    for _ in range(15):
        ridge = noise / variance
        metric, cost, curvature = refine_metric(
            cameras, alpha, metric, "weak_perspective", ridge, 1e-4
        )
        # Curvature in the strains, with the common metric eliminated (a Schur
        # complement), and the effective number of strain parameters from it.
        mixed = curvature[:size, size:]
        inverse = np.linalg.pinv(curvature[:size, :size], hermitian=True)
        strain_curvature = curvature[size:, size:] - mixed.T @ inverse @ mixed
        values = np.maximum(np.linalg.eigvalsh(strain_curvature), ridge)
        n_effective = float(np.sum(1.0 - ridge / values))
        # The two variances: sums of squares over effective numbers (MacKay).
        freedom = max(n_equations - size - n_effective, 0.1 * n_equations)
        previous = noise, variance
        noise = max(cost / freedom, OF_DIFFERENCES**2)
        variance = np.sum(metric[1:] ** 2) / max(n_effective, 1e-3)
        variance = np.clip(variance, OF_DIFFERENCES, most_variance)
        if np.abs(np.log([noise, variance]) - np.log(previous)).max() < 0.05:
            break
    return refine_metric(cameras, alpha, metric, "weak_perspective", ridge)
