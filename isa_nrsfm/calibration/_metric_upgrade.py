"""Metric upgrade of affine cameras of a rigid shape, and Euclidean shapes."""

from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._frames.camera_models import full_rotations, nearest_calibrated
from isa_nrsfm._linalg import OF_PRODUCTS, OF_RANKS
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
    parts = (of_all_rows(each, usable) for each in (full_rotations(rows)[0], scales))
    return MetricUpgrade(Q, *parts, *quality(*fit, len(cameras)))


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
