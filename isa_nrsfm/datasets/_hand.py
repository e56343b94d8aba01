"""Draw the tracks of hands that take poses."""

from numbers import Integral

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from sklearn.utils import Bunch, check_random_state

from isa_nrsfm._compat.scikit_learn import Interval, checked_parameters
from isa_nrsfm._tables.tracks import Layout
from isa_nrsfm.datasets._scene import PARAMETERS, Camera, film, observe, perform, wander
from isa_nrsfm.skeletons import get_skeleton

POSES = ("open", "fist", "point")
# How far each finger is bent in a pose, from the thumb to the little finger.
BENDS = np.array([[0.0, 0, 0, 0, 0], [1.0, 1, 1, 1, 1], [0.8, 0, 1, 1, 1]])
# Degrees of the joints of a bent finger, from the palm on; of the thumb.
FLEXION, THUMB_FLEXION = (75.0, 95.0, 55.0), (15.0, 35.0, 55.0)
# Millimetres. A right hand whose palm is seen: x to the right, y down, z away.
# (first joint, direction of the stretched finger, lengths of its three bones)
THUMB = ((24.0, -22.0, -8.0), (0.72, -0.62, -0.3), (38.0, 32.0, 26.0))
FINGERS = (
    ((24.0, -88.0, 2.0), (0.14, -1.0, 0.0), (44.0, 26.0, 22.0)),
    ((2.0, -92.0, 4.0), (0.02, -1.0, 0.0), (48.0, 30.0, 23.0)),
    ((-18.0, -86.0, 2.0), (-0.1, -1.0, 0.0), (45.0, 28.0, 23.0)),
    ((-35.0, -75.0, -3.0), (-0.22, -1.0, 0.0), (35.0, 21.0, 20.0)),
)
# Where bent fingers and the bent thumb go.
INTO_THE_PALM, ACROSS_THE_PALM = (0.0, 0.0, -1.0), (-0.75, -0.3, -0.6)
# Standard deviation of the logarithms of a person's size and of single bones, and how
# far fingers are held from their poses.
SIZES, BONES, HELD = 0.06, 0.05, 0.12


@checked_parameters(
    {**PARAMETERS, "n_people": [Interval(Integral, 1, None, closed="left")]}
)
def make_hand_tracks(
    n_frames: int = 400,
    *,
    n_people: int = 4,
    camera: Camera = "weak_perspective",
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
    camera : {"weak_perspective", "affine", "orthographic"}, default="weak_perspective"
        Camera model. The camera moves smoothly around the person within 60, 35 and 35
        degrees of yaw, pitch and roll to either side. Weak-perspective and affine
        cameras have 1 to 3 pixels per millimetre, orthographic cameras their geometric
        mean. Affine cameras also stretch each image, see `make_face_tracks`.
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
            The cameras, in pixels per millimetre.
        translation : ndarray of shape (n_frames, 2)
            The centroids in pixels.
        angles : ndarray of shape (n_frames, 3)
            Yaw, pitch and roll of the camera in degrees, see `make_face_tracks`.
        labels : ndarray of shape (n_frames,), dtype=str
            The pose: "open", "fist" or "point"; in a transition the nearer one.
        groups : ndarray of shape (n_frames,), dtype=int
            The number of the person, from 0. Each has lengths of bones of their own.
        time : ndarray of shape (n_frames,)
            Seconds since the person was first seen, at 25 frames per second.
        noise_variance : float
            Variance of the noise in one coordinate, in squared pixels.
        feature_names : list of str
            The names of the columns, x_0, y_0, x_1, ... in the order of `layout`.
        point_names : list of str
            The names of the points.

    Raises
    ------
    ValueError
        If a parameter is not of the kind or in the range given above, or there are
        fewer than two frames for each person.

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
    shapes, path, truths = perform(n_frames, n_people, POSES, _hand, rng)
    largest = (60.0, 35.0, 35.0)
    angles, motion, translation = film(path, largest, (1.0, 3.0), camera, rng)
    table = observe(shapes, motion, translation, rng, noise, missing, layout)
    point_names = list(get_skeleton("hand-21").point_names or ())
    return Bunch(**table, **truths, angles=angles, point_names=point_names)


def _hand(time: NDArray, weights: NDArray, rng: RandomState) -> NDArray[np.float64]:
    """Return the shapes (n, 21, 3) of a new person's hand."""
    bends = weights @ BENDS + HELD * wander(time, 5, rng)
    size = np.exp(SIZES * rng.standard_normal())
    shape = np.zeros((len(time), 21, 3))
    fingers = (
        (*THUMB, THUMB_FLEXION, ACROSS_THE_PALM),
        *((*finger, FLEXION, INTO_THE_PALM) for finger in FINGERS),
    )
    for f, (joint, direction, bones, flexion, bent) in enumerate(fingers):
        along = np.array(direction) / np.linalg.norm(direction)
        across = np.array(bent) - (bent @ along) * along
        across /= np.linalg.norm(across)
        lengths = np.array(bones) * np.exp(BONES * rng.standard_normal(3))
        angles = np.cumsum(np.deg2rad(flexion)) * bends[:, [f]]
        steps = np.cos(angles)[..., None] * along + np.sin(angles)[..., None] * across
        chain = np.cumsum(lengths[:, None] * steps, axis=1)
        first = np.array(joint) * np.exp(BONES * rng.standard_normal())
        shape[:, 1 + 4 * f] = first
        shape[:, 2 + 4 * f : 5 + 4 * f] = first + chain
    return size * shape
