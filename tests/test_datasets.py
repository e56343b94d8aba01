"""Tables with known truth."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm._tables.landmark_columns import names_layout
from isa_nrsfm._tables.layout import table_to_tracks
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.datasets._face_model import (
    COMPONENT_NAMES,
    deformations,
    mirror_points,
    neutral_shape,
)

MAKERS = [make_nonrigid_tracks, make_face_tracks]
CAMERAS = ["weak_perspective", "affine", "orthographic"]
SHAPES = ["mean_shape", "basis", "alpha", "shapes"]
TRUTHS = [*SHAPES, "motion", "translation", "clean"]


def root_mean_square(values):
    return np.sqrt(np.mean(values**2))


def centred(tracks):
    return tracks - tracks.mean(axis=1, keepdims=True)


def model(tracks):
    rows = [
        (tracks.mean_shape + np.tensordot(alpha, tracks.basis, 1)) @ motion.T + shift
        for alpha, motion, shift in zip(
            tracks.alpha, tracks.motion, tracks.translation, strict=True
        )
    ]
    return np.array(rows)


@pytest.mark.parametrize("make", MAKERS)
class TestEveryMaker:
    @pytest.mark.parametrize("camera", CAMERAS)
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    @pytest.mark.parametrize("n_components", [0, 1, 5])
    def test_follows_the_model_without_noise(self, make, camera, layout, n_components):
        tracks = make(
            40,
            n_components=n_components,
            camera=camera,
            layout=layout,
            noise=0.0,
            random_state=0,
        )
        assert_allclose(table_to_tracks(tracks.data, layout), model(tracks), rtol=1e-12)
        assert_array_equal(tracks.tracks, tracks.clean)
        assert tracks.noise_variance == 0
        assert tracks.basis.shape == (n_components, 68, 3)
        assert tracks.alpha.shape == (40, n_components)
        assert tracks.visible.all()

    def test_shapes_follow_the_model(self, make):
        tracks = make(40, n_components=3, random_state=1)
        expected = tracks.mean_shape + np.einsum(
            "ik,kjc->ijc", tracks.alpha, tracks.basis
        )
        assert_allclose(tracks.shapes, expected, atol=1e-10)

    def test_conventions_of_the_truth(self, make):
        tracks = make(40, n_components=3, random_state=1)
        assert_allclose(tracks.alpha.mean(axis=0), 0, atol=1e-13)
        assert_allclose(tracks.alpha.var(axis=0), 1)
        assert_allclose(tracks.mean_shape.mean(axis=0), 0, atol=1e-13)
        assert_allclose(tracks.basis.mean(axis=1), 0, atol=1e-13)
        assert_allclose(tracks.shapes.mean(axis=0), tracks.mean_shape, atol=1e-12)
        assert_allclose(tracks.clean.mean(axis=1), tracks.translation)

    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_feature_names_tell_the_layout(self, make, layout):
        tracks = make(10, layout=layout, random_state=0)
        assert names_layout(tracks.feature_names) == layout
        assert len(tracks.feature_names) == tracks.data.shape[1]
        assert tracks.feature_names[0] == "x_0"
        column = tracks.feature_names.index("y_7")
        assert_array_equal(tracks.data[:, column], tracks.tracks[:, 7, 1])

    def test_noise_is_relative_to_the_centred_tracks(self, make):
        tracks = make(400, noise=0.05, random_state=2)
        noise = tracks.tracks - tracks.clean
        size = root_mean_square(centred(tracks.clean))
        assert_allclose(root_mean_square(noise) / size, 0.05, rtol=0.02)
        assert_allclose(np.sqrt(tracks.noise_variance) / size, 0.05)

    def test_missing_points_have_no_coordinates(self, make):
        tracks = make(50, missing=0.3, noise=0.01, random_state=3)
        assert_allclose(np.mean(~tracks.visible), 0.3, atol=0.5 / tracks.visible.size)
        assert_array_equal(
            np.isnan(tracks.tracks), np.repeat(~tracks.visible[..., None], 2, axis=2)
        )
        assert_array_equal(table_to_tracks(tracks.data), tracks.tracks)
        assert np.isfinite(tracks.clean).all()

    def test_truth_does_not_depend_on_what_is_done_to_the_table(self, make):
        plain = make(30, noise=0.0, random_state=4)
        other = make(30, noise=0.1, missing=0.2, layout="planar", random_state=4)
        for name in TRUTHS:
            assert_array_equal(plain[name], other[name])

    @pytest.mark.parametrize("camera", CAMERAS)
    def test_shapes_do_not_depend_on_the_camera(self, make, camera):
        plain = make(30, random_state=4)
        other = make(30, camera=camera, random_state=4)
        for name in [*SHAPES, "translation"]:
            assert_array_equal(plain[name], other[name])

    def test_random_state_determines_everything(self, make):
        one, same, other = (make(20, noise=0.1, random_state=s) for s in (7, 7, 8))
        assert_array_equal(one.data, same.data)
        assert not np.allclose(one.data, other.data)
        state = np.random.RandomState(7)
        assert_array_equal(make(20, noise=0.1, random_state=state).data, one.data)

    def test_singular_values_of_the_cameras(self, make):
        values = {
            camera: np.linalg.svd(
                make(500, camera=camera, random_state=0).motion, compute_uv=False
            )
            for camera in CAMERAS
        }
        ratios = {camera: v[:, 1] / v[:, 0] for camera, v in values.items()}
        assert_allclose(ratios["orthographic"], 1)
        assert_allclose(values["orthographic"], values["orthographic"][0, 0])
        assert_allclose(ratios["weak_perspective"], 1)
        assert values["weak_perspective"].std() > 0.1
        assert 0.5 <= ratios["affine"].min() < 0.55
        assert 0.95 < ratios["affine"].max() <= 1
        # The stretch leaves the area, and so the scale.
        assert_allclose(
            values["affine"].prod(axis=1), values["weak_perspective"].prod(axis=1)
        )

    @pytest.mark.parametrize(
        ("parameter", "value"),
        [
            ("n_frames", 1),
            ("n_frames", 10.5),
            ("n_components", -1),
            ("noise", -0.1),
            ("noise", np.nan),
            ("missing", 1.0),
            ("missing", -0.1),
            ("camera", "perspective"),
            ("layout", "columns"),
            ("random_state", "seed"),
        ],
    )
    def test_refuses_nonsense(self, make, parameter, value):
        with pytest.raises(ValueError, match=f"The '{parameter}' parameter"):
            make(**{"n_frames": 10, parameter: value})


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("n_points", 3),
        ("amplitude", -1.0),
        ("shapes", "sparse"),
        ("coefficients", "uniform"),
    ],
)
def test_nonrigid_refuses_nonsense(parameter, value):
    with pytest.raises(ValueError, match=f"The '{parameter}' parameter"):
        make_nonrigid_tracks(**{parameter: value})


@pytest.mark.parametrize("shapes", ["heavy_tailed", "gaussian"])
@pytest.mark.parametrize("amplitude", [0.0, 0.3])
def test_amplitude_is_the_relative_size_of_the_deformation(shapes, amplitude):
    tracks = make_nonrigid_tracks(
        n_frames=25, n_points=12, amplitude=amplitude, shapes=shapes, random_state=0
    )
    deformation = tracks.shapes - tracks.mean_shape
    # Root mean squares of coordinates and of lengths have the same ratio.
    ratio = root_mean_square(deformation) / root_mean_square(tracks.mean_shape)
    assert_allclose(ratio, amplitude, atol=1e-13)
    assert_allclose(np.mean(np.sum(tracks.mean_shape**2, axis=1)), 1)


def test_basis_shapes_have_the_same_norm():
    basis = make_nonrigid_tracks(n_components=4, random_state=0).basis
    norms = np.linalg.norm(basis, axis=(1, 2))
    assert_allclose(norms, norms[0])


@pytest.mark.parametrize(
    ("shapes", "expected"), [("gaussian", 5 / 3), ("heavy_tailed", 5.0)]
)
def test_tails_of_the_basis_shapes(shapes, expected):
    # E r^4 / (E r^2)^2 of the radius: 15 / 9 for a Gaussian 3-vector, and 3 times
    # that after the multiplication with a Gaussian number.
    basis = make_nonrigid_tracks(
        n_frames=2, n_points=200_000, n_components=1, shapes=shapes, random_state=0
    ).basis
    energy = np.sum(basis**2, axis=2)
    assert_allclose(np.mean(energy**2) / np.mean(energy) ** 2, expected, rtol=0.05)
    # Directions are uniform on the sphere.
    directions = basis[0] / np.sqrt(energy[0])[:, None]
    assert_allclose(np.cov(directions.T), np.eye(3) / 3, atol=0.005)


@pytest.mark.parametrize(
    ("coefficients", "expected"), [("gaussian", 3.0), ("heavy_tailed", 6.0)]
)
def test_tails_of_the_coefficients(coefficients, expected):
    alpha = make_nonrigid_tracks(
        50_000, 4, 2, coefficients=coefficients, random_state=0
    ).alpha
    assert_allclose(np.mean(alpha**4, axis=0), expected, rtol=0.1)
    assert_allclose(np.mean(alpha[:, 0] * alpha[:, 1]), 0, atol=0.02)


def test_orientations_are_uniform():
    motion = make_nonrigid_tracks(
        20_000, 4, 0, camera="orthographic", random_state=0
    ).motion
    assert_allclose(motion.mean(axis=0), 0, atol=0.02)
    axes = motion[:, 0]
    assert_allclose(axes.T @ axes / len(axes), np.eye(3) / 3, atol=0.01)
    assert_allclose(np.mean(axes**4, axis=0), 1 / 5, atol=0.01)


def test_rank_of_the_table_is_that_of_the_model():
    tracks = make_nonrigid_tracks(n_components=3, camera="affine", random_state=0)
    values = np.linalg.svd(
        centred(tracks.tracks).transpose(0, 2, 1).reshape(-1, 68), compute_uv=False
    )
    assert values[11] > 1e-3 * values[0]
    assert values[12] < 1e-12 * values[0]


class TestFace:
    def test_every_point_is_given_and_mirrored(self):
        neutral, mirror = neutral_shape(), mirror_points()
        assert_array_equal(np.sort(mirror), np.arange(68))
        assert_array_equal(mirror[mirror], np.arange(68))
        assert_array_equal(neutral[mirror] * (-1, 1, 1), neutral)
        # No point was left at zero, and points on the axis are their own images.
        assert np.abs(neutral).sum(axis=1).min() > 5
        assert_array_equal(np.flatnonzero(neutral[:, 0] == 0), _middle())
        assert_array_equal(np.flatnonzero(mirror == np.arange(68)), _middle())
        spread = np.linalg.norm(neutral[:, None] - neutral, axis=2)
        assert spread[~np.eye(68, dtype=bool)].min() > 2

    def test_anatomy_in_image_coordinates(self):
        face = make_face_tracks(random_state=0).neutral_shape
        x, y, z = face.T
        assert z.argmin() == 30  # tip of the nose in front
        assert set(z.argsort()[-2:]) == {0, 16}  # ears behind
        assert y.argmax() == 8  # chin lowest, y points down
        assert y[17:27].max() < y[36:48].min()  # brows above eyes
        assert y[36:48].max() < y[31:36].min() < y[48:].min()  # nostrils, then mouth
        assert x[36:42].max() < 0 < x[42:48].min()  # the subject's right is left
        assert_array_equal(np.argsort(x[:17]), np.arange(17))
        assert (y[[37, 38, 43, 44]] < y[[41, 40, 47, 46]]).all()  # lids
        assert (y[61:64] < y[[67, 66, 65]]).all()  # inner lips do not cross

    @pytest.mark.parametrize("k", range(8))
    def test_deformations_are_symmetric_local_and_solid(self, k):
        change = deformations(8)[k]
        assert_array_equal(change[mirror_points()] * (-1, 1, 1), change)
        energy = np.sum(change**2, axis=1)
        assert np.mean(energy == 0) > 0.4
        # Beyond 5 / 3, the value of Gaussian 3-vectors.
        assert np.mean(energy**2) / np.mean(energy) ** 2 > 2.5
        values = np.linalg.svd(change - change.mean(axis=0), compute_uv=False)
        assert values[2] > 0.03 * values[0]  # three directions of its own

    def test_deformations_do_what_they_are_called(self):
        neutral = neutral_shape()
        change = dict(zip(COMPONENT_NAMES, deformations(8), strict=True))
        assert len(change) == 8
        full = {name: neutral + shape for name, shape in change.items()}

        assert change["jaw open"][8, 1] > 20
        assert (full["jaw open"][66, 1] - full["jaw open"][62, 1]) > 20
        corners = change["smile"][[48, 54]]
        assert (corners[:, 1] < -8).all()
        assert corners[0, 0] < -8
        assert corners[1, 0] > 8
        assert (change["brow raise"][17:27, 1] < -5).all()
        assert (change["brow lower"][17:27, 1] > 0).all()
        opening = (
            full["blink"][[41, 40, 47, 46], 1] - full["blink"][[37, 38, 44, 43], 1]
        )
        assert_allclose(opening, 0, atol=0.5)  # the eyes are shut
        assert np.ptp(full["lip pucker"][48:, 0]) < 0.6 * np.ptp(neutral[48:, 0])
        assert (change["lip pucker"][48:, 2] < -5).all()
        assert (change["nose wrinkle"][31:36, 1] < -4).all()
        assert np.ptp(full["face width"][:17, 0]) > 1.05 * np.ptp(neutral[:17, 0])

    def test_strengths_give_the_coefficients(self):
        faces = make_face_tracks(300, n_components=8, random_state=0)
        assert faces.component_names == list(COMPONENT_NAMES)
        assert faces.strength[:, :7].min() >= 0
        assert faces.strength[:, 7].min() < -0.5
        assert np.abs(faces.strength).max() <= 1
        full = deformations(8) - deformations(8).mean(axis=1, keepdims=True)
        expected = faces.neutral_shape + np.tensordot(faces.strength, full, 1)
        assert_allclose(faces.shapes, expected, atol=1e-10)

    def test_strengths_are_skewed_and_independent(self):
        alpha = make_face_tracks(20_000, n_components=8, random_state=0).alpha
        # Beta(0.4, 2): skewness 2 * 1.6 * sqrt(3.4) / (4.4 * sqrt(0.8)).
        assert_allclose(np.mean(alpha[:, :7] ** 3, axis=0), 1.499, rtol=0.1)
        assert (np.mean(alpha[:, :7] ** 4, axis=0) > 3.5).all()
        assert_allclose(np.mean(alpha[:, 7] ** 3), 0, atol=0.05)
        assert_allclose(np.corrcoef(alpha.T), np.eye(8), atol=0.03)

    def test_angles_are_those_of_the_cameras(self):
        faces = make_face_tracks(500, camera="orthographic", random_state=0)
        yaw, pitch, roll = np.radians(faces.angles.T)
        # Image of the direction of the nose, (0, 0, -1), before the roll.
        nose = np.stack([-np.sin(yaw), np.sin(pitch) * np.cos(yaw)], axis=1)
        turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
        expected = np.einsum("abi,ib->ia", turn, nose)
        assert_allclose(-faces.motion[:, :, 2], 2 * expected, atol=1e-12)
        limits = np.array([45.0, 25.0, 20.0])
        largest = np.abs(faces.angles).max(axis=0)
        assert (largest <= limits).all()
        assert (largest > 0.95 * limits).all()

    def test_units_are_pixels(self):
        faces = make_face_tracks(500, random_state=0)
        scales = np.linalg.norm(faces.motion, axis=2)
        assert 1 <= scales.min() < 1.1
        assert 3.8 < scales.max() <= 4 + 1e-12
        assert (faces.translation.min(axis=0) >= (320, 240)).all()
        assert (faces.translation.max(axis=0) <= (960, 720)).all()
        assert 0.25 < np.sqrt(faces.noise_variance) < 0.75

    @pytest.mark.parametrize("n_components", [1, 4, 8])
    def test_singular_values_reveal_every_direction(self, n_components):
        faces = make_face_tracks(n_components=n_components, noise=0.0, random_state=0)
        values = np.linalg.svd(
            centred(faces.tracks).transpose(0, 2, 1).reshape(-1, 68), compute_uv=False
        )
        rank = 3 * n_components + 3
        assert values[rank - 1] > 1e-5 * values[0]
        assert values[rank] < 1e-12 * values[0]

    def test_too_many_components(self):
        with pytest.raises(ValueError, match=r"'n_components'.*range \[0, 8\]"):
            make_face_tracks(n_components=9)


def _middle():
    return [8, 27, 28, 29, 30, 33, 51, 57, 62, 66]
