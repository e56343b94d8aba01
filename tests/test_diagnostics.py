"""What a fit says of itself: reliabilities and information, by their definitions."""

import re
from html import escape
from itertools import product
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from layers import slow_after
from numpy.testing import assert_allclose
from refusals import refusals_of, refused, warned
from scenes import with_outliers
from scipy.linalg import eigvals
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import KFold, cross_val_predict
from sklearn.pipeline import make_pipeline

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.models import DepthCertainty
from isa_nrsfm._joint.fit import left_out_distances
from isa_nrsfm._joint.uncertainty import reliabilities
from isa_nrsfm.analysis._advice import (
    COMPARE,
    FIT,  # noqa: F401  in refusals.txt
    Facts,
    advice,
    depth_advice,
    gross_residuals,
    verdict,  # noqa: F401  in refusals.txt
)
from isa_nrsfm.analysis._diagnostics import outlier_text, pose_share, weak_information
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.skeletons import get_skeleton

TABLE = make_nonrigid_tracks(60, 16, 2, noise=0.02, random_state=0).data


class TestReliabilities:
    def test_are_shares_of_the_variance(self, rng):
        # Of coefficients with covariances, for shapes that do not follow any noise
        alpha = rng.normal(size=(50, 3)) * [2.0, 1.0, 0.3]
        factor = rng.normal(size=(3, 3))
        covariance, moment = 0.2 * factor @ factor.T, alpha.T @ alpha / 50
        expected = np.sort(eigvals(moment, moment + covariance).real)[::-1]
        found = reliabilities(alpha, covariance, np.zeros((3, 3)), 1.0)
        assert_allclose(found, expected, rtol=1e-9)

    @pytest.mark.parametrize("gamma", [0.2, 20.0])
    def test_are_correlations_with_the_truth(self, gamma, rng):
        # A random matrix of rank one and noise: its left singular vector.
        n_frames, signal = 300, 10 * np.sqrt(gamma)
        true = rng.normal(size=n_frames)
        noise = rng.normal(size=(n_frames, int(gamma * n_frames)))
        noise[:, 0] += np.sqrt(signal) * true
        left, values, _ = np.linalg.svd(noise, full_matrices=False)
        y = values[0] ** 2 / n_frames
        alpha = np.sqrt(n_frames * (1 - 1 / y)) * left[:, :1]
        moments = np.full((1, 1), gamma / y * (1 - 1 / y) * n_frames)
        found = reliabilities(alpha, np.full((1, 1), 1 / y), moments, float(n_frames))
        correlation = np.corrcoef(true, left[:, 0])[0, 1] ** 2
        # The margin of chance makes it a little smaller.
        assert correlation - 0.05 < found[0] < correlation + 0.02

    @pytest.mark.parametrize(("gamma", "above"), [(0.2, 1.05), (2.0, 10.0)])
    def test_by_their_formula_from_the_limit_of_detection_on(self, gamma, above):
        # Of a random matrix of rank one and noise
        signal = above * np.sqrt(gamma)
        y = (1 + signal) * (1 + gamma / signal)
        share, left = 1 - 1 / y, np.full((1, 1), 1 / y)
        caused = np.full((1, 1), gamma / y * share / 1.5)  # the margin of chance
        (found,) = reliabilities(np.full((50, 1), np.sqrt(share)), left, caused, 1.0)
        expected = (signal**2 - gamma) / (signal * (signal + 1))
        assert found == pytest.approx(expected)

    @pytest.mark.parametrize(
        ("n_frames", "n_points", "n_components"),
        slow_after(1, [(100, 68, 4), (300, 68, 1)]),
    )
    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    def test_noise_of_rigid_objects(self, n_frames, n_points, n_components, loss):
        options = {"noise": 0.01, "random_state": n_frames}
        rigid = make_nonrigid_tracks(n_frames, n_points, 0, **options)
        model = AffineNRSfM(n_components, loss=loss, random_state=0).fit(rigid.data)
        assert model.reliability_.max() < 0.1
        (message,) = model.diagnostics().messages
        assert "no deformation was found" in message

    def test_true_shapes_keep_theirs(self):
        options = {"noise": 0.02, "amplitude": 0.1, "random_state": 0}
        truth = make_nonrigid_tracks(100, 400, 2, **options)
        model = AffineNRSfM(4, random_state=0).fit(truth.data)
        assert (model.reliability_[:2] > 0.98).all()
        assert (model.reliability_[2:] == 0).all()
        (message,) = model.diagnostics().messages
        assert "2 direction(s) of the coefficients are probably noise" in message


class TestWeakInformation:
    def test_is_what_cameras_and_coefficients_do_not_explain(self, rng):
        # By differences: images are linear in each of the unknowns.
        n_frames, n_points, n_components = 5, 9, 2
        shapes = rng.normal(size=(n_components + 1, n_points, 3))
        shapes -= shapes.mean(axis=1, keepdims=True)
        motion = rng.normal(size=(n_frames, 2, 3))
        alpha = rng.normal(size=(n_frames, n_components))

        def information(M, a):
            def images(x):
                M_x, t, a_x, V = np.split(x, [6, 8, 8 + n_components])
                basis = shapes[1:] + shapes[0] @ V.reshape(-1, 3, 3).swapaxes(1, 2)
                shape = shapes[0] + np.tensordot(a + a_x, basis, 1)
                return (shape @ (M + M_x.reshape(2, 3)).T + t).ravel()

            unknowns = np.eye(8 + 10 * n_components)
            changes = np.array([images(x) - images(0 * x) for x in unknowns]).T
            free, strain = np.split(changes, [8 + n_components], axis=1)
            rest = strain - free @ np.linalg.lstsq(free, strain)[0]
            return rest.T @ rest

        expected = sum(map(information, motion, alpha))
        found = weak_information(shapes[0], shapes[1:], motion, alpha)
        assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())

    def test_some_of_many_frames_stand_for_all(self, rng):
        shapes = rng.normal(size=(6, 3)), rng.normal(size=(1, 6, 3))
        frame = rng.normal(size=(1, 2, 3)), rng.normal(size=(1, 1))
        one = weak_information(*shapes, *frame)
        many = weak_information(*shapes, *(each.repeat(1000, axis=0) for each in frame))
        assert_allclose(many, 1000 * one, atol=1e-9 * np.abs(many).max())


@pytest.fixture(scope="module")
def model():
    """Return a model of faces."""
    faces = make_face_tracks(n_frames=60, n_components=2, random_state=0)
    return AffineNRSfM(2, camera="weak_perspective", random_state=0).fit(faces.data)


class TestFigures:
    def test_amplitude_is_that_of_the_deformations(self, model):
        deformations = np.tensordot(model.alpha_, model.basis_, 1)
        mean_square = np.mean(np.sum(deformations**2, axis=(1, 2)))
        expected = np.sqrt(mean_square / np.sum(model.mean_shape_**2))
        found = model.diagnostics()
        assert_allclose(found.deformation_amplitude, expected, rtol=1e-9)

    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_are_printed_as_sentences_and_a_table(self, model, camera):
        found, depth = model.diagnostics(), "not estimated"
        if camera == "affine":
            pose = np.array([np.nan, 0.1])
            found = found._replace(depth_uncertainty=np.nan, pose_share=pose)
            found = found._replace(messages=("Use more frames",))
        fit, of_depth, first, *_, head, one, two = str(found).splitlines()
        assert fit == "fit: not known without the table"
        if camera == "affine":
            assert (first, two.split()[2:4]) == ("Use more frames", ["10", "%"])
        else:
            assert (of_depth, first) == ("depth: GOOD", "no warning")
            depth = f"{100 * found.depth_uncertainty:.3g} % of the depth"
        assert f"\ndepth error: {depth}\n" in str(found)
        assert f"\ncameras: {found.camera_meaning}\n" in str(found)
        assert head.split() == "effective frames pose share in another fit".split()
        assert one.split()[:2] == ["alpha_1", f"{found.effective_frames[0]:.1f}"]
        assert len(one) == len(two) == len(head)


OUTLIERS = "the table has outliers: .* % of the points .* they bend the shapes"


def with_wrong_points(faces, share):
    """Return a table of faces with wrong points, and which points are wrong."""
    table = with_outliers(faces.tracks, faces.tracks.std(axis=1).mean(), share)
    wrong = (table != faces.tracks).any(axis=2)
    return table.reshape(len(table), -1), wrong


class TestPoseShare:
    def test_is_that_of_frames_left_out(self, rng):
        R = Rotation.from_rotvec(0.4 * rng.normal(size=(40, 3))).as_matrix()
        scales = rng.uniform(0.5, 2.0, size=(40, 1, 1))
        alpha = rng.normal(size=(40, 2))
        alpha[:, 0] += 1 + 5 * R[:, 0, 2]
        predictors = np.hstack([np.ones((40, 1)), R.reshape(40, 9)])
        fit = LinearRegression(fit_intercept=False)
        error = alpha - cross_val_predict(fit, predictors, alpha, cv=KFold(5))
        energy = np.sum((alpha - alpha.mean(axis=0)) ** 2, axis=0)
        expected = 1 - np.sum(error**2, axis=0) / energy
        found = pose_share(scales * R[:, :2], alpha)
        assert_allclose(found, expected, rtol=1e-9)
        assert found[0] > 0.5 > found[1]
        turned = R[:, :2] @ Rotation.from_rotvec([1.0, 2.0, 3.0]).as_matrix()
        assert_allclose(pose_share(turned, alpha), expected, rtol=1e-9)

    @pytest.mark.slow
    @pytest.mark.parametrize("camera", ["weak_perspective", "affine"])
    def test_a_contour_that_slides_is_named(self, camera):
        options = {"camera": "weak_perspective", "noise": 0.01, "random_state": 0}
        faces = make_face_tracks(300, n_components=2, **options)
        model = AffineNRSfM(2, camera=camera, random_state=0).fit(faces.data)
        assert np.abs(model.diagnostics().pose_share).max() < 0.1
        assert model.diagnostics().messages == ()
        # The jaw follows the visible outline: it slides along itself by the yaw.
        tracks, jaw = faces.tracks.copy(), np.arange(1, 16)
        yaw = faces.motion[:, 0, 2] / np.linalg.norm(faces.motion[:, 0], axis=1)
        along = tracks[:, jaw + 1] - tracks[:, jaw - 1]
        tracks[:, jaw] += yaw[:, None, None] * along
        table = tracks.reshape(300, -1)
        model = AffineNRSfM(3, camera=camera, random_state=0).fit(table)
        found = model.diagnostics()
        assert found.pose_share.max() > 0.3
        assert re.search("17 points of ibug-68 .*--points inner", found.messages[-1])
        inner = table[:, get_skeleton("ibug-68").inner_columns]
        model = AffineNRSfM(2, camera=camera, random_state=0).fit(inner)
        assert np.abs(model.diagnostics().pose_share).max() < 0.1


class TestOutliers:
    def test_are_found_beside_badly_explained_points_and_frames(self, rng):
        lengths = np.linalg.norm(rng.normal(size=(50, 20, 2)), axis=2)
        lengths[7] *= 10
        lengths[:, 3] *= 10
        lengths[2, 5], lengths[4, 4], lengths[9, 9] = 20.0, 30.0, np.nan
        share, energy, found = gross_residuals(lengths)
        assert found.tolist() == [[4, 4], [2, 5]]
        assert share == 2 / 999
        assert energy == pytest.approx(1300 / np.nansum(lengths**2))
        share, energy, found = gross_residuals(np.zeros((3, 4)))
        assert share == energy == 0
        assert found.shape == (0, 2)

    @pytest.mark.slow
    def test_are_named_and_stand_for_what_they_cause(self):
        faces = make_face_tracks(60, n_components=2, noise=0.01, random_state=0)
        table, wrong = with_wrong_points(faces, 0.05)
        model = warned(OUTLIERS, AffineNRSfM(2, random_state=0).fit, table)
        found = model.diagnostics(table)
        (message,) = found.messages
        assert message.startswith(f"the table has outliers: {len(found.outliers)} ")
        assert message.endswith(f"they bend the shapes. Correct them. {COMPARE}")
        assert wrong[tuple(found.outliers.T)].mean() > 0.98
        assert 0.03 < found.outlier_share < wrong.mean()
        robust = AffineNRSfM(2, loss="cauchy", random_state=0).fit(table)
        found = robust.diagnostics(table)
        assert not any("outliers" in message for message in found.messages)
        assert 0.04 < found.outlier_share < 1.05 * wrong.mean()

    @pytest.mark.parametrize("camera", slow_after(1, ["affine", "weak_perspective"]))
    def test_tables_without_have_none(self, camera):
        faces = make_face_tracks(60, noise=0.02, random_state=0)
        model = AffineNRSfM(3, camera=camera, random_state=0).fit(faces.data)
        assert model.diagnostics(faces.data).outlier_share == 0
        assert np.isnan(model.diagnostics().outlier_share)
        refused("which has 60 rows; got X with 59", model.diagnostics, faces.data[1:])

    def test_rows_and_points_have_their_names(self):
        faces = make_face_tracks(100, n_components=2, noise=0.01, random_state=0)
        table = pd.DataFrame(faces.data, columns=faces.feature_names)
        table.index = [f"image{i}" for i in range(100)]
        for point in range(5, 30, 2):
            table.loc[f"image{point + 2}", f"x_{point}"] += 400.0
            table.loc[f"image{90 - point}", "x_5"] += 400.0
        model = warned(OUTLIERS, AffineNRSfM(2, random_state=0).fit, table)
        (message,) = model.diagnostics(table).messages
        assert re.search(r"rows image9, .* points 7,", message)

    def test_fit_names_a_few_that_directions_of_the_shapes_explain(self):
        faces = make_face_tracks(40, camera="weak_perspective", random_state=0)
        table, wrong = with_wrong_points(faces, 0.02)
        given = AffineNRSfM("auto", camera="weak_perspective", random_state=0)
        with pytest.warns(match=OUTLIERS) as caught:
            given.fit(table)
        rows = re.search("in the rows (.*), ...:", str(caught[0].message))[1]
        assert wrong[[*map(int, rows.split(", "))]].any(axis=1).all()

    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_distances_are_those_of_fits_without_the_point(self, camera):
        options = {"camera": "weak_perspective", "noise": 0.01, "random_state": 0}
        faces = make_face_tracks(40, **options)
        model = AffineNRSfM(2, camera=camera, random_state=0).fit(faces.data)
        frames, rows = model._model, faces.tracks[:6].mT.copy()
        rows[:, :, 9] += 30.0  # beyond the noise
        rows -= rows.mean(axis=2, keepdims=True)
        sizes = np.sqrt(np.mean(rows**2, axis=(1, 2), keepdims=True))
        found = left_out_distances(frames.frames, rows / sizes)
        others = np.where(np.arange(rows.shape[2]) == 9, np.nan, rows)
        left = frames.decompose(others, deviations=False)
        shapes = frames.shapes(left, None, False)
        images = frames.images(shapes, left.motion, left.translation)
        distance = np.linalg.norm(rows.mT - images, axis=2)[:, 9]
        assert_allclose(sizes[:, 0, 0] * found[:, 9], distance, rtol=0.05)
        few = np.where(np.arange(rows.shape[2]) % 12, np.nan, rows / sizes)
        assert np.isnan(left_out_distances(frames.frames, few)).all()  # six points


def described(share):
    """Return the words for four outliers with a share of the energy."""
    points = np.array([[3, 1], [0, 2], [3, 2], [7, 0]])
    found = SimpleNamespace(outlier_energy=share, outlier_share=6e-4, outliers=points)
    return outlier_text(found, np.arange(10, 20), "abc")


def test_a_few_frames_that_determine_a_coefficient_are_named():
    tracks = make_face_tracks(200, n_components=1, noise=0.01, random_state=0).tracks
    tracks[:4, 48:68, 1] *= 1.3  # all lips of four frames
    model = AffineNRSfM(2, random_state=0).fit(tracks.reshape(200, -1))
    message = r"a few of the 200 frames determine alpha_. \(.* most row [0-3]\)"
    found = model.diagnostics()
    assert any(re.match(message, each) for each in found.messages)
    assert found.effective_frames.min() < 10 < found.effective_frames.max()


OF_MODEL = {"camera": "weak_perspective", "loss": "linear", "consensus": False}
OF_MODEL |= {"decided": False, "certainty": DepthCertainty(0.1, 0.0), "n_points": 20}
OF_MODEL |= {"reliability": np.ones(3), "noise_ratio": 1.0, "prior": None}


def facts(**known):
    """Return the facts of a fit with three basis shapes."""
    of = SimpleNamespace(**{n: known.pop(n, given) for n, given in OF_MODEL.items()})
    frames = SimpleNamespace(certainty=of.certainty, loss=of.loss)
    model = SimpleNamespace(_model=SimpleNamespace(frames=frames), prior=of.prior)
    model.refinement = "consensus" if of.consensus else "joint"
    model.camera_, model.camera_noise_ratio_ = of.camera, of.noise_ratio
    model.mean_shape_, model.reliability_ = np.ones((of.n_points, 3)), of.reliability
    vars(model).update({"_trials": ()} if of.decided else {})
    return Facts(model, **known)


UNKNOWN = {
    "deformation": DepthCertainty(1.4, 1.0),
    "parts": DepthCertainty(0.9, 1e-6),
    "doubtful": DepthCertainty(0.45, 1e-6),
    None: DepthCertainty(0.1, 1e-6),
}


class TestAdvice:
    @pytest.mark.parametrize("decided", [False, True])
    def test_messages_agree(self, decided):
        cameras, ratios = ["affine", "weak_perspective"], [1.0, 1.5, 100.0, np.nan]
        shares, errors = [np.nan, 0.0, 0.2], [np.nan, 0.01, 0.3]
        cases = product(cameras, UNKNOWN, ratios, range(4), errors, shares)
        for camera, depth, ratio, supported, error, share in cases:
            known = {"noise_ratio": ratio, "decided": decided, "camera": camera}
            known |= {"reliability": 1.0 * (np.arange(3) < supported)}
            known |= {"certainty": UNKNOWN[depth], "deviation": 0.3, "few": "frames"}
            known |= {"outliers": "wrong points", "outlier_energy": share}
            known |= {"held_out_error": error}
            found = advice(facts(**known, pose="the outline"))
            text = " | ".join(found)
            assert len({*found}) == len(found) <= 3
            # Other settings are named once, and never after they were compared.
            assert not (decided and COMPARE in text)
            assert not re.search("camera=|loss=|refinement=|prior=", text)
            if error == 0.3:
                assert text.startswith("the fit is poor")
                assert len(found) == 1
                assert COMPARE not in text
                continue
            known = camera == "affine" or depth is None
            state = "doubtful" if depth == "doubtful" else "not determined"
            assert (f"depth of the shapes is {state}" in text) == (not known)
            assert not (known or depth == "doubtful") or "are withheld" not in text
            bent = "wrong points: they bend the shapes. Correct them"
            assert text.startswith(bent) == (share > 0)
            assert not (share > 0 and "n_components" in text)

    def test_doubts_are_those_of_fits_without_a_prior(self):
        known = {"certainty": UNKNOWN["doubtful"]}
        assert "doubtful" in depth_advice(facts(**known))
        assert not depth_advice(facts(**known, prior=object()))


# --- what a notebook shows of a model ------------------------------------------------


def estimator(**params):
    return AffineNRSfM(2, random_state=0, **params)


def test_the_summary_has_key_figures_and_diagnostics():
    summarised = estimator().fit(TABLE)
    shown = summarised._html_repr()  # which scikit-learn shows from 1.7 on
    assert shown.count("isa-nrsfm-summary") == 1
    assert "2 basis shapes of 16 points" in shown
    percent = 100 * np.array([summarised.inverse_snr_, summarised.rank_floor_])
    assert "inverse SNR: {:.3g} %, rank floor {:.3g} %".format(*percent) in shown
    assert escape(repr(summarised.diagnostics())) in shown


@pytest.mark.parametrize(
    "params", [{"refinement": "alternating"}, {"keep_frames": False}], ids=str
)
def test_what_is_not_known_is_left_out(params):
    shown = estimator(**params).fit(TABLE)._html_repr()
    assert ("inverse SNR: " in shown, "cameras: " in shown) == (True, False)


def test_names_of_columns_are_escaped():
    table = pd.DataFrame(TABLE, columns=[f"<marked>{column}" for column in range(32)])
    named = estimator(refinement=None).fit(table)
    shown = make_pipeline(named)._repr_html_() + named._html_repr()
    assert "<marked>" not in shown
    assert "isa-nrsfm-summary" in shown


test_refusals = refusals_of("diagnostics", globals())
