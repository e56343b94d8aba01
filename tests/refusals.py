"""Calls that are refused, that warn, or with their results: the table `refusals.txt`.

A section of the table has the name of a test file, and for each call two lines: the
call, in the names of that file, and an expression for the message of its ValueError,
or of another error or a warning that is named before it, as in "OSError: is a pipe".
Calls that are not refused have their result after "== ", up to rounding after "~= ", or
what their text matches after "~ ", and does not after "!~ ".
`written(name, content)` writes a file into `folder`. `tmp_path` stays empty. Commands
are `begun`, `told`, `told_of_fit` and `usage`; `pd` and `isa_nrsfm` are imported.
"""

import builtins
import re
from pathlib import Path

import pandas as pd
import pytest
from fit_runs import begun, told, told_of_fit, usage
from numpy.testing import assert_allclose, assert_equal

import isa_nrsfm

TABLE = Path(__file__).with_suffix(".txt")
GIVEN = {"isa_nrsfm": isa_nrsfm, "pd": pd}
GIVEN |= {"begun": begun, "told": told, "told_of_fit": told_of_fit, "usage": usage}

# Of results: their equality, also up to rounding, and whether a text matches
CHECKS = {
    "==": lambda found, rest, scope: assert_equal(found, eval(rest, scope)),
    "~=": lambda found, rest, scope: assert_close(found, eval(rest, scope)),
    "~": lambda found, rest, _: assert_regex(rest, found, True),
    "!~": lambda found, rest, _: assert_regex(rest, found, False),
}


def assert_close(found, expected):
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def assert_regex(pattern, text, expected):
    assert bool(re.search(pattern, text)) == expected, text


def refused(message, call, /, *args, error=ValueError, **kwargs):
    """Check that a call raises an error whose message matches, and return the error."""
    with pytest.raises(error, match=message) as caught:
        call(*args, **kwargs)
    return caught.value


def warned(message, call, /, *args, category=UserWarning, **kwargs):
    """Check that a call warns with a message that matches, and return its result."""
    with pytest.warns(category, match=message):
        return call(*args, **kwargs)


def refusals_of(section, names):
    """Return a test that the calls in a section are refused, and write no file."""
    text = TABLE.read_text(encoding="utf-8").partition(f"[{section}]\n")[2]
    lines = text.partition("\n\n[")[0].splitlines()
    calls = [*zip(lines[::2], map(str.strip, lines[1::2]), strict=True)]
    assert calls, section

    @pytest.mark.parametrize(("call", "message"), calls)
    def test(call, message, tmp_path, tmp_path_factory):
        folder = tmp_path_factory.mktemp("input")

        def written(name, content):
            text = content.encode() if isinstance(content, str) else content
            (folder / name).write_bytes(text)
            return folder / name

        given = {"tmp_path": tmp_path, "folder": folder, "written": written}
        scope = names | given | GIVEN
        sign, _, rest = message.partition(" ")
        if sign in CHECKS:
            CHECKS[sign](eval(call, scope), rest, scope)
            return
        kind, _, rest = message.partition(": ")
        error = vars(builtins).get(kind)
        if error is None:
            refused(message, eval, call, scope)
        elif issubclass(error, Warning):
            warned(rest, eval, call, scope, category=error)
        else:
            refused(rest, eval, call, scope, error=error)
        assert not any(tmp_path.iterdir())

    return test
