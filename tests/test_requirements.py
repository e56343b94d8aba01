"""Settings that need others, in messages of Python and of the command line."""

import pytest
from refusals import refused

from isa_nrsfm._parameters import REQUIREMENTS, check_requirements, named

WRONG = {"refinement": "alternating", "camera": "affine", "loss": "cauchy"}
# Values of settings of which any needs another, and their option with its value.
GIVEN = {
    "std": (True, "--std"),
    "remove_pose": (True, "--remove-pose"),
    "focal_length": (1000.0, "--focal-length 1000"),
    "principal_point": ((1.0, 2.0), "--principal-point 1 2"),
    "prior": (object(), "--prior face"),
    "point_weight": ([[1.0]], "--weights confidence"),
}


@pytest.mark.parametrize(("name", "values", "other", "allowed", "why"), REQUIREMENTS)
def test_settings_that_need_others(fails, tmp_path, name, values, other, allowed, why):
    value = values[-1] if values else GIVEN[name][0]
    error = refused(None, check_requirements, {name: value, other: WRONG[other]})
    needed = f"needs {other}={' or '.join(map(repr, allowed))}"
    shown = f"{name}={value!r}" if values else name
    assert str(error).startswith(f"{shown} {needed}{', ' * bool(why)}{why}")
    assert str(error).endswith(f"; got {named(other, WRONG[other])}")
    for fine in ({name: value, other: allowed[-1]}, {name: value}, {other: "x"}):
        check_requirements(fine)

    flag = f"--{name.replace('_', '-')}"
    option = f"{flag} {values[-1]}" if values else GIVEN[name][1]
    given = [*option.split(), f"--{other}", WRONG[other]]
    message = fails("fit", tmp_path / "absent.csv", "-o", tmp_path, *given)
    shown = option if values else option.partition(" ")[0]
    assert f"{shown} needs --{other} {' or '.join(allowed)}" in message
    assert message.endswith(f"got --{other} {WRONG[other]}")
