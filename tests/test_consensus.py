"""The consensus of groups: neighbours, fits, merge, and the refinement as a whole."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from frame_parts import depth_errors
from layers import Quick, slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of
from scenes import with_gaps
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._joint.consensus import (
    COVER,
    Group,
    Scene,
    _principal,
    aligning_rotations,
    centred,
    common_coordinates,
    group_fit,
    hidden_residuals,
    merge,
    neighbourhoods,
    principal_shapes,
    share_of_first,
    weighted,
)
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

AS_USERS = ["few_frames", "widths", "error_steps", "restarts"]
SETTINGS = FitSettings(camera="orthographic", max_iter=300)


def random_groups(rng, z, sizes=(4, 4, 5, 6), weights=(1, 2, 1, 3)):
    """Return groups of depths (I, n), each shifted in each frame."""
    n_frames, n_points = z.shape
    groups = []
    for size, weight in zip(sizes, weights, strict=True):
        points = np.sort(rng.choice(n_points, size, replace=False))
        coordinates = rng.standard_normal((n_frames, 3, size))
        coordinates[:, 2] = z[:, points] + rng.standard_normal((n_frames, 1))
        groups.append(Group(points, weight, np.arange(n_frames), coordinates, 1.0))
    return groups


def scene_of(first, rows=None):
    """Return a scene whose other entries do not matter to a merge."""
    rows = first[:, :2].copy() if rows is None else rows
    return Scene(rows, first, np.zeros((len(first), 2, 3)), 1.0, 1e-6)


@pytest.mark.parametrize("size", [2, 12])
def test_each_point_is_in_a_group(size):
    """Groups have the given size, cover all points, and are counted."""
    points = np.random.default_rng(2).standard_normal((40, 2))
    groups = neighbourhoods(cdist(points, points), size)
    assert all(len(points) == size for points, _ in groups)
    assert set(np.concatenate([points for points, _ in groups])) == set(range(40))
    assert sum(count for _, count in groups) >= min(COVER * 40 // size, 40)
    assert len({tuple(points) for points, _ in groups}) == len(groups)


class TestMerge:
    """Depths of all points from those of groups."""

    def test_is_the_least_squares_solution(self):
        """The depths minimise the weighted squared differences, means apart."""
        rng = np.random.default_rng(4)
        first = rng.standard_normal((3, 3, 7))
        groups = random_groups(rng, rng.standard_normal((3, 7)))
        for group in groups:
            group.coordinates[:, 2] += rng.standard_normal((3, len(group.points)))
        found = merge(scene_of(first), groups)[:, 2]
        # The same problem, each group as rows of one matrix; the joint fit last
        small = 1e-3 * min(group.weight for group in groups)
        whole = Group(np.arange(7), small, np.arange(3), first, 1.0)
        rows, values = [], []
        for group in [*groups, whole]:
            n = len(group.points)
            P = np.sqrt(group.weight) * (np.eye(n) - 1 / n)
            rows.append(P @ np.eye(7)[group.points])
            values.append(group.coordinates[:, 2] @ P)
        expected = np.linalg.lstsq(np.vstack(rows), np.hstack(values).T)[0].T
        assert_allclose(centred(found), centred(expected), atol=1e-9)

    def test_visible_points_stay_at_their_images(self):
        """x and y are the images; a share of the residual moves them to the groups."""
        rng = np.random.default_rng(6)
        first = rng.standard_normal((4, 3, 8))
        rows = rng.standard_normal((4, 2, 8))
        rows[1, :, 2] = np.nan
        group = random_groups(rng, first[:, 2], sizes=(8,), weights=(1,))[0]
        scene = scene_of(first, rows)
        seen = np.isfinite(rows)
        assert_array_equal(merge(scene, [group])[:, :2][seen], rows[seen])
        fitted = merge(scene, [group], 1.0)[:, :2]
        assert_allclose(fitted, group.coordinates[:, :2], atol=1e-2)
        half = merge(scene, [group], 0.5)[:, :2]
        assert_allclose(half[seen], ((rows + fitted) / 2)[seen])
        assert_allclose(half[1, :, 2], fitted[1, :, 2])

    def test_weights_are_inverse_disagreements_of_sizes_and_starts(self):
        """Groups of a size and start share one factor, of the merge of their size."""
        rng = np.random.default_rng(7)
        first = rng.standard_normal((5, 3, 8))
        groups = random_groups(rng, rng.standard_normal((5, 8)), sizes=(5, 5, 5, 6))
        groups[2] = groups[2]._replace(start=1)
        for group in groups:
            group.coordinates[:, 2] += rng.standard_normal((5, len(group.points)))
        scene = scene_of(first)
        found = weighted(scene, groups)
        z = merge(scene, groups[:3])[:, 2]
        off = [
            np.mean((centred(g.coordinates[:, 2]) - centred(z[:, g.points])) ** 2)
            for g in groups[:3]
        ]
        both = np.average(off[:2], weights=[g.weight for g in groups[:2]])
        for group, square in zip(groups, (both, both, off[2]), strict=False):
            after = next(g for g in found if g.points is group.points)
            assert_allclose(after.weight, group.weight / (5 * square), rtol=1e-9)


def test_principal_shapes_of_frames():
    """Fewer components leave a mean square, which the third argument may bound."""
    S = np.random.default_rng(9).standard_normal((20, 3, 5))
    by_number = [principal_shapes(S, k) for k in range(1, 12)]
    for shapes, alpha, left in by_number:
        rest = S - shapes[0] - np.tensordot(alpha, shapes[1:], 1)
        assert_allclose(left, np.mean(rest**2))
    shapes, _, left = principal_shapes(S, 11, 1.01 * by_number[5][2])
    assert len(shapes) == 7
    assert_allclose(left, by_number[5][2])
    # More components than frames are filled with zeros.
    shapes, alpha, _ = principal_shapes(S[:4], 9)
    assert shapes.shape == (10, 3, 5)
    assert not shapes[5:].any()
    assert not alpha[:, 4:].any()


def test_share_of_the_joint_fit_by_hidden_points():
    """The true model predicts hidden points, missing ones do not count."""
    X, fitted_jointly, _ = sufficient_fits()
    model = fitted_jointly._model
    frames, rows = model.frames, X.reshape(30, 14, 2).mT / model.unit
    flat = replace(frames, shapes=frames.shapes * [[1.0], [1.0], [0.5]])
    assert np.abs(hidden_residuals(frames, rows)).max() < 1e-4
    assert np.abs(hidden_residuals(flat, rows)).max() > 1e-2
    assert share_of_first(flat, frames, rows) < 0.01
    assert share_of_first(frames, flat, rows) > 0.49
    assert share_of_first(frames, frames, rows) == 0
    rows[:5, :, 3] = np.nan
    assert_array_equal(np.isnan(hidden_residuals(frames, rows)), np.isnan(rows))


class TestGroupFit:
    """The fit of one group."""

    def scene(self, hidden=0.0):
        """Return the scene of a deforming group, and its true coordinates."""
        tracks = make_nonrigid_tracks(
            60, 12, 2, camera="orthographic", noise=0.0, random_state=0
        )
        rotations, scales = full_rotations(tracks.motion)
        truth = centred(scales[:, None, None] * rotations @ tracks.shapes.mT)
        size = np.sqrt(np.mean(truth[:, :2] ** 2))
        truth, motion = truth / size, tracks.motion / size
        rows = with_gaps(truth[:, :2].mT, hidden, 1).mT
        off = np.random.default_rng(1).standard_normal(truth.shape)
        return Scene(rows, truth + 0.05 * off, motion, 1.0 / 0.008**2, 1e-5), truth

    @pytest.mark.parametrize(("hidden", "side"), [(0.2, 1), (0.0, -1)])
    def test_finds_depths(self, hidden, side):
        """They are those of a group, up to their mean, on the side of the joint fit."""
        scene, truth = self.scene(hidden=hidden)
        scene.first[:, 2] *= side
        frames, found, noise = group_fit(scene, 2, SETTINGS)
        off = centred(found[:, 2]) - side * centred(truth[frames, 2])
        assert np.sqrt(np.mean(off**2)) < 0.02
        assert np.sqrt(np.mean((found[:, :2] - truth[frames, :2]) ** 2)) < 0.02
        assert noise >= 1e-5

    def test_frames_with_few_points_are_left_out(self):
        """Frames show at least four points of a group; more than basis shapes do."""
        scene, _ = self.scene()
        scene.rows[:5, :, 3:] = np.nan
        frames, found, _ = group_fit(scene, 2, SETTINGS)
        assert_array_equal(frames, np.arange(5, 60))
        assert found.shape == (55, 3, 12)
        scene.rows[7:, :, 3:] = np.nan
        assert group_fit(scene, 2, SETTINGS) is None


FLOOR = 1e-5


def jointed(n_frames=60, seed=0):
    """Return coordinates (I, 3, 16) of two jointed bodies of rank one, and groups.

    Each body has ten points, four of them common, and turns by itself about these.
    """
    rng = np.random.default_rng(seed)
    views = Rotation.from_rotvec(0.6 * rng.standard_normal((n_frames, 3))).as_matrix()
    Y = np.zeros((n_frames, 3, 16))
    Y[:, 0, :4] = [-0.3, -0.1, 0.1, 0.3]  # on the axis of the joint
    for part in (slice(4, 10), slice(10, 16)):
        shape, change = rng.standard_normal((2, 3, 6)) * [[[1.0]], [[0.2]]]
        alpha = rng.standard_normal(n_frames)
        bend = 0.6 * rng.standard_normal(n_frames)
        turns = Rotation.from_rotvec(np.outer(bend, [1.0, 0.0, 0.0])).as_matrix()
        Y[:, :, part] = turns @ (shape + alpha[:, None, None] * change)
    Y = views @ Y
    frames = np.arange(n_frames)
    groups = [(frames, np.arange(10)), (frames, np.r_[0:4, 10:16])]
    return Y - Y.mean(axis=2, keepdims=True), groups


@pytest.fixture(scope="module")
def corrected():
    """Return coordinates and groups, the first coordinates, and the common ones."""
    (Y, groups), rng = jointed(), np.random.default_rng(1)
    first = Y.copy()
    first[:, 2] += centred(0.1 * rng.standard_normal(Y[:, 2].shape))
    return Y, groups, first, common_coordinates(Y[:, :2], first, groups, FLOOR, FLOOR)


def error(found, Y):
    """Return the relative error of the depths."""
    return np.linalg.norm(centred(found[:, 2]) - Y[:, 2]) / np.linalg.norm(Y[:, 2])


def test_depths_become_truer_and_true_ones_stay_in_any_order(corrected):
    Y, groups, first, found = corrected
    assert error(found, Y) < 0.5 * error(first, Y)
    assert_array_equal(found[:, :2], Y[:, :2])
    kept = common_coordinates(Y[:, :2], Y, groups, FLOOR, FLOOR)
    assert error(kept, Y) < 2 * np.sqrt(FLOOR)
    order = np.random.default_rng(3).permutation(len(Y))
    again = common_coordinates(Y[order, :2], first[order], groups[::-1], FLOOR, FLOOR)
    assert_allclose(again, found[order], atol=1e-6)


def test_missing_points_are_filled_in(corrected):
    Y, groups, first, _ = corrected
    hidden = np.random.default_rng(2).random(Y[:, 0].shape) < 0.2
    images = np.where(hidden[:, None], np.nan, Y[:, :2])
    first = first + 0.1 * hidden[:, None] * [[1.0], [1.0], [0.0]]
    found = common_coordinates(images, first, groups, FLOOR, FLOOR)
    seen = np.broadcast_to(~hidden[:, None], images.shape)
    assert_array_equal(found[:, :2][seen], Y[:, :2][seen])
    assert np.sqrt(np.mean((found[:, :2] - Y[:, :2])[~seen] ** 2)) < 0.05
    assert error(found, Y) < 0.5 * error(first, Y)


def test_points_and_frames_of_no_group_stay(corrected):
    Y, (group, _), first, _ = corrected
    some = group[0][:-5], group[1]
    found = common_coordinates(Y[:, :2], first, [some], FLOOR, FLOOR)
    assert_allclose(found[:, :, 10:], first[:, :, 10:], atol=1e-12)
    assert_allclose(found[-5:], first[-5:], atol=1e-12)
    assert np.abs(found - first)[:-5, 2, :10].max() > 0.01


@pytest.mark.parametrize("s2", [1e-3, 0.05])
def test_precision_is_that_of_probabilistic_components(s2, rng):
    """It is ``(B B^T + s2 I)^-1`` for ``B = U (v - s2)^.5``, for centred shapes."""
    B = rng.standard_normal((12, 2))
    shapes = (B @ rng.standard_normal((2, 500))).reshape(4, 3, 500)
    shapes += 0.1 * rng.standard_normal(shapes.shape)
    shapes -= shapes.mean(axis=0)
    found, slope = _principal(shapes, s2)
    values, vectors = np.linalg.eigh(np.cov(shapes.reshape(12, -1), bias=True))
    kept = values > s2
    B = vectors[:, kept] * np.sqrt(values[kept] - s2)
    centring = np.kron(np.eye(4) - 0.25, np.eye(3))
    expected = np.linalg.inv(B @ B.T + s2 * np.eye(12)) @ centring
    assert_allclose(found, expected, atol=1e-9 / s2)
    off = (shapes.mean(axis=2, keepdims=True) - shapes).reshape(12, -1)
    assert_allclose(slope.reshape(12, -1), expected @ off, atol=1e-9 / s2)


def test_aligning_rotations_leave_the_deformation(rng):
    """Shapes of rank one that were turned have rank one again."""
    base, basis = rng.standard_normal((2, 3, 6))
    S = base + 0.3 * rng.standard_normal((50, 1, 1)) * basis
    S -= S.mean(axis=2, keepdims=True)
    S = Rotation.from_rotvec(0.1 * rng.standard_normal((50, 3))).as_matrix() @ S
    R = aligning_rotations(S, 1e-4)
    assert_allclose(R @ R.mT, np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    second = [
        np.linalg.svd((each - each.mean(axis=0)).reshape(50, -1))[1][1]
        for each in (S, R.mT @ S)
    ]
    assert second[1] < 0.05 * second[0]


def articulated(n_frames=80, noise=1e-4, seed=0, n_points=6):
    """Return a table (I, 2J) and the shapes (I, J, 3) of four rods with three joints.

    Each rod turns by itself, and all together turn further, in the axes of the cameras.
    """
    rng = np.random.default_rng(seed)
    rods = rng.uniform(-0.5, 0.5, (4, n_points, 3)) * [1.0, 0.4, 0.4]
    joint, parts = np.zeros((n_frames, 3)), []
    for rod in rods:
        turns = Rotation.from_rotvec(0.3 * rng.standard_normal((n_frames, 3)))
        along = turns.apply([0.5, 0.0, 0.0])
        turned = turns.as_matrix() @ rod.T
        parts.append(turned.mT + (joint + along)[:, None])
        joint = joint + 2 * along
    shapes = np.concatenate(parts, axis=1)
    views = Rotation.from_rotvec(0.6 * rng.standard_normal((n_frames, 3)))
    shapes = shapes @ views.as_matrix().mT
    shapes -= shapes.mean(axis=1, keepdims=True)
    tracks = shapes[:, :, :2]
    tracks = tracks + noise * rng.standard_normal(tracks.shape)
    return tracks.reshape(n_frames, -1), shapes


X, SHAPES = articulated(60, n_points=4)


def consensus_fit(table=X, n_components=8, kind=AffineNRSfM, **parameters):
    """Return the consensus of a table."""
    given = {"camera": "orthographic", "refinement": "consensus", "random_state": 0}
    return kind(n_components, **given | parameters).fit(table)


def in_camera(model, table):
    """Return shapes in the axes of the cameras, in the units of the images."""
    return model.reconstruct(table, axes="camera")


def error_of(model, table, truth):
    """Return the error of shapes in the axes of the cameras."""
    return mean_shape_error_3d(truth, in_camera(model, table), convention="camera")


@made_once
def sufficient_fits(noise=0.0):
    """Return a table that a joint fit explains, its joint fit and its consensus."""
    options = {"camera": "orthographic", "noise": noise, "random_state": 0}
    table = make_nonrigid_tracks(30, 14, 1, **options).data
    kinds = "joint", "consensus"
    return table, *(consensus_fit(table, 1, Quick, refinement=k) for k in kinds)


@pytest.fixture(scope="module")
def body():
    """Return the consensus of a body."""
    return consensus_fit()


class TestEstimator:
    """`AffineNRSfM` with refinement="consensus"."""

    @pytest.mark.filterwarnings("ignore:the depth of the shapes")  # few, rough fits
    def test_frames_of_the_fit_are_those_of_transform(self):
        """`alpha_` and `motion_` are the results of `decompose`.

        A number of basis shapes is that of the result, beyond the joint fit's.
        """
        few = X[:40]
        body = consensus_fit(few, 14, Quick, tol=1.0)
        assert body.basis_.shape == (14, 16, 3)
        assert body.alpha_.shape == (40, 14)
        assert len(body.get_feature_names_out()) == 14
        found = body.decompose(few)
        assert_allclose(found.alpha, body.alpha_, atol=1e-9)
        assert_allclose(found.motion, body.motion_, atol=1e-9 * np.abs(few).max())
        model = body._model  # of all directions
        alpha = model.decompose(few.reshape(len(few), -1, 2).mT).alpha
        shapes = model.mean_shape + np.tensordot(alpha, model.basis, 1)
        assert_allclose(body.reconstruct(few), shapes, atol=1e-9)

    @pytest.mark.slow
    def test_deviations_of_depths_are_those_of_errors(self, body):
        """Their size is right; in frames, also new ones, they have similar ranks."""
        for table, truth in ((X, SHAPES), articulated(50, n_points=4)):
            off = depth_errors(body, table, truth[:, :, 2])
            _, std = body.reconstruct(table, return_std=True)
            ranks = spearmanr(np.mean(off**2, axis=1), np.mean(std**2, axis=1))
            assert ranks[0] > 0.4
            if table is X:
                assert 0.5 < np.sqrt(np.mean((off / std) ** 2)) < 2.0

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore:the depth of the shapes")  # 60 frames, gaps
    def test_processes_order_of_frames_and_missing_points(self, body):
        """Two processes have the same result to the bit."""
        other = consensus_fit(n_jobs=2)
        assert_array_equal(other.basis_, body.basis_)
        assert_array_equal(other.alpha_, body.alpha_)
        other = consensus_fit(X[np.random.default_rng(0).permutation(len(X))])
        before, after = (in_camera(model, X) for model in (body, other))
        assert mean_shape_error_3d(before, after, convention="camera") < 0.01
        table = with_gaps(X, 0.2, 1)
        hidden = error_of(consensus_fit(table), table, SHAPES)
        assert hidden < 2 * error_of(body, X, SHAPES)

    @pytest.mark.filterwarnings("ignore:the depth of the shapes")  # few, rough fits
    def test_depths_have_the_share_of_the_joint_fit(self, monkeypatch):
        monkeypatch.setattr("isa_nrsfm._joint.consensus.share_of_first", lambda *_: 1)
        kinds = ("joint", "consensus")
        models = (consensus_fit(X[:16], 2, Quick, tol=1.0, refinement=k) for k in kinds)
        joint, found = (in_camera(model, X[:16])[:, :, 2] for model in models)
        assert np.std(found - joint) < 0.15 * np.std(joint)  # groups alone: 2

    @pytest.mark.parametrize("noise", slow_after(1, [0.0, 0.02]))
    def test_a_sufficient_joint_fit_is_kept(self, noise):
        """Groups change no fit whose noise is below their floor or the spectrum's."""
        table, joint, model = sufficient_fits(noise)
        shapes, expected = in_camera(model, table), in_camera(joint, table)
        assert_allclose(shapes, expected, atol=1e-5 * np.abs(joint.mean_shape_).max())
        if noise:
            models = joint, model
            assert_array_equal(
                *(each.reconstruct(table, return_std=True)[1] for each in models)
            )

    @pytest.mark.slow
    def test_points_beyond_those_of_the_groups_follow_them(self):
        """Of many points a hundred are in groups; others move with those near them."""
        table, truth = articulated(30, n_points=26)
        others = np.ones(104, dtype=bool)
        others[np.linspace(0, 103, 100).round().astype(int)] = False
        with warnings.catch_warnings(action="ignore"):  # of the joint fit, rightly
            joint = consensus_fit(table, 3, refinement="joint", tol=0.5)
        models = joint, consensus_fit(table, 3, tol=0.5)
        off = [depth_errors(model, table, truth[:, :, 2]) for model in models]
        before, after = np.mean(np.square(off)[:, :, others], axis=(1, 2))
        assert after < before


@pytest.mark.slow
def test_shapes_become_truer_also_where_the_noise_is_at_its_floor(load_data):
    data = load_data("akhter_drink")
    first = data["R"]
    axes = np.concatenate([first, np.cross(first[:, 0], first[:, 1])[:, None]], axis=1)
    truth, table = axes @ data["S3d"].mT, data["W2d"].reshape(len(first), -1)
    joint, merged = (
        consensus_fit(table, "auto", refinement=name) for name in ("joint", "consensus")
    )
    errors = [error_of(model, table, truth.mT) for model in (joint, merged)]
    assert errors[1] < 0.8 * errors[0]
    # As many coefficients are reported, however many the model has.
    assert len(merged.basis_) == len(joint.basis_) <= 12


test_refusals = refusals_of("consensus", globals())
