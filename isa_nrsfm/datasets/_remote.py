"""Find the files of public data sets in a folder, or download them into it."""

import hashlib
import os
import tomllib
from pathlib import Path
from typing import Any

from isa_nrsfm._compat.lazy import import_optional

DataHome = str | os.PathLike[str] | None
SOURCES = tomllib.loads(Path(__file__).with_name("sources.toml").read_text("utf-8"))

# Constraints of the parameters that all fetchers have in common.
PARAMETERS: dict[str, list[Any]] = {
    "data_home": [str, os.PathLike, None],
    "download_if_missing": ["boolean"],
}


def fetch_file(
    url: str, sha256: str, data_home: DataHome = None, download_if_missing: bool = True
) -> Path:
    """Return the path of a file of a public data set; download it if it is missing.

    The file has the last part of its address as its name, and a hexadecimal checksum.
    An existing file with the right checksum is used, and never overwritten. A failed
    download leaves nothing in the folder.
    """
    from sklearn.datasets import get_data_home  # takes a while

    home = Path(get_data_home(), "isa_nrsfm") if data_home is None else data_home
    folder = Path(home).expanduser()
    path = folder / url.rpartition("/")[2]
    by_hand = f"To put it there by hand, take it from {url}; its sha256 is {sha256}"
    absent = f"{path.name} is not in the folder {folder}, and"
    if not path.exists() and not download_if_missing:
        raise FileNotFoundError(f"{absent} download_if_missing is False. {by_hand}")
    if not path.exists():
        try:
            import_optional("pooch", extra="datasets").retrieve(
                url, known_hash=f"sha256:{sha256}", fname=path.name, path=folder
            )
        except ImportError as error:
            raise ImportError(f"{absent} {error}. {by_hand}") from error
        # Of the network and the disk; a wrong checksum is a ValueError.
        except (OSError, ValueError) as error:
            raise OSError(
                f"{absent} it could not be downloaded ({error}). {by_hand}"
            ) from error
    with path.open("rb") as file:
        stored = hashlib.file_digest(file, "sha256").hexdigest()
    if stored != sha256:
        raise OSError(
            f"{path} is damaged, or it is another file of the same name: its sha256 is "
            f"{stored}. Remove it, and the next call downloads the right file. "
            f"{by_hand}"
        )
    return path
