"""Interruptions of the package at a given line."""

import contextlib
import sys
from linecache import getline

# Python does not interrupt between a block and the release of its lock.
WITH = "with self._lock:"


@contextlib.contextmanager
def interrupted_after(n_lines, files, functions=None):
    """Raise KeyboardInterrupt after so many lines of files with this path.

    Lines of some functions only, if these are named.
    """
    left = n_lines

    def trace(frame, event, arg):
        nonlocal left
        code = frame.f_code
        if not code.co_filename.startswith(files):
            return None
        if functions is not None and code.co_name not in functions:
            return None
        locks = getline(code.co_filename, frame.f_lineno).strip() == WITH
        if event == "line" and not locks:
            left -= 1
            if left == 0:
                raise KeyboardInterrupt
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield
    finally:
        sys.settrace(before)
