"""Draw random deforming shapes and the tracks of their points."""

from numbers import Integral, Real
from typing import Literal

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.utils import Bunch, check_random_state

from isa_nrsfm._compat.scikit_learn import Interval, StrOptions, checked_parameters
from isa_nrsfm._tables.tracks import Layout
from isa_nrsfm.datasets._scene import (
    PARAMETERS,
    Camera,
    centre_shapes,
    draw_motion,
    observe,
    standardise,
)

Distribution = Literal["heavy_tailed", "gaussian"]
DISTRIBUTIONS = [StrOptions({"heavy_tailed", "gaussian"})]


@checked_parameters(
    {
        **PARAMETERS,
        "n_points": [Interval(Integral, 4, None, closed="left")],
        "n_components": [Interval(Integral, 0, None, closed="left")],
        "amplitude": [Interval(Real, 0, None, closed="left")],
        "shapes": DISTRIBUTIONS,
        "coefficients": DISTRIBUTIONS,
    }
)
def make_nonrigid_tracks(
    n_frames: int = 300,
    n_points: int = 68,
    n_components: int = 3,
    *,
    amplitude: float = 0.2,
    noise: float = 0.0,
    camera: Camera = "weak_perspective",
    shapes: Distribution = "heavy_tailed",
    coefficients: Distribution = "gaussian",
    missing: float = 0.0,
    layout: Layout = "interleaved",
    random_state: int | RandomState | None = None,
) -> Bunch:
    r"""
    Generate the tracks of a random cloud of points that deforms in random directions.

    The table follows the model of `AffineNRSfM`: the points of frame i are
    :math:`(B_0 + \sum_k \alpha_{ik} B_k) M_i^T + t_i` plus noise.

    Parameters
    ----------
    n_frames : int, default=300
        Number of frames, at least 2.
    n_points : int, default=68
        Number of points, at least 4.
    n_components : int, default=3
        Number of basis shapes K; 0 makes a rigid cloud.
    amplitude : float, default=0.2
        Size of the deformation: the root mean square over frames and points of
        the length of :math:`\sum_k \alpha_{ik} b_{kj}`, divided by that of
        :math:`b_{0j}`. It is met exactly.
    noise : float, default=0.0
        Standard deviation of the Gaussian noise that is added to every coordinate,
        divided by the root mean square of all coordinates of the tracks without
        noise, each frame centred over its points. The noise is equal in all frames.
        The inverse SNR of the truth is about ``noise ** 2``.
    camera : {"weak_perspective", "affine", "orthographic"}, default="weak_perspective"
        The orientations are spread uniformly over all rotations. Orthographic cameras
        are the first two rows of the rotation. Weak-perspective ones are multiplied by
        a scale between 2/3 and 3/2, drawn log-uniformly for each frame. Affine ones
        also stretch the image along a random axis; their smaller singular value
        is 0.5 to 1 times the larger.
    shapes : {"heavy_tailed", "gaussian"}, default="heavy_tailed"
        How the points of a basis shape are drawn, independently of each other and of
        the other basis shapes: Gaussian 3-vectors, or, if heavy-tailed, Gaussian
        3-vectors times a Gaussian number each, so that a few points move far and most
        of them little. Gaussian basis shapes cannot be told apart by their
        independence; only their span is meaningful.
    coefficients : {"gaussian", "heavy_tailed"}, default="gaussian"
        How the coefficients are drawn, independently: normally, or, if heavy-tailed,
        by the Laplace distribution.
    missing : float, default=0.0
        Share of the points that are not seen, in [0, 1). They are chosen at random
        over the whole table, and both of their coordinates are NaN.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    random_state : int, RandomState instance or None, default=None
        Determines all random numbers. Pass an int for reproducible tables. Of two
        calls with the same int that differ in `noise`, `missing` or `layout`, the
        truths are the same; so are the shapes and coefficients if they differ in
        `camera`.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (n_frames, 2 * n_points)
            The table, with noise, NaN where a point is not seen.
        tracks : ndarray of shape (n_frames, n_points, 2)
            The same numbers, one (x, y) pair per point.
        clean : ndarray of shape (n_frames, n_points, 2)
            The tracks without noise, complete.
        visible : ndarray of shape (n_frames, n_points), dtype=bool
            False where a point is missing from the table.
        mean_shape : ndarray of shape (n_points, 3)
            A Gaussian cloud whose extents along x, y and z are as 1 to 0.8 to 0.6,
            centred; its root mean square distance from the origin is 1.
        basis : ndarray of shape (n_components, n_points, 3)
            The basis shapes, centred over the points, all of the same norm, in the
            units of `mean_shape`. They are not ordered.
        alpha : ndarray of shape (n_frames, n_components)
            The coefficients; each has zero mean and unit variance over the frames.
        motion : ndarray of shape (n_frames, 2, 3)
            The cameras.
        translation : ndarray of shape (n_frames, 2)
            The images of the origin, which is the centroid of every shape; they are
            normal with unit variance.
        shapes : ndarray of shape (n_frames, n_points, 3)
            The shape of every frame, ``mean_shape + tensordot(alpha, basis, 1)``.
        noise_variance : float
            Variance of the noise in one coordinate, in squared units of the image.
        feature_names : list of str
            The names of the columns, x_0, y_0, x_1, ... in the order of `layout`.

    Raises
    ------
    ValueError
        If a parameter is not of the kind or in the range given above.

    See Also
    --------
    make_face_tracks : A face with named expressions.

    Examples
    --------
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(n_frames=50, n_points=30, random_state=0)
    >>> tracks.data.shape
    (50, 60)
    >>> tracks.basis.shape
    (3, 30, 3)
    """
    rng = check_random_state(random_state)
    mean_shape = centre_shapes(rng.standard_normal((n_points, 3)) * (1.0, 0.8, 0.6))
    mean_shape /= _root_mean_square_length(mean_shape)
    basis = rng.standard_normal((n_components, n_points, 3))
    if shapes == "heavy_tailed":
        basis *= rng.standard_normal((n_components, n_points, 1))
    basis = centre_shapes(basis)
    basis /= np.linalg.norm(basis, axis=(1, 2), keepdims=True)
    draw = rng.laplace if coefficients == "heavy_tailed" else rng.standard_normal
    alpha = standardise(draw(size=(n_frames, n_components)))
    if n_components:
        size = _root_mean_square_length(np.tensordot(alpha, basis, 1))
        basis *= amplitude / size
    rotations = Rotation.from_quat(rng.standard_normal((n_frames, 4))).as_matrix()
    motion = draw_motion(rotations, camera, (2 / 3, 3 / 2), rng)
    translation = rng.standard_normal((n_frames, 2))
    frames = mean_shape + np.tensordot(alpha, basis, 1)
    table = observe(frames, motion, translation, rng, noise, missing, layout)
    return Bunch(**table, mean_shape=mean_shape, basis=basis, alpha=alpha)


def _root_mean_square_length(vectors: NDArray) -> float:
    """Return the root mean square length of the vectors along the last axis."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))
