"""Tables of orthographic cameras and their truth, for the tests of the baselines."""

import numpy as np

from isa_nrsfm.datasets import make_nonrigid_tracks


def exact_table(seed, n_frames=60, n_points=30, n_components=2, **parameters):
    """Return a table of orthographic cameras with its truth, without noise."""
    return make_nonrigid_tracks(
        n_frames,
        n_points,
        n_components,
        camera="orthographic",
        random_state=seed,
        **parameters,
    )


def rotations(motion):
    """Return the rotation of each camera with orthonormal rows, up to their scale."""
    unit = motion / np.linalg.norm(motion, axis=2, keepdims=True)
    return np.concatenate([unit, np.cross(unit[:, 0], unit[:, 1])[:, None]], axis=1)


def camera_frame(model):
    """Return the fitted shapes in the coordinates of each frame's camera."""
    return model.shapes_ @ rotations(model.motion_).swapaxes(1, 2)


def mocap_shapes(data):
    """Return the true shapes of a mocap table in the coordinates of the cameras.

    There a camera that follows the object, which turns and deforms, counts like one
    that does not: the images do not tell them apart.
    """
    return data["S3d"] @ rotations(data["R"]).swapaxes(1, 2)
