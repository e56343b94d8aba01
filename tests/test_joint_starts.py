"""Starts of the joint fit, the choice between them, and the number of shapes."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from frame_parts import assert_calibrated
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_scene, with_gaps
from scipy.spatial.transform import Rotation

from benchmarks.depth import bird, depth_error, seen, sheet
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.models import LARGEST_SHARE, FrameMap, FrameModel, spread_starts
from isa_nrsfm._joint.fit import GROUPS, _first_fit, other_fits, steadiest
from isa_nrsfm._joint.likelihood import JointFrames, MarginalLikelihood
from isa_nrsfm._joint.problem import FactorisedTable, JointProblem, JointState, Widths
from isa_nrsfm._joint.settings import LIMITS, FitSettings
from isa_nrsfm._joint.starts import (
    affine_start,
    best_starts,
    both_sides,
    extended_shapes,
    flat_cameras,
    lifted_shapes,
    likely_basis,
    mixed_cameras,
    reversed_groups,
    steadied,
    unfolded,
)
from isa_nrsfm._joint.uncertainty import reversal_error
from isa_nrsfm._joint.whole import (
    FAR_FRAMES,
    determined,
    evidence,
    extended,
    n_directions,
    rival_depths,
    whole_distribution,
)
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.isa._pipeline import factorise

MIRROR = np.array([1.0, 1.0, -1.0])


def problem_of(scene, thorough=True, **settings):
    """Return the rows of a complete scene, and the problem of its fit."""
    rows = scene.centred.mT
    frames = JointFrames.of_rows(rows)
    return rows, JointProblem(frames, FitSettings(**settings), thorough)


def factorised(scene):
    """Return the table of a complete scene, and the shapes of the paper's start."""
    W = scene.centred.mT.reshape(-1, scene.tracks.shape[1])
    factors = factorise(W, len(scene.shapes) - 1)
    shapes = np.concatenate([factors.rigid_shape, factors.signals])
    table = FactorisedTable(*[None] * 5, W, [], factors)
    return table, shapes.reshape(scene.shapes.shape)


def camera_error(motion, truth):
    """Return the largest error of cameras up to a rotation or reflection of space."""
    U, _, Vt = np.linalg.svd(motion.reshape(-1, 3).T @ truth.reshape(-1, 3))
    return np.abs(motion @ (U @ Vt) - truth).max()


@pytest.mark.parametrize(
    ("camera", "noise", "n_mixtures"),
    [("weak_perspective", 0.0, 2), ("orthographic", 0.05, 6)],
)
def test_mixed_cameras_are_calibrated_and_exact_without_noise(
    camera, noise, n_mixtures
):
    scene = random_scene(0, 60, 40, 2, noise=noise, camera=camera)
    scales = np.linalg.norm(scene.motion, axis=(1, 2)) / np.sqrt(2)
    scales = scales if camera == "weak_perspective" else None
    found = [*mixed_cameras(scene.centred.mT, scales, np.arange(60), LIMITS.widths)]
    # Of up to 6, 9, 12, 18, 24 and 36 columns, if there are as many
    assert len(found) == n_mixtures
    for motion in found:
        assert_calibrated(motion, camera)
    if not noise:
        # The cost is of fourth order in some directions.
        assert min(camera_error(each, scene.motion) for each in found) < 1e-4


@pytest.mark.parametrize("n_frames", [4, 200])
def test_lifted_shapes_are_principal_directions(n_frames):
    # With fewer frames than shapes, and with more than coordinates
    scene = random_scene(0, n_frames, 40, 2, camera="weak_perspective")
    rows = scene.centred.mT
    shapes = lifted_shapes(rows, scene.motion, 6)
    pairs = zip(rows, scene.motion, strict=True)
    lifted = [(np.linalg.pinv(M) @ (W - M @ shapes[0])).ravel() for W, M in pairs]
    _, S, Vt = np.linalg.svd(np.array(lifted), full_matrices=False)
    flat = shapes[1:4].reshape(3, -1)
    assert_allclose(np.linalg.norm(flat, axis=1), S[:3] / np.sqrt(n_frames))
    cosines = flat @ Vt[:3].T / np.linalg.norm(flat, axis=1)[:, None]
    assert_allclose(np.abs(cosines), np.eye(3), atol=1e-6)
    assert_array_equal(shapes[n_frames + 1 :], 0.0)


def test_shapes_that_fit_are_extended_by_nothing():
    scene = random_scene(0, 40, 30, 2)
    parts = scene.centred.mT, scene.shapes, scene.motion, scene.alpha
    expected = np.pad(scene.shapes, ((0, 2), (0, 0), (0, 0)))
    assert_allclose(extended_shapes(*parts, 2), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("n_frames", "thorough", "n_starts"), [(60, True, 3), (450, False, 1)]
)
def test_best_starts_have_nearly_the_true_cameras(n_frames, thorough, n_starts):
    """Of large tables some frames are compared. The likeliest of the fits counts."""
    camera = {"camera": "orthographic"}
    scene = random_scene(0, n_frames, 40, 2, noise=0.02, deformation=0.6, **camera)
    _, problem = problem_of(scene, thorough, tol=0.01, **camera)
    table, paper = factorised(scene)
    states = best_starts(problem, table, paper)
    assert len(states) == n_starts
    for state in states:
        assert state.motion.shape == scene.motion.shape
        assert_calibrated(state.motion, "orthographic")
    assert camera_error(states[0].motion, scene.motion) < 0.1
    if thorough:
        fit, _ = _first_fit(problem, table, paper)
        ends = [problem.unreversed(state).history[-1] for state in states]
        assert fit.history[-1] == min(ends) < max(ends)


def test_affine_starts_are_least_squares_fits_with_coefficients_of_size_one():
    scene = random_scene(0, 60, 40, 2, camera="orthographic", noise=0.05)
    rows, problem = problem_of(scene)
    table, paper = factorised(scene)
    shapes, motion, noise = affine_start(problem, table.W, paper)
    residual = rows - motion @ shapes[0]
    assert_allclose(residual @ shapes[0].T, 0.0, atol=1e-9)
    assert noise == pytest.approx(0.1 * np.mean(residual**2))
    shown = np.einsum("irc,kcj->ikrj", motion, shapes[1:])
    along = np.einsum("ikrj,irj->ik", shown, rows)
    alpha = along / np.sum(shown**2, axis=(2, 3))
    assert_allclose(alpha.std(axis=0), 1.0)


def test_frames_at_a_wrong_minimum_start_from_other_coefficients():
    """Otherwise shapes that are fitted to larger samples would follow them."""
    camera = "weak_perspective"
    scene = random_scene(0, 120, 12, 2, deformation=1.0, noise=0.02, camera=camera)
    rows, problem = problem_of(scene, camera=camera)
    state, n_wrong = JointState(scene.shapes, scene.motion, 0.02**2), []
    for starts in (np.empty((0, 2)), spread_starts(scene.alpha)):
        found = problem.aligned(state, starts)
        assert_calibrated(found.motion, camera)
        kind = starts, "linear", FrameMap.identity(2), camera
        model = FrameModel(state.shapes, state.noise, *kind)
        assert_allclose(model.posterior(rows).motion, found.motion, atol=1e-9)
        error = np.abs(found.motion - scene.motion).max(axis=(1, 2))
        n_wrong.append(np.count_nonzero(error > 0.1))
    assert n_wrong[0] > n_wrong[1] == 0
    assert problem.likelihood(*found).value < problem.likelihood(*state).value


@pytest.mark.parametrize("penalty", [0.0, 300.0])
def test_no_other_basis_is_likelier(penalty):
    scene = random_scene(0, 40, 30, 2)
    truth, motion, true_alpha = scene.shapes, scene.motion, scene.alpha
    shapes = likely_basis(truth, motion, true_alpha, penalty)
    frames = truth[0] + np.tensordot(true_alpha, truth[1:], 1)

    def objective(shift, mixing):
        # alpha of these shapes from the true ones: S = B_0 + alpha B.
        basis = np.tensordot(mixing, shapes[1:], 1).reshape(2, -1)
        mean = shapes[0] + np.tensordot(shift, shapes[1:], 1)
        alpha = (frames - mean).reshape(40, -1) @ np.linalg.pinv(basis)
        seen = np.einsum("ira,kaj->ikrj", motion, basis.reshape(2, 3, -1))
        gram = np.einsum("ikrj,ilrj->ikl", seen, seen)
        value = np.linalg.slogdet(gram)[1].sum() + np.sum(alpha**2)
        return value + penalty * np.trace(gram, axis1=1, axis2=2).sum()

    least = objective(np.zeros(2), np.eye(2))
    rng = np.random.default_rng(6)
    for _ in range(10):
        step = 0.01 * rng.normal(size=2), np.eye(2) + 0.01 * rng.normal(size=(2, 2))
        assert objective(*step) > least


@pytest.mark.parametrize(("deformation", "n_found"), [(0.3, 2), (1.0, 0)])
def test_fits_from_other_starts_count_by_their_evidence(deformation, n_found):
    """Each has ``exp(-(e - e_0) / 2)``, the evidence e_0 that of the joint fit."""
    options = {"noise": 0.3, "camera": "orthographic", "deformation": deformation}
    scene = random_scene(2, 40, 16, 3, **options)
    limits = LIMITS._replace(few_frames=0, widths=())  # one start each
    _, problem = problem_of(scene, camera="orthographic", tol=0.01, limits=limits)
    table, paper = factorised(scene)
    table = table._replace(compressed=problem.frames)
    state = JointState(scene.shapes, scene.motion, 0.1)
    joint = problem.refined(state, max_iter=20)
    found = other_fits(table, paper, problem.settings, joint)
    assert len(found) == n_found
    n = n_directions(problem, 16, few=True)
    least = evidence(problem, extended(problem, joint.state, n))
    for weight, state in found:
        above = evidence(problem, joint._replace(state=state)) - least
        assert weight == pytest.approx(np.exp(-above / 2), rel=1e-6)


def test_the_steadiest_fit_is_more_evident_than_its_start():
    """Six frames of an object that is nearly flat are reversed at first."""
    options = {"camera": "orthographic", "noise": 0.05, "extent": (1.0, 1.0, 0.05)}
    scene = random_scene(0, 24, 9, 1, deformation=0.4, **options)
    rows, problem = problem_of(scene, camera="orthographic", tol=0.1)
    table, _ = factorised(scene)
    motion = np.where(np.arange(24)[:, None, None] < 6, MIRROR, 1.0) * scene.motion
    start = JointState(lifted_shapes(rows, motion, 2), motion, 0.1)
    first = extended(problem, problem.refined(start, max_iter=20).state, 4)
    best = steadiest(problem, table, first)
    fit = whole_distribution(problem, first.state)
    assert evidence(problem, best) < evidence(problem, fit) - 0.5
    # Other depths count by their evidence, mirror images not at all.
    shapes, motion, noise = best.state
    state = JointState(shapes * MIRROR[:, None], motion * MIRROR, noise)
    for other, some in ((fit, True), (best._replace(state=state), False)):
        found = [rival_depths(problem, [(0.0, best), (e, other)]) for e in (0.0, 0.2)]
        assert_allclose(found[1], np.exp(-0.2 * FAR_FRAMES) * found[0], atol=1e-9)
        assert (found[0] > 1e-3) == some


NOISE, FEW_POINTS = 0.05, 12


def random_problem(kind="complete", n_frames=30, **options):
    """Return the problem of a random table, and a state with its shapes and cameras."""
    scene = random_scene(0, n_frames, FEW_POINTS, noise=NOISE, **options)
    tracks, shapes = scene.centred, scene.shapes
    if kind == "missing":
        tracks = with_gaps(tracks, 0.2)
    frames = JointFrames.of_rows(tracks.mT)
    if kind == "directions":
        directions = np.linalg.svd(shapes.reshape(-1, FEW_POINTS))[2][: FEW_POINTS - 1]
        rows = FrameBlocks.of_array(tracks.mT, 64)
        frames = JointFrames.from_directions(rows, directions)
        shapes = frames.coordinates(shapes)
    camera = options.get("camera", "affine")
    settings = FitSettings(camera=camera, max_iter=100, tol=1e-3)
    problem = JointProblem(frames, settings, penalty=0.02)
    return problem, JointState(shapes, scene.motion, NOISE**2)


def basis_products(state):
    """Return the products <B_k, B_l>."""
    basis = state.shapes[1:].reshape(3, -1)
    return basis @ basis.T


def shares_and_variances(problem, state, v):
    """Return g_k and the next v_k after a round from prior variances v_k."""
    curvature = MarginalLikelihood(problem.frames)(*state).shape_curvature
    curvature = curvature + NOISE**2 * np.diag(np.repeat([0.0, *1 / v], 3))
    traces = np.zeros(3)
    for j in range(FEW_POINTS):
        covariance = NOISE**2 * np.linalg.inv(curvature[j % len(curvature)])
        for k in range(3):
            of_shape = slice(3 * k + 3, 3 * k + 6)
            traces[k] += np.trace(covariance[of_shape, of_shape])
    g = 1 - traces / (3 * FEW_POINTS * v)
    return g, np.diag(basis_products(state)) / (3 * FEW_POINTS * g)


class TestWholeDistribution:
    """All directions of a shape, and their variances."""

    @pytest.mark.parametrize("kind", ["complete", "missing", "directions"])
    def test_rounds_by_their_definition(self, kind):
        problem, state = random_problem(kind)
        reached, widths = determined(problem, state, None)
        # Another basis of the same shapes, which is orthogonal
        assert_allclose(reached.shapes[0], state.shapes[0])
        before = np.linalg.pinv(state.shapes[1:].reshape(3, -1))
        mixing = reached.shapes[1:].reshape(3, -1) @ before
        assert_allclose(mixing @ mixing.T, np.eye(3), atol=1e-10)
        energies = np.linalg.eigvalsh(basis_products(state))[::-1]
        assert_allclose(basis_products(reached), np.diag(energies), atol=1e-9)
        v = energies / (3 * FEW_POINTS)
        for _ in range(2):
            shares, v = shares_and_variances(problem, reached, v)
            assert_allclose(widths.shares, shares, rtol=1e-6)
            assert_allclose(widths.variances, v, rtol=1e-6)
            assert widths.n_determined == pytest.approx(36 * (1 + shares.sum()))
            reached, widths = determined(problem, reached, widths)

    def test_noise_has_the_coordinates_that_are_left(self):
        problem, state = random_problem()
        rigid = np.array([1.0, 0.0, 0.0, 0.0])[:, None, None]
        still = state._replace(shapes=rigid * state.shapes)
        assert determined(problem, still, None)[1].n_relevant == 1  # at least one
        widths = Widths(np.full(3, 0.1), np.array([1.0, 0.5, 0.0]), np.ones(3), 36)
        precisions = np.tile(10 * np.eye(3), (3, 1, 1))
        plain = MarginalLikelihood(problem.frames, precisions=precisions)(*state)
        found = replace(problem, widths=widths).likelihood(*state)
        n_unknowns = 30 * (2 + 6) + 36 * 2.5  # affine cameras
        change = n_unknowns * np.log(state.noise)
        assert found.value == pytest.approx(plain.value - change)
        slope = plain.noise_gradient - n_unknowns
        assert found.noise_gradient == pytest.approx(slope)
        assert_allclose(found.shape_gradient, plain.shape_gradient)

    def test_all_directions_have_no_noise_without_the_correction(self):
        """The likelihood alone explains each frame by enough directions."""
        problem, state = random_problem(n_frames=120)
        fit = problem.refined(state, max_iter=5)
        n = n_directions(problem, FEW_POINTS, few=False)
        assert n == 12  # half of 2,880 coordinates, less 8 a frame, over 36, less one
        wide = extended(problem, fit.state, n)
        found = whole_distribution(problem, wide.state)
        assert found.state.noise > 0.5 * NOISE**2

    def test_noise_of_the_fit_is_the_most_evident(self):
        """The unknowns count once in the evidence: its minimum is where the fit ends.

        It does not depend on the axes of the object.
        """
        problem, state = random_problem(n_frames=60, camera="weak_perspective")
        fit = whole_distribution(problem, problem.refined(state, max_iter=30).state)
        values = []
        for factor in 0.8, 1.0, 1.25:
            state = fit.state._replace(noise=factor * fit.state.noise)
            values.append(evidence(problem, fit._replace(state=state)))
        assert values[1] == min(values)
        assert_allclose(values[0], values[2], atol=0.5 * (values[0] - values[1]))
        shapes, motion, noise = fit.state
        turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
        turned = fit._replace(state=JointState(turn @ shapes, motion @ turn.T, noise))
        for widths in (fit.widths, None):
            pair = (evidence(problem, f._replace(widths=widths)) for f in (fit, turned))
            assert_allclose(*pair, rtol=1e-9)


def test_steadied_cameras_turn_about_one_axis_less():
    """Lines of sight stay in one plane; nothing changes along the axis."""
    views = Rotation.from_rotvec(np.linspace([-1.5, 0.1, 0], [1.5, -0.1, 0.3], 9))
    motion = views.as_matrix()[:, :2]
    still = steadied(motion)
    assert_calibrated(still, "orthographic")
    sight = np.cross(still[:, 0], still[:, 1])
    spread = np.linalg.svd(sight, compute_uv=False)
    assert spread[2] < 1e-12
    assert spread[1] < 0.3 < np.linalg.svd(np.cross(*motion.swapaxes(0, 1)))[1][1]


def test_frames_of_flat_objects_may_be_reversed():
    """Bent to both sides, each frame has z or -z, with the same probability."""
    options = {"camera": "orthographic", "turns": 0.3, "deformation": 0.2}
    scene = random_scene(4, 30, 12, 1, **options)
    scene.shapes[0, 2] = scene.shapes[1, :2] = 0.0
    for thickness, expected in ((0.0, 2.0), (0.5, 0.0)):
        scene.shapes[0, 2] += thickness * np.tile([-1.0, 1.0], 6)
        tracks = images(scene.shapes, scene.motion, scene.translation, scene.alpha)
        _, problem = problem_of(scene._replace(tracks=tracks), camera="orthographic")
        state = JointState(scene.shapes, scene.motion, 1e-4)
        assert_allclose(problem.reversal_errors(state), expected, atol=0.02)
        error = reversal_error(problem, state, problem.depths(state))
        assert_allclose(error, expected, atol=0.1)  # of fitted shapes


def test_shapes_that_follow_frames_do_not_decide_on_their_sides():
    """Shapes explain frames of which half are reversed, but not frames left out."""
    options = {"camera": "orthographic", "turns": 0.5, "extent": (1.0, 1.0, 0.1)}
    scene = random_scene(0, 60, 15, 3, noise=0.01, **options)
    _, problem = problem_of(scene, camera="weak_perspective")
    wrong = scene.motion.copy()
    wrong[::2] *= MIRROR
    for cameras, least, most in (scene.motion, 0.0, 0.1), (wrong, 1.0, 4.0):
        state = JointState(scene.shapes[:1], cameras, 1e-4)
        state = extended(problem, state, 8).state
        error = reversal_error(problem, state, problem.depths(state))
        assert least <= error < most


def test_unfolded_shapes_lie_on_both_sides_alike():
    scene = random_scene(0, 30, 40, 2, camera="orthographic")
    state = unfolded(JointState(scene.shapes, scene.motion, 0.01), 5)
    axes, extents, _ = np.linalg.svd(state.shapes[0])
    assert extents[2] < 1e-12 * extents[0]
    across = axes[:, 2:]
    mirror = np.eye(3) - 2 * across @ across.T
    left = np.abs(state.motion - scene.motion).max(axis=(1, 2)) == 0
    assert left.sum() == 15
    assert_allclose(state.motion[~left], scene.motion[~left] @ mirror)
    _, problem = problem_of(scene, camera="orthographic")
    values = [
        problem.likelihood(*state._replace(motion=M)).value
        for M in (state.motion, state.motion @ mirror)
    ]
    assert values[1] == pytest.approx(values[0], rel=1e-12)


def test_flat_cameras_do_not_follow_the_relief_of_the_mean_shape():
    scene = random_scene(0, 30, 40, 2, camera="orthographic")
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    plane, across = axes[:, :2] @ axes[:, :2].T, axes[:, 2]
    mean, *basis = scene.shapes
    tracks = (scene.motion @ plane @ mean).mT
    _, problem = problem_of(scene._replace(tracks=tracks), camera="orthographic")
    # Relief across the plane that is no slope of it
    relief = 0.1 * across @ mean
    relief -= relief @ np.linalg.pinv(plane @ mean) @ (plane @ mean)
    relief = np.outer(across, relief)
    state = JointState(np.stack([plane @ mean + relief, *basis]), scene.motion, 1e-4)
    motion = flat_cameras(problem, state)
    assert_calibrated(motion, "weak_perspective")
    assert_allclose(motion @ plane, scene.motion @ plane, atol=1e-6)
    assert both_sides(state)
    assert not both_sides(
        state._replace(shapes=np.stack([mean, *(0.01 * b for b in basis)]))
    )


@pytest.mark.parametrize("reversed_share", [0.0, 0.25])
def test_groups_of_frames_are_turned_back(reversed_share):
    """Shapes that fit frames reversed together explain them, but not the others."""
    camera = {"camera": "weak_perspective"}
    options = {"turns": 0.3, "extent": (1.0, 1.0, 0.3), "deformation": 0.2} | camera
    scene = random_scene(1, 80, 12, 2, noise=0.02, **options)
    rows, problem = problem_of(scene, thorough=False, **camera)
    mirrored, first = scene.motion * MIRROR, scene.alpha[:, 0]
    turned = first < np.quantile(first, reversed_share)
    start = np.where(turned[:, None, None], mirrored, scene.motion)
    state = JointState(lifted_shapes(rows, start, 6), start, 0.01)
    state = problem.refined(state, max_iter=50).state
    cameras, alpha = state.motion, problem.likelihood(*state).alpha
    for n_groups in GROUPS:
        cameras = reversed_groups(problem, rows, cameras, alpha, n_groups)
    assert_calibrated(cameras, "weak_perspective")
    pair = scene.motion, mirrored
    near = np.less(*(np.linalg.norm(cameras - x, axis=(1, 2)) for x in pair)).mean()
    assert max(near, 1.0 - near) >= 1.0 - 0.6 * reversed_share
    if not reversed_share:
        assert_array_equal(cameras, state.motion)


def beating_wings(seed):
    """Return the table of a bird from above that turns by 3 degrees, and its points.

    Its wings beat: it is no rolling bird.
    """
    return seen(bird(140, seed), 3, seed)[:2]


def waving_sheet(seed):
    """Return the table of a sheet that waves to both sides, and its points."""
    return seen(sheet(200, seed), 40, seed)[:2]


def balloon(seed):
    """Return the table of a balloon that hardly turns, and its points.

    Depths twice as large, with half of the turning, are nearly as likely.
    """
    rng = np.random.default_rng(seed)
    sphere = rng.normal(size=(25, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    shapes = sphere * (1 + 0.25 * rng.normal(size=(100, 1, 3)))
    return seen(shapes, 4, seed)[:2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "seed"), [(beating_wings, 1), (waving_sheet, 0), (balloon, 0)]
)
def test_depths_are_right_or_known_to_be_wrong(make, seed):
    X, points = make(seed)
    with warnings.catch_warnings(action="ignore"):
        model = AffineNRSfM(3, camera="weak_perspective", random_state=0).fit(X)
    _, error = depth_error(model, X, points)
    stated = model.depth_uncertainty_
    assert stated > LARGEST_SHARE or error < min(3 * stated, 0.3)
    if make is waving_sheet:
        assert stated > LARGEST_SHARE
    if make is balloon:
        assert 0.5 * error < stated < 2 * error
