"""Draw the tracks of shapes that follow the model: of a face, and of random points.

The symmetric face of 68 points and its expressions are a table in millimetres. The
origin lies between the nose tip and the ears' plane, x points to the right in the
image, y down and z away from the camera: the nose tip has the smallest z. Only the half
on the left of the image (the subject's right) and the middle are written down, at the
indices of the iBUG-68 scheme; the other half is the mirror image.
"""

from collections.abc import Sequence
from importlib.resources import files
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
    FRAMES_A_SECOND,
    PARAMETERS,
    Camera,
    centre_shapes,
    draw_motion,
    observe,
    standardise,
)
from isa_nrsfm.skeletons import get_skeleton

COMPONENT_NAMES = (
    *("jaw open", "smile", "brow raise", "blink"),
    *("lip pucker", "brow lower", "nose wrinkle", "face width"),
)
# As often negative as positive; the others are expressions.
SIGNED_COMPONENTS = ("face width",)


@checked_parameters(
    {
        **PARAMETERS,
        "n_components": [Interval(Integral, 0, len(COMPONENT_NAMES), closed="both")],
    }
)
def make_face_tracks(
    n_frames: int = 400,
    *,
    n_components: int = 4,
    camera: Camera = "weak_perspective",
    noise: float = 0.005,
    missing: float = 0.0,
    layout: Layout = "interleaved",
    random_state: int | RandomState | None = None,
) -> Bunch:
    r"""
    Generate the 68 landmarks of a face that moves its head and its features.

    The face is drawn by hand, not measured. The points are in the order of the
    iBUG-68 scheme: jaw 0 to 16, right brow 17 to 21, left brow 22 to 26, bridge and
    tip of the nose 27 to 30, nostrils 31 to 35, right eye 36 to 41, left eye 42 to 47,
    outer lips 48 to 59, inner lips 60 to 67. Right is the subject's right, on the
    left of the image. The table follows the model of `AffineNRSfM`: the points of
    frame i are :math:`(B_0 + \sum_k \alpha_{ik} B_k) M_i^T + t_i` plus noise.

    Parameters
    ----------
    n_frames : int, default=400
        Number of frames, at least 2. They are independent of each other.
    n_components : int, default=4
        Number of basis shapes K, 0 to 8: the first of "jaw open", "smile",
        "brow raise", "blink", "lip pucker", "brow lower", "nose wrinkle" and
        "face width".
    camera : {"weak_perspective", "affine", "orthographic"}, default="weak_perspective"
        The head turns by yaw, pitch and roll (see `angles` below), uniform within
        45, 25 and 20 degrees to either side. Orthographic cameras have 2 pixels a
        millimetre, weak-perspective and affine ones 1 to 4, drawn log-uniformly for
        each frame. Affine ones also stretch the image along a random axis; their
        smaller singular value is 0.5 to 1 times the larger.
    noise : float, default=0.005
        Standard deviation of the Gaussian noise that is added to every coordinate,
        divided by the root mean square of all coordinates of the tracks without
        noise, each frame centred over its points. The noise is equal in all frames.
        The default is about half a pixel.
    missing : float, default=0.0
        Share of the points that are not seen, in [0, 1). They are chosen at random
        over the whole table, and both of their coordinates are NaN.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    random_state : int, RandomState instance or None, default=None
        Determines all random numbers. Pass an int for reproducible tables. Of two
        calls with the same int that differ in `noise`, `missing` or `layout`, the
        truths are the same.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (n_frames, 136)
            The table in pixels, with noise, NaN where a point is not seen. y points
            down.
        tracks : ndarray of shape (n_frames, 68, 2)
            The same numbers, one (x, y) pair per point.
        clean : ndarray of shape (n_frames, 68, 2)
            The tracks without noise, complete.
        visible : ndarray of shape (n_frames, 68), dtype=bool
            False where a point is missing from the table.
        mean_shape : ndarray of shape (68, 3)
            The mean face in millimetres, centred over the points: x points to the
            right of the image, y down, z away from the camera.
        basis : ndarray of shape (n_components, 68, 3)
            The basis shapes in the order of `component_names`, in millimetres,
            centred over the points. Before the centring each of them moves only a part
            of the face. They point into the direction of their name and have the size
            of one standard deviation of the expression.
        alpha : ndarray of shape (n_frames, n_components)
            The coefficients, independent of each other; each has zero mean and unit
            variance over the frames.
        motion : ndarray of shape (n_frames, 2, 3)
            The cameras, in pixels per millimetre.
        translation : ndarray of shape (n_frames, 2)
            The centroids of the faces in pixels, uniform in x from 320 to 960 and y
            from 240 to 720.
        shapes : ndarray of shape (n_frames, 68, 3)
            The shape of every frame, ``mean_shape + tensordot(alpha, basis, 1)``.
        noise_variance : float
            Variance of the noise in one coordinate, in squared pixels.
        feature_names : list of str
            The names of the columns, x_0, y_0, x_1, ... in the order of `layout`.
        component_names : list of str
            The names of the basis shapes.
        neutral_shape : ndarray of shape (68, 3)
            The face at rest, centred over the points.
        strength : ndarray of shape (n_frames, n_components)
            The expressions as drawn, before `alpha` was standardised: 0 is the face at
            rest, 1 the full expression. Most faces are near rest: the strengths have
            the skewed and heavy-tailed Beta(0.4, 2) distribution. Only the "face
            width" is symmetric between -1 and 1: 2 Beta(2, 2) - 1.
        labels : ndarray of shape (n_frames,), dtype=str
            The strongest expression of each face, "rest" where there is none.
        groups : ndarray of shape (n_frames,), dtype=int
            The number of the person, which is always 0.
        time : ndarray of shape (n_frames,)
            Seconds of a video with 25 frames per second. The faces are in no order and
            do not depend on it.
        angles : ndarray of shape (n_frames, 3)
            Yaw, pitch and roll in degrees, the rotations about the y, x and z axes
            that are applied in this order. Positive yaw turns the nose to the left of
            the image, positive pitch down, positive roll turns the image clockwise.

    Raises
    ------
    ValueError
        If a parameter is not of the kind or in the range given above.

    See Also
    --------
    make_nonrigid_tracks : Random points and random deformations.
    make_hand_tracks : Hands of several people in motion.
    make_body_tracks : Bodies of several people in motion.

    Examples
    --------
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> faces = make_face_tracks(n_frames=100, random_state=0)
    >>> faces.data.shape
    (100, 136)
    >>> faces.component_names
    ['jaw open', 'smile', 'brow raise', 'blink']
    """
    rng = check_random_state(random_state)
    names = COMPONENT_NAMES[:n_components]
    strength = rng.beta(0.4, 2.0, (n_frames, n_components))
    expressions = [k for k in range(n_components) if names[k] not in SIGNED_COMPONENTS]
    for k in set(range(n_components)).difference(expressions):
        strength[:, k] = 2 * rng.beta(2.0, 2.0, n_frames) - 1
    labels = np.full(n_frames, "rest")
    if expressions:
        labels = np.array(names)[expressions][strength[:, expressions].argmax(axis=1)]
    alpha = standardise(strength)
    shapes = centre_shapes(_drawn_shapes(["neutral", *names]))
    neutral, full = shapes[0], shapes[1:]  # deformations at full strength
    mean_shape = neutral + np.tensordot(strength.mean(axis=0), full, 1)
    basis = full * strength.std(axis=0)[:, None, None]

    angles = rng.uniform(-1.0, 1.0, (n_frames, 3)) * (45.0, 25.0, 20.0)
    rotations = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    motion = draw_motion(rotations, camera, (1.0, 4.0), rng)
    translation = rng.uniform((320.0, 240.0), (960.0, 720.0), size=(n_frames, 2))
    shapes = mean_shape + np.tensordot(alpha, basis, 1)
    table = observe(shapes, motion, translation, rng, noise, missing, layout)
    return Bunch(
        **table,
        mean_shape=mean_shape,
        basis=basis,
        alpha=alpha,
        component_names=list(names),
        neutral_shape=neutral,
        strength=strength,
        labels=labels,
        groups=np.zeros(n_frames, dtype=np.intp),
        time=np.arange(n_frames) / FRAMES_A_SECOND,
        angles=angles,
    )


def _drawn_shapes(names: Sequence[str]) -> NDArray[np.float64]:
    """Return shapes (n, 68, 3) of the table; points that it does not list are zero."""
    face, mirror = get_skeleton("ibug-68"), np.arange(68)
    mirror[[*face.left, *face.right]] = [*face.right, *face.left]
    columns = [("name", "U20"), ("point", int), ("place", float, 3)]
    with (files("isa_nrsfm.datasets") / "face_model.csv").open() as file:
        table = np.loadtxt(file, delimiter=",", dtype=columns)
    shapes = np.zeros((len(names), 68, 3))
    for shape, name in zip(shapes, names, strict=True):
        rows = table[table["name"] == name]
        shape[mirror[rows["point"]]] = rows["place"] * (-1.0, 1.0, 1.0)
        shape[rows["point"]] = rows["place"]
    return shapes


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
