"""One kind of error for files that other libraries cannot read."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def reading(
    path: str | os.PathLike[str], what: str, expected: str | None = None
) -> Iterator[None]:
    """
    Name the file in whatever the reading of it raises, as a ValueError.

    Which errors damaged content makes h5py, pyarrow, zipfile, json and others raise is
    not documented, and there are many kinds. What the reader itself finds wrong may be
    raised within, without the path.

    Parameters
    ----------
    path : str or path-like
        The file.
    what : str
        What it is read as.
    expected : str, optional
        What such a file must have.

    Yields
    ------
    None

    Raises
    ------
    ValueError
        If the content cannot be read. The cause is the error of the library.
    OSError
        If the system does not open or read the file; it is named.
    """
    try:
        yield
    except (ImportError, MemoryError):
        raise
    except Exception as error:
        # Errors of the system have a number, those that libraries make of content none.
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = os.fspath(path)
            raise
        said = str(error).strip().partition("\n")[0]
        if isinstance(error, UnicodeDecodeError):
            said = f"its text is not in {error.encoding.upper()} ({said})"
        elif not isinstance(error, ValueError | OSError):
            said = f"{type(error).__name__}: {said}"
        raise ValueError(
            f"{os.fspath(path)} cannot be read as {what}: {said}"
            + (f". Expected {expected}" if expected else "")
        ) from error
