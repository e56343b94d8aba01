"""A fitted estimator as a dict of plain values under public names, and back.

The dict is what a model file holds. Its names and shapes are those of a version of the
format: a change of them is a new version, and `model_from_contents` goes on reading the
older ones. All that model files know of the private parts of `AffineNRSfM` is here.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm import __version__
from isa_nrsfm._compat.callbacks import without_callbacks
from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.basis_change import FrameMap
from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._frames.depth import NOT_MEASURED, DepthCertainty
from isa_nrsfm._frames.models import PosteriorFrames, RigidFrames
from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm._tables.layout import LAYOUTS
from isa_nrsfm.io._model_promises import check_promises
from isa_nrsfm.io._model_values import (
    N_FEATURES,
    N_OUT,
    PUBLIC_PARTS,
    plain_parts,
    restored_strategy,
    with_parameters,
)
from isa_nrsfm.io._value_checks import (
    check_array,
    check_choice,
    check_entries,
    check_flag,
    check_names,
    check_number,
    check_whole,
    kind_of,
)

FORMAT, FORMAT_VERSION = "isa_nrsfm model", 1
HEAD = ("format", "format_version", "package_version")
# Attributes of every model, of those of the joint refinement, and of those that keep
# the frames: all, those of the joint refinement, those with calibrated cameras.
OF_ALL = (
    "mean_shape_",
    "basis_",
    "inverse_snr_",
    "rank_floor_",
    "energy_share_",
    "mode_covariance_",
    "singular_values_",
    "reference_motion_",
    "reference_translation_",
    "isa_",
    "n_iter_",
    N_FEATURES,
)
OF_JOINT = ("noise_variance_", "reliability_", "objective_history_", "gradient_norm_")
OF_FRAMES = ("motion_", "translation_", "alpha_")
OF_JOINT_FRAMES = ("alpha_std_",)
OF_CALIBRATED_FRAMES = ("rotations_", "scales_")
# Older fits did not measure the ratio, or the uncertainty of the depth.
NAMES, RATIO, DEPTH = "feature_names_in_", "camera_noise_ratio_", "depth_uncertainty_"
ATTRIBUTES = (
    *OF_ALL,
    *OF_JOINT,
    *OF_FRAMES,
    *OF_JOINT_FRAMES,
    *OF_CALIBRATED_FRAMES,
    NAMES,
    RATIO,
    DEPTH,
)
# Entries of the model of a table, and of that of a frame.
OF_TABLE = ("model", "layout", "each_scaled", "unit", "sizes")
OF_POSTERIOR = (
    "camera",
    "loss",
    "shapes",
    "noise_variance",
    "coefficient_starts",
    "basis_change",
    "certainty",
    "turns",
)
OF_RIGID = ("camera", "mean_shape", "basis")
MODELS = {"posterior": OF_POSTERIOR, "rigid": OF_RIGID}
# What the estimator holds besides: the fitted model of tables, the one size of all
# frames, those of the kept ones, and what follows from the model.
MODEL, UNIT, SIZES = "_model", "_unit", "_frame_sizes"
CAMERA, SCALED = "camera_", "frames_scaled_"


def model_contents(estimator: Any) -> dict[str, Any]:
    """
    Return all that a fitted estimator is, as plain values.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted estimator. Its callbacks are left out.

    Returns
    -------
    dict
        None, numbers, texts, lists and dicts of these, and numpy arrays.

    Raises
    ------
    ValueError
        If the estimator is of another class, is not fitted, or holds something that is
        not part of a model.
    """
    if type(estimator) is not AffineNRSfM:
        raise ValueError(
            f"the estimator should be an AffineNRSfM; got {kind_of(estimator)}, which "
            "is not part of a model"
        )
    check_is_fitted(estimator)
    held = vars(without_callbacks(estimator))
    private = (MODEL, UNIT, SIZES, CAMERA, SCALED)
    model = held[MODEL]
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        **plain_parts(estimator, ATTRIBUTES, private, held, "the estimator"),
        "frames": {
            **_plain_frames(model.frames),
            "layout": model.layout,
            "each_scaled": model.unit is None,
            "unit": held[UNIT],
            "sizes": held.get(SIZES),
        },
    }


def model_from_contents(contents: Any) -> AffineNRSfM:
    """
    Return the fitted estimator that plain values describe.

    Parameters
    ----------
    contents : object
        What `model_contents` returns. It is checked.

    Returns
    -------
    AffineNRSfM
        The estimator.

    Raises
    ------
    ValueError
        If an entry is missing, is not known, or does not fit; it is named.
    """
    _check_head(contents)
    check_entries(contents, "the model", (*HEAD, *PUBLIC_PARTS, "frames"))
    estimator = with_parameters(AffineNRSfM, contents)
    found = contents["attributes"]
    if type(found) is dict:
        found = {DEPTH: None, **found}
    check_entries(found, "attributes", ATTRIBUTES)
    K, P, _ = check_array(found["basis_"], "basis_", (None, None, 3)).shape
    if not K or not P:
        raise ValueError(f"basis_ should have shapes and points; got {(K, P, 3)}")
    frames, unit, sizes = _restored_frames(contents["frames"], K, P)
    each_scaled = check_flag(contents["frames"]["each_scaled"], "each_scaled of frames")
    layout = check_choice(contents["frames"]["layout"], "layout of frames", LAYOUTS)
    expected = _expected(frames, sizes is not None)
    joint = isinstance(frames, PosteriorFrames)
    optional = (NAMES, RATIO, DEPTH) if joint else (NAMES,)
    for name, value in found.items():
        if value is None and name in expected:
            raise ValueError(f"attributes should have {name}; got None")
        if value is not None and name not in {*expected, *optional}:
            raise ValueError(f"{name} should be None in such a model; got a value")
    checks = _checks(K, P, None if sizes is None else len(sizes))
    for name, value in found.items():
        if value is not None:
            setattr(estimator, name, checks[name](value, name))
    check_promises(found, frames, sizes)
    model = TableModel(
        frames,
        estimator.mean_shape_,
        estimator.basis_,
        layout,
        found[NAMES],
        None if each_scaled else unit,
    )
    setattr(estimator, MODEL, model)
    setattr(estimator, UNIT, unit)
    setattr(estimator, CAMERA, frames.camera)
    setattr(estimator, SCALED, each_scaled)
    setattr(estimator, N_OUT, K)
    if sizes is not None:
        setattr(estimator, SIZES, sizes)
    return estimator


def _check_head(contents: Any) -> None:
    """Raise if the contents are not those of a model of this version."""
    if type(contents) is not dict or contents.get("format") != FORMAT:
        raise ValueError(
            f"it should hold a dict with format {FORMAT!r}; got {kind_of(contents)}"
        )
    check_entries({name: contents.get(name) for name in HEAD}, "the model", HEAD)
    version = check_whole(contents.get("format_version"), "format_version", least=1)
    if version > FORMAT_VERSION:
        raise ValueError(
            f"written by a newer isa_nrsfm (format {version}); this one reads up to "
            f"{FORMAT_VERSION}"
        )
    if type(contents.get("package_version")) is not str:
        got = kind_of(contents.get("package_version"))
        raise ValueError(f"package_version should be text; got {got}")


def _expected(frames: RigidFrames | PosteriorFrames, kept: bool) -> set[str]:
    """Return the attributes that a model has."""
    joint = isinstance(frames, PosteriorFrames)
    return {
        *OF_ALL,
        *(OF_JOINT if joint else ()),
        *(OF_FRAMES if kept else ()),
        *(OF_JOINT_FRAMES if kept and joint else ()),
        *(OF_CALIBRATED_FRAMES if kept and frames.camera != "affine" else ()),
    }


def _checks(K: int, P: int, N: int | None) -> dict[str, Callable[[Any, str], Any]]:
    """Return what checks the attributes of K basis shapes, P points and N frames."""

    def array(*shape: int | None, kind: str = "float") -> Callable[[Any, str], Any]:
        return lambda value, name: check_array(value, name, shape, kind=kind)

    return {
        "mean_shape_": array(P, 3, kind="finite"),
        "basis_": array(K, P, 3, kind="finite"),
        "inverse_snr_": check_number,
        "rank_floor_": check_number,
        "energy_share_": array(K),
        "mode_covariance_": array(3 * K, 3 * K),
        "singular_values_": array(3 * K + 3),
        "reference_motion_": array(2, 3, kind="finite"),
        "reference_translation_": array(2, kind="finite"),
        "isa_": _fitted_strategy,
        "n_iter_": check_whole,
        N_FEATURES: lambda a, w: check_whole(a, w, least=2 * P, most=2 * P),
        "noise_variance_": check_number,
        RATIO: check_number,
        DEPTH: check_number,
        "reliability_": array(K),
        "objective_history_": array(None),
        "gradient_norm_": check_number,
        "motion_": array(N, 2, 3),
        "translation_": array(N, 2),
        "alpha_": array(N, K),
        "alpha_std_": array(N, K),
        "rotations_": array(N, 3, 3),
        "scales_": array(N),
        NAMES: lambda value, name: check_names(value, name, 2 * P),
    }


def _fitted_strategy(value: Any, where: str) -> Any:
    """Return the fitted strategy that a plain value stands for."""
    strategy = restored_strategy(value, where)
    if not hasattr(strategy, "components_"):
        raise ValueError(f"{where} should be a fitted strategy; got {strategy!r}")
    return strategy


def _plain_frames(frames: RigidFrames | PosteriorFrames) -> dict[str, Any]:
    """Return the model of a frame as plain values."""
    if isinstance(frames, RigidFrames):
        return {
            "model": "rigid",
            "camera": frames.camera,
            "mean_shape": frames.mean_shape,
            "basis": frames.basis,
        }
    return {
        "model": "posterior",
        "camera": frames.camera,
        "loss": frames.loss,
        "shapes": frames.shapes,
        "noise_variance": frames.noise_variance,
        "coefficient_starts": frames.starts,
        "basis_change": {"mixing": frames.gauge.mixing, "space": frames.gauge.space},
        "certainty": np.array(frames.certainty[:-1]),
        "turns": frames.certainty.turns,
    }


def _restored_frames(
    contents: Any, K: int, P: int
) -> tuple[RigidFrames | PosteriorFrames, float, np.ndarray | None]:
    """Return the model of a frame, the size of frames and those of the kept ones."""
    if type(contents) is not dict:
        raise ValueError(f"frames should be a dict; got {kind_of(contents)}")
    model = check_choice(contents.get("model"), "model of frames", MODELS)
    if model == "posterior":
        unknown = np.array(NOT_MEASURED[:-1])
        contents = {"certainty": unknown, "turns": None, **contents}
    check_entries(contents, "frames", (*OF_TABLE, *MODELS[model]))
    unit = check_number(contents["unit"], "unit of frames", positive=True)
    sizes = contents["sizes"]
    if sizes is not None:
        sizes = check_array(sizes, "sizes of frames", (None,))
    camera = check_choice(contents["camera"], "camera of frames", CAMERAS)

    def array(name: str, *shape: int | None) -> np.ndarray:
        return check_array(contents[name], f"{name} of frames", shape, kind="finite")

    if model == "rigid":
        rigid = RigidFrames(array("mean_shape", P, 3), array("basis", K, P, 3), camera)
        return rigid, unit, sizes
    change = contents["basis_change"]
    check_entries(change, "basis_change of frames", ("mixing", "space"))
    shape = (K + 1, K + 1)
    mixing = check_array(change["mixing"], "mixing of frames", shape, kind="finite")
    space = check_array(change["space"], "space of frames", (3, 3), kind="finite")
    noise = contents["noise_variance"]
    certainty = check_array(
        contents["certainty"], "certainty of frames", (len(NOT_MEASURED) - 1,)
    )
    turns = None if contents["turns"] is None else array("turns", K, 3, K, 3)
    posterior = PosteriorFrames(
        shapes=array("shapes", K + 1, 3, P),
        noise_variance=check_number(noise, "noise_variance of frames", positive=True),
        starts=array("coefficient_starts", None, K),
        loss=check_choice(contents["loss"], "loss of frames", LOSSES),
        gauge=FrameMap(mixing, space),
        camera=camera,
        certainty=DepthCertainty(*certainty.tolist())._replace(turns=turns),
    )
    return posterior, unit, sizes
