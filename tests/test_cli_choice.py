"""The number of basis shapes by frames that were not fitted, part by part."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.cli._choice import N_PARTS, choice_report, choose_n_components
from isa_nrsfm.datasets import make_nonrigid_tracks

X = pd.DataFrame(make_nonrigid_tracks(48, 14, 2, noise=0.01, random_state=0).data)


def estimator():
    return AffineNRSfM(1, isa=FastISA(n_init=2), refinement=None, random_state=0)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_errors_are_those_of_blocks_of_rows():
    search = choose_n_components(estimator(), X, [1, 2, 3])
    found = choice_report(search, X)
    expected = []
    for n_components in (1, 2, 3):
        errors = []
        for part in np.split(np.arange(48), N_PARTS):
            model = clone(estimator()).set_params(n_components=n_components)
            model.fit(X.drop(index=part))
            errors.append(-model.score(X.iloc[part]))
        expected.append(errors)
    np.testing.assert_allclose(found["held_out_error_of_parts"], expected)
    np.testing.assert_allclose(found["held_out_error"], np.mean(expected, axis=1))
    assert found["n_components"] == [1, 2, 3]
    best = 1 + int(np.argmin(np.mean(expected, axis=1)))
    assert found["chosen"] == len(search.best_estimator_.basis_) == best


def test_too_few_frames_are_said_to_be_those_of_parts():
    with pytest.raises(ValueError, match="tried on 2 of 3 parts of the frames; there"):
        choose_n_components(estimator(), X[:9], [1, 2, 3])
