"""Warnings that point to the line of the user's program."""

import contextlib
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from isa_nrsfm._compat.texts import printable

# They are not imported: reading a file does not need scikit-learn.
LIBRARIES = [find_spec(name) for name in ("sklearn", "joblib")]
# Files whose frames are skipped on the way from the warning up to the user's line.
INSIDE = (
    *(str(Path(s.origin or "").parent) for s in LIBRARIES if s),
    str(Path(__file__).parents[1]),
    contextlib.__file__,
    np.errstate.__call__.__code__.co_filename,
)


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line that called this package, however deep the warning is raised."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(INSIDE):
        level, frame = level + 1, frame.f_back
    warnings.warn(printable(message), category, stacklevel=level)
