"""Draw tracks with all truths known: of a face, random points, bodies and hands.

The symmetric face of 68 points and its expressions are a table in millimetres. The
origin lies between the nose tip and the ears' plane, x points to the right in the
image, y down and z away from the camera: the nose tip has the smallest z. Only the half
on the left of the image (the subject's right) and the middle are written down, at the
indices of the iBUG-68 scheme; the other half is the mirror image.
"""

import tomllib
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.utils import Bunch, check_random_state

from isa_nrsfm._compat.scikit_learn import Interval, StrOptions, checked_parameters
from isa_nrsfm._tables import LAYOUTS, Layout, tracks_to_table
from isa_nrsfm.skeletons import get_skeleton

FlatCamera = Literal["weak_perspective", "affine", "orthographic"]
Camera = FlatCamera | Literal["perspective"]
FLAT_CAMERAS = get_args(FlatCamera)
Range = tuple[float, float]
# Returns the shapes (n, n_points, 3) of a new person, x to the right, y down, z away,
# at times (n,) for weights (n, n_poses) of poses that add up to one.
Build = Callable[[NDArray, NDArray, RandomState], NDArray[np.float64]]

# Constraints of the parameters that all generated tables have in common.
PARAMETERS: dict[str, list[Any]] = {
    "n_frames": [Interval(Integral, 2, None, closed="left")],
    "camera": [StrOptions({*FLAT_CAMERAS, "perspective"})],
    "focal_length": [Interval(Real, 0, None, closed="neither"), None],
    "distance": [Interval(Real, 0, None, closed="neither"), None],
    "noise": [Interval(Real, 0, None, closed="left")],
    "missing": [Interval(Real, 0, 1, closed="left")],
    "layout": [StrOptions(set(LAYOUTS))],
    "random_state": ["random_state"],
}
# Frame rate of the videos.
FRAMES_A_SECOND = 25.0
# Pixels of translations of films: their middle, and the largest way from it
MIDDLE, REACH = np.array([640.0, 480.0]), np.array([320.0, 240.0])
# Perspective cameras: pixels of the image, and of the focal length if it is not given;
# nearest and largest relative distance
IMAGE, FOCAL_LENGTH = np.array([1280.0, 720.0]), 1000.0
NEAREST, FARTHEST = 0.85, 1.15


class Recording(NamedTuple):
    """How shapes are recorded: parameters of all tables, and random numbers."""

    camera: Camera
    focal_length: float | None
    distance: float | None
    noise: float
    missing: float
    layout: Layout
    rng: RandomState

    def scales(self, usual: Range, distance: float) -> Range:
        """Return the smallest and the largest scale, other ones if perspective."""
        if self.camera == "perspective":
            scale = (self.focal_length or FOCAL_LENGTH) / (self.distance or distance)
            return scale / FARTHEST, scale / NEAREST
        if self.focal_length is not None or self.distance is not None:
            raise ValueError(
                "focal_length and distance are for camera='perspective'; got "
                f"camera={self.camera!r}, focal_length={self.focal_length!r}, "
                f"distance={self.distance!r}"
            )
        return usual

    def motion(self, rotations: NDArray, scales: Range) -> NDArray[np.float64]:
        """Return cameras (n_frames, 2, 3) that look along the z axis of the rotations.

        Scales are log-uniform, orthographic ones the geometric mean. Affine cameras
        stretch the image along a random axis, by 0.5 to 1 at constant area.
        """
        per_frame = (len(rotations), 1, 1)
        shortest, longest = np.log(scales)
        # Drawn for each kind of camera, so that the rest of the scene is the same.
        log_scales = self.rng.uniform(shortest, longest, per_frame)
        ratios = self.rng.uniform(0.5, 1.0, per_frame)
        axes = self.rng.uniform(0.0, np.pi, per_frame)
        if self.camera == "orthographic":
            log_scales = np.full(per_frame, (shortest + longest) / 2)
        motion = np.exp(log_scales) * rotations[:, :2]
        if self.camera == "affine":
            # Symmetric matrices of determinant 1 and the given singular ratios
            along = np.concatenate([np.cos(axes), np.sin(axes)], axis=1)
            across = along[:, ::-1] * [[-1.0], [1.0]]
            longer, shorter = ratios**-0.5, ratios**0.5
            motion = (longer * along * along.mT + shorter * across * across.mT) @ motion
        return motion

    def table(
        self, shapes: NDArray, motion: NDArray, translation: NDArray
    ) -> dict[str, Any]:
        """Return the table of shapes seen by cameras, and its ground truth.

        Perspective cameras: translations up to `REACH` are places up to the image's
        edge.
        """
        truth: dict[str, Any] = {"translation": translation}
        if self.camera == "perspective":
            place = (translation - MIDDLE) / REACH
            focal_length = float(self.focal_length or FOCAL_LENGTH)
            clean, truth = see_in_perspective(shapes, motion, place, focal_length)
        else:
            clean = shapes @ motion.transpose(0, 2, 1) + translation[:, None]
        centred = clean - clean.mean(axis=1, keepdims=True)
        noise_variance = self.noise**2 * np.mean(centred**2)

        # Always drawn, so that noise and missing change nothing else.
        tracks = clean + np.sqrt(noise_variance) * self.rng.standard_normal(clean.shape)
        order = self.rng.permutation(clean[..., 0].size).reshape(clean.shape[:2])
        visible = order >= round(self.missing * order.size)
        tracks[~visible] = np.nan

        names = [f"{axis}_{j}" for j in range(clean.shape[1]) for axis in "xy"]
        columns = tracks_to_table(np.reshape(names, (1, -1, 2)), self.layout)[0]
        return {
            "data": tracks_to_table(tracks, self.layout),
            "tracks": tracks,
            "clean": clean,
            "visible": visible,
            "motion": motion,
            "shapes": shapes,
            "noise_variance": float(noise_variance),
            "feature_names": columns.tolist(),
            **truth,
        }

    def film(
        self, shapes: NDArray, path: NDArray, largest: Sequence[float], scales: Range
    ) -> dict[str, Any]:
        """Return the table and the truth of a film: also yaw, pitch, roll in degrees.

        The path (n, 6) of angles, scale and place is between -1 and 1. `largest` are
        angles, `scales` the smallest and the largest number of pixels per unit.
        """
        angles = path[:, :3] * largest
        shortest, longest = np.log(scales)
        share = (1 + path[:, 3, None, None]) / 2
        sizes = np.exp(shortest + (longest - shortest) * share)
        if self.camera == "orthographic":
            sizes = np.full_like(sizes, np.sqrt(np.prod(scales)))
        rotations = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
        motion = sizes * self.motion(rotations, (1.0, 1.0))
        reach = REACH if self.camera == "perspective" else (160.0, 100.0)
        translation = MIDDLE + path[:, 4:] * reach
        return self.table(shapes, motion, translation) | {"angles": angles}


def see_in_perspective(
    shapes: NDArray, motion: NDArray, place: NDArray, focal_length: float
) -> tuple[NDArray, dict[str, Any]]:
    """Return images (n, J, 2) of pinhole cameras, and the truth about the cameras.

    The place (n, 2) is between -1 and 1, from the left to the right edge of the image
    and from the upper to the lower.
    """
    scales = np.linalg.norm(motion[:, :1], axis=2)
    depth = np.cross(motion[:, 0], motion[:, 1])[:, None] / scales[..., None]
    flat = shapes @ motion.mT
    ratio = 1 + shapes @ depth.mT / focal_length  # of a point's depth to the object's
    edge = ratio * IMAGE / 2
    # Translations from the principal point for which all points are in the image
    lower, upper = np.max(-edge - flat, axis=1), np.min(edge - flat, axis=1)
    if (lower > upper).any():
        raise ValueError(
            f"the image of {IMAGE[0]:g} x {IMAGE[1]:g} pixels is too small for the "
            f"object in {np.sum((lower > upper).any(axis=1))} frames; take a larger "
            "distance or a smaller focal_length"
        )
    translation = (lower + upper + place * (upper - lower)) / 2
    return (flat + translation[:, None]) / ratio + IMAGE / 2, {
        "translation": translation + IMAGE / 2,
        "positions": np.insert(translation, 2, focal_length, axis=1) / scales,
        "rotations": np.append(motion, depth, axis=1) / scales[..., None],
        "focal_length": focal_length,
        "principal_point": tuple((IMAGE / 2).tolist()),
    }


def standardise(coefficients: NDArray) -> NDArray[np.float64]:
    """Return coefficients with zero mean and unit variance over the frames."""
    return (coefficients - coefficients.mean(axis=0)) / coefficients.std(axis=0)


def centre_shapes(shapes: NDArray) -> NDArray[np.float64]:
    """Return shapes (..., n_points, 3) centred over the points."""
    return shapes - shapes.mean(axis=-2, keepdims=True)


COMPONENT_NAMES = (
    *("jaw open", "smile", "brow raise", "blink"),
    *("lip pucker", "brow lower", "nose wrinkle", "face width"),
)


@checked_parameters(
    PARAMETERS
    | {"n_components": [Interval(Integral, 0, len(COMPONENT_NAMES), closed="both")]}
)
def make_face_tracks(
    n_frames: int = 400,
    *,
    n_components: int = 4,
    camera: Camera = "weak_perspective",
    focal_length: float | None = None,
    distance: float | None = None,
    noise: float = 0.005,
    missing: float = 0.0,
    layout: Layout = "interleaved",
    random_state: int | RandomState | None = None,
) -> Bunch:
    """
    Generate the 68 landmarks of a face that moves its head and its features.

    The face is drawn by hand, not measured. The points are in the order of the
    iBUG-68 scheme: jaw 0 to 16, right brow 17 to 21, left brow 22 to 26, bridge and
    tip of the nose 27 to 30, nostrils 31 to 35, right eye 36 to 41, left eye 42 to 47,
    outer lips 48 to 59, inner lips 60 to 67. Right is the subject's right, on the
    left of the image. The table follows the model of `AffineNRSfM`: the points of
    frame i are ``(B_0 + sum_k alpha_ik B_k) M_i^T + t_i`` plus noise, unless cameras
    are perspective.

    Parameters
    ----------
    n_frames : int, default=400
        Number of frames, at least 2. They are independent of each other.
    n_components : int, default=4
        Number of basis shapes K, 0 to 8: the first of "jaw open", "smile",
        "brow raise", "blink", "lip pucker", "brow lower", "nose wrinkle" and
        "face width".
    camera : {"weak_perspective", "affine", "orthographic", "perspective"}, \
default="weak_perspective"
        The head turns by yaw, pitch and roll (see `angles` below), uniform within
        45, 25 and 20 degrees to either side. Orthographic cameras have 2 pixels a
        millimetre, weak-perspective and affine ones 1 to 4, drawn log-uniformly for
        each frame. Affine ones also stretch the image along a random axis; their
        smaller singular value is 0.5 to 1 times the larger. Perspective ones are
        pinhole cameras with images of 1280 x 720 pixels. The faces are everywhere in
        them, but not cut off.
    focal_length : float or None, default=None
        Focal length of perspective cameras in pixels; None means 1000.
    distance : float or None, default=None
        Mean distance of perspective cameras along their axis, in millimetres; None
        means 500. That of a frame is up to 15 % smaller or larger.
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
            The cameras, in pixels per millimetre. Perspective ones are given by the
            weak-perspective cameras with the same rotations and positions.
        translation : ndarray of shape (n_frames, 2)
            The images of the centroids of the faces, in pixels. With other than
            perspective cameras they are uniform in x from 320 to 960 and y from 240 to
            720.
        shapes : ndarray of shape (n_frames, 68, 3)
            The shape of every frame, ``mean_shape + tensordot(alpha, basis, 1)``.
        positions : ndarray of shape (n_frames, 3)
            The centroids of the points in millimetres, in the axes of the camera: x
            to the right, y down, z away from it. Only perspective cameras have
            `positions`, `rotations`, `focal_length` and `principal_point`.
        rotations : ndarray of shape (n_frames, 3, 3)
            Rotations of the shapes to the axes of the camera.
        focal_length : float
            The focal length in pixels.
        principal_point : tuple of float
            The middle of the image, (640.0, 360.0).
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
        If a parameter is not of the kind or in the range given above, if
        `focal_length` or `distance` are given with other cameras, or if the image of
        a perspective camera is too small for a face.

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
    # As often negative as positive; the others are expressions.
    signed = np.isin(names, ["face width"])
    strength[:, signed] = 2 * rng.beta(2.0, 2.0, (n_frames, signed.sum())) - 1
    labels = np.full(n_frames, "rest")
    if not signed.all():
        labels = np.array(names)[~signed][strength[:, ~signed].argmax(axis=1)]
    alpha = standardise(strength)
    shapes = centre_shapes(_drawn_shapes(["neutral", *names]))
    neutral, full = shapes[0], shapes[1:]  # deformations at full strength
    mean_shape = neutral + np.tensordot(strength.mean(axis=0), full, 1)
    basis = full * strength.std(axis=0)[:, None, None]

    angles = rng.uniform(-1.0, 1.0, (n_frames, 3)) * (45.0, 25.0, 20.0)
    rotations = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    seen = Recording(camera, focal_length, distance, noise, missing, layout, rng)
    motion = seen.motion(rotations, seen.scales((1.0, 4.0), 500.0))
    translation = rng.uniform((320.0, 240.0), (960.0, 720.0), size=(n_frames, 2))
    shapes = mean_shape + np.tensordot(alpha, basis, 1)
    return Bunch(
        **seen.table(shapes, motion, translation),
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
    with Path(__file__).with_name("face_model.csv").open() as file:
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
        "camera": [StrOptions(set(FLAT_CAMERAS))],
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
    camera: FlatCamera = "weak_perspective",
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
    mean_shape /= np.sqrt(np.mean(np.sum(mean_shape**2, axis=-1)))
    basis = rng.standard_normal((n_components, n_points, 3))
    if shapes == "heavy_tailed":
        basis *= rng.standard_normal((n_components, n_points, 1))
    basis = centre_shapes(basis)
    basis /= np.linalg.norm(basis, axis=(1, 2), keepdims=True)
    draw = rng.laplace if coefficients == "heavy_tailed" else rng.standard_normal
    alpha = standardise(draw(size=(n_frames, n_components)))
    if n_components:
        square = np.sum(np.tensordot(alpha, basis, 1) ** 2, axis=-1)
        basis *= amplitude / np.sqrt(np.mean(square))
    rotations = Rotation.from_quat(rng.standard_normal((n_frames, 4))).as_matrix()
    seen = Recording(camera, None, None, noise, missing, layout, rng)
    motion = seen.motion(rotations, (2 / 3, 3 / 2))
    translation = rng.standard_normal((n_frames, 2))
    frames = mean_shape + np.tensordot(alpha, basis, 1)
    table = seen.table(frames, motion, translation)
    return Bunch(**table, mean_shape=mean_shape, basis=basis, alpha=alpha)


OF_PEOPLE = PARAMETERS | {"n_people": [Interval(Integral, 1, None, closed="left")]}
# Standard deviation of the logarithms of a person's size and of single bones
SIZES, BONES = 0.06, 0.05
ACTIONS = ("walk", "reach", "squat")
FIGURES = tomllib.loads(Path(__file__).with_name("figures.toml").read_text("utf-8"))
STEPS_A_SECOND, MOVES_A_SECOND = 0.9, 0.5


@checked_parameters(OF_PEOPLE | {"scheme": [StrOptions({"coco-17", "h36m-17"})]})
def make_body_tracks(
    n_frames: int = 400,
    *,
    n_people: int = 4,
    scheme: Literal["coco-17", "h36m-17"] = "coco-17",
    camera: Camera = "weak_perspective",
    focal_length: float | None = None,
    distance: float | None = None,
    noise: float = 0.005,
    missing: float = 0.0,
    layout: Layout = "interleaved",
    random_state: int | RandomState | None = None,
) -> Bunch:
    """
    Generate the 17 landmarks of bodies that walk, reach and squat.

    The bodies are drawn by hand, not measured. People come one after the other; each
    walks on the spot, reaches up with the right arm and squats in turn, with smooth
    changes between them.

    Parameters
    ----------
    n_frames : int, default=400
        Number of frames of all people, at least two for each.
    n_people : int, default=4
        Number of people.
    scheme : {"coco-17", "h36m-17"}, default="coco-17"
        Points and their order: a layout of `isa_nrsfm.skeletons`.
    camera : {"weak_perspective", "affine", "orthographic", "perspective"}, \
default="weak_perspective"
        Camera model. The camera moves smoothly around the person within 80, 20 and 8
        degrees of yaw, pitch and roll to either side. Weak-perspective and affine
        cameras have 0.2 to 0.5 pixels per millimetre, orthographic cameras their
        geometric mean. Affine cameras also stretch each image, see `make_face_tracks`.
        Perspective cameras are pinhole cameras with images of 1280 x 720 pixels. The
        bodies are everywhere in them, but not cut off.
    focal_length : float or None, default=None
        Focal length of perspective cameras in pixels; None means 1000.
    distance : float or None, default=None
        Mean distance of perspective cameras along their axis, in millimetres; None
        means 3500. That of a frame is up to 15 % smaller or larger.
    noise : float, default=0.005
        Standard deviation of the Gaussian noise that is added to every coordinate,
        divided by the root mean square of all coordinates of the tracks without
        noise, each frame centred over its points.
    missing : float, default=0.0
        Share of the points that are not seen, in [0, 1). They are chosen at random
        over the whole table, and both of their coordinates are NaN.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    random_state : int, RandomState instance or None, default=None
        Determines all random numbers. Pass an int for reproducible tables.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (n_frames, 34)
            The table in pixels, with noise, NaN where a point is not seen. y points
            down.
        tracks : ndarray of shape (n_frames, 17, 2)
            The same numbers, one (x, y) pair per point.
        clean : ndarray of shape (n_frames, 17, 2)
            The tracks without noise, complete.
        visible : ndarray of shape (n_frames, 17), dtype=bool
            False where a point is missing from the table.
        shapes : ndarray of shape (n_frames, 17, 3)
            The true points in millimetres, each frame centred over its points, before
            the camera turns: x points to the right of the image, y down, z away from
            the camera.
        mean_shape : ndarray of shape (17, 3)
            Their mean. The shapes are no linear function of a few coefficients: joints
            turn.
        motion : ndarray of shape (n_frames, 2, 3)
            The cameras, in pixels per millimetre. Perspective ones are given by the
            weak-perspective cameras with the same rotations and positions.
        translation : ndarray of shape (n_frames, 2)
            The images of the centroids, in pixels.
        angles : ndarray of shape (n_frames, 3)
            Yaw, pitch and roll of the camera in degrees, see `make_face_tracks`.
        labels : ndarray of shape (n_frames,), dtype=str
            The action: "walk", "reach" or "squat"; in a transition the nearer one.
        groups : ndarray of shape (n_frames,), dtype=int
            The number of the person, from 0. Each has their own lengths of bones.
        time : ndarray of shape (n_frames,)
            Seconds since the person was first seen, at 25 frames per second.
        positions : ndarray of shape (n_frames, 3)
            The centroids of the points in millimetres, in the axes of the camera: x
            to the right, y down, z away from it. Only perspective cameras have
            `positions`, `rotations`, `focal_length` and `principal_point`.
        rotations : ndarray of shape (n_frames, 3, 3)
            Rotations of the shapes to the axes of the camera.
        focal_length : float
            The focal length in pixels.
        principal_point : tuple of float
            The middle of the image, (640.0, 360.0).
        noise_variance : float
            Variance of the noise in one coordinate, in squared pixels.
        feature_names : list of str
            The names of the columns, x_0, y_0, x_1, ... in the order of `layout`.
        point_names : list of str
            The names of the points.

    Raises
    ------
    ValueError
        If a parameter is not of the kind or in the range given above, there are fewer
        than two frames for each person, `focal_length` or `distance` are given with
        other cameras, or the image of a perspective camera is too small.

    See Also
    --------
    make_hand_tracks : Hands of several people.
    make_face_tracks : A face with named expressions.

    Examples
    --------
    >>> from isa_nrsfm.datasets import make_body_tracks
    >>> bodies = make_body_tracks(n_frames=120, n_people=2, random_state=0)
    >>> bodies.data.shape
    (120, 34)
    >>> bodies.point_names[:3]
    ['nose', 'left_eye', 'right_eye']
    """
    names = get_skeleton(scheme).point_names or ()

    def build(time: NDArray, weights: NDArray, rng: RandomState) -> NDArray:
        joints = _joints(time, weights, rng)
        return np.stack([joints[name] for name in names], axis=1)

    rng = check_random_state(random_state)
    shapes, path, truths = perform(n_frames, n_people, ACTIONS, build, rng)
    seen = Recording(camera, focal_length, distance, noise, missing, layout, rng)
    table = seen.film(shapes, path, (80.0, 20.0, 8.0), seen.scales((0.2, 0.5), 3500.0))
    return Bunch(**table, **truths, point_names=list(names))


def _angles(time: NDArray, weights: NDArray, rng: RandomState) -> dict[str, NDArray]:
    """Return the angles of the joints in radians: forwards and bent are positive."""
    step = 2 * np.pi * (STEPS_A_SECOND * time + rng.uniform())
    up = (1 - np.cos(2 * np.pi * (MOVES_A_SECOND * time + rng.uniform()))) / 2
    eager = rng.uniform(0.8, 1.1, 3)
    walk, reach, squat = (weights * eager).T
    reach, squat = reach * up, squat * up
    swing = np.sin(step)
    angles = {"lean": 0.1 * reach + 0.7 * squat}
    for side, sign in (("left", 1), ("right", -1)):
        angles |= {
            f"{side}_hip": 0.5 * sign * walk * swing + 1.5 * squat,
            f"{side}_knee": walk * (0.5 - 0.4 * np.cos(step + sign * np.pi / 2))
            + 2.0 * squat,
            f"{side}_shoulder": -0.45 * sign * walk * swing + 1.3 * squat,
            f"{side}_elbow": 0.3 + 0.2 * walk,
            f"{side}_spread": np.full(len(time), 0.12),
        }
    angles["right_shoulder"] = angles["right_shoulder"] + 2.4 * reach
    angles["right_spread"] = angles["right_spread"] + 0.3 * reach
    # Radians by which joints are held off their poses
    held = 0.08 * wander(time, len(angles), rng).T
    parts = zip(angles.items(), held, strict=True)
    return {name: angle + off for (name, angle), off in parts}


def _joints(time: NDArray, weights: NDArray, rng: RandomState) -> dict[str, NDArray]:
    """Return the joints of a new person, each (n, 3)."""
    angle = _angles(time, weights, rng)
    size = np.exp(SIZES * rng.standard_normal())
    length = {
        bone: size * value * np.exp(BONES * rng.standard_normal())
        for bone, value in FIGURES["lengths"].items()
    }
    x = np.array([1.0, 0.0, 0.0])
    pelvis = np.zeros((len(time), 3))
    up = -_direction(-angle["lean"])
    thorax, spine = (pelvis + part * length["trunk"] * up for part in (1.0, 0.5))
    joints = {"pelvis": pelvis, "spine": spine, "thorax": thorax}
    neck = thorax + length["neck"] * up
    # The head leans with the trunk, half as much.
    ahead = _direction(np.pi / 2 - angle["lean"] / 2)
    down = _direction(-angle["lean"] / 2)
    for name, (left, low, back) in FIGURES["head"].items():
        place = neck + size * (low * down - back * ahead)
        joints[name.replace("left", "right")] = place - size * left * x
        joints[name] = place + size * left * x
    for side, sign in (("left", 1), ("right", -1)):
        hip = pelvis + sign * length["hips"] * x
        bend = angle[f"{side}_hip"]
        knee = hip + length["thigh"] * _direction(bend)
        foot = knee + length["shank"] * _direction(bend - angle[f"{side}_knee"])
        shoulder = thorax + sign * length["shoulders"] * x
        raised, spread = angle[f"{side}_shoulder"], sign * angle[f"{side}_spread"]
        elbow = shoulder + length["upper_arm"] * _direction(raised, spread)
        raised = raised + angle[f"{side}_elbow"]
        wrist = elbow + length["forearm"] * _direction(raised, spread)
        ends = {"hip": hip, "knee": knee, "ankle": foot, "foot": foot}
        ends |= {"shoulder": shoulder, "elbow": elbow, "wrist": wrist}
        joints |= {f"{side}_{name}": joint for name, joint in ends.items()}
    return joints


def _direction(forwards: NDArray, sideways: NDArray | float = 0.0) -> NDArray:
    """Return unit vectors (n, 3) that hang down, raised forwards and sideways."""
    along, across = np.cos(sideways), np.sin(sideways) + 0 * forwards
    parts = across, along * np.cos(forwards), -along * np.sin(forwards)
    return np.stack(parts, axis=1)


@checked_parameters(OF_PEOPLE)
def make_hand_tracks(
    n_frames: int = 400,
    *,
    n_people: int = 4,
    camera: Camera = "weak_perspective",
    focal_length: float | None = None,
    distance: float | None = None,
    noise: float = 0.005,
    missing: float = 0.0,
    layout: Layout = "interleaved",
    random_state: int | RandomState | None = None,
) -> Bunch:
    """
    Generate the 21 landmarks of hands that open, point and close.

    The hands are drawn by hand, not measured: right ones, whose palms are seen. The
    points are those of the layout ``"hand-21"`` of `isa_nrsfm.skeletons`: the wrist,
    and four of each finger from the thumb on. People come one after the other; each
    takes the poses in turn, with smooth changes between them.

    Parameters
    ----------
    n_frames : int, default=400
        Number of frames of all people, at least two for each.
    n_people : int, default=4
        Number of people.
    camera : {"weak_perspective", "affine", "orthographic", "perspective"}, \
default="weak_perspective"
        Camera model. The camera moves smoothly around the person within 60, 35 and 35
        degrees of yaw, pitch and roll to either side. Weak-perspective and affine
        cameras have 1 to 3 pixels per millimetre, orthographic cameras their geometric
        mean. Affine cameras also stretch each image, see `make_face_tracks`.
        Perspective cameras are pinhole cameras with images of 1280 x 720 pixels. The
        hands are everywhere in them, but not cut off.
    focal_length : float or None, default=None
        Focal length of perspective cameras in pixels; None means 1000.
    distance : float or None, default=None
        Mean distance of perspective cameras along their axis, in millimetres; None
        means 500. That of a frame is up to 15 % smaller or larger.
    noise : float, default=0.005
        Standard deviation of the Gaussian noise that is added to every coordinate,
        divided by the root mean square of all coordinates of the tracks without
        noise, each frame centred over its points.
    missing : float, default=0.0
        Share of the points that are not seen, in [0, 1). They are chosen at random
        over the whole table, and both of their coordinates are NaN.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    random_state : int, RandomState instance or None, default=None
        Determines all random numbers. Pass an int for reproducible tables.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (n_frames, 42)
            The table in pixels, with noise, NaN where a point is not seen. y points
            down.
        tracks : ndarray of shape (n_frames, 21, 2)
            The same numbers, one (x, y) pair per point.
        clean : ndarray of shape (n_frames, 21, 2)
            The tracks without noise, complete.
        visible : ndarray of shape (n_frames, 21), dtype=bool
            False where a point is missing from the table.
        shapes : ndarray of shape (n_frames, 21, 3)
            The true points in millimetres, each frame centred over its points, before
            the camera turns: x points to the right of the image, y down, z away from
            the camera.
        mean_shape : ndarray of shape (21, 3)
            Their mean. The shapes are no linear function of a few coefficients: joints
            turn.
        motion : ndarray of shape (n_frames, 2, 3)
            The cameras, in pixels per millimetre. Perspective ones are given by the
            weak-perspective cameras with the same rotations and positions.
        translation : ndarray of shape (n_frames, 2)
            The images of the centroids, in pixels.
        angles : ndarray of shape (n_frames, 3)
            Yaw, pitch and roll of the camera in degrees, see `make_face_tracks`.
        labels : ndarray of shape (n_frames,), dtype=str
            The pose: "open", "fist" or "point"; in a transition the nearer one.
        groups : ndarray of shape (n_frames,), dtype=int
            The number of the person, from 0. Each has their own lengths of bones.
        time : ndarray of shape (n_frames,)
            Seconds since the person was first seen, at 25 frames per second.
        positions : ndarray of shape (n_frames, 3)
            The centroids of the points in millimetres, in the axes of the camera: x
            to the right, y down, z away from it. Only perspective cameras have
            `positions`, `rotations`, `focal_length` and `principal_point`.
        rotations : ndarray of shape (n_frames, 3, 3)
            Rotations of the shapes to the axes of the camera.
        focal_length : float
            The focal length in pixels.
        principal_point : tuple of float
            The middle of the image, (640.0, 360.0).
        noise_variance : float
            Variance of the noise in one coordinate, in squared pixels.
        feature_names : list of str
            The names of the columns, x_0, y_0, x_1, ... in the order of `layout`.
        point_names : list of str
            The names of the points.

    Raises
    ------
    ValueError
        If a parameter is not of the kind or in the range given above, there are fewer
        than two frames for each person, `focal_length` or `distance` are given with
        other cameras, or the image of a perspective camera is too small.

    See Also
    --------
    make_body_tracks : Bodies of several people.
    make_face_tracks : A face with named expressions.

    Examples
    --------
    >>> from isa_nrsfm.datasets import make_hand_tracks
    >>> hands = make_hand_tracks(n_frames=120, n_people=2, random_state=0)
    >>> hands.data.shape
    (120, 42)
    >>> sorted(set(hands.labels.tolist())), sorted(set(hands.groups.tolist()))
    (['fist', 'open', 'point'], [0, 1])
    """
    rng = check_random_state(random_state)
    poses = [*FIGURES["poses"]]
    shapes, path, truths = perform(n_frames, n_people, poses, _hand, rng)
    seen = Recording(camera, focal_length, distance, noise, missing, layout, rng)
    table = seen.film(shapes, path, (60.0, 35.0, 35.0), seen.scales((1.0, 3.0), 500.0))
    names = get_skeleton("hand-21").point_names or ()
    return Bunch(**table, **truths, point_names=list(names))


def _hand(time: NDArray, weights: NDArray, rng: RandomState) -> NDArray[np.float64]:
    """Return the shapes (n, 21, 3) of a new person's hand."""
    # Fingers are held off their poses.
    bends = weights @ [*FIGURES["poses"].values()] + 0.12 * wander(time, 5, rng)
    size = np.exp(SIZES * rng.standard_normal())
    shape = np.zeros((len(time), 21, 3))
    fingers = np.array(FIGURES["hand"]["fingers"])
    for f, (joint, direction, bones, flexion, bent) in enumerate(fingers):
        along = direction / np.linalg.norm(direction)
        across = bent - (bent @ along) * along
        across /= np.linalg.norm(across)
        lengths = bones * np.exp(BONES * rng.standard_normal(3))
        angles = np.cumsum(np.deg2rad(flexion)) * bends[:, [f]]
        steps = np.cos(angles)[..., None] * along + np.sin(angles)[..., None] * across
        chain = np.cumsum(lengths[:, None] * steps, axis=1)
        first = joint * np.exp(BONES * rng.standard_normal())
        shape[:, 1 + 4 * f] = first
        shape[:, 2 + 4 * f : 5 + 4 * f] = first + chain
    return size * shape


def perform(
    n_frames: int, n_people: int, poses: Sequence[str], build: Build, rng: RandomState
) -> tuple[NDArray, NDArray, dict[str, NDArray]]:
    """Return shapes of people who take poses in turn, a path (n, 6), and the truths."""
    if n_frames < 2 * n_people:
        raise ValueError(
            f"n_frames must be at least 2 frames for each of {n_people} people; got "
            f"{n_frames}"
        )
    people = []
    for person, rows in enumerate(np.array_split(np.arange(n_frames), n_people)):
        time = np.arange(len(rows)) / FRAMES_A_SECOND
        weights = _take_turns(time, len(poses), rng)
        shapes = centre_shapes(build(time, weights, rng))
        path = np.hstack([wander(time, n, rng) for n in (3, 1, 2)])
        labels = np.array(poses)[weights.argmax(axis=1)]
        people.append((shapes, path, labels, np.full(len(rows), person), time))
    shapes, path, labels, groups, time = map(np.concatenate, zip(*people, strict=True))
    truths = {"labels": labels, "groups": groups, "time": time}
    return shapes, path, truths | {"mean_shape": shapes.mean(axis=0)}


def wander(time: NDArray, n: int, rng: RandomState) -> NDArray[np.float64]:
    """Return n smooth functions of time, (len(time), n), between -1 and 1."""
    frequency = rng.uniform(0.08, 0.35, (2, n))  # waves per second
    phase = rng.uniform(0, 2 * np.pi, (2, n))
    waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    return 0.6 * waves[:, 0] + 0.4 * waves[:, 1]


def _take_turns(time: NDArray, n_poses: int, rng: RandomState) -> NDArray[np.float64]:
    """Return the weights (len(time), n_poses) of poses that are taken in turn."""
    duration = len(time) / FRAMES_A_SECOND
    # A pose lasts 1.6 seconds, with a transition of 0.6 seconds to the next one.
    n_turns = max(n_poses, round(duration / 1.6))
    rounds = [rng.permutation(n_poses) for _ in range(-(-n_turns // n_poses))]
    turns = np.concatenate(rounds)[:n_turns]
    length = duration / n_turns
    change = min(0.6, length)
    # From 0 to 1 round the beginning of each turn but the first.
    begins = length * np.arange(1, n_turns)
    passed = np.clip((time[:, None] - begins) / change + 0.5, 0.0, 1.0)
    begun = np.insert((1 - np.cos(np.pi * passed)) / 2, 0, 1.0, axis=1)
    share = -np.diff(begun, axis=1, append=0.0)
    weights = np.zeros((len(time), n_poses))
    np.add.at(weights.T, turns, share.T)
    return weights
