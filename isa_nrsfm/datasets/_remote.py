"""Find the files of public data sets in a folder, or download them into it."""

import hashlib
import os
from pathlib import Path
from typing import NamedTuple

from sklearn.datasets import get_data_home

from isa_nrsfm._compat.optional import import_optional

# Subfolder of scikit-learn's data home for what this package downloads.
FOLDER = "isa_nrsfm"

DataHome = str | os.PathLike[str] | None


class RemoteFile(NamedTuple):
    """
    A file of a public data set.

    Attributes
    ----------
    name : str
        Its name in the folder.
    url : str
        Where it is downloaded from.
    sha256 : str
        Checksum of its bytes, hexadecimal.
    """

    name: str
    url: str
    sha256: str


def fetch_file(
    remote: RemoteFile, data_home: DataHome = None, download_if_missing: bool = True
) -> Path:
    """
    Return the path of a file of a public data set.

    A file that is there is taken, without network and without pooch, if its bytes are
    the right ones. It is never overwritten. One that is missing is downloaded by pooch;
    nothing is left in the folder if that fails.

    Parameters
    ----------
    remote : RemoteFile
        The file.
    data_home : str or path-like, optional
        The folder that has the file or is to have it, the subfolder ``isa_nrsfm`` of
        scikit-learn's data home by default.
    download_if_missing : bool, default=True
        Whether to download a file that is not there.

    Returns
    -------
    Path
        The file, which has the checksum that it should have.

    Raises
    ------
    OSError
        If the file is not there and cannot or must not be downloaded, or if it is
        there with other contents.
    ImportError
        If the file is to be downloaded and pooch is not installed.
    """
    if data_home is None:
        folder = Path(get_data_home(), FOLDER)
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
