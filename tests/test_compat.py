"""Where warnings point to."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks


@pytest.mark.parametrize(("n_jobs", "piped"), [(None, True), (2, False)])
def test_warnings_point_to_the_line_of_the_user(n_jobs, piped):
    model = AffineNRSfM(1, refinement=None, n_jobs=n_jobs, random_state=0)
    if piped:
        model = make_pipeline(FunctionTransformer(), model)
    X = make_face_tracks(n_frames=40, n_components=1, random_state=0).data
    X[3, 4] = np.nan  # a point has only one of its coordinates
    for method in (model.fit, model.fit_transform, model.transform, model.score):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            method(X)
        about = [each for each in caught if "only one of" in str(each.message)]
        assert {Path(each.filename) for each in about} == {Path(__file__)}
