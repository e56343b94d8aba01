"""The consensus of groups: neighbours, fits, merge, and the refinement as a whole."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._frames.models import FrameMap, PosteriorFrames
from isa_nrsfm._joint import consensus as consensus_module
from isa_nrsfm._joint.consensus import (
    COVER,
    MOST_POINTS,
    Group,
    Scene,
    centred,
    group_fit,
    interpolation,
    merge,
    neighbour_distances,
    neighbourhoods,
    principal_shapes,
    weighted,
)
from isa_nrsfm._joint.problem import JointSettings
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import mean_shape_error_3d

SETTINGS = JointSettings("orthographic", "linear", 300, 0.025)


def random_groups(rng, z, sizes=(4, 4, 5, 6), weights=(1, 2, 1, 3)):
    """Return groups of depths (I, n), each shifted in each frame."""
    n_frames, n_points = z.shape
    groups = []
    for size, weight in zip(sizes, weights, strict=True):
        points = np.sort(rng.choice(n_points, size, replace=False))
        coordinates = rng.standard_normal((n_frames, 3, size))
        coordinates[:, 2] = z[:, points] + rng.standard_normal((n_frames, 1))
        groups.append(Group(points, np.arange(n_frames), coordinates, 1.0, weight))
    return groups


def scene_of(first, rows=None):
    """Return a scene whose other entries do not matter to a merge."""
    rows = first[:, :2].copy() if rows is None else rows
    return Scene(rows, first, np.zeros((len(first), 2, 3)), 1.0, 1e-6)


class TestNeighbours:
    """Which points are in a group."""

    def test_distances_are_deviations_and_means(self):
        """They are the standard deviation of the distances and 0.15 of their mean."""
        shapes = np.random.default_rng(0).standard_normal((30, 3, 5))
        between = np.linalg.norm(shapes[..., None] - shapes[:, :, None], axis=1)
        expected = between.std(axis=0) + 0.15 * between.mean(axis=0)
        assert_allclose(neighbour_distances(shapes), expected, atol=1e-12)

    def test_rigidly_connected_points_come_first(self):
        """A far point of the same rigid part is nearer than a near one of another."""
        rng = np.random.default_rng(1)
        shapes = np.zeros((50, 3, 3))
        shapes[:, 0] = [0.0, 1.0, 0.8]
        shapes[:, :, 2] += 0.5 * rng.standard_normal((50, 3))
        distances = neighbour_distances(shapes)
        assert distances[0, 1] < distances[0, 2]

    @pytest.mark.parametrize("size", [2, 5, 12])
    def test_each_point_is_in_a_group(self, size):
        """Groups have the given size, cover all points, and are counted."""
        points = np.random.default_rng(2).standard_normal((40, 2))
        distances = np.linalg.norm(points[:, None] - points, axis=2)
        groups = neighbourhoods(distances, size)
        assert all(len(points) == size for points, _ in groups)
        assert set(np.concatenate([points for points, _ in groups])) == set(range(40))
        assert sum(count for _, count in groups) >= min(COVER * 40 // size, 40)
        assert len({tuple(points) for points, _ in groups}) == len(groups)

    def test_one_group_of_few_points(self):
        """Fewer points than the size are one group, as often as there are points."""
        distances = np.ones((6, 6)) - np.eye(6)
        ((points, count),) = neighbourhoods(distances, 12)
        assert_array_equal(points, np.arange(6))
        assert count == 2  # COVER * 6 / 12


class TestMerge:
    """Depths of all points from those of groups."""

    def test_consistent_groups_give_their_depths(self):
        """Groups that differ by a shift of each frame have one merge."""
        rng = np.random.default_rng(3)
        first = rng.standard_normal((7, 3, 8))
        z = centred(rng.standard_normal((7, 8)))
        groups = random_groups(rng, z, sizes=(8, 5, 6, 4))
        found = merge(scene_of(first), groups)[:, 2]
        assert_allclose(centred(found), z, atol=1e-2)

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
        whole = Group(np.arange(7), np.arange(3), first, 1.0, small)
        rows, values = [], []
        for group in [*groups, whole]:
            n = len(group.points)
            P = np.sqrt(group.weight) * (np.eye(n) - 1 / n)
            rows.append(P @ np.eye(7)[group.points])
            values.append(group.coordinates[:, 2] @ P)
        expected = np.linalg.lstsq(np.vstack(rows), np.hstack(values).T)[0].T
        assert_allclose(centred(found), centred(expected), atol=1e-9)

    def test_frames_without_a_group_keep_the_joint_fit(self):
        """A frame in which no group is visible has the depths of the joint fit."""
        rng = np.random.default_rng(5)
        first = rng.standard_normal((4, 3, 8))
        group = random_groups(rng, rng.standard_normal((4, 8)))[0]
        some = group._replace(
            frames=np.array([0, 2]), coordinates=group.coordinates[[0, 2]]
        )
        found = merge(scene_of(first), [some])
        assert_allclose(found[[1, 3], 2], centred(first[[1, 3], 2]), atol=1e-9)

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

    def test_weights_are_inverse_disagreements_of_sizes(self):
        """Groups of a size share one factor, its inverse mean square disagreement."""
        rng = np.random.default_rng(7)
        first = rng.standard_normal((5, 3, 8))
        groups = random_groups(rng, rng.standard_normal((5, 8)), sizes=(5, 5, 5, 6))
        for group in groups:
            group.coordinates[:, 2] += rng.standard_normal((5, len(group.points)))
        scene = scene_of(first)
        found = weighted(scene, groups)
        same = groups[:3]
        z = merge(scene, same)[:, 2]
        off = [
            np.mean((centred(g.coordinates[:, 2]) - centred(z[:, g.points])) ** 2)
            for g in same
        ]
        square = np.average(off, weights=[g.weight for g in same])
        for before, after in zip(same, found[:3], strict=True):
            assert_allclose(after.weight, before.weight / (5 * square), rtol=1e-9)


class TestPrincipalShapes:
    """From the shapes of frames to a model."""

    def test_all_components_give_the_shapes_again(self):
        """As many components as the shapes have reproduce them."""
        S = np.random.default_rng(8).standard_normal((6, 3, 5))
        shapes, alpha, left = principal_shapes(S, 5)
        assert_allclose(shapes[0] + np.tensordot(alpha, shapes[1:], 1), S, atol=1e-12)
        assert_allclose(alpha.T @ alpha / 6, np.eye(5), atol=1e-12)
        assert left < 1e-20

    def test_fewer_components_leave_a_mean_square(self):
        """The third result is the mean square of the rest."""
        S = np.random.default_rng(9).standard_normal((20, 3, 5))
        shapes, alpha, left = principal_shapes(S, 4)
        rest = S - shapes[0] - np.tensordot(alpha, shapes[1:], 1)
        assert_allclose(left, np.mean(rest**2))

    def test_components_below_the_noise_are_left_out(self):
        """The smallest number of components leaves no more than the noise."""
        S = np.random.default_rng(10).standard_normal((20, 3, 5))
        by_number = [principal_shapes(S, k)[2] for k in range(1, 12)]
        shapes, _, left = principal_shapes(S, 11, 1.01 * by_number[5])
        assert len(shapes) == 7
        assert_allclose(left, by_number[5])

    def test_surplus_components_are_zero(self):
        """More components than frames are filled with zeros."""
        S = np.random.default_rng(11).standard_normal((4, 3, 5))
        shapes, alpha, _ = principal_shapes(S, 9)
        assert shapes.shape == (10, 3, 5)
        assert not shapes[5:].any()
        assert not alpha[:, 4:].any()


def test_interpolation_of_changes():
    """Chosen points keep their changes; others have means of three of them."""
    rng = np.random.default_rng(12)
    chosen = np.array([0, 2, 5, 7])
    weights = interpolation(rng.standard_normal((3, 9)), chosen)
    assert_allclose(weights.sum(axis=0), 1.0)
    assert_array_equal(weights[:, chosen], np.eye(4))
    others = np.setdiff1d(np.arange(9), chosen)
    assert ((weights[:, others] > 0).sum(axis=0) == 3).all()


class TestGroupFit:
    """The fit of one group."""

    def scene(self, n_frames=60, hidden=0.0):
        """Return the scene of a deforming group, and its true coordinates."""
        tracks = make_nonrigid_tracks(
            n_frames, 12, 2, camera="orthographic", noise=0.0, random_state=0
        )
        rotations, scales = full_rotations(tracks.motion)
        truth = scales[:, None, None] * rotations @ tracks.shapes.transpose(0, 2, 1)
        truth = truth - truth.mean(axis=2, keepdims=True)
        size = np.sqrt(np.mean(truth[:, :2] ** 2))
        truth, motion = truth / size, tracks.motion / size
        rows = truth[:, :2].copy()
        rng = np.random.default_rng(1)
        rows[np.broadcast_to(rng.random((n_frames, 1, 12)) < hidden, rows.shape)] = (
            np.nan
        )
        first = truth + 0.05 * rng.standard_normal(truth.shape)
        price = 1.0 / 0.008**2
        return Scene(rows, first, motion, price, 1e-5), truth

    @pytest.mark.parametrize("hidden", [0.0, 0.2])
    def test_finds_depths(self, hidden):
        """Depths of a group are found, up to the mean of each frame."""
        scene, truth = self.scene(hidden=hidden)
        frames, found, noise = group_fit(scene, 2, SETTINGS)
        off = centred(found[:, 2]) - centred(truth[frames, 2])
        assert np.sqrt(np.mean(off**2)) < 0.02
        assert np.sqrt(np.mean((found[:, :2] - truth[frames, :2]) ** 2)) < 0.02
        assert noise >= 1e-5

    def test_mirror_image_is_that_of_the_joint_fit(self):
        """Depths have the sign of those of the joint fit."""
        scene, truth = self.scene()
        mirrored = scene.first * [[[1.0], [1.0], [-1.0]]]
        frames, found, _ = group_fit(scene._replace(first=mirrored), 2, SETTINGS)
        off = centred(found[:, 2]) + centred(truth[frames, 2])
        assert np.sqrt(np.mean(off**2)) < 0.02

    def test_frames_with_few_points_are_left_out(self):
        """A group is fitted to the frames that show at least four of its points."""
        scene, _ = self.scene()
        scene.rows[:5, :, 3:] = np.nan
        frames, found, _ = group_fit(scene, 2, SETTINGS)
        assert_array_equal(frames, np.arange(5, 60))
        assert found.shape == (55, 3, 12)

    def test_too_few_frames(self):
        """There is no fit if no more frames than basis shapes show the group."""
        scene, _ = self.scene()
        scene.rows[2:, :, 3:] = np.nan
        assert group_fit(scene, 2, SETTINGS) is None


class TestFittedGroups:
    """The groups of a table, without any fit."""

    def test_each_group_has_its_points(self, monkeypatch):
        """Groups have up to three quarters of the points, and those with a fit stay."""
        rng = np.random.default_rng(0)
        scene = scene_of(rng.standard_normal((8, 3, 42)))
        distances = neighbour_distances(scene.first)
        steps, tasks = [], []

        def fit(part, n_components, settings):
            tasks.append(part)
            assert n_components == 5
            assert settings.on_step is None
            n_points = part.rows.shape[2]
            return None if n_points == 30 else (np.arange(8), part.first, 1e-3)

        monkeypatch.setattr(consensus_module, "group_fit", fit)
        settings = SETTINGS._replace(on_step=lambda: steps.append(1))
        groups = consensus_module.fitted_groups(scene, distances, 5, settings, None)
        expected = [neighbourhoods(distances, size) for size in (12, 30)]
        assert len(tasks) == len(steps) == sum(map(len, expected))
        assert len(groups) == len(expected[0])
        for group, (points, count) in zip(groups, expected[0], strict=True):
            assert_array_equal(group.points, points)
            assert_array_equal(group.frames, np.arange(8))
            assert_array_equal(group.coordinates, scene.first[:, :, points])
            assert (group.noise, group.weight) == (1e-3, count)
        for part, (points, _) in zip(tasks, [*expected[0], *expected[1]], strict=True):
            assert_array_equal(part.rows, scene.rows[:, :, points])

    def test_few_points_are_one_group(self, monkeypatch):
        """Tables with fewer points than the smallest group have one of all points."""
        scene = scene_of(np.random.default_rng(0).standard_normal((8, 3, 9)))
        monkeypatch.setattr(
            consensus_module,
            "group_fit",
            lambda part, *others: (np.arange(8), part.first, 1e-3),
        )
        distances = neighbour_distances(scene.first)
        (group,) = consensus_module.fitted_groups(scene, distances, 2, SETTINGS, None)
        assert_array_equal(group.points, np.arange(9))


class TestConsensus:
    """Scene of the groups, and the model from their merge, without any fit."""

    def found(self, monkeypatch, noise=1e-4, shift=None, n_points=20):
        """Return the model, its frames, what groups are fitted to, and the result."""
        rng = np.random.default_rng(0)
        shapes = centred(rng.standard_normal((3, 3, n_points)))
        shapes[1:] *= 0.3
        motion = Rotation.random(30, rng).as_matrix()[:, :2]
        frames = shapes[0] + np.tensordot(rng.standard_normal((30, 2)), shapes[1:], 1)
        rows = centred(motion @ frames + 0.01 * rng.standard_normal((30, 2, n_points)))
        model = PosteriorFrames(
            shapes, noise, np.zeros((0, 2)), "linear", FrameMap.identity(2)
        )
        model = replace(model, camera="orthographic")
        passed = []

        def fitted_groups(scene, *others):
            passed.extend([scene, *others])
            if shift is None:
                return []
            points = np.arange(scene.first.shape[2])
            return [Group(points, np.arange(30), scene.first, 2e-4, 1.0)]

        monkeypatch.setattr(consensus_module, "fitted_groups", fitted_groups)
        monkeypatch.setattr(
            consensus_module,
            "common_coordinates",
            lambda images, first, groups, noise, floor: first + shift,
        )
        monkeypatch.setattr(
            consensus_module,
            "aligning_rotations",
            lambda S, noise: np.tile(np.eye(3), (len(S), 1, 1)),
        )
        blocks = FrameBlocks.of_array(rows, 30)
        result = consensus_module.consensus(model, blocks, SETTINGS, 29, 40)
        return model, rows, passed, result

    def test_scene_of_the_groups(self, monkeypatch):
        """Groups start from the joint fit; prior and floor are shares of its size."""
        model, rows, (scene, distances, n_components, *_), result = self.found(
            monkeypatch
        )
        fit = model.posterior(rows)
        shapes = model.shapes[0] + np.tensordot(fit.alpha, model.shapes[1:], 1)
        assert_array_equal(scene.rows, rows)
        assert_allclose(scene.motion, fit.motion)
        images = fit.motion @ shapes + fit.translation[:, :, None]
        assert_allclose(scene.first[:, :2], images, atol=1e-12)
        depths = np.cross(fit.motion[:, 0], fit.motion[:, 1])[:, None] @ shapes
        assert_allclose(scene.first[:, 2:], depths, atol=1e-12)
        assert scene.price == pytest.approx(1 / (0.008**2 * np.mean(rows**2)))
        assert scene.floor == pytest.approx(0.2 * 5e-5 * np.mean(rows**2))
        assert_allclose(distances, neighbour_distances(shapes), atol=1e-12)
        assert n_components == 2
        assert result.variances is None
        assert result.noise == pytest.approx(model.noise_variance)

    def test_noise_below_the_floor_needs_no_groups(self, monkeypatch):
        """The result is the joint fit."""
        *_, passed, result = self.found(monkeypatch, noise=1e-7)
        assert not passed
        assert result.variances is None

    def test_other_points_follow_those_near_them(self, monkeypatch):
        """Changes of depths are interpolated, by distances in the mean shape."""
        n_points = MOST_POINTS + 20
        d = centred(np.random.default_rng(1).standard_normal((30, MOST_POINTS)))
        shift = np.zeros((30, 3, MOST_POINTS))
        shift[:, 2] = 0.1 * d
        model, _, (scene, *_), result = self.found(
            monkeypatch, shift=shift, n_points=n_points
        )
        chosen = np.linspace(0, n_points - 1, MOST_POINTS).round().astype(int)
        assert scene.rows.shape == (30, 2, MOST_POINTS)
        expected = centred(0.1 * d @ interpolation(model.shapes[0], chosen))
        assert_allclose(result.variances, np.mean(expected**2, axis=0), rtol=1e-9)

    def test_variances_are_mean_square_changes_by_the_common_step(self, monkeypatch):
        """The noise is that of the groups, with the last floor."""
        d = centred(np.random.default_rng(1).standard_normal((30, 20)))
        shift = np.zeros((30, 3, 20))
        shift[:, 2] = 0.1 * d
        *_, (scene, *_), result = self.found(monkeypatch, shift=shift)
        assert_allclose(result.variances, 0.01 * np.mean(d**2, axis=0), rtol=1e-9)
        shapes = result.shapes[0] + np.tensordot(result.alpha, result.shapes[1:], 1)
        M = np.concatenate(
            [scene.motion, np.cross(*scene.motion.swapaxes(0, 1))[:, None]], axis=1
        )
        off = centred(scene.rows - scene.first[:, :2])
        share = scene.floor / 2e-4
        expected = centred(scene.first + shift)
        expected[:, :2] += share * off
        assert_allclose(centred(M @ shapes), expected, atol=2e-3)
        assert result.noise == pytest.approx(2e-4 - 0.8 * scene.floor)


def articulated(n_frames=80, noise=1e-4, seed=0):
    """Return a table (I, 2J) and the shapes (I, J, 3) of four rods with three joints.

    Each rod turns by itself, and all together turn further, in the axes of the cameras.
    """
    rng = np.random.default_rng(seed)
    rods = rng.uniform(-0.5, 0.5, (4, 6, 3)) * [1.0, 0.4, 0.4]
    joint, parts = np.zeros((n_frames, 3)), []
    for rod in rods:
        turns = Rotation.from_rotvec(0.3 * rng.standard_normal((n_frames, 3)))
        along = turns.apply([0.5, 0.0, 0.0])
        turned = turns.as_matrix() @ rod.T
        parts.append(turned.transpose(0, 2, 1) + (joint + along)[:, None])
        joint = joint + 2 * along
    shapes = np.concatenate(parts, axis=1)
    views = Rotation.from_rotvec(0.6 * rng.standard_normal((n_frames, 3)))
    shapes = shapes @ views.as_matrix().transpose(0, 2, 1)
    shapes -= shapes.mean(axis=1, keepdims=True)
    tracks = shapes[:, :, :2] + noise * rng.standard_normal((n_frames, 24, 2))
    return tracks.reshape(n_frames, -1), shapes


X, SHAPES = articulated()


def consensus_fit(table=X, n_components=14, **parameters):
    """Return the consensus of a table."""
    settings = {
        "camera": "orthographic",
        "refinement": "consensus",
        "random_state": 0,
        **parameters,
    }
    return AffineNRSfM(n_components, **settings).fit(table)


def in_camera(model, table):
    """Return shapes in the axes of the cameras, in the units of the images."""
    fit = model.decompose(table)
    rotations, scales = full_rotations(fit.motion)
    turned = model.reconstruct(table) @ rotations.transpose(0, 2, 1)
    return scales[:, None, None] * turned


@pytest.fixture(scope="module")
def body():
    """Return the consensus of a body."""
    return consensus_fit()


class TestEstimator:
    """`AffineNRSfM` with refinement="consensus"."""

    def test_frames_of_the_fit_are_those_of_transform(self, body):
        """`alpha_` and `motion_` are the results of `decompose`."""
        found = body.decompose(X)
        assert_allclose(found.alpha, body.alpha_, atol=1e-9)
        assert_allclose(found.motion, body.motion_, atol=1e-9 * np.abs(X).max())
        shapes = body.mean_shape_ + np.tensordot(body.alpha_, body.basis_, 1)
        assert_allclose(body.reconstruct(X), shapes, atol=1e-9)

    def test_number_of_components_as_given(self, body):
        """A number of basis shapes is that of the result, beyond the joint fit's."""
        assert body.basis_.shape == (14, 24, 3)
        assert body.alpha_.shape == (80, 14)
        assert len(body.get_feature_names_out()) == 14

    @pytest.mark.slow
    def test_automatic_number_of_components(self):
        """Automatic numbers of components exceed the twelve of the joint fit."""
        model = consensus_fit(n_components="auto")
        assert 12 < len(model.basis_) <= 60

    def test_deviations_have_the_size_of_errors(self, body):
        """Errors of depths are half to twice their standard deviations."""
        z, d = (centred(each[:, :, 2]) for each in (SHAPES, in_camera(body, X)))
        _, std = body.reconstruct(X, return_std=True)
        off = np.sign(np.sum(z * d)) * d - z
        assert 0.5 < np.sqrt(np.mean((off / std) ** 2)) < 2.0

    def test_deviations_are_larger_in_frames_with_larger_errors(self, body):
        """Errors and deviations of frames, also of new ones, have similar ranks."""
        for table, truth in ((X, SHAPES), articulated(160)):
            z, d = (centred(each[:, :, 2]) for each in (truth, in_camera(body, table)))
            off = np.sign(np.sum(z * d)) * d - z
            _, std = body.reconstruct(table, return_std=True)
            ranks = spearmanr(np.mean(off**2, axis=1), np.mean(std**2, axis=1))
            assert ranks[0] > 0.4

    @pytest.mark.slow
    def test_number_of_processes_does_not_matter(self, body):
        """Two processes have the same result to the bit."""
        other = consensus_fit(n_jobs=2)
        assert_array_equal(other.basis_, body.basis_)
        assert_array_equal(other.alpha_, body.alpha_)

    @pytest.mark.slow
    def test_order_of_frames_does_not_matter(self, body):
        """Permuted rows have permuted shapes."""
        order = np.random.default_rng(0).permutation(len(X))
        other = consensus_fit(X[order])
        before, after = (in_camera(model, X) for model in (body, other))
        error = mean_shape_error_3d(before, after, convention="camera")
        assert error < 0.01

    @pytest.mark.slow
    def test_missing_points(self, body):
        """Hidden points are found, nearly as well as from the complete table."""
        table = X.reshape(len(X), -1, 2).copy()
        hidden = np.random.default_rng(1).random(table.shape[:2]) < 0.2
        table[hidden] = np.nan
        table = table.reshape(X.shape)
        model = consensus_fit(table)
        convention = {"convention": "camera"}
        error = mean_shape_error_3d(SHAPES, in_camera(model, table), **convention)
        assert error < 2 * mean_shape_error_3d(SHAPES, in_camera(body, X), **convention)

    @pytest.mark.slow
    @pytest.mark.parametrize("loss", ["huber", "cauchy"])
    def test_robust_losses(self, loss, body):
        """A few outliers hardly change the shapes."""
        table = X.copy()
        rows = np.random.default_rng(2).choice(len(X), 10, replace=False)
        table[rows, 6] += 0.3
        model = consensus_fit(table, loss=loss)
        good = np.setdiff1d(np.arange(len(X)), rows)
        error = mean_shape_error_3d(
            SHAPES[good], in_camera(model, table)[good], convention="camera"
        )
        assert error < 1.3 * mean_shape_error_3d(
            SHAPES[good], in_camera(body, X)[good], convention="camera"
        )

    def test_exact_tables_keep_the_joint_fit(self):
        """Groups do not change a fit whose noise is below their floor."""
        tracks = make_nonrigid_tracks(
            80, 20, 2, camera="orthographic", noise=0.0, random_state=0
        )
        settings = {"camera": "orthographic", "random_state": 0}
        joint = AffineNRSfM(2, **settings).fit(tracks.data)
        model = AffineNRSfM(2, refinement="consensus", **settings).fit(tracks.data)
        assert_allclose(
            in_camera(model, tracks.data),
            in_camera(joint, tracks.data),
            atol=1e-5 * np.abs(joint.mean_shape_).max(),
        )

    def test_right_models_are_those_of_the_joint_fit(self):
        """Groups do not change a fit whose residual is below the spectrum's noise."""
        tracks = make_nonrigid_tracks(
            80, 20, 2, camera="orthographic", noise=0.02, random_state=0
        )
        joint, model = (
            consensus_fit(tracks.data, 2, refinement=name)
            for name in ("joint", "consensus")
        )
        assert_array_equal(model.basis_, joint.basis_)
        assert_array_equal(
            *(
                each.reconstruct(tracks.data, return_std=True)[1]
                for each in (joint, model)
            )
        )

    def test_affine_cameras_are_refused(self):
        """Depths of groups with affine cameras have no common unit."""
        message = "needs calibrated cameras.*camera='weak_perspective'"
        with pytest.raises(ValueError, match=message):
            consensus_fit(camera="affine")

    def test_saved_models(self, body, tmp_path):
        """A model that is read again gives the same results."""
        save_model(body, tmp_path / "model.npz")
        other = load_model(tmp_path / "model.npz")
        assert_array_equal(other.transform(X), body.transform(X))
        for each in zip(
            other.reconstruct(X, return_std=True),
            body.reconstruct(X, return_std=True),
            strict=True,
        ):
            assert_array_equal(*each)

    @pytest.mark.slow
    def test_progress(self, capsys):
        """The groups are a stage of the fit."""
        consensus_fit(verbose=1)
        printed = capsys.readouterr().out
        assert "consensus of groups of points: " in printed

    @pytest.mark.slow
    def test_search_compares_joint_fits(self):
        """Only the chosen number of components is fitted with the consensus."""
        estimator = AffineNRSfM(
            camera="orthographic", refinement="consensus", random_state=0
        )
        search = AffineNRSfMCV((2, 3), estimator=estimator, cv=2).fit(X)
        plain = estimator.set_params(refinement="joint")
        joint = AffineNRSfMCV((2, 3), estimator=plain, cv=2).fit(X)
        scores = "mean_test_score"
        assert_array_equal(search.cv_results_[scores], joint.cv_results_[scores])
        assert search.best_estimator_.refinement == "consensus"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_articulated_shapes_become_truer(seed):
    """The consensus has a smaller error than the joint fit."""
    table, truth = articulated(seed=seed)
    joint, merged = (
        mean_shape_error_3d(
            truth,
            in_camera(consensus_fit(table, 20, refinement=name), table),
            convention="camera",
        )
        for name in ("joint", "consensus")
    )
    assert merged < joint
