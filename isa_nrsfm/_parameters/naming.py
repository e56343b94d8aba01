"""Parameters in messages, as the user writes them; what settings need of others."""

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from typing import Any

from isa_nrsfm._parameters.choices import CAMERA_NAMES, JOINT_REFINEMENTS, LOSSES


def in_python(name: str, *values: Any) -> str:
    """Return a parameter, and its values if there are any, as an argument of Python."""
    return f"{name}={' or '.join(map(repr, values))}" if values else name


# The command line sets its own way for the time of a command.
WRITTEN: ContextVar[Callable[..., str]] = ContextVar("WRITTEN", default=in_python)


def named(name: str, *values: Any) -> str:
    """
    Return a parameter, and its values if there are any, as the user writes it.

    >>> from isa_nrsfm._parameters.naming import named
    >>> named("columns"), named("camera", "affine")
    ('columns', "camera='affine'")
    """
    return WRITTEN.get()(name, *values)


_JOINT, _CALIBRATED = ("refinement", JOINT_REFINEMENTS), ("camera", CAMERA_NAMES[1:])
# Settings (of no values: any but None and False), the setting that they need, its
# values, and why.
REQUIREMENTS: tuple[tuple[str, tuple[str, ...], str, tuple[str, ...], str], ...] = (
    ("n_components", ("auto",), *_JOINT, ""),
    ("loss", LOSSES[1:], *_JOINT, ""),
    ("independence", ("coefficients",), *_JOINT, ""),
    ("std", (), *_JOINT, ""),
    ("camera", ("perspective",), *_JOINT, "whose fits find the depths of the points"),
    ("refinement", ("consensus",), *_CALIBRATED, "which give depths a common unit"),
    ("remove_pose", (), *_CALIBRATED, "which have a yaw"),
    ("focal_length", (), *_CALIBRATED, "which have axes"),
    ("principal_point", (), *_CALIBRATED, "which have axes"),
    ("prior", (), *_CALIBRATED, "whose depths are those of the prior"),
    ("prior", (), "refinement", ("joint",), "which has a likelihood for it"),
    ("point_weight", (), "refinement", ("joint",), "the only fit with weights"),
    ("point_weight", (), "loss", ("linear",), "as others find weights of their own"),
)


def check_requirements(given: Mapping[str, Any]) -> None:
    """Raise if a setting needs another value of another one that is given."""
    for name, values, other, allowed, why in REQUIREMENTS:
        value = given.get(name)
        is_set = value in values if values else value is not None and value is not False
        if is_set and given.get(other, allowed[0]) not in allowed:
            because = f", {why}" if why else ""
            raise ValueError(
                f"{named(name, *[value][: len(values)])} needs {named(other, *allowed)}"
                f"{because}; got {named(other, given[other])}"
            )
