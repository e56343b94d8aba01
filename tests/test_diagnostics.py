"""What a fit says of itself: reliabilities and information, by their definitions."""

import re
from copy import copy
from dataclasses import replace
from html import escape
from itertools import product

import numpy as np
import pandas as pd
import pytest
from made_once import made_once
from numpy.testing import assert_allclose
from refusals import refusals_of, refused
from scenes import with_outliers
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import KFold, cross_val_predict
from sklearn.pipeline import make_pipeline

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks

TABLE = make_nonrigid_tracks(60, 16, 2, noise=0.02, random_state=0).data


def estimator(n_components=2, **params):
    return AffineNRSfM(n_components, random_state=0, **params)


@made_once
def fitted():
    """Return a model with affine cameras."""
    return estimator().fit(TABLE)


@made_once
def of_faces():
    """Return a table of faces, and a model with calibrated cameras."""
    faces = make_face_tracks(n_frames=40, n_components=2, random_state=0)
    table = pd.DataFrame(faces.data, columns=faces.feature_names)
    table.index = [f"image{i}" for i in range(40)]
    return table, estimator(camera="weak_perspective", tol=1e3).fit(table)


def noisy_scene(n_frames, n_points, noise):
    options = {"noise": noise, "amplitude": 0.1, "random_state": 0}
    return make_nonrigid_tracks(n_frames, n_points, 1, **options)


class TestReliabilities:
    # The noise is that of the coefficients, and that of the shapes.
    @pytest.mark.parametrize("size", [(100, 12, 0.12), (40, 100, 0.25)])
    def test_are_correlations_with_the_truth(self, size):
        scene = noisy_scene(*size)
        model = estimator(1).fit(scene.data)
        correlation = np.corrcoef(scene.alpha[:, 0], model.alpha_[:, 0])[0, 1] ** 2
        assert correlation < 0.9
        assert correlation - 0.03 < model.reliability_[0] < correlation + 0.02

    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    def test_noise_of_rigid_objects(self, loss):
        rigid = make_nonrigid_tracks(60, 30, 0, noise=0.01, random_state=100)
        model = estimator(loss=loss).fit(rigid.data)
        assert model.reliability_.max() < 0.1
        (message,) = model.diagnostics().messages
        assert "no deformation was found" in message

    def test_true_shapes_keep_theirs(self):
        options = {"noise": 0.02, "amplitude": 0.1, "random_state": 0}
        model = estimator(4).fit(make_nonrigid_tracks(60, 60, 2, **options).data)
        assert (model.reliability_[:2] > 0.98).all()
        assert (model.reliability_[2:] == 0).all()
        (message,) = model.diagnostics().messages
        assert "2 direction(s) of the coefficients are probably noise" in message


class TestFigures:
    def test_amplitude_is_that_of_the_deformations(self):
        _, model = of_faces()
        deformations = np.tensordot(model.alpha_, model.basis_, 1)
        mean_square = np.mean(np.sum(deformations**2, axis=(1, 2)))
        expected = np.sqrt(mean_square / np.sum(model.mean_shape_**2))
        found = model.diagnostics()
        assert_allclose(found.deformation_amplitude, expected, rtol=1e-9)

    def test_weak_deviations_are_of_what_cameras_and_coefficients_do_not_explain(self):
        # By differences: images are linear in each of the unknowns.
        model, K = fitted(), 2
        tracks = TABLE.reshape(60, 16, 2)
        tracks = tracks - tracks.mean(axis=1, keepdims=True)
        size = np.sqrt(np.mean(tracks**2, axis=(1, 2)))[:, None, None]

        def information(M, a):
            def images(x):
                M_x, t, a_x, V = np.split(x, [6, 8, 8 + K])
                basis = model.basis_ + model.mean_shape_ @ V.reshape(K, 3, 3).mT
                shape = model.mean_shape_ + np.tensordot(a + a_x, basis, 1)
                return (shape @ (M + M_x.reshape(2, 3)).T + t).ravel()

            unknowns = np.eye(8 + 10 * K)
            changes = np.array([images(x) - images(0 * x) for x in unknowns]).T
            free, strain = np.split(changes, [8 + K], axis=1)
            rest = strain - free @ np.linalg.lstsq(free, strain)[0]
            return rest.T @ rest

        total = sum(map(information, model.motion_ / size, model.alpha_))
        # Not the traces of the V_k
        values = np.linalg.eigvalsh(total)[::-1][: 8 * K]
        found = model.diagnostics().weak_deviations
        assert_allclose(found, np.sqrt(model.noise_variance_ / values), rtol=1e-6)

    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_are_printed_as_sentences_and_a_table(self, camera):
        found, depth = of_faces()[1].diagnostics(), "not estimated"
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


class TestPoseShare:
    def test_is_that_of_frames_left_out(self):
        _, model = of_faces()
        predictors = np.hstack([np.ones((40, 1)), model.rotations_.reshape(40, 9)])
        alpha, moved = model.alpha_, copy(model)
        # A coefficient that goes with the yaw
        moved.alpha_ = alpha + [[1.0, 0.0]] * (1 + 5 * model.rotations_[:, :1, 2])
        for each, yaw in (model, False), (moved, True):
            fit = LinearRegression(fit_intercept=False)
            error = each.alpha_ - cross_val_predict(
                fit, predictors, each.alpha_, cv=KFold(5)
            )
            energy = np.sum((each.alpha_ - each.alpha_.mean(axis=0)) ** 2, axis=0)
            found = each.diagnostics().pose_share
            assert_allclose(found, 1 - np.sum(error**2, axis=0) / energy, rtol=1e-6)
            assert (found > 0.3).tolist() == [yaw, False]
        message = moved.diagnostics().messages[-1]
        assert re.search("17 points of ibug-68 .*--points inner", message)


# Of tables that are not those of the fit
pytestmark = pytest.mark.filterwarnings("ignore:the points of X lie")
OUTLIERS = "the table has outliers: .* % of the points .* they bend the shapes"
COMPARE = "isa_nrsfm.AutoNRSfM().fit(X) compares other settings"


class TestOutliers:
    def test_are_found_beside_badly_explained_points_and_frames(self, rng):
        table, model = of_faces()
        tracks = table.to_numpy().reshape(40, 68, 2).copy()
        size = tracks.std(axis=1).mean()
        noise = 9 * size * np.sqrt(model.noise_variance_)
        tracks[7] += noise * rng.normal(size=(68, 2))
        tracks[:, 3] += noise * rng.normal(size=(40, 2))
        tracks[[8, 2, 4], [5, 5, 4]] += size * np.array([[8], [6], [4]])
        tracks[9, 9] = np.nan
        X = pd.DataFrame(tracks.reshape(40, -1), table.index, table.columns)
        found = model.diagnostics(X)
        assert found.outliers.tolist() == [[8, 5], [2, 5], [4, 4]]
        assert found.outlier_share == 3 / (40 * 68 - 1)
        assert 0.9 < found.outlier_energy < 1
        assert found.messages == (
            "the table has outliers: 3 points (0.11 %) in 3 frames are more than 8 "
            "standard deviations from the model, in the rows image2, image4, image8, "
            "most often the points 5, 4: they bend the shapes. Correct them. "
            f"{COMPARE} by held-out points",
        )

    def test_tables_without_have_none(self):
        table, model = of_faces()
        found = model.diagnostics(table)
        assert (found.outlier_share, found.fit, found.depth) == (0, "good", "good")
        assert np.isnan(model.diagnostics().outlier_share)
        refused("which has 40 rows; got X with 39", model.diagnostics, table[1:])

    def test_fit_names_a_few_that_directions_of_the_shapes_explain(self):
        faces = make_face_tracks(30, camera="weak_perspective", random_state=0)
        tracks = faces.tracks[:, ::3]
        table = with_outliers(tracks, tracks.std(axis=1).mean(), 0.005)
        wrong, X = (table != tracks).any(axis=2), table.reshape(30, -1)
        with pytest.warns(match=OUTLIERS) as caught:
            estimator(1, camera="weak_perspective").fit(X)
        rows = re.search("in the rows (.*): they", str(caught[0].message))[1]
        assert wrong[[*map(int, rows.split(", "))]].any(axis=1).all()
        # A robust loss finds them, too, and is not bent.
        found = estimator(loss="cauchy").fit(X).diagnostics(X)
        assert sorted(found.outliers[:3].tolist()) == np.argwhere(wrong).tolist()
        assert not any("outliers" in message for message in found.messages)


def test_a_few_frames_that_determine_a_coefficient_are_named():
    tracks = make_face_tracks(150, n_components=1, noise=0.01, random_state=0).tracks
    tracks[:4, 48:68, 1] *= 1.3  # all lips of four frames
    found = estimator().fit(tracks.reshape(150, -1)).diagnostics()
    message = r"a few of the 150 frames determine alpha_. \(.* most row [0-3]\)"
    assert any(re.match(message, each) for each in found.messages)
    assert found.effective_frames.min() < 10 < found.effective_frames.max()


# Errors of the depths, and those by deformation
DEPTHS = {
    "deformation": (1.4, 1.0),
    "parts": (0.9, 1e-6),
    "doubtful": (0.45, 1e-6),
    "known": (0.1, 1e-6),
}


def messages_of(model, X=None, depth="known", **results):
    """Return the messages of a model as if it had other results."""
    model, (total, deformation) = copy(model), DEPTHS[depth]
    frames = model._model.frames
    certainty = frames.certainty._replace(total=total, deformation=deformation)
    model._model = model._model._replace(frames=replace(frames, certainty=certainty))
    vars(model).update(results)
    return model.diagnostics(X).messages


class TestAdvice:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_messages_agree(self, camera):
        model = fitted() if camera == "affine" else of_faces()[1]
        depths = ["known"] if camera == "affine" else DEPTHS
        trials = {}, {"_trials": ()}  # other settings were compared
        for depth, supported, compared in product(depths, range(2), trials):
            results = {"reliability_": 1.0 * (np.arange(2) < supported)}
            found = messages_of(model, None, depth, **results, **compared)
            text = " | ".join(found)
            assert len({*found}) == len(found) <= 3
            # Other settings are not named after they were compared.
            assert not (compared and COMPARE in text)
            assert not re.search("camera=|loss=|refinement=|prior=", text)
            known = camera == "affine" or depth == "known"
            state = "doubtful" if depth == "doubtful" else "not determined"
            assert (f"depth of the shapes is {state}" in text) == (not known)
            assert not (known or depth == "doubtful") or "are withheld" not in text

    def test_of_a_poor_fit_nothing_else_is_said(self, rng):
        table, model = of_faces()
        noise = table.std(axis=1).mean() * rng.normal(size=table.shape)
        assert model.diagnostics(table + 0.1 * noise).fit == "fair"
        (message,) = messages_of(model, table + 3 * noise, "parts")
        assert message.startswith("the fit is poor: points left out of it are not")


def test_the_summary_has_key_figures_and_diagnostics():
    summarised = fitted()
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
