"""Look into HDF5 files."""

from pathlib import Path

from isa_nrsfm._compat.optional import import_optional

_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_hdf5(path: Path) -> bool:
    """Tell whether a file begins as HDF5 files do."""
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def root_groups(path: Path) -> set[str]:
    """Return the names at the root of an HDF5 file, or raise where it is damaged."""
    h5py = import_optional("h5py", extra="h5")
    try:
        with h5py.File(path, "r") as file:
            return set(file)
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path} is a damaged HDF5 file: {error}") from error
