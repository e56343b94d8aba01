"""Find the files of public data sets in a folder, or download them into it."""

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

from sklearn.datasets import get_data_home

from isa_nrsfm._compat.optional import import_optional

DataHome = str | os.PathLike[str] | None


class RemoteFile(NamedTuple):
    """A file of a public data set, with the hexadecimal checksum of its bytes."""

    name: str
    url: str
    sha256: str


def fetch_file(
    remote: RemoteFile, data_home: DataHome = None, download_if_missing: bool = True
) -> Path:
    """Return the path of a file of a public data set; download it if it is missing.

    An existing file with the right checksum is used, and never overwritten. A failed
    download leaves nothing in the folder.
    """
    if data_home is None:
        folder = Path(get_data_home(), "isa_nrsfm")
    else:
        folder = Path(data_home).expanduser()
    path = folder / remote.name
    if not path.exists():
        if not download_if_missing:
            why = "download_if_missing is False"
            raise FileNotFoundError(_not_there(remote, folder, why))
        _download(remote, folder)
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    if sha256 != remote.sha256:
        raise OSError(
            f"{path} is not the file that is expected under this name: its sha256 is "
            f"{sha256} instead of {remote.sha256}. Remove it to download the right "
            f"one, or put that there by hand, from {remote.url}"
        )
    return path


def _download(remote: RemoteFile, folder: Path) -> None:
    """Put a file into the folder, which is created if need be."""
    try:
        pooch = import_optional("pooch", extra="datasets")
    except ImportError as error:
        raise ImportError(_not_there(remote, folder, str(error))) from error
    try:
        pooch.retrieve(
            remote.url,
            known_hash=f"sha256:{remote.sha256}",
            fname=remote.name,
            path=folder,
        )
    # Errors of the network and the disk are OSErrors; a wrong checksum is a ValueError.
    except (OSError, ValueError) as error:
        why = f"it could not be downloaded ({error})"
        raise OSError(_not_there(remote, folder, why)) from error


def _not_there(remote: RemoteFile, folder: Path, why: str) -> str:
    """Say that a file is missing, why, and how to put it there by hand."""
    return (
        f"{remote.name} is not in the folder {folder}, and {why}. To put it there by "
        f"hand, take it from {remote.url}; its sha256 is {remote.sha256}"
    )
