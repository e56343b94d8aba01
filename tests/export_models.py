"""Fitted models for the tests of exports."""

import numpy as np
from made_once import made_once

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks

N_FRAMES, N_COMPONENTS = 60, 3
HOSTILE = "</script><script>document.title = 'taken'</script><b>&amp;'\"\u2028"
LABELS = [["neutral", HOSTILE, "smile"][i % 3] for i in range(N_FRAMES)]


@made_once
def faces(camera="weak_perspective"):
    """Return artificial faces seen by calibrated cameras."""
    options = {"camera": camera, "noise": 0.005, "random_state": 0}
    return make_face_tracks(N_FRAMES, n_components=N_COMPONENTS, **options)


@made_once
def face_model(y_up=False):
    """Return a model of the faces, also of images whose y points up."""
    table = faces().data * (np.tile([1, -1], 68) if y_up else 1)
    return AffineNRSfM(N_COMPONENTS, random_state=0).fit(table)


@made_once
def calibrated_model(camera="weak_perspective"):
    """Return a model of the faces with calibrated cameras."""
    model = AffineNRSfM(N_COMPONENTS, camera=camera, random_state=0)
    return model.fit(faces(camera).data)


@made_once
def blob_model():
    """Return a small model of points that are no face."""
    rng = np.random.default_rng(0)
    shapes = rng.standard_normal((20, 3)) * [3, 2, 1]
    drift = rng.standard_normal((20, 3)) * 0.3
    turns = np.linalg.qr(rng.standard_normal((40, 3, 3)))[0][:, :2]
    weights = rng.standard_normal(40)[:, None, None]
    tracks = (shapes + weights * drift) @ turns.transpose(0, 2, 1)
    return AffineNRSfM(1, random_state=0).fit(tracks.reshape(40, 40))


def aligned(shapes, target):
    """Return shapes aligned to others by similarities, without reflections."""
    shapes = shapes - shapes.mean(axis=-2, keepdims=True)
    target = target - target.mean(axis=-2, keepdims=True)
    target = np.broadcast_to(target, shapes.shape)
    left, values, right = np.linalg.svd(shapes.swapaxes(-1, -2) @ target)
    signs = np.ones(values.shape)
    signs[..., 2] = np.linalg.det(left @ right)
    scales = np.sum(values * signs, axis=-1) / np.sum(shapes**2, axis=(-1, -2))
    turns = (left * signs[..., None, :]) @ right
    return scales[..., None, None] * (shapes @ turns)
