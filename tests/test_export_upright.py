import numpy as np
import pytest
from export_models import aligned, blob_model, calibrated_model, face_model, faces
from numpy.testing import assert_allclose

from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm.export._upright import upright_basis, upright_frames, upright_space

CHIN, NOSE, LEFT_JAW, RIGHT_JAW, BROW = 8, 30, 0, 16, 19


def space_of(model, camera="weak_perspective", origin="auto", mirrored=False):
    return upright_space(model, camera, origin, mirrored)


@pytest.mark.parametrize("y_up", [False, True])
@pytest.mark.parametrize("camera", ["weak_perspective", None])
def test_faces_stand_upright_and_look_at_the_viewer(camera, y_up):
    model = face_model(y_up=y_up)
    mean, _ = upright_basis(space_of(model, camera), model)
    assert mean[BROW, 1] < mean[NOSE, 1] < mean[CHIN, 1]  # y points down
    assert mean[LEFT_JAW, 0] < mean[NOSE, 0] < mean[RIGHT_JAW, 0]
    assert mean[NOSE, 2] < mean[[LEFT_JAW, RIGHT_JAW], 2].min()  # z points away


@pytest.mark.parametrize("make", [face_model, calibrated_model])
def test_the_mean_face_has_its_true_proportions(make):
    truth, model = faces(), make()
    mean, _ = upright_basis(space_of(model), model)
    error = aligned(mean, truth.mean_shape) - truth.mean_shape
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(truth.mean_shape)
    # The pose depends on a few points: the same, but for a few degrees of pitch.
    cosines = np.sum(mean * truth.mean_shape, axis=0)
    cosines /= np.linalg.norm(mean, axis=0) * np.linalg.norm(truth.mean_shape, axis=0)
    assert cosines.min() > 0.99


@pytest.mark.parametrize("y_up", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("make", [face_model, blob_model, calibrated_model])
def test_frames_in_their_poses_have_the_images_of_the_model(make, mirrored, y_up):
    model = make(y_up=True) if y_up and make is face_model else make()
    origin = "lower" if y_up else "upper"
    space = space_of(model, origin=origin, mirrored=mirrored)
    frames = upright_frames(space, model, model.motion_, model.alpha_)
    identity = np.broadcast_to(np.eye(3), frames.rotations.shape)
    turned = frames.rotations @ frames.rotations.transpose(0, 2, 1)
    assert_allclose(turned, identity, atol=1e-10)
    assert_allclose(np.linalg.det(frames.rotations), 1.0)

    scales = frames.scales[:, None, None]
    images = scales * (frames.shapes @ frames.rotations[:, :2].transpose(0, 2, 1))
    shapes = compose(model.mean_shape_, model.basis_, model.alpha_)
    expected = project(shapes, model.motion_, 0.0 * model.translation_)
    expected = expected * [1, -1 if y_up else 1]  # upright images
    assert_allclose(images, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("options", "signs"),
    [({"mirrored": True}, [1, 1, -1]), ({"origin": "lower"}, [1, -1, -1])],
)
def test_mirror_images_and_origins_change_signs(options, signs):
    model = blob_model()
    mean, basis = upright_basis(space_of(model), model)
    other = upright_basis(space_of(model, **options), model)
    assert_allclose(other[0], mean * signs, atol=1e-9)
    assert_allclose(other[1], basis * signs, atol=1e-9)


def test_basis_shapes_are_the_least_squares_fit_to_the_frames():
    model = face_model()
    space = space_of(model)
    shapes = upright_frames(space, model, model.motion_, model.alpha_).shapes
    weights = np.insert(model.alpha_, 0, 1.0, axis=1)
    best = np.linalg.lstsq(weights, shapes.reshape(len(shapes), -1), rcond=None)[0]
    best = best.reshape(-1, 68, 3)
    for options in ({}, {"block_numbers": 1000}):
        mean, basis = upright_basis(space, model, **options)
        found = np.concatenate([mean[None], basis])
        assert_allclose(found, best, atol=1e-9 * np.abs(best).max())


@pytest.mark.parametrize("asked", ["weak_perspective", None])
@pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
class TestCalibratedCameras:
    def test_shapes_are_those_of_the_model_turned(self, camera, asked):
        model = calibrated_model(camera)
        space = space_of(model, asked)
        assert (space.camera, space.metric) == (camera, None)
        turn = space.transform
        assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        mean, basis = upright_basis(space, model)
        assert_allclose(mean, model.mean_shape_ @ turn.T)
        assert_allclose(basis, model.basis_ @ turn.T)
        assert mean[BROW, 1] < mean[NOSE, 1] < mean[CHIN, 1]
        assert mean[NOSE, 2] < mean[[LEFT_JAW, RIGHT_JAW], 2].min()
