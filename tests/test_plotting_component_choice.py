import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.plotting import ComponentChoiceDisplay

SCORES = np.array([[-0.020, -0.030, -0.025], [-0.002, -0.003, -0.004]])


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def bars(display):
    """Return the lower and upper ends of the error bars (n_candidates, 2)."""
    segments = display.errorbar_.lines[2][0].get_segments()
    return np.array([segment[:, 1] for segment in segments])


def test_errors_in_percent_with_standard_errors():
    display = ComponentChoiceDisplay(n_components=[2, 4], scores=SCORES, chosen=4)
    display.plot()
    curve = display.errorbar_.lines[0]
    assert_array_equal(curve.get_xdata(), [2, 4])
    assert_allclose(curve.get_ydata(), [2.5, 0.3])
    # Deviations of 0.5 and 0.1 %, of three parts each
    mean, half = np.array([[2.5], [0.3]]), np.array([[0.5], [0.1]]) / np.sqrt(3)
    assert_allclose(bars(display), mean + half * [-1, 1])
    assert display.ax_.get_yscale() == "log"
    assert_allclose(display.chosen_.get_xydata(), [[4, 0.3]])


def test_other_scores_are_drawn_as_they_are():
    display = ComponentChoiceDisplay(
        n_components=[2, 4], scores=SCORES[:, :1], held_out_error=False
    ).plot(errorbar_kw={"color": "red"})
    assert_allclose(display.errorbar_.lines[0].get_ydata(), SCORES[:, 0])
    assert display.errorbar_.lines[0].get_color() == "red"
    assert display.ax_.get_yscale() == "linear"
    assert display.chosen_ is None
    # One part has no standard error.
    assert not display.errorbar_.has_yerr


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_a_fitted_search_is_drawn():
    X = make_nonrigid_tracks(60, 20, 2, noise=0.01, random_state=0).data
    estimator = AffineNRSfM(refinement=None, random_state=0)
    search = AffineNRSfMCV((3, 1, 2), estimator=estimator).fit(X)
    _, ax = plt.subplots()
    display = ComponentChoiceDisplay.from_estimator(search, ax=ax)
    assert display.ax_ is ax
    assert display.scores.shape == (3, 3)
    mean = -100 * search.cv_results_["mean_test_score"]
    assert_allclose(display.errorbar_.lines[0].get_ydata(), mean)
    assert display.chosen == search.n_components_
    with pytest.raises(NotFittedError):
        ComponentChoiceDisplay.from_estimator(AffineNRSfMCV())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"scores": SCORES[0]}, "one row for each of n_components"),
        ({"n_components": [1, 2, 3]}, "one row for each of n_components"),
        ({"chosen": 3}, "chosen must be one of n_components"),
    ],
)
def test_what_does_not_go_together_is_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        ComponentChoiceDisplay(**({"n_components": [2, 4], "scores": SCORES} | changed))
