"""Starts of the joint fit, the choice between them, and the number of shapes."""

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from frame_parts import assert_calibrated
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from refusals import warned
from scenes import random_scene as random_model, with_gaps
from scipy.spatial.transform import Rotation

from benchmarks.depth import bird, depth_error, seen, sheet
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS
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
from isa_nrsfm._linalg import centred
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.isa._pipeline import Factorisation, factorise

N_POINTS = 40
BOTH = pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])


class Scene(NamedTuple):
    rows: NDArray  # (n_frames, 2, n_points), centred
    motion: NDArray  # (n_frames, 2, 3)
    shapes: NDArray  # (n_components + 1, 3, n_points)

    @property
    def W(self):
        return self.rows.reshape(-1, self.rows.shape[2])

    @property
    def factors(self) -> Factorisation:
        return factorise(self.W, 2)

    @property
    def scales(self):
        return np.linalg.norm(self.motion, axis=(1, 2)) / np.sqrt(2)


def random_scene(camera="orthographic", seed=0, n_frames=60, n_components=2, **options):
    options |= {"camera": camera, "random_state": seed}
    truth = make_nonrigid_tracks(n_frames, N_POINTS, n_components, **options)
    tracks = truth.tracks - truth.tracks.mean(axis=1, keepdims=True)
    shapes = np.concatenate([truth.mean_shape[None], truth.basis])
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    return Scene(rows, truth.motion, shapes.transpose(0, 2, 1))


def camera_error(motion, truth):
    """Return the largest error of cameras up to a rotation or reflection of space."""
    U, _, Vt = np.linalg.svd(motion.reshape(-1, 3).T @ truth.reshape(-1, 3))
    return np.abs(motion @ (U @ Vt) - truth).max()


@BOTH
@pytest.mark.parametrize(("noise", "n_mixtures"), [(0.0, 2), (0.05, 6)])
def test_mixed_cameras_are_calibrated_and_exact_without_noise(
    camera, noise, n_mixtures
):
    scene = random_scene(camera, noise=noise)
    scales = scene.scales if camera == "weak_perspective" else None
    found = list(mixed_cameras(scene.rows, scales, np.arange(60), LIMITS.widths))
    # Of up to 6, 9, 12, 18, 24 and 36 columns, if there are as many
    assert len(found) == n_mixtures
    for motion in found:
        assert_calibrated(motion, camera)
    if not noise:
        # The cost is of fourth order in some directions.
        assert min(camera_error(each, scene.motion) for each in found) < 1e-4


@BOTH
@pytest.mark.parametrize("n_frames", [4, 60, 200])
def test_lifted_shapes_are_principal_directions(camera, n_frames):
    # With more frames than coordinates, with fewer, and with fewer than shapes
    scene = random_scene(camera, n_frames=n_frames)
    shapes = lifted_shapes(scene.rows, scene.motion, 6)
    pairs = zip(scene.rows, scene.motion, strict=True)
    lifted = [(np.linalg.pinv(M) @ (W - M @ shapes[0])).ravel() for W, M in pairs]
    _, S, Vt = np.linalg.svd(np.array(lifted), full_matrices=False)
    flat = shapes[1:4].reshape(3, -1)
    assert_allclose(np.linalg.norm(flat, axis=1), S[:3] / np.sqrt(n_frames))
    cosines = flat @ Vt[:3].T / np.linalg.norm(flat, axis=1)[:, None]
    assert_allclose(np.abs(cosines), np.eye(3), atol=1e-6)
    assert_array_equal(shapes[n_frames + 1 :], 0.0)


def test_shapes_that_fit_are_extended_by_nothing():
    scene = random_model(0, 40, 30, 2)
    parts = scene.centred.mT, scene.shapes, scene.motion, scene.alpha
    expected = np.pad(scene.shapes, ((0, 2), (0, 0), (0, 0)))
    assert_allclose(extended_shapes(*parts, 2), expected, atol=1e-9)


def problem_of(scene, thorough=True):
    rows = FrameBlocks.of_array(scene.rows, 64)
    frames = JointFrames.from_points(rows, True)
    settings = FitSettings(camera="orthographic", tol=0.01)
    return JointProblem(frames, settings, thorough)


def paper_shapes(factors):
    """Return the rigid shape and the first triples of signals."""
    triples = factors.signals.reshape(-1, 3, N_POINTS)[:2]
    return np.concatenate([factors.rigid_shape[None], triples])


def started(scene, camera, problem=None):
    """Return the starts."""
    factors = scene.factors
    problem = problem or problem_of(scene)
    paper = paper_shapes(factors)
    table = FactorisedTable(*[None] * 5, scene.W, [], factors)
    problem = replace(problem, seen_by=CAMERAS[camera])
    return best_starts(problem, table, paper)


@pytest.mark.parametrize(
    ("thorough", "n_starts", "largest", "options"),
    [
        (True, 3, 0.05, {"amplitude": 0.6}),  # rigid cameras are wrong by 0.3
        (True, 3, 0.2, {"n_frames": 450, "noise": 0.01}),  # some of them are compared
        (False, 1, 0.2, {"n_frames": 450, "noise": 0.01}),
    ],
)
def test_best_starts_have_nearly_the_true_cameras(thorough, n_starts, largest, options):
    scene = random_scene(**options)
    states = started(scene, "orthographic", problem_of(scene, thorough))
    assert len(states) == n_starts
    for state in states:
        assert state.motion.shape == scene.motion.shape
        assert_calibrated(state.motion, "orthographic")
    assert camera_error(states[0].motion, scene.motion) < largest


def test_affine_starts_are_least_squares_fits_with_coefficients_of_size_one():
    scene = random_scene(noise=0.05)
    shapes, motion, noise = affine_start(
        problem_of(scene), scene.W, paper_shapes(scene.factors)
    )
    residual = scene.rows - motion @ shapes[0]
    assert_allclose(residual @ shapes[0].T, 0.0, atol=1e-9)
    assert noise == pytest.approx(0.1 * np.mean(residual**2))
    images = np.einsum("irc,kcj->ikrj", motion, shapes[1:])
    along = np.einsum("ikrj,irj->ik", images, scene.rows)
    alpha = along / np.sum(images**2, axis=(2, 3))
    assert_allclose(alpha.std(axis=0), 1.0)


def table_of(scene, **settings):
    """Return the rows of a complete table, its problem, and it, without factors."""
    rows = scene.centred.mT
    frames = JointFrames.from_points(FrameBlocks.of_array(rows, 64), True)
    W = rows.reshape(-1, rows.shape[2])
    table = FactorisedTable(None, frames, *[None] * 3, W, [], None)
    return rows, JointProblem(frames, FitSettings(**settings)), table


def test_frames_at_a_wrong_minimum_start_from_other_coefficients():
    """Otherwise shapes that are fitted to larger samples would follow them."""
    camera = "weak_perspective"
    scene = random_model(0, 120, 12, 2, deformation=1.0, noise=0.02, camera=camera)
    rows, problem, _ = table_of(scene, camera=camera)
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


@pytest.mark.parametrize("penalty", [0.0, 0.5, 300.0])
def test_no_other_basis_is_likelier(penalty):
    scene = random_model(0, 40, 30, 2)
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


def test_the_likeliest_fit_of_the_starts_counts():
    scene = random_scene(amplitude=0.6, noise=0.02)
    problem, factors = problem_of(scene), scene.factors
    states = started(scene, "orthographic", problem)
    ends = [problem.unreversed(state).history[-1] for state in states]
    table = FactorisedTable(*[None] * 5, scene.W, [], factors)
    fit, _ = _first_fit(problem, table, paper_shapes(factors))
    assert max(ends) > min(ends)
    assert fit.history[-1] == min(ends)


@pytest.mark.parametrize(("deformation", "n_found"), [(0.3, 2), (1.0, 0)])
def test_fits_from_other_starts_count_by_their_evidence(deformation, n_found):
    """Each has ``exp(-(e - e_0) / 2)``, the evidence e_0 that of the joint fit."""
    options = {"noise": 0.3, "camera": "orthographic", "deformation": deformation}
    scene = random_model(2, 40, 16, 3, **options)
    limits = LIMITS._replace(few_frames=0, widths=())  # one start each
    _, problem, table = table_of(scene, camera="orthographic", tol=0.01, limits=limits)
    factors = factorise(table.W, 3)
    paper = np.concatenate([factors.rigid_shape, factors.signals]).reshape(4, 3, 16)
    state = JointState(scene.shapes, scene.motion, 0.1)
    joint = problem.refined(state, max_iter=20)
    table = table._replace(factors=factors)
    found = other_fits(table, paper, problem.settings, joint)
    assert len(found) == n_found
    n = n_directions(problem, 16, few=True)
    least = evidence(problem, extended(problem, joint.state, n))
    for weight, state in found:
        above = evidence(problem, joint._replace(state=state)) - least
        assert weight == pytest.approx(np.exp(-above / 2), rel=1e-6)


@pytest.mark.parametrize("depth", [0.05, 1.0])
def test_the_steadiest_fit_is_more_evident_than_its_start(depth):
    """Six frames are reversed at first, and an object may be nearly flat."""
    options = {"camera": "orthographic", "noise": 0.05, "extent": (1.0, 1.0, depth)}
    scene = random_model(0, 24, 9, 1, deformation=0.4, **options)
    rows, problem, table = table_of(scene, camera="orthographic", tol=0.1)
    mirror = np.array([1.0, 1.0, -1.0])
    motion = np.where(np.arange(24)[:, None, None] < 6, mirror, 1.0) * scene.motion
    start = JointState(lifted_shapes(rows, motion, 2), motion, 0.1)
    first = extended(problem, problem.refined(start, max_iter=20).state, 4)
    best = steadiest(problem, table, first)
    fit = whole_distribution(problem, first.state)
    assert evidence(problem, best) < evidence(problem, fit) - 0.5
    # Other depths count by their evidence, mirror images not at all.
    shapes, motion, noise = best.state
    state = JointState(shapes * mirror[:, None], motion * mirror, noise)
    for other, some in ((fit, True), (best._replace(state=state), False)):
        found = [rival_depths(problem, [(0.0, best), (e, other)]) for e in (0.0, 0.2)]
        assert_allclose(found[1], np.exp(-0.2 * FAR_FRAMES) * found[0], atol=1e-9)
        assert (found[0] > 1e-3) == some


NOISE, FEW_POINTS = 0.05, 12


def random_problem(kind="complete", n_frames=30, **options):
    """Return the problem of a random table, and a state with its shapes and cameras."""
    scene = random_model(0, n_frames, FEW_POINTS, noise=NOISE, **options)
    complete, tracks, shapes = kind != "missing", scene.centred, scene.shapes
    if not complete:
        tracks = with_gaps(tracks, 0.2)
    rows = FrameBlocks.of_array(tracks.transpose(0, 2, 1), 64)
    frames = JointFrames.from_points(rows, complete)
    if kind == "directions":
        directions = np.linalg.svd(shapes.reshape(-1, FEW_POINTS))[2][: FEW_POINTS - 1]
        frames = JointFrames.from_directions(rows, directions)
        shapes = frames.coordinates(shapes)
    settings = FitSettings(max_iter=100, tol=1e-3)
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


@BOTH
def test_frames_of_flat_objects_may_be_reversed(camera):
    """Bent to both sides, each frame has z or -z, with the same probability."""
    rng, n_frames = np.random.default_rng(0), 30
    shapes = rng.normal(size=(2, 3, 12)) * [[[1.0], [1.0], [0.0]], [[0], [0], [0.2]]]
    shapes -= shapes.mean(axis=2, keepdims=True)
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(n_frames, 3)))
    motion, alpha = turns.as_matrix()[:, :2], rng.normal(size=(n_frames, 1))
    settings = FitSettings(camera=camera)
    for thickness, expected in ((0.0, 2.0), (0.5, 0.0)):
        shapes[0, 2] += thickness * rng.permutation(np.repeat([-1.0, 1.0], 6))
        state = JointState(shapes, motion, 1e-4)
        rows = motion @ (shapes[0] + alpha[..., None] * shapes[1])
        blocks = FrameBlocks.of_array(rows, n_frames)
        problem = JointProblem(JointFrames.from_points(blocks, True), settings)
        depths = state.depths(problem.likelihood(*state).alpha)
        assert_allclose(problem.reversal_errors(state), expected, atol=0.02)
        error = reversal_error(problem, state, depths)
        assert_allclose(error, expected, atol=0.1)  # of fitted shapes


@pytest.mark.parametrize("seed", range(3))
def test_shapes_that_follow_frames_do_not_decide_on_their_sides(seed):
    """Shapes explain frames of which half are reversed, but not frames left out."""
    rng, n = np.random.default_rng(seed), 60
    shapes = centred(rng.normal(size=(4, 3, 15)) * [[1.0], [1.0], [0.1]])
    shapes[1:] *= [[0.3], [0.3], [0.0]]
    alpha, turns = rng.normal(size=(n, 3)), 0.5 * rng.normal(size=(n, 3))
    motion = Rotation.from_rotvec(turns).as_matrix()[:, :2]
    rows = motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1))
    rows += 0.01 * centred(rng.normal(size=rows.shape))
    settings = FitSettings(camera="weak_perspective")
    problem = JointProblem(JointFrames.of_rows(rows), settings)
    wrong = motion.copy()
    wrong[::2] *= [1.0, 1.0, -1.0]
    for cameras, least, most in (motion, 0.0, 0.1), (wrong, 1.0, 4.0):
        state = JointState(shapes[:1], cameras, 1e-4)
        state = extended(problem, state, 8).state
        error = reversal_error(problem, state, problem.depths(state))
        assert least <= error < most


def test_unfolded_shapes_lie_on_both_sides_alike():
    scene = random_scene(n_frames=30)
    state = unfolded(JointState(centred(scene.shapes), scene.motion, 0.01), 5)
    axes, extents, _ = np.linalg.svd(state.shapes[0])
    assert extents[2] < 1e-12 * extents[0]
    across = axes[:, 2:]
    mirror = np.eye(3) - 2 * across @ across.T
    left = np.abs(state.motion - scene.motion).max(axis=(1, 2)) == 0
    assert left.sum() == 15
    assert_allclose(state.motion[~left], scene.motion[~left] @ mirror)
    problem = problem_of(scene)
    values = [
        problem.likelihood(*state._replace(motion=M)).value
        for M in (state.motion, state.motion @ mirror)
    ]
    assert values[1] == pytest.approx(values[0], rel=1e-12)


def test_flat_cameras_do_not_follow_the_relief_of_the_mean_shape():
    scene = random_scene(n_frames=30)
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    plane, across = axes[:, :2] @ axes[:, :2].T, axes[:, 2]
    mean, *basis = centred(scene.shapes)
    rows = scene.motion @ plane @ mean
    problem = problem_of(scene._replace(rows=rows))
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_depths_of_sheets_that_wave_to_both_sides_are_withheld(seed):
    X, points, _ = seen(sheet(200, seed), 40, seed)
    model = AffineNRSfM(2, camera="weak_perspective", random_state=0)
    warned("depth of the shapes is not determined", model.fit, X)
    # Each frame is right, or its mirror image is.
    z = np.einsum("ijc,ic->ij", model.reconstruct(X), model.rotations_[:, 2])
    z, truth = centred(model.scales_[:, None] * z), centred(points[:, :, 2])
    off = np.sum([(z - truth) ** 2, (z + truth) ** 2], axis=2).min(axis=0)
    assert off.sum() < 0.05**2 * np.sum(truth**2)


@pytest.mark.parametrize("reversed_share", [0.0, 0.25, 0.5])
def test_groups_of_frames_are_turned_back(reversed_share):
    """Shapes that fit frames reversed together explain them, but not the others."""
    rng, n_frames = np.random.default_rng(1), 80
    sizes = np.array([[1.0, 1.0, 0.3], [0.2] * 3, [0.2] * 3])[..., None]
    shapes = centred(rng.normal(size=(3, 3, 12)) * sizes)
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(n_frames, 3)))
    motion, alpha = turns.as_matrix()[:, :2], rng.normal(size=(n_frames, 2))
    rows = motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1))
    rows = centred(rows + 0.02 * rng.normal(size=rows.shape))
    frames = JointFrames.from_points(FrameBlocks.of_array(rows, n_frames), True)
    problem = JointProblem(frames, FitSettings(camera="weak_perspective"))
    mirrored = motion * [1.0, 1.0, -1.0]
    turned = alpha[:, 0] < np.quantile(alpha[:, 0], reversed_share)
    start = np.where(turned[:, None, None], mirrored, motion)
    state = JointState(lifted_shapes(rows, start, 6), start, 0.01)
    state = problem.refined(state, max_iter=50).state
    cameras, alpha = state.motion, problem.likelihood(*state).alpha
    for n_groups in GROUPS:
        cameras = reversed_groups(problem, rows, cameras, alpha, n_groups)
    assert_calibrated(cameras, "weak_perspective")
    distances = (np.linalg.norm(cameras - x, axis=(1, 2)) for x in (motion, mirrored))
    near = np.less(*distances).mean()
    assert max(near, 1.0 - near) >= 1.0 - 0.6 * reversed_share
    if not reversed_share:
        assert_array_equal(cameras, state.motion)


def test_noise_of_the_fit_is_the_most_evident():
    """The unknowns count once in the evidence: its minimum is where the fit ends."""
    tracks = make_nonrigid_tracks(
        60, 20, 2, noise=0.02, camera="weak_perspective", random_state=0
    )
    rows = tracks.data.reshape(60, 20, 2).mT
    rows = rows - rows.mean(axis=2, keepdims=True)
    problem, state = random_problem(camera="weak_perspective")
    frames = JointFrames.from_points(FrameBlocks.of_array(rows, 60), True)
    settings = problem.settings._replace(camera="weak_perspective", tol=1e-6)
    problem = replace(problem, frames=frames, settings=settings)
    motion, noise = tracks.motion, 0.01 * problem.mean_square
    start = JointState(lifted_shapes(rows, motion, 4), motion, noise)
    fit = whole_distribution(problem, problem.refined(start, max_iter=30).state)
    values = []
    for factor in 0.8, 1.0, 1.25:
        state = fit.state._replace(noise=factor * fit.state.noise)
        values.append(evidence(problem, fit._replace(state=state)))
    assert values[1] == min(values)
    assert_allclose(values[0], values[2], atol=0.5 * (values[0] - values[1]))
    # It does not depend on the axes of the object.
    shapes, motion, noise = fit.state
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    turned = fit._replace(state=JointState(turn @ shapes, motion @ turn.T, noise))
    for own in (fit.widths, None):
        found = [evidence(problem, each._replace(widths=own)) for each in (fit, turned)]
        assert_allclose(found[1], found[0], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_beating_wings_are_no_rolling_bird(seed):
    """Depths are right or withheld, for a bird from above that turns by 3 degrees."""
    X, points, _ = seen(bird(140, seed), 3, seed)
    model = AffineNRSfM(3, camera="weak_perspective", random_state=0)
    with warnings.catch_warnings(action="ignore"):
        model.fit(X)
    _, error = depth_error(model, X, points)
    stated = model.depth_uncertainty_
    assert stated > LARGEST_SHARE or error < min(3 * stated, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_depths_of_balloons_that_hardly_turn_are_unsure(seed):
    """Depths twice as large, with half of the turning, are nearly as likely."""
    rng = np.random.default_rng(seed)
    sphere = rng.normal(size=(25, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    X, points, _ = seen(sphere * (1 + 0.25 * rng.normal(size=(100, 1, 3))), 4, seed)
    with warnings.catch_warnings(action="ignore"):
        model = AffineNRSfM(3, camera="weak_perspective", random_state=0).fit(X)
    _, error = depth_error(model, X, points)
    assert 0.5 * error < model.depth_uncertainty_ < 2 * error
