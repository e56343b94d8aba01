"""scikit-learn's checks for estimators, with tables of landmarks."""

import re

import numpy as np
from sklearn.utils.estimator_checks import check_estimator

N_POINTS = 16

# Checks that scikit-learn runs on its own estimators but `check_estimator` does not.
EXTRA_CHECKS = (
    "check_dataframe_column_names_consistency check_get_feature_names_out_error "
    "check_global_output_transform_pandas check_global_set_output_transform_polars "
    "check_inplace_ensure_writeable check_param_validation check_set_output_transform "
    "check_set_output_transform_pandas check_set_output_transform_polars "
    "check_transformer_get_feature_names_out "
    "check_transformer_get_feature_names_out_pandas"
).split()


def widen(estimator, X, X_test=None, kernel=None):
    """Map the rows of a table of any width to views of 16 points that deform."""
    if X_test is not None:
        return widen(estimator, X), widen(estimator, X_test)
    rng = np.random.RandomState(0)
    points = rng.standard_normal((N_POINTS, 3))
    to_camera = rng.standard_normal((X.shape[1], 2, 3))
    to_deformation = rng.standard_normal((X.shape[1], 2 * N_POINTS))
    with np.errstate(invalid="ignore"):  # one check has infinite values
        cameras = np.eye(2, 3) + np.tensordot(X, to_camera, 1)
        rigid = (points @ cameras.transpose(0, 2, 1)).reshape(len(X), -1)
        wide = rigid + 0.2 * np.sin(X @ to_deformation + np.arange(2 * N_POINTS))
    return wide.astype(X.dtype if X.dtype.kind == "f" else np.float64)


def assert_only_narrow_tables_fail(estimator):
    """Assert that checks fail on their own tables only because these are refused."""
    results = check_estimator(estimator, on_fail=None, on_skip=None)
    errors = [each["exception"] for each in results if each["status"] == "failed"]
    assert len(errors) > 20
    for error in errors:
        while not isinstance(error, ValueError):
            error = error.__cause__ or error.__context__
        assert re.search("an even number; got|at least 7 points", str(error))
