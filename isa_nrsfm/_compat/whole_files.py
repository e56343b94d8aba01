"""Atomic writes of files."""

import os
import uuid
from pathlib import Path


def write_whole(path: str | os.PathLike[str], contents: bytes) -> None:
    """
    Write a file atomically: it has all of its new contents, or stays as it was.

    The contents go to a new file in the same folder. That file gets the permissions of
    the old one and replaces it. A path that is no regular file, such as a pipe, is
    written to directly.

    Parameters
    ----------
    path : str or path-like
        The file; where it is a link, the file that it leads to.
    contents : bytes
        All that the file shall hold.

    Raises
    ------
    OSError
        If the file cannot be written; it is named.
    """
    target = Path(os.path.realpath(path))
    exists = target.exists()
    if exists and not target.is_file():
        target.write_bytes(contents)
        return
    new = target.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        with new.open("xb") as file:
            file.write(contents)
        if exists:
            new.chmod(target.stat().st_mode & 0o777)
        os.replace(new, target)
    except OSError as error:
        error.filename, error.filename2 = os.fspath(path), None
        raise
    finally:
        new.unlink(missing_ok=True)
