import re
from functools import partial

import numpy as np
import pytest
import sklearn
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of
from scipy.signal import lfilter
from scipy.stats import spearmanr
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from sklearn.pipeline import make_pipeline
from sklearn.utils import shuffle

from isa_nrsfm.analysis import (
    AlignedFrames,
    WithinGroups,
    association,
    between_share,
    predictability,
)

rng_of = np.random.default_rng


def related(seed=0, n=120, effect=1.5):
    """Return three coefficients, of which the second goes with two classes."""
    rng = rng_of(seed)
    alpha, y = rng.normal(size=(n, 3)), rng.integers(2, size=n)
    alpha[:, 1] += effect * y
    return alpha, y


def video(seed, n=200, memory=0.9, n_classes=2, effect=0.0):
    """Return three autoregressions, and classes in blocks, whose effect is on one."""
    rng = rng_of(seed)
    alpha = rng.normal(size=(n, 3))
    for t in range(1, n):
        alpha[t] = memory * alpha[t - 1] + np.sqrt(1 - memory**2) * alpha[t]
    y = np.repeat(rng.integers(n_classes, size=n), rng.geometric(1 / 20, n))[:n]
    alpha[:, 1] += effect * y
    return alpha, y


def rhythms(rng, period=12, n=900):
    """Return oscillations, and whether another one of the same period is positive.

    Their phases are lost after about a hundred frames.
    """
    noise = rng.normal(size=(n + 600, 4))
    recursion = [1, -1.98 * np.cos(2 * np.pi / period), 0.99**2]
    waves = lfilter([1], recursion, noise, axis=0)[600:]
    return waves[:, :3], waves[:, 3] > 0


def joined_clips(rng):
    """Return coefficients, a label of each clip, and the numbers of eight clips."""
    clip = np.repeat(np.arange(8), 60)
    within = [video(rng.integers(1000), 60)[0] for _ in range(8)]
    return np.concatenate(within) + 3 * rng.normal(size=(8, 3))[clip], clip % 2, clip


def spread(rng):
    """Return coefficients with another spread in the second class, and the classes."""
    y = np.arange(200) < 15
    return rng.normal(size=(200, 3)) * np.where(y, 3, 1)[:, None], y


def sessions(rng):
    """Return coefficients of sessions, their labels, and who is in them."""
    session = np.repeat(np.arange(80), 8)
    alpha = rng.normal(size=(640, 3)) + rng.normal(size=(80, 3))[session]
    return alpha, rng.integers(2, size=80)[session], session // 4


def repeated(rng):
    """Return coefficients of people in any order, and labels of the people."""
    person = rng.permutation(np.repeat(np.arange(20), 10))
    alpha = rng.normal(size=(200, 3)) + 3 * rng.normal(size=(20, 3))[person]
    return alpha, rng.integers(2, size=20)[person]


def people(rng, effect=0.0):
    """Return people of many and few frames, and labels that vary within them."""
    person = np.repeat(np.arange(25), rng.integers(1, 12, 25))
    alpha = 2.0 * rng.normal(size=(25, 3))[person]
    alpha += rng.normal(size=alpha.shape)
    y = rng.integers(2, size=len(person))
    alpha[:, 0] += effect * y
    return alpha, y, person


def significant(trial, n_trials=20):
    """Return the share of random trials (alpha, y, groups) with a small p-value."""
    options, given = {"n_permutations": 99}, map(trial, map(rng_of, range(n_trials)))
    found = (association(*g, random_state=i, **options) for i, g in enumerate(given))
    return np.mean([each.p_value.min() <= 0.05 for each in found])


# Options where the number of permutations makes no difference
FEW = {"n_permutations": 199, "random_state": 0}


def differ_in_any_order(alpha, y):
    """Tell whether frames, mixed up and of no known group, go with a label."""
    mixed = rng_of(2).permutation(len(y))
    found = association(alpha[mixed, None], y[mixed], **FEW)
    return bool(found.untested) or found.p_value[0] < 0.01


class TestAssociation:
    def test_eta_squared_is_r_squared_on_the_classes(self):
        alpha, y = related()
        y = np.where(y == 1, 1, rng_of(1).integers(2, 4, len(y)))
        found = association(alpha, y, **FEW)
        dummies = (y[:, None] == np.unique(y)).astype(float)
        means = LinearRegression().fit(dummies, alpha).predict(dummies)
        expected = r2_score(alpha, means, multioutput="raw_values")
        assert_allclose(found.statistic, expected)
        assert (found.kind, found.n_frames) == ("classes", len(y))

    def test_numbers_have_spearmans_correlation(self):
        alpha, _ = related()
        age = np.exp(alpha[:, 0]) + 0.1 * rng_of(3).normal(size=len(alpha))
        found = association(alpha, age, **FEW)
        expected = [spearmanr(column, age).statistic for column in alpha.T]
        assert_allclose(found.statistic, expected)
        assert found.kind == "number"
        assert found.p_value[0] == 0.005
        assert found.p_value[1:].min() > 0.05

    def test_labels_of_people_are_permuted_among_people(self, rng):
        # Four people, two of each sex: of the six ways to deal the labels out two are
        # as extreme. Frame by frame it would look certain.
        person = np.repeat(np.arange(4), 30)
        alpha = np.array([0.0, 0.1, 5.0, 5.1])[person] + 0.01 * rng.normal(size=120)
        sex = np.array(["m", "m", "f", "f"])[person]
        found = association(alpha[:, None], sex, person, **FEW)
        assert found.p_value[0] == pytest.approx(1 / 3, abs=0.06)
        assert found.permuted == "groups"
        assert differ_in_any_order(alpha, sex)

    def test_labels_that_differ_within_people_are_permuted_there(self):
        # Who is in a frame explains all; within people nothing goes with the label. Of
        # 15 ways to deal out the majorities one is as extreme.
        person = np.repeat(np.arange(6), 20)
        y = (person % 3 > 0) ^ (np.arange(120) % 20 < 3)
        alpha = 3.0 * (person % 3 > 0) + 0.1 * rng_of(1).normal(size=120)
        found = association(alpha[:, None], y, person, **FEW)
        assert found.p_value[0] > 0.01
        assert differ_in_any_order(alpha, y)

    def test_repeated_people_are_told(self):
        found = [association(*repeated(rng_of(i)), **FEW) for i in range(5)]
        assert sum("Give the people as groups" in each.untested for each in found) > 3

    def test_correction_for_attenuation(self):
        rng = rng_of(0)
        true, error = rng.normal(size=(2, 4000, 1))
        y, std = rng.normal(size=4000) + true[:, 0], np.ones((4000, 1))
        # Posterior means, and the errors that they are known to have.
        alpha = (true + error) / 2
        found = association(alpha, y, alpha_std=std / 2**0.5, n_permutations=9)
        expected = association(true, y, n_permutations=9).statistic
        assert found.corrected == pytest.approx(expected, abs=0.04)
        assert list(found.to_frame()) == ["spearman", "spearman_corrected", "p_value"]
        assert "corrected" in str(found)

    # Nine in ten videos would, if single frames were permuted.
    @pytest.mark.parametrize(
        "trial", slow_after(2, [people, video, spread, sessions, rhythms])
    )
    def test_labels_go_with_nothing_by_chance(self, trial):
        assert significant(trial) <= 0.1

    def test_what_cannot_be_tested_is_said(self):
        rng = rng_of(0)
        drifts = np.linspace(-2, 2, 300)[:, None] * rng.choice([-1, 1], size=3)
        event = np.arange(300) >= rng.integers(75, 225)
        found = association(drifts + rng.normal(size=(300, 3)), event, **FEW)
        assert "one event" in found.untested
        assert np.isnan(found.p_value).all()
        assert np.isfinite(found.statistic).all()

    def test_joined_clips_need_groups(self):
        alpha, y, clip = joined_clips(rng_of(0))
        found = association(alpha, y, **FEW)
        assert re.search(r"jump \d times.*Give the clips as groups", found.untested)
        grouped = association(alpha, y, clip, **FEW)
        assert (grouped.permuted, grouped.untested) == ("groups", "")
        # An effect at each change of the label is no seam.
        found = association(*video(2, n=400, effect=5.0), **FEW)
        assert found.p_value[1] < 0.05

    def test_copies_of_a_frame_count_once(self, rng):
        alpha, y = related()
        copies = rng.permutation(np.repeat(np.arange(120), 4))
        found = association(alpha[copies], y[copies], **FEW)
        assert found.n_frames == 120
        expected = association(alpha, y, **FEW)
        assert_allclose(found.statistic, expected.statistic)
        assert_allclose(found.p_value, expected.p_value, atol=0.06)

    @pytest.mark.parametrize(
        "trial", [partial(video, n=400, effect=2.0), partial(people, effect=1.0)]
    )
    def test_real_effects_are_found(self, trial):
        assert significant(trial, 6) > 0.8

    def test_blocks_follow_time(self):
        alpha, y = video(0)
        expected = association(alpha, y, **FEW)
        assert expected.permuted == "frequencies"
        mixed = rng_of(0).permutation(len(y))
        found = association(alpha[mixed], y[mixed], time=mixed / 25, **FEW)
        assert found.permuted == expected.permuted
        assert_allclose(found.p_value, expected.p_value)

    def test_photos_sorted_by_label_are_independent_frames(self):
        alpha, y = related(effect=1.0)
        order = np.argsort(y, kind="stable")
        found = association(alpha[order], y[order], **FEW)
        assert found.permuted == "frames"
        assert found.p_value[1] == 0.005

    def test_frames_without_coefficients_are_left_out_and_counted(self):
        alpha, y = related()
        expected = association(alpha[10:], y[10:], **FEW)
        alpha[:10] = np.nan
        found = association(alpha, y, **FEW)
        assert found.n_frames == len(y) - 10
        assert_array_equal(found.statistic, expected.statistic)
        assert_array_equal(found.p_value, expected.p_value)

    def test_p_values_step_down(self):
        alpha, y = rng_of(4).normal(size=(60, 6)), np.arange(60) % 2
        given = FEW | {"n_permutations": 499}
        found = association(alpha, y, **given)
        each = (association(a[:, None], y, **given) for a in alpha.T)
        alone = np.array([single.p_value[0] for single in each])
        order = np.argsort(-found.statistic)
        p, alone = found.p_value[order], alone[order]
        assert np.all(np.diff(p) >= 0)
        # That of the strongest of so many is larger than its own, the weakest has its.
        assert np.all(p >= alone)
        assert p[0] == pytest.approx(1 - (1 - alone[0]) ** 6, rel=0.25)
        assert p[-1] == max(alone[-1], p[-2])

    def test_table(self):
        found = association(*related(), **FEW)
        frame = found.to_frame()
        assert list(frame.columns) == ["eta_squared", "p_value"]
        assert list(frame.index) == [1, 2, 3]
        assert_array_equal(frame["p_value"], found.p_value)
        head, *rows, meaning = str(found).splitlines()
        assert head.split() == ["eta", "squared", "p"]
        names, _, shown = zip(*(row.split() for row in rows), strict=True)
        assert names == ("alpha_1", "alpha_2", "alpha_3")
        assert_allclose(np.float64(shown), found.p_value, atol=5e-4)
        assert meaning.endswith("p-values: permutations of frames; 120 frames")
        untested = str(found._replace(untested="one group", kind="number"))
        assert "rank correlation" in untested
        assert "no p-values: one group; 120 frames" in untested


class TestPredictability:
    def test_accuracy_of_classes_and_r_squared_of_numbers(self):
        alpha, y = related(effect=8.0)
        scores = predictability(alpha, y, random_state=0)
        assert len(scores) == 5
        assert scores.mean() > 0.98
        assert predictability(alpha[:, :1], y, random_state=0).mean() < 0.7
        numbers = alpha @ [1.0, 2.0, 3.0]
        assert predictability(alpha, numbers, random_state=0).min() > 0.99

    def test_groups_stay_together(self, rng):
        # Each person has coefficients of one's own that tell the label, and no other's.
        person = np.repeat(np.arange(12), 10)
        y = (np.arange(12) % 2)[person]
        alpha = 10.0 * rng.normal(size=(12, 8))[person] + rng.normal(size=(120, 8))
        alpha, y, person = shuffle(alpha, y, person, random_state=0)
        alone = predictability(alpha, y, random_state=0).mean()
        grouped = predictability(alpha, y, person, random_state=0).mean()
        assert alone > grouped + 0.15

    def test_blocks_of_a_video_stay_together(self):
        # Neighbours of a frame give its class away, though nothing goes with classes.
        alpha, y = video(3, n=400, memory=0.97, n_classes=3)
        mixed = rng_of(0).permutation(400)
        alone = predictability(alpha[mixed], y[mixed], random_state=0).mean()
        found = predictability(alpha, y, random_state=0).mean()
        assert alone > found + 0.15
        timed = predictability(alpha[mixed], y[mixed], time=mixed, random_state=0)
        assert timed.mean() == pytest.approx(found, abs=0.05)


class TestWithinGroups:
    alpha = rng_of(0).normal(size=(30, 2))
    people = np.repeat(["a", "b", "c"], 10)

    def test_groups_of_the_fit_keep_their_means_and_new_ones_have_their_own(self):
        step = WithinGroups().fit(self.alpha, groups=self.people)
        rows = [[1.0, 2.0], [3.0, 2.0], [1.0, 2.0]]
        got = step.transform(rows, groups=["x", "x", "b"])
        assert_allclose(got[:2], [[-1, 0], [1, 0]])
        assert_allclose(got[2], [1, 2] - self.alpha[10:20].mean(axis=0))

    def test_means_are_those_of_neutral_frames_with_coefficients(self):
        alpha, neutral = self.alpha.copy(), np.arange(30) % 10 < 4
        alpha[3] = np.nan
        given = {"groups": self.people, "neutral": neutral}
        got = WithinGroups().fit_transform(alpha, **given)
        assert_array_equal(np.isnan(got), np.isnan(alpha))
        for person in "abc":
            means = np.nanmean(got[(self.people == person) & neutral], axis=0)
            assert_allclose(means, 0, atol=1e-15)

    def test_in_a_pipeline(self):
        requests, step = {"groups": True, "neutral": False}, WithinGroups()
        with sklearn.config_context(enable_metadata_routing=True):
            step.set_fit_request(**requests).set_transform_request(**requests)
            got = make_pipeline(step).fit_transform(self.alpha, groups=self.people)
        expected = WithinGroups().fit_transform(self.alpha, groups=self.people)
        assert_allclose(got, expected)


def test_share_between_groups_of_a_random_effects_model(rng):
    person = np.repeat(np.arange(400), rng.integers(2, 12, 400))
    share = np.array([0.0, 0.3, 0.9, 1.0])
    alpha = np.sqrt(share) * rng.normal(size=(400, 4))[person]
    alpha += np.sqrt(1 - share) * rng.normal(size=(len(person), 4))
    found = between_share(alpha, person)
    assert_allclose(found.between, share, atol=0.05)
    assert_allclose(found.within, 1 - found.between)
    assert (found.n_groups, found.n_frames) == (400, len(person))


def test_position_size_and_turn_of_frames_are_taken_away(rng):
    shape = rng.normal(size=20) + 1j * rng.normal(size=20)
    frames = rng.uniform(1, 5, (9, 1)) * np.exp(1j * rng.normal(size=(9, 1))) * shape
    frames = np.ascontiguousarray(frames + rng.normal(size=(9, 1)))
    points = AlignedFrames().fit_transform(frames.view(float)).view(complex)
    assert_allclose(points, points[:1].repeat(9, axis=0), atol=1e-9)
    assert_allclose(points.mean(axis=1), 0, atol=1e-12)
    assert_allclose(np.mean(np.abs(points) ** 2, axis=1), 1)


test_refusals = refusals_of("analysis", globals())
