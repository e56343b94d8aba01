"""The formats of landmark files, and reading them.

Readers are imported when a file is read: the help of the command line must not wait.
"""

import contextlib
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from isa_nrsfm._compat.files import errors_of, reading, refuse_special
from isa_nrsfm._compat.texts import as_utf8, by_number, first_items
from isa_nrsfm._parameters import named

if TYPE_CHECKING:
    from isa_nrsfm.io._landmarks import Landmarks

# A table with named columns, which any program may have written.
TABLE = "table"
# Stands for a folder where others have the suffix of a file.
_FOLDER = "/"


@dataclass(frozen=True)
class LandmarkFormat:
    """
    A format of landmark files.

    Parameters
    ----------
    name : str
        The name to give to `read_landmarks`.
    title : str
        Which program or data set it belongs to.
    expected : str
        Required content of such a file.
    suffixes : sequence of str
        Suffixes of its files in lower case; "/" for a folder of files.
    reader : str
        Module and name of its two functions, such as ``_keypoints.coco``. ``is_coco``
        takes the path and returns whether the file begins like this format.
        ``read_coco`` returns its `Landmarks`, or raises a ValueError without the path.
    options : sequence of str
        Names of the options that `read` takes.
    begins : str
        Regular expression for the beginning of its files, instead of the first of these
        functions.
    """

    name: str
    title: str
    expected: str
    suffixes: Sequence[str]
    reader: str = field(repr=False)
    options: Sequence[str] = ()
    begins: str | None = field(default=None, repr=False)

    def matches(self, path: str | os.PathLike[str]) -> bool:
        """
        Return whether a file begins like one of this format.

        Parameters
        ----------
        path : str or path-like
            The file or folder.

        Returns
        -------
        bool
            Whether suffix and beginning of the file match the format.

        Raises
        ------
        ValueError
            If it is an HDF5 file that is damaged.
        OSError
            If the file cannot be opened.
        """
        path = Path(path)
        _check_exists(path)
        if _suffix(path) not in self.suffixes or self.begins is None:
            return _suffix(path) in self.suffixes and self._function("is")(path)
        with path.open("rb") as file:
            return re.match(self.begins.encode(), file.read(2**16)) is not None

    def _function(self, kind: str) -> Callable[..., Any]:
        """Return the function of the reader that begins with "is" or "read"."""
        module, _, name = self.reader.partition(".")
        return getattr(import_module(f"isa_nrsfm.io.{module}"), f"{kind}_{name}")

    def read(self, path: str | os.PathLike[str], **options: Any) -> "Landmarks":
        """
        Read a file of this format.

        Parameters
        ----------
        path : str or path-like
            The file or folder.
        **options : dict
            Those of the format's `options`.

        Returns
        -------
        Landmarks
            The landmarks.

        Raises
        ------
        ValueError
            If the file is not of the format, or the format has no such option. The
            message has the path and the required content.
        OSError
            If the file cannot be opened.
        """
        path = Path(path)
        if unknown := set(options).difference(self.options):
            raise ValueError(
                f"the format {self.name} has no option {', '.join(sorted(unknown))}; "
                + (f"it has {', '.join(self.options)}" if self.options else "")
            )
        _check_exists(path)
        if path.is_dir() and _FOLDER not in self.suffixes:
            return _joined(path, self, **options)
        if _suffix(path) not in self.suffixes:
            raise ValueError(
                f"{path} cannot be read as {self.name} ({self.title}): expected "
                f"{self.expected}, in {_listed(self.suffixes)}"
            )
        with reading(path, f"{self.name} ({self.title})", self.expected):
            return self._function("read")(path, **options)


def read_landmarks(
    path: str | os.PathLike[str],
    format: str = "auto",
    *,
    min_confidence: float | None = None,
    **options: Any,
) -> "Landmarks":
    r"""
    Read landmarks from a file of one of several formats.

    Parameters
    ----------
    path : str or path-like
        The file, or a folder of files of one format, which are put below each other,
        with the column ``file``.
    format : str, default="auto"
        The format, one of `FORMATS`. With "auto", it is the one whose files begin like
        this one, which must be a single one. Files of separated values that no other
        format claims are of format "table".
    min_confidence : float, optional
        Points with a lower confidence become NaN, where the format has confidences.
    **options : dict
        Options of the format: ``image_size`` (width, height) of "mediapipe" and
        "mediapipe_json", in pixels, and of "yolo", for fractions of the image's size;
        ``part`` of "openpose", one of "pose", "face", "hand_left" and "hand_right", and
        of "mediapipe_json", also "left_hand" and "right_hand"; of whole bodies of
        "coco" and "mmpose", one of "body", "feet", "face", "left_hand", "right_hand"
        and "all"; ``columns`` and ``missing`` of "table" and "mediapipe", and
        ``individuals`` and ``row_per_point`` of "table", as in `landmark_table`.

    Returns
    -------
    Landmarks
        The landmarks and further columns of each frame. A frame in which tracking
        failed is a row of NaN.

    Raises
    ------
    ValueError
        If the file is not of the format, if not exactly one format matches, or if an
        option or the threshold does not apply. The message has the path and the
        required content.
    OSError
        If the file cannot be opened.

    Warns
    -----
    UserWarning
        If points are probably missing, such as those at (0, 0), or coordinates are
        probably fractions of the width and height of an image.

    See Also
    --------
    from_mediapipe : Landmarks from results of MediaPipe.
    from_movement : Landmarks from datasets of movement.
    from_sleap_io : Landmarks from labels of sleap-io.
    read_table : All columns of a table.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from isa_nrsfm.io import read_landmarks
    >>> with TemporaryDirectory() as folder:
    ...     for name, shift in (("a", 1), ("b", 5)):
    ...         lines = [f"{j + shift} {j * j}" for j in range(3)]
    ...         head = ["version: 1", "n_points: 3", "{"]
    ...         path = Path(folder, f"{name}.pts")
    ...         _ = path.write_text("\n".join([*head, *lines, "}"]))
    ...     landmarks = read_landmarks(folder)
    >>> landmarks.format
    'pts'
    >>> landmarks.points
       x_0  y_0  x_1  y_1  x_2  y_2
    0  1.0  0.0  2.0  1.0  3.0  4.0
    1  5.0  0.0  6.0  1.0  7.0  4.0
    >>> list(landmarks.frames["file"])
    ['a.pts', 'b.pts']
    """
    if format != "auto" and format not in FORMATS:
        raise ValueError(
            f"format must be auto or one of {', '.join(FORMATS)}; got {format!r}"
        )
    name = find_format(path) if format == "auto" else format
    landmarks = FORMATS[name].read(path, **options)
    if min_confidence is not None:
        with errors_of(str(path)):
            landmarks = landmarks.without_unsure_points(min_confidence)
    tracks = landmarks.points.to_numpy().reshape(len(landmarks.points), -1, 2)
    coordinates = import_module("isa_nrsfm._prepare.coordinates")
    warned = coordinates.warn_of_places(tracks, landmarks.confidence, name)
    landmarks.points.attrs[coordinates.TOLD] = warned
    return landmarks


def find_format(path: str | os.PathLike[str]) -> str:
    """
    Find the one format that a file is of.

    Parameters
    ----------
    path : str or path-like
        The file or folder.

    Returns
    -------
    str
        The name of the format. It is "table" where no other format with files of this
        suffix matches.

    Raises
    ------
    ValueError
        If no format matches, or more than one.
    OSError
        If the file cannot be opened.
    """
    path = Path(path)
    _check_exists(path)
    possible = [found for found in FORMATS.values() if _suffix(path) in found.suffixes]
    others = [each for each in possible if each.name != TABLE]
    matching = [each.name for each in others if each.matches(path)]
    if path.is_dir() and not matching:
        matching = [*dict.fromkeys(form.name for _, form in _members(path))]
    if len(matching) > 1:
        raise ValueError(
            f"{path} matches more than one format: {', '.join(matching)}. Choose with "
            f"{named('format')}"
        )
    if matching:
        return matching[0]
    names = import_module("isa_nrsfm.io._tables").header_names
    if len(others) < len(possible) and (path.suffix != ".txt" or len(names(path)) > 1):
        return TABLE
    if _suffix(path) in (".xlsx", ".xls", ".ods"):
        raise ValueError(f"{path} is a file of a spreadsheet: save it as .csv there")
    known = (f"{f.name}: {f.expected}, in {_listed(f.suffixes)}" for f in possible)
    if not possible:
        known = (f"{each.name} ({_listed(each.suffixes)})" for each in FORMATS.values())
    raise ValueError(
        f"{path} is of no known format: {_seen(path)}. Expected {'; '.join(known)}. "
        "Unpack compressed files. Projects of SLEAP, NWB and others are read with "
        "sleap-io and from_sleap_io. Save other tables and arrays as .csv, in pandas: "
        "pd.DataFrame(array, columns=names).to_csv('new.csv', index=False)"
    )


def _members(folder: Path) -> list[tuple[Path, LandmarkFormat]]:
    """Return the files of a folder that are of a format, by their names and numbers."""
    found = []
    for file in sorted(folder.iterdir(), key=by_number):
        refuse_special(file)
        if file.is_file() and not file.name.startswith("."):
            with contextlib.suppress(ValueError):
                found.append((file, FORMATS[find_format(file)]))
    return found


def _joined(folder: Path, form: LandmarkFormat, **options: Any) -> "Landmarks":
    """Read all files of a folder of one format, with the column ``file``."""
    from isa_nrsfm._compat.caller import warn_caller
    from isa_nrsfm.io._landmarks import joined

    if not (files := [file for file, found in _members(folder) if found == form]):
        raise ValueError(f"{folder} has no {form.name} files: expected {form.expected}")
    beside = sorted({*folder.glob(f"[!.]*{files[0].suffix}")}.difference(files))
    others = first_items(file.name for file in beside)
    known = {re.sub(r"\d+", "", file.name) for file in files}
    alike = [f for f in beside if re.sub(r"\d+", "", f.name) in known]
    with errors_of(str(folder)):
        # Others are such as classes.txt, or labels of an image without any.
        if beside and (
            files[0].suffix != ".txt" or any(f.stat().st_size for f in alike)
        ):
            raise ValueError(f"{others} cannot be read as {form.name}")
        if beside:
            warn_caller(f"not of {form.name}, and left out: {others}")
        return joined({as_utf8(f.name): form.read(f, **options) for f in files})


def _seen(path: Path) -> str:
    """Return what an unknown file has: names of entries, or its first bytes."""
    if path.is_dir():
        return f"a folder with {first_items(sorted(p.name for p in path.iterdir()))}"
    with path.open("rb") as file:
        start = file.read(40)
    if start.startswith(b"\x89HDF"):
        groups = import_module("isa_nrsfm.io._animals").root_groups(path)
        return f"an HDF5 file with {first_items(sorted(groups)) or 'nothing'}"
    line = start.partition(b"\n")[0]
    return f"it begins with {line.decode() if line.isascii() else line!r}"


def _suffix(path: Path) -> str:
    """Return the suffix of a file in lower case; "/" for a folder."""
    return _FOLDER if path.is_dir() else path.suffix.lower()


def _check_exists(path: Path) -> None:
    """Raise the error of opening a file where there is none."""
    refuse_special(path)
    if not path.is_dir():
        path.open("rb").close()


def _listed(suffixes: Sequence[str]) -> str:
    """List suffixes in words."""
    return " or ".join("a folder" if each == _FOLDER else each for each in suffixes)


_ENTRIES = tomllib.loads(Path(__file__).with_name("formats.toml").read_text("utf-8"))
FORMATS: Mapping[str, LandmarkFormat] = MappingProxyType(
    {name: LandmarkFormat(name, **entry) for name, entry in _ENTRIES.items()}
)
