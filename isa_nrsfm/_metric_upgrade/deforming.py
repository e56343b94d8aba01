"""Metric upgrade of cameras that see a deforming shape, and its Euclidean shapes."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._metric_upgrade.minimisation import exponential, refine_fit
from isa_nrsfm._metric_upgrade.quadric import symmetric_power
from isa_nrsfm._metric_upgrade.residuals import (
    MetricFit,
    fit_at,
    frame_blocks,
    strain_basis,
)
from isa_nrsfm._metric_upgrade.rigid import (
    fit_metric,
    nearest_rotations,
    scaled,
    usable_cameras,
    warn_if_degenerate,
)

# The largest, and first, standard deviation of an entry of E_k. Affine cameras
# that bend space more than that with the deformation are not believed.
STRAIN_DEVIATION = 0.3
# The logarithm of the metric of a frame is no larger, so that unusual coefficients do
# not stretch any direction by more than exp(1 / 2).
LARGEST_STRAIN = 1.0
# Rounds of estimating the deviation, and the change of its logarithm that ends them.
MAX_ROUNDS = 15
SETTLED = 0.05
# Until then metrics are as good as that.
ROUGH_STEP = 1e-4
# Rounding errors of the residuals.
ROUNDING = 1e-12


class DeformationMetric(NamedTuple):
    """
    The upgrade of affine cameras that see a deforming shape.

    Attributes
    ----------
    Q : ndarray of shape (3, 3)
        Symmetric and positive definite, as in `MetricUpgrade`; of the mean shape.
    strain : ndarray of shape (n_components, 3, 3)
        E_k, symmetric and without trace, for one unit of coefficient k: cameras of a
        frame become those of a scaled rotation by ``Q exp(sum_k alpha_ik E_k / 2)``.
    residual : float
        As in `MetricUpgrade`, with the strain.
    condition_number : float
        As in `MetricUpgrade`.
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

    Affine cameras hide part of the deformation: that of a basis shape :math:`B_k + V
    B_0` is absorbed by cameras :math:`M_i (I - \alpha_{ik} V)`, to first order. They
    are not orthogonal any more then, which tells V, but for rotations and scales. So
    ``Q exp(sum_k alpha_ik E_k / 2)`` takes the place of the one Q of `metric_upgrade`,
    with symmetric strains E_k without trace.

    Parameters
    ----------
    motion : array-like of shape (n_frames, 2, 3)
        Affine cameras, such as `AffineNRSfM.motion_`. Those that are zero or NaN are
        left out.
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
        cameras together see less than three directions of space.

    Warns
    -----
    UserWarning
        If the condition number is above 50, as in `metric_upgrade`.

    See Also
    --------
    euclidean_frames : Shapes, rotations and scales of frames.

    Notes
    -----
    The sum of squares of the weak-perspective residuals plus a price of the squared
    norm of the strains is minimised. The price is that of maximal evidence (MacKay,
    "Bayesian interpolation", Neural Computation 4, 1992): residuals and entries of the
    strains are taken for normally distributed, with variances that are estimated with
    them, that of the strains being at most :math:`0.3^2`. Few frames, or cameras that
    are not weak-perspective ones, then lead to small strains.
    """
    cameras, usable = usable_cameras(motion)
    weights = np.asarray(alpha, dtype=np.float64)
    if weights.ndim != 2 or len(weights) != len(cameras):
        raise ValueError(
            f"alpha must be of the shape ({len(cameras)}, n_components) for "
            f"{len(cameras)} cameras; got {weights.shape}"
        )
    usable = usable & np.isfinite(weights).all(axis=1)
    cameras, weights = cameras[usable], weights[usable]
    fit = _fit_strain(cameras, weights, fit_metric(cameras, "weak_perspective"))
    # E_k in the axes of the symmetric Q.
    Q = symmetric_power(fit.Q @ fit.Q.T, 0.5)
    turn = np.linalg.solve(Q, fit.Q)
    strain = turn @ fit.strain @ turn.T
    Q = scaled(Q, cameras)
    warn_if_degenerate(fit.condition_number)
    return DeformationMetric(Q, strain, fit.residual, fit.condition_number)


def euclidean_frames(
    metric: DeformationMetric,
    motion: ArrayLike,
    alpha: ArrayLike,
    mean_shape: ArrayLike,
    basis: ArrayLike,
) -> EuclideanFrames:
    """
    Return Euclidean shapes, rotations and scales of frames.

    Each frame is taken by itself: its result does not depend on the others.

    Parameters
    ----------
    metric : DeformationMetric
        Of `deformation_metric`, from the table that the shapes were fitted to.
    motion : array-like of shape (n_frames, 2, 3)
        Affine cameras of these or other frames, as `AffineNRSfM.decompose` returns
        them.
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
        If the arrays do not fit each other.

    Notes
    -----
    Three steps lead from an affine shape to a Euclidean one: the metric of the frame
    (eigenvalues of its strain are limited to one, which only unusual coefficients or
    fits that have failed exceed); the least stretching in the plane of the image that
    makes the camera, nearly a scaled rotation by now, exactly one; and the rotation
    that brings the shape nearest to the mean shape. Whether the object turned or the
    camera, and how much of a rotation is deformation, no image tells.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.calibration import deformation_metric, euclidean_frames
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.metrics import mean_shape_error_3d
    >>> faces = make_face_tracks(n_frames=200, random_state=0)
    >>> model = AffineNRSfM(n_components=4, random_state=0).fit(faces.data)
    >>> metric = deformation_metric(model.motion_, model.alpha_)
    >>> frames = euclidean_frames(
    ...     metric, model.motion_, model.alpha_, model.mean_shape_, model.basis_
    ... )
    >>> mean_shape_error_3d(faces.shapes, frames.shapes, convention="frame") < 0.02
    True
    """
    cameras, usable = usable_cameras(motion, least=0)
    weights = np.asarray(alpha, dtype=np.float64)
    mean = np.asarray(mean_shape, dtype=np.float64)
    directions = np.asarray(basis, dtype=np.float64)
    n_components = len(metric.strain)
    if weights.shape != (len(cameras), n_components):
        raise ValueError(
            f"alpha must be of the shape ({len(cameras)}, {n_components}), for the "
            f"cameras and the metric; got {weights.shape}"
        )
    if mean.ndim != 2 or mean.shape[1] != 3:
        raise ValueError(f"mean_shape must have shape (n_points, 3); got {mean.shape}")
    if directions.shape != (n_components, *mean.shape):
        raise ValueError(
            f"basis must have shape {(n_components, *mean.shape)}, for the metric and "
            f"the mean shape; got {directions.shape}"
        )
    usable = usable & np.isfinite(weights).all(axis=1)
    cameras, weights = cameras[usable], weights[usable]

    stretch, axes = np.linalg.eigh(np.tensordot(weights, metric.strain, 1))
    stretch = np.clip(stretch, -LARGEST_STRAIN, LARGEST_STRAIN)
    strain = (axes * stretch[:, None]) @ axes.transpose(0, 2, 1)
    Q = metric.Q @ exponential(strain / 2)
    shapes = mean + np.tensordot(weights, directions, 1)
    shapes = shapes @ np.linalg.inv(Q).transpose(0, 2, 1)
    rotations, stretches = nearest_rotations(cameras @ Q)
    scales = np.trace(stretches, axis1=1, axis2=2) / 2
    # In the axes of the image the camera is the stretch, which moves to the shape.
    seen = shapes @ rotations.transpose(0, 2, 1)
    seen[:, :, :2] = seen[:, :, :2] @ (stretches / scales[:, None, None])
    shapes = seen @ rotations
    turns = _turns_to(shapes, mean @ np.linalg.inv(metric.Q).T)

    frames = EuclideanFrames(
        np.full((len(usable), *mean.shape), np.nan),
        np.full((len(usable), 3, 3), np.nan),
        np.full(len(usable), np.nan),
    )
    frames.shapes[usable] = shapes @ turns
    frames.rotations[usable] = rotations @ turns
    frames.scales[usable] = scales
    return frames


def _fit_strain(cameras: NDArray, alpha: NDArray, rigid: MetricFit) -> MetricFit:
    """Return the metric with strains, their price being that of maximal evidence."""
    size = len(strain_basis("weak_perspective"))
    n_equations = 2 * len(cameras)
    noise = max(rigid.cost / n_equations, ROUNDING**2)
    variance = STRAIN_DEVIATION**2
    blocks = frame_blocks(cameras, alpha)
    none = np.zeros((alpha.shape[1], 3, 3))
    fit = fit_at(blocks, rigid.Q, none, "weak_perspective")
    for _ in range(MAX_ROUNDS):
        ridge = noise / variance
        fit = refine_fit(blocks, fit, "weak_perspective", ridge, ROUGH_STEP)
        across = fit.curvature[:size, size:]
        inside = np.linalg.pinv(fit.curvature[:size, :size], hermitian=True)
        own = fit.curvature[size:, size:] - across.T @ inside @ across
        known = np.linalg.eigvalsh(own)
        known = np.maximum(known, 0.0)
        n_known = float(np.sum(known / (known + ridge)))
        freedom = max(n_equations - size - n_known, 0.1 * n_equations)
        previous = noise, variance
        noise = max(fit.cost / freedom, ROUNDING**2)
        variance = np.sum(fit.strain**2) / max(n_known, 1e-3)
        variance = np.clip(variance, ROUNDING, STRAIN_DEVIATION**2)
        if np.abs(np.log([noise, variance]) - np.log(previous)).max() < SETTLED:
            break
    return refine_fit(blocks, fit, "weak_perspective", ridge)


def _turns_to(shapes: NDArray, mean_shape: NDArray) -> NDArray:
    """Return the rotations O that bring ``shape @ O`` nearest to the mean shape."""
    centred = mean_shape - mean_shape.mean(axis=0)
    left, _, right = np.linalg.svd(shapes.transpose(0, 2, 1) @ centred)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    return left @ right
