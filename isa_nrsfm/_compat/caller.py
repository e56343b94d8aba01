"""Warnings that point to the line of the user's program."""

import contextlib
import sys
import warnings
from pathlib import Path

import joblib
import numpy as np
import sklearn

# Files whose frames are skipped on the way from the warning up to the user's line.
INSIDE = (
    *(str(Path(inner).parent) for inner in (sklearn.__file__, joblib.__file__)),
    str(Path(__file__).parents[1]),
    contextlib.__file__,
    np.errstate.__call__.__code__.co_filename,
)


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line that called this package, however deep the warning is raised."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(INSIDE):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
