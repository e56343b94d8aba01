"""Metric upgrade of affine cameras of rigid or deforming shapes; Euclidean shapes."""

from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._frames.camera_models import compose, full_rotations, nearest_calibrated
from isa_nrsfm._linalg import OF_DIFFERENCES, OF_PRODUCTS, OF_RANKS, procrustes
from isa_nrsfm._parameters import CALIBRATED_CAMERAS, CalibratedCamera
from isa_nrsfm._tables import of_all_rows
from isa_nrsfm.calibration import _metric

# Above this condition number the cameras hardly determine the metric. It is that of
# rotations by about five degrees: docs/benchmarks/README.md, "Thresholds".
LARGEST_CONDITION = 50.0


class MetricUpgrade(NamedTuple):
    """
    The upgrade of affine cameras to orthographic or weak-perspective ones.

    Attributes
    ----------
    Q : ndarray of shape (3, 3)
        ``motion_i @ Q`` is nearly ``scales_i * rotations_i[:2]``. Symmetric and
        positive definite: all matrices ``Q O`` with O orthogonal fit equally well, and
        this one changes the coordinate axes least. It preserves the handedness of the
        space. The root mean square of the scales is one, so Euclidean shapes are in
        units of the images.
    rotations : ndarray of shape (n_frames, 3, 3)
        Rotations, of determinant one: the rows are the axes of the image, x, y and z.
        NaN for frames without camera.
    scales : ndarray of shape (n_frames,)
        Non-negative scales of the cameras; all equal to one for orthographic cameras.
        NaN for frames without camera.
    residual : float
        Deviation from Euclidean cameras, zero for perfect ones. For weak-perspective
        cameras it is the root mean square over the frames of ``(s1^2 - s2^2) / (s1^2 +
        s2^2)``, with the singular values s1 and s2 of ``motion_i @ Q``. For
        orthographic ones it is that of ``||M_i Q Q^T M_i^T - I||_F``.
    condition_number : float
        Ratio of the largest to the smallest amplification of camera errors, over all
        directions of space. It is about one for cameras all round the object, 2.5 for a
        full turn about an axis in the image, 4 for rotations of about 20 degrees, 14
        for 10, and 54 for 5. It is about twice as large for rotations about one axis,
        and infinite if Q is not determined, as for rotations about the viewing
        direction alone.
    """

    Q: NDArray
    rotations: NDArray
    scales: NDArray
    residual: float
    condition_number: float


def metric_upgrade(
    motion: ArrayLike, camera: CalibratedCamera = "weak_perspective"
) -> MetricUpgrade:
    """
    Find the coordinates of space in which affine cameras are Euclidean ones.

    The 3x3 matrix Q makes ``M_i Q`` as nearly as possible ``s_i R_i``, the first two
    rows of a rotation times a scale.

    Parameters
    ----------
    motion : array-like of shape (n_frames, 2, 3)
        Affine cameras, such as `AffineNRSfM.motion_`. Cameras that are zero or NaN are
        ignored.
    camera : {"weak_perspective", "orthographic"}, default="weak_perspective"
        Whether each camera has its own scale or all have the same scale. Only cameras
        of a rigid shape can have a common scale. For a deforming shape, scales are a
        convention.

    Returns
    -------
    MetricUpgrade
        Named tuple of Q, rotations, scales, residual and condition_number. Q and ``Q @
        diag(1, 1, -1)`` fit the cameras equally well. The returned Q has a positive
        determinant.

    Raises
    ------
    ValueError
        If `motion` is not of the shape above or has infinite entries, if `camera` is
        not one of the two, or if the cameras together see fewer than three directions
        of space.

    Warns
    -----
    UserWarning
        If the condition number is above 50: the cameras turn too little, or there are
        too few, to determine the depth.

    See Also
    --------
    euclidean_shapes : Transform shapes to the new coordinates.
    deformation_metric : The same for a shape that deforms.

    Notes
    -----
    ``G = Q Q^T`` solves ``M_i G M_i^T = s_i^2 I``, equations that are linear in G
    (Tomasi, Kanade 1992; Poelman, Kanade 1997). If there is no exact solution, the
    least squares solution minimises an algebraic error and may not be positive
    definite. It is only a start for the minimisation of the sum of squares of
    `residual` over positive definite matrices. A second start is the metric in which
    the cameras see all directions alike. The better of the two results is taken.

    References
    ----------
    C. Tomasi, T. Kanade, "Shape and motion from image streams under orthography: a
    factorization method", International Journal of Computer Vision 9, 1992.

    C. Poelman, T. Kanade, "A paraperspective factorization method for shape and motion
    recovery", IEEE Transactions on Pattern Analysis and Machine Intelligence 19, 1997.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.calibration import euclidean_shapes, metric_upgrade
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> faces = make_face_tracks(n_frames=50, random_state=0)
    >>> affinity = np.array([[1.0, 0.5, 0.0], [0.0, 2.0, 0.0], [0.3, 0.0, 0.4]])
    >>> upgrade = metric_upgrade(faces.motion @ affinity)
    >>> upgrade.residual < 1e-10, round(upgrade.condition_number, 1)
    (True, 3.8)

    The face has true proportions again: distances between its points are correct up to
    one factor.

    >>> affine = faces.mean_shape @ np.linalg.inv(affinity).T
    >>> shape = euclidean_shapes(affine, upgrade.Q)
    >>> ratio = [np.linalg.norm(s[36] - s[45]) / np.linalg.norm(s[8] - s[27])
    ...          for s in (affine, shape, faces.mean_shape)]
    >>> np.round(ratio, 3)
    array([1.502, 0.781, 0.781])
    """
    cameras, _, usable = usable_frames(motion)
    if camera not in CALIBRATED_CAMERAS:
        raise ValueError(f"camera must be one of {CALIBRATED_CAMERAS}; got {camera!r}")
    fit = fit_metric(cameras, camera)
    _, Q = symmetric_upgrade(fit[0][0], cameras)
    rows, scales = nearest_calibrated(cameras @ Q)
    if camera == "orthographic":
        scales = np.ones_like(scales)
    rotations = of_all_rows(full_rotations(rows)[0], usable)
    scales = of_all_rows(scales, usable)
    return MetricUpgrade(Q, rotations, scales, *quality(*fit, len(cameras)))


def euclidean_shapes(shapes: ArrayLike, Q: ArrayLike) -> NDArray[np.float64]:
    """
    Transform shapes to the coordinates in which the cameras are Euclidean.

    Parameters
    ----------
    shapes : array-like of shape (..., n_points, 3)
        A mean shape (n_points, 3), basis shapes (n_components, n_points, 3) or the
        shapes of frames (n_frames, n_points, 3), in the coordinates of the affine
        cameras.
    Q : array-like of shape (3, 3)
        The matrix Q of `metric_upgrade`.

    Returns
    -------
    ndarray of shape (..., n_points, 3)
        ``Q^-1 b`` for each point b. Cameras become ``M Q``, so that the images do not
        change.

    Raises
    ------
    ValueError
        If the arrays are not of the shapes above, or Q is singular.
    """
    points = np.asarray(shapes, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise ValueError(
            f"shapes must be of the shape (..., n_points, 3); got {points.shape}"
        )
    matrix = np.asarray(Q, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.linalg.matrix_rank(matrix) == 3:
        raise ValueError(
            "Q must be a 3x3 matrix that is not singular; got "
            f"{'a singular one' if matrix.shape == (3, 3) else matrix.shape}"
        )
    return points @ np.linalg.inv(matrix).T


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
    fit = fit_strain(cameras, weights)
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


def usable_frames(
    motion: ArrayLike, alpha: ArrayLike | None = None, least: int = 1
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the usable cameras (I, 2, 3) and coefficients (I, K), and their mask.

    At least `least` cameras must be given. There are no coefficients without `alpha`.
    """
    cameras = np.asarray(motion, dtype=np.float64)
    if cameras.ndim != 3 or cameras.shape[1:] != (2, 3) or len(cameras) < least:
        raise ValueError(
            f"motion must be of the shape (n_frames, 2, 3); got {cameras.shape}"
        )
    if np.isinf(cameras).any():
        raise ValueError(
            f"motion must not be infinite; {np.isinf(cameras).sum()} entries are"
        )
    weights = np.zeros((len(cameras), 0)) if alpha is None else np.asarray(alpha, float)
    usable = np.isfinite(cameras).all(axis=(1, 2)) & cameras.any(axis=(1, 2))
    usable &= np.isfinite(weights).all(axis=1)
    return cameras[usable], weights[usable], usable


def fit_metric(cameras: NDArray, camera: CalibratedCamera) -> _metric.MetricFit:
    """Return the best metric of usable cameras (n_frames, 2, 3), from two starts."""
    gram = np.zeros((3, 3))
    if len(cameras):
        gram = _metric.mean_gram(_metric.unit_cameras(cameras))
    n_seen = np.linalg.matrix_rank(gram, rtol=OF_RANKS, hermitian=True)
    if n_seen < 3:
        raise ValueError(
            "a metric upgrade needs cameras that together see three directions of "
            f"space; the {len(cameras)} usable cameras see {n_seen}"
        )
    alpha, metrics = np.zeros((len(cameras), 0)), [np.linalg.inv(gram)]
    if (G := _metric.metric_quadric(cameras)) is not None:
        metrics.append(G)
    starts = [_metric.safe_start(cameras, G, camera)[None] for G in metrics]
    fits = [_metric.refine_metric(cameras, alpha, start, camera) for start in starts]
    return min(fits, key=itemgetter(1))


def fit_strain(cameras: NDArray, alpha: NDArray) -> _metric.MetricFit:
    """Return the metric with strains, with the ridge of maximal evidence.

    Starts without strains. Usable cameras are (I, 2, 3), coefficients (I, K).
    """
    rigid, cost, curvature = fit_metric(cameras, "weak_perspective")
    size, n_equations = len(curvature), 2 * len(cameras)
    noise = max(cost / n_equations, OF_DIFFERENCES**2)
    # Larger strains than these are taken for errors of the affine cameras.
    variance = most_variance = 0.3**2
    metric = np.concatenate([rigid, np.zeros((alpha.shape[1], 3, 3))])
    for _ in range(15):
        ridge = noise / variance
        metric, cost, curvature = _metric.refine_metric(
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
    return _metric.refine_metric(cameras, alpha, metric, "weak_perspective", ridge)


def best_metric(motion: NDArray) -> NDArray:
    """Return Q (3, 3) with which cameras (n, 2, 3) are most nearly scaled rotations.

    The identity if they do not see three directions of space.
    """
    cameras, *_ = usable_frames(motion)
    try:
        metric, *_ = fit_metric(cameras, "weak_perspective")
    except ValueError:
        return np.eye(3)
    return symmetric_upgrade(metric[0], cameras)[1]


def symmetric_upgrade(Q: NDArray, cameras: NDArray) -> tuple[NDArray, NDArray]:
    """Return the orthogonal O and the symmetric S of ``Q = S O``, S (3, 3) scaled.

    The scales of the upgraded cameras (I, 2, 3) have mean square one.
    """
    turn, Q = linalg.polar(Q, side="left")
    # A scale is s = (s1 + s2) / 2 with the singular values of a camera. Then
    # s^2 = (s1^2 + s2^2) / 4 + s1 s2 / 2, and s1 s2 is the area that the rows span.
    rows = cameras @ Q
    area = np.linalg.norm(np.cross(rows[:, 0], rows[:, 1]), axis=1)
    return turn, Q / np.sqrt((np.sum(rows**2) / 4 + np.sum(area) / 2) / len(rows))


def quality(
    metric: NDArray, cost: float, curvature: NDArray, n_frames: int
) -> tuple[float, float]:
    """Return residual and condition number; warn if cameras hardly determine a metric.

    The root mean square over the frames of the norm of the residuals, and the condition
    number of the residuals as functions of the common metric.
    """
    size = len(curvature) // len(metric)
    values = np.linalg.eigvalsh(curvature[:size, :size])
    definite = values[0] > OF_PRODUCTS * values[-1]
    condition = float(np.sqrt(values[-1] / values[0])) if definite else np.inf
    if condition > LARGEST_CONDITION:
        warn_caller(
            f"the cameras hardly determine the metric of space: its condition number "
            f"is {condition:.3g}, above {LARGEST_CONDITION:g}. Euclidean shapes "
            "may have wrong depth and angles. Take frames that are seen from more "
            "sides, or more frames, or affine shapes"
        )
    return float(np.sqrt(cost / n_frames)), condition
