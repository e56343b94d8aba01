"""The number of basis shapes by frames that were not fitted, part by part."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli._choice import choice_report, choose_n_components, extrapolated
from isa_nrsfm.cli._report import _choice_lines
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.plotting import ComponentChoiceDisplay

X = pd.DataFrame(make_nonrigid_tracks(48, 20, 2, noise=0.01, random_state=0).data)


@pytest.fixture(scope="module")
def estimator():
    return AffineNRSfM(refinement=None, random_state=0)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_report_has_what_the_search_found(estimator, capsys):
    search = choose_n_components(estimator, X, [1, 2, 3])
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 3
    report = choice_report(search, X)
    assert report["n_components"] == [1, 2, 3]
    parts = report["held_out_error_of_parts"]
    assert parts.shape == (3, 3)
    assert_allclose(report["held_out_error"], parts.mean(axis=1))
    error = report["held_out_error_standard_error"]
    assert_allclose(error, parts.std(axis=1, ddof=1) / np.sqrt(3))
    # As in the figure.
    figure = ComponentChoiceDisplay.from_estimator(search)
    (bars,) = figure.errorbar_.lines[2]
    ends = np.array([bar[:, 1] for bar in bars.get_segments()])
    assert_allclose(np.diff(ends)[:, 0], 200 * error)
    assert all(", standard error " in line for line in told.err.splitlines())
    best = 1 + int(np.argmin(parts.mean(axis=1)))
    assert report["chosen"] == search.n_components_ == best
    assert (report["seconds"] > 0).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_what_comes_next_is_what_the_table_allows(estimator):
    search = choose_n_components(estimator, X, [1, 2])
    assert search.n_components_ == 2
    following = choice_report(search, X)["next"]
    assert following["n_components"] == [3, 4, 5]  # 20 points allow no more
    assert following["seconds"] > 0
    few = X.iloc[:, :28]
    search = choose_n_components(estimator, few, [3])
    assert "next" not in choice_report(search, few)  # 14 points allow three


def test_numbers_of_the_choice_have_no_point_at_the_end():
    choice = {
        "n_components": [1, 2],
        "held_out_error": [1.23, 0.05],
        "held_out_error_standard_error": [0.12, 0.003],
        "chosen": 2,
        "next": {"n_components": [3], "seconds": 10.0},
    }
    lines = _choice_lines(choice)
    assert lines[0].endswith("+- standard error")
    assert lines[1:3] == ["  1   123 +- 12 %", "  2   5.00 +- 0.30 %, the least"]
    assert lines[-1] == "to try K = 3, too, would take about 10 s"


def test_errors_above_the_centroid_are_told_in_words():
    choice = {"n_components": [1, 2], "chosen": 2}
    choice["held_out_error_standard_error"] = [0, 0]
    good = "\n".join(_choice_lines(choice | {"held_out_error": [1.2, 0.9]}))
    assert "larger K may be better" in good
    bad = "\n".join(_choice_lines(choice | {"held_out_error": [1.2, 1.1]}))
    assert "larger K" not in bad
    assert "no number of basis shapes predicts held-out points" in bad


def test_seconds_go_on_along_a_line():
    tried = np.array([1, 2, 3, 4])
    # The first one, which searches for starts, does not count.
    seconds = np.array([9.0, 1.0, 1.5, 2.0])
    assert_allclose(extrapolated(tried, seconds, np.array([5, 6])), [2.5, 3.0])
    # Larger numbers do not take less.
    assert_allclose(extrapolated(tried, 5.0 - tried, np.array([5])), [1.0])
    assert_allclose(extrapolated(tried[:1], seconds[:1], np.array([2, 3])), [9.0, 9.0])
