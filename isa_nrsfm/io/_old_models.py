"""Model files of format 0: the estimator itself, as skops writes objects.

Such a file names private classes and attributes of its time, which this module takes to
the names of format 1. The modules of the classes do not matter.
"""

from typing import Any

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm.io._model_contents import ATTRIBUTES, FORMAT
from isa_nrsfm.io._model_values import CLASSES
from isa_nrsfm.io._skops_values import NamedValue
from isa_nrsfm.io._value_checks import check_entries, kind_of


def is_old_model(values: Any) -> bool:
    """Tell whether what a file holds is an object, and not a dict."""
    return isinstance(values, NamedValue)


def contents_of_old(values: NamedValue) -> dict[str, Any]:
    """
    Return the contents, in format 1, of a file of format 0.

    Parameters
    ----------
    values : NamedValue
        What the file holds.

    Returns
    -------
    dict
        The contents, which `model_from_contents` checks.

    Raises
    ------
    ValueError
        If it is no fitted AffineNRSfM.

    Warns
    -----
    UserWarning
        If the model was fitted with a stiffness, a parameter that there is no more.
    """
    if values.name != "AffineNRSfM":
        raise ValueError(f"it should hold an AffineNRSfM; got {values.name}")
    held = dict(_attributes_of(values))
    if "_frames" not in held:
        raise ValueError("it should hold a fitted estimator; got one that is not")
    unit, sizes = held.pop("_unit", None), held.pop("_frame_sizes", None)
    frames = _frames(held.pop("_frames"))
    stiffness = held.pop("stiffness", None), held.pop("stiffness_", None)
    if any(stiffness):
        warn_caller(
            f"the model was fitted with stiffness={stiffness[1]}, a parameter that "
            "there is no more: a new fit will be another one"
        )
    parts = _parts(held, ATTRIBUTES)
    parts["parameters"].setdefault("camera", "affine")
    return {
        "format": FORMAT,
        "format_version": 1,
        "package_version": "0.1.0",
        **parts,
        "frames": {
            **frames,
            "layout": parts["parameters"].get("layout"),
            # The parameters at the time of saving: the fit did not keep its own.
            "each_scaled": parts["parameters"].get("scale_frames")
            and frames["camera"] != "orthographic",
            "unit": unit,
            "sizes": sizes,
        },
    }


def _attributes_of(values: NamedValue) -> dict[str, Any]:
    """Return what an object held."""
    if type(values.content) is not dict:
        raise ValueError(
            f"{values.name} should hold attributes; got {kind_of(values.content)}"
        )
    return values.content


def _parts(held: dict[str, Any], attributes: tuple[str, ...]) -> dict[str, Any]:
    """Return parameters, fitted attributes and output from what an estimator held."""
    held = {name: _plain(value) for name, value in held.items()}
    held.pop("_n_features_out", None)
    output = held.pop("_sklearn_output_config", {"transform": None})
    fitted = {name: held.pop(name) for name in [*held] if name.endswith("_")}
    return {
        "parameters": held,
        "attributes": dict.fromkeys(attributes) | fitted if fitted else None,
        "set_output": check_entries(output, "output", ("transform",))["transform"],
    }


def _plain(value: Any) -> Any:
    """Return what format 1 has in place of an object of format 0."""
    if not isinstance(value, NamedValue):
        return value
    if value.name == "RandomState":
        return {"class": value.name, "state": value.content}
    if value.name in CLASSES:
        held = _attributes_of(value)
        return {"class": value.name, **_parts(held, CLASSES[value.name][1])}
    raise ValueError(f"it contains objects that are not part of a model: {value.name}")


def _frames(frames: Any) -> dict[str, Any]:
    """Return the model of a frame."""
    match frames:
        case NamedValue("RigidFrames", (mean_shape, basis, *camera)):
            found = {"model": "rigid", "mean_shape": mean_shape, "basis": basis}
        case NamedValue(
            "PosteriorFrames",
            (
                shapes,
                noise_variance,
                starts,
                loss,
                NamedValue("FrameMap", (mixing, space)),
                *camera,
            ),
        ):
            found = {
                "model": "posterior",
                "shapes": shapes,
                "noise_variance": noise_variance,
                "coefficient_starts": starts,
                "loss": loss,
                "basis_change": {"mixing": mixing, "space": space},
            }
        case _:
            name = frames.name if isinstance(frames, NamedValue) else kind_of(frames)
            raise ValueError(f"it has a model of frames that is not known: {name}")
    if len(camera) > 1:
        raise ValueError("the model of frames has fields that are not known")
    return {**found, "camera": camera[0] if camera else "affine"}
