"""Generated tables: one contract over all makers, then what each of them makes."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of
from scenes import tracks_of

from isa_nrsfm.datasets import (
    make_body_tracks,
    make_face_tracks,
    make_hand_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.skeletons import get_skeleton

BODIES = {
    "hand-21": make_hand_tracks,
    "coco-17": make_body_tracks,
    "h36m-17": partial(make_body_tracks, scheme="h36m-17"),
}
LINEAR = {"random": make_nonrigid_tracks, "face": make_face_tracks}
MAKERS = LINEAR | {kind: BODIES[kind] for kind in ("hand-21", "coco-17")}
# Distances of perspective cameras
FILMED = {"face": 500, "hand-21": 500, "coco-17": 3500}
CAMERAS = ["weak_perspective", "affine", "orthographic"]
TRUTHS = "mean_shape", "shapes", "motion", "translation", "clean"

every = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
linear = pytest.mark.parametrize("make", LINEAR.values(), ids=LINEAR)
people = pytest.mark.parametrize("kind", BODIES)


def root_mean_square(values):
    return np.sqrt(np.mean(values**2))


def centred(tracks):
    return tracks - tracks.mean(axis=1, keepdims=True)


@every
class TestEveryMaker:
    @pytest.mark.parametrize("camera", CAMERAS)
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_tables_are_images_of_the_shapes(self, make, camera, layout):
        options = {"camera": camera, "layout": layout, "random_state": 0}
        scene = make(40, noise=0.0, **options)
        images = scene.shapes @ scene.motion.mT + scene.translation[:, None]
        assert_allclose(scene.clean, images, rtol=1e-12)
        assert_array_equal(scene.tracks, scene.clean)
        assert scene.noise_variance == 0
        assert scene.visible.all()
        assert_array_equal(tracks_of(scene.data, layout), scene.tracks)
        assert len(set(scene.feature_names)) == scene.data.shape[1]
        for axis in range(2):
            column = scene.feature_names.index(f"{'xy'[axis]}_7")
            assert_array_equal(scene.data[:, column], scene.tracks[:, 7, axis])
        assert_allclose(scene.shapes.mean(axis=1), 0, atol=1e-12)
        assert_allclose(scene.shapes.mean(axis=0), scene.mean_shape, atol=1e-11)
        assert_allclose(scene.clean.mean(axis=1), scene.translation)

    def test_noise_and_missing_points(self, make):
        scene = make(200, missing=0.3, noise=0.05, random_state=2)
        size = root_mean_square(centred(scene.clean))
        hidden = ~scene.visible
        noise = root_mean_square((scene.tracks - scene.clean)[scene.visible])
        assert_allclose(noise / size, 0.05, rtol=0.02)
        assert_allclose(np.sqrt(scene.noise_variance) / size, 0.05)
        assert_allclose(np.mean(hidden), 0.3, atol=0.5 / hidden.size)
        assert_array_equal(np.isnan(scene.tracks), np.stack([hidden] * 2, axis=2))
        assert_array_equal(tracks_of(scene.data), scene.tracks)
        assert np.isfinite(scene.clean).all()

    def test_random_state(self, make):
        state = np.random.RandomState(4)
        plain, same, other = (make(30, random_state=seed) for seed in (4, state, 5))
        assert_array_equal(plain.data, same.data)
        assert not np.allclose(plain.data, other.data)
        # Whatever is done to the table, the truth is the same.
        other = make(30, noise=0.1, missing=0.2, layout="planar", random_state=4)
        for name in TRUTHS:
            assert_array_equal(plain[name], other[name])
        for camera in CAMERAS:
            other = make(30, camera=camera, random_state=4)
            assert_array_equal(plain.shapes, other.shapes)
            assert_array_equal(plain.translation, other.translation)

    def test_singular_values_of_the_cameras(self, make):
        affine, ortho, weak = (
            np.linalg.svd(make(500, camera=camera, random_state=0).motion)[1]
            for camera in ("affine", "orthographic", "weak_perspective")
        )
        assert_allclose(ortho, ortho[0, 0])
        assert_allclose(weak[:, 1], weak[:, 0])
        assert np.ptp(weak) > 0.1
        ratios = affine[:, 1] / affine[:, 0]
        assert 0.5 <= ratios.min() < 0.55
        assert 0.95 < ratios.max() <= 1
        # The stretch leaves the area, and so the scale.
        assert_allclose(affine.prod(axis=1), weak.prod(axis=1))


@linear
@pytest.mark.parametrize("n_components", [0, 1, 5])
def test_linear_models(make, n_components):
    options = {"camera": "affine", "noise": 0.0, "random_state": 1}
    scene = make(40, n_components=n_components, **options)
    assert scene.basis.shape == (n_components, 68, 3)
    assert scene.alpha.shape == (40, n_components)
    expected = scene.mean_shape + np.einsum("ik,kjc->ijc", scene.alpha, scene.basis)
    assert_allclose(scene.shapes, expected, atol=1e-10)
    assert_allclose(scene.alpha.mean(axis=0), 0, atol=1e-13)
    assert_allclose(scene.alpha.var(axis=0), 1)
    assert_allclose(scene.basis.mean(axis=1), 0, atol=1e-13)
    W = centred(scene.tracks).mT.reshape(80, -1)
    assert np.linalg.matrix_rank(W, rtol=1e-6) == 3 * n_components + 3


@pytest.mark.parametrize("kind", FILMED)
class TestPerspective:
    def test_tables_are_images_of_the_points_before_the_camera(self, kind):
        options = {"focal_length": 800.0, "random_state": 0}
        scene = MAKERS[kind](60, camera="perspective", **options)
        assert (scene.focal_length, scene.principal_point) == (800.0, (640.0, 360.0))
        points = scene.shapes @ scene.rotations.mT + scene.positions[:, None]
        images = 800 * points[..., :2] / points[..., 2:] + scene.principal_point
        assert_allclose(scene.clean, images, rtol=0, atol=1e-9)
        gram = scene.rotations @ scene.rotations.mT
        assert_allclose(gram, [np.eye(3)] * 60, atol=1e-12)
        assert_allclose(np.linalg.det(scene.rotations), 1)
        # As a weak-perspective camera at the same place
        scales = 800 / scene.positions[:, 2]
        assert_allclose(scene.motion, scales[:, None, None] * scene.rotations[:, :2])
        place = scales[:, None] * scene.positions[:, :2] + scene.principal_point
        assert_allclose(scene.translation, place)

    def test_objects_are_everywhere_in_the_image(self, kind):
        scene = MAKERS[kind](800, camera="perspective", random_state=0)
        distances = scene.positions[:, 2] / FILMED[kind]
        assert 0.85 <= distances.min() < 0.9
        assert 1.1 < distances.max() <= 1.15
        first, last = scene.clean.min(axis=(0, 1)), scene.clean.max(axis=(0, 1))
        assert ((first >= 0) & (first < 60)).all()
        assert ((last > (1180, 660)) & (last <= (1280, 720))).all()

    def test_truth_about_the_object_is_that_of_other_cameras(self, kind):
        plain, scene = (
            MAKERS[kind](30, missing=0.2, camera=camera, random_state=4)
            for camera in ("weak_perspective", "perspective")
        )
        for name in ("shapes", "mean_shape", "angles", "labels", "visible"):
            assert_array_equal(plain[name], scene[name])
        noise = ((s.tracks - s.clean) / s.noise_variance**0.5 for s in (plain, scene))
        assert_allclose(*noise, atol=1e-9)
        assert "positions" not in plain


@pytest.mark.parametrize("shapes", ["heavy_tailed", "gaussian"])
@pytest.mark.parametrize("amplitude", [0.0, 0.3])
def test_amplitude_is_the_relative_size_of_the_deformation(shapes, amplitude):
    options = {"amplitude": amplitude, "shapes": shapes}
    scene = make_nonrigid_tracks(25, 12, **options, random_state=0)
    # Root mean squares of coordinates and of lengths have the same ratio.
    deformation = root_mean_square(scene.shapes - scene.mean_shape)
    ratio = deformation / root_mean_square(scene.mean_shape)
    assert_allclose(ratio, amplitude, atol=1e-13)
    assert_allclose(np.mean(np.sum(scene.mean_shape**2, axis=1)), 1)
    norms = np.linalg.norm(scene.basis, axis=(1, 2))
    assert_allclose(norms, norms[0])


@pytest.fixture(scope="module")
def expressive():
    """Many faces with all expressions."""
    return make_face_tracks(8_000, n_components=8, random_state=0)


@pytest.fixture(scope="module")
def deformations(expressive):
    """Return the deformations at full strength by name, moved to the face at rest."""
    full = expressive.basis / expressive.strength.std(axis=0)[:, None, None]
    # Most points stay where they are.
    full = full - np.median(full, axis=1, keepdims=True)
    return dict(zip(expressive.component_names, full, strict=True))


class TestFace:
    def test_deformations_are_symmetric_local_and_solid(self, deformations):
        face, mirror = get_skeleton("ibug-68"), np.arange(68)
        mirror[[*face.left, *face.right]] = [*face.right, *face.left]
        for change in deformations.values():
            assert_allclose(change[mirror] * (-1, 1, 1), change, atol=1e-9)
            energy = np.sum(change**2, axis=1)
            assert np.mean(energy < 1e-18) > 0.4
            # Beyond 5 / 3, the value of Gaussian 3-vectors.
            assert np.mean(energy**2) / np.mean(energy) ** 2 > 2.5
            values = np.linalg.svd(change - change.mean(axis=0), compute_uv=False)
            assert values[2] > 0.03 * values[0]  # three directions of its own

    def test_deformations_do_what_they_are_called(self, expressive, deformations):
        neutral, change = expressive.neutral_shape, deformations
        full = {name: neutral + shape for name, shape in change.items()}
        assert change["jaw open"][8, 1] > 20
        assert full["jaw open"][66, 1] - full["jaw open"][62, 1] > 20
        (right, up), (left, _) = change["smile"][[48, 54], :2] * [1, -1]
        assert min(-right, left, up) > 8
        assert (change["brow raise"][17:27, 1] < -5).all()
        lids = full["blink"][:, 1]
        opening = lids[[41, 40, 47, 46]] - lids[[37, 38, 44, 43]]
        assert_allclose(opening, 0, atol=0.5)  # the eyes are shut

    def test_strengths_labels_groups_and_time(self, expressive):
        faces, strength, alpha = expressive, expressive.strength, expressive.alpha
        assert strength[:, :7].min() >= 0
        assert strength[:, 7].min() < -0.5
        assert np.abs(strength).max() <= 1
        full = faces.basis / strength.std(axis=0)[:, None, None]
        expected = faces.neutral_shape + np.tensordot(strength[:9], full, 1)
        assert_allclose(faces.shapes[:9], expected, atol=1e-10)
        # Beta(0.4, 2): skewness 2 * 1.6 * sqrt(3.4) / (4.4 * sqrt(0.8)).
        assert_allclose(np.mean(alpha[:, :7] ** 3, axis=0), 1.499, rtol=0.1)
        assert (np.mean(alpha[:, :7] ** 4, axis=0) > 3.5).all()
        assert_allclose(np.mean(alpha[:, 7] ** 3), 0, atol=0.05)
        assert_allclose(np.corrcoef(alpha.T), np.eye(8), atol=0.03)
        strongest = strength[:, :7].argmax(axis=1)  # the width is no expression
        assert_array_equal(faces.labels, np.array(faces.component_names)[strongest])
        assert not faces.groups.any()
        assert_allclose(faces.time, np.arange(8_000) / 25)
        assert set(make_face_tracks(5, n_components=0).labels.tolist()) == {"rest"}

    def test_angles_are_those_of_the_cameras(self):
        faces = make_face_tracks(500, camera="orthographic", random_state=0)
        yaw, pitch, roll = np.radians(faces.angles.T)
        # Image of the direction of the nose, (0, 0, -1), before the roll.
        nose = np.stack([-np.sin(yaw), np.sin(pitch) * np.cos(yaw)], axis=1)
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        expected = np.einsum("abi,ib->ia", turn, nose)
        assert_allclose(-faces.motion[:, :, 2], 2 * expected, atol=1e-12)
        largest = np.abs(faces.angles).max(axis=0) / [45.0, 25.0, 20.0]
        assert ((largest > 0.95) & (largest <= 1)).all()


class TestPeople:
    @people
    def test_each_person_takes_all_poses_in_time(self, kind):
        scene = BODIES[kind](400, n_people=3, random_state=1)
        assert scene.point_names == list(get_skeleton(kind).point_names)
        assert_array_equal(np.unique(scene.groups), range(3))
        same = np.diff(scene.groups) == 0
        assert (np.diff(scene.groups) >= 0).all()
        poses = {"reach", "squat", "walk"}
        if "hand" in kind:
            poses = {"fist", "open", "point"}
        for person in range(3):
            own = scene.groups == person
            assert {*scene.labels[own].tolist()} == poses
            assert_allclose(scene.time[own], np.arange(own.sum()) / 25)
        # Smooth within a person: a frame is near the one before, relative to the size.
        steps = np.linalg.norm(np.diff(scene.shapes, axis=0), axis=(1, 2))
        assert steps[same].max() < 0.3 * np.linalg.norm(scene.shapes[0])
        assert np.abs(np.diff(scene.angles, axis=0))[same].max() < 10

    @pytest.mark.parametrize("kind", ["hand-21", "coco-17"])
    def test_bones_are_rigid_and_everybody_has_their_own(self, kind):
        scene = MAKERS[kind](300, n_people=3, random_state=2)
        edges = get_skeleton(kind).edges[:16]
        if kind == "coco-17":
            # Arms and legs; shoulders and hips keep their width, the trunk bends.
            edges = [[5, 7], [7, 9], [6, 8], [11, 13], [13, 15], [5, 6], [11, 12]]
        bones = np.diff(scene.shapes[:, np.array(edges)], axis=2)[:, :, 0]
        lengths = np.linalg.norm(bones, axis=2)
        firsts = lengths[[np.argmax(scene.groups == person) for person in range(3)]]
        assert_allclose(lengths, firsts[scene.groups], rtol=1e-6)
        assert np.ptp(firsts, axis=0).min() > 1e-3 * np.mean(firsts)


test_refusals = refusals_of("datasets", globals())
