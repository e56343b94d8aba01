"""scikit-learn's checks for estimators of landmark tables: what feeds what."""

import numpy as np
from sklearn.utils.estimator_checks import check_estimator

N_POINTS = 16

ODD = "feeds an odd number of columns, which cannot be landmarks"
FEW_POINTS = "feeds fewer points than one basis shape needs"
NARROW_TABLE_CHECKS = {
    "check_array_api_input": FEW_POINTS,
    "check_dict_unchanged": ODD,
    "check_dont_overwrite_parameters": ODD,
    "check_dtype_object": FEW_POINTS,
    "check_estimators_dtypes": ODD,
    "check_estimators_fit_returns_self": FEW_POINTS,
    "check_estimators_nan_inf": ODD,
    "check_estimators_overwrite_params": FEW_POINTS,
    "check_estimators_pickle": ODD,
    "check_f_contiguous_array_estimator": ODD,
    "check_fit2d_predict1d": ODD,
    "check_fit_check_is_fitted": FEW_POINTS,
    "check_fit_idempotent": FEW_POINTS,
    "check_fit_score_takes_y": ODD,
    "check_methods_sample_order_invariance": ODD,
    "check_methods_subset_invariance": ODD,
    "check_n_features_in": FEW_POINTS,
    "check_n_features_in_after_fitting": FEW_POINTS,
    "check_pipeline_consistency": ODD,
    "check_positive_only_tag_during_fit": FEW_POINTS,
    "check_readonly_memmap_input": FEW_POINTS,
    "check_transformer_data_not_an_array": ODD,
    "check_transformer_general": ODD,
    "check_transformer_n_iter": ODD,
    "check_transformer_preserve_dtypes": ODD,
}

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


def assert_only_narrow_tables_fail(estimator, expected):
    """Assert which checks fail on their own tables, each because it is refused."""
    results = check_estimator(estimator, on_fail=None, on_skip=None)
    failed = [result for result in results if result["status"] == "failed"]
    names = {result["check_name"] for result in failed}
    skipped = {r["check_name"] for r in results if r["status"] == "skipped"}
    generated = {result["check_name"] for result in results}
    assert names == (set(expected) & generated) - skipped
    for result in failed:
        error = result["exception"]
        while not isinstance(error, ValueError):
            error = error.__cause__ or error.__context__
        messages = {ODD: "an even number; got", FEW_POINTS: "at least 7 points"}
        assert messages[expected[result["check_name"]]] in str(error)
