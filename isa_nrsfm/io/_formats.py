"""The formats of landmark files, and reading them.

Readers are imported when a file is read: the help of the command line must not wait.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from isa_nrsfm._compat.damaged_files import errors_of, reading, refuse_special

if TYPE_CHECKING:
    from isa_nrsfm.io._landmarks import Landmarks

# A table with named columns, which any program may have written.
TABLE = "table"
# Stands for a folder where others have the suffix of a file.
_FOLDER = "/"
_TABLES = (".csv", ".tsv", ".parquet")


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
    suffixes : tuple of str
        Suffixes of its files in lower case; "/" for a folder of files.
    reader : str
        Module and name of its two functions, such as ``_keypoints.coco``. ``is_coco``
        takes the path and returns whether the file begins like this format.
        ``read_coco`` returns its `Landmarks`, or raises a ValueError without the path.
    options : tuple of str
        Names of the options that `read` takes.
    """

    name: str
    title: str
    expected: str
    suffixes: tuple[str, ...]
    reader: str = field(repr=False)
    options: tuple[str, ...] = ()

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
        return _suffix(path) in self.suffixes and self._function("is")(path)

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
        unknown = set(options).difference(self.options)
        if unknown:
            raise ValueError(
                f"the format {self.name} has no option {', '.join(sorted(unknown))}; "
                + (f"it has {', '.join(self.options)}" if self.options else "")
            )
        _check_exists(path)
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
        The file, or a folder of ``.pts`` files or of json files of OpenPose or MMPose.
    format : str, default="auto"
        The format, one of `FORMATS`. With "auto", it is the one whose files begin like
        this one, which must be a single one. Files of separated values that no other
        format claims are of format "table".
    min_confidence : float, optional
        Points with a lower confidence become NaN, where the format has confidences.
    **options : dict
        Options of the format: ``image_size`` (width, height) of "mediapipe", in
        pixels, for coordinates in shares of the image's size; ``part`` of "openpose",
        one of "pose", "face", "hand_left" and "hand_right"; ``part`` of whole bodies of
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
        probably shares of the width and height of an image.

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
    if len(matching) > 1:
        raise ValueError(
            f"{path} matches more than one format: {', '.join(matching)}. Choose with "
            "format (command line: --format)"
        )
    if matching:
        return matching[0]
    if len(others) < len(possible):
        return TABLE
    if _suffix(path) in (".xlsx", ".xls", ".ods"):
        raise ValueError(f"{path} is a file of a spreadsheet: save it as .csv there")
    if not possible:
        known = (f"{each.name} ({_listed(each.suffixes)})" for each in FORMATS.values())
        raise ValueError(
            f"{path} is of no known format: {'; '.join(known)}. Unpack compressed "
            "files. Save tables and arrays as .csv, in pandas: "
            "pd.DataFrame(array, columns=names).to_csv('new.csv', index=False)"
        )
    raise ValueError(
        f"{path} is of no known format. Expected "
        + "; ".join(
            f"{found.name}: {found.expected}, in {_listed(found.suffixes)}"
            for found in (*possible, FORMATS[TABLE])
        )
        + ". Rename tables of separated values to .csv"
    )


def _suffix(path: Path) -> str:
    """Return the suffix of a file in lower case; "/" for a folder."""
    return _FOLDER if path.is_dir() else path.suffix.lower()


def _check_exists(path: Path) -> None:
    """Raise the error of opening a file where there is none."""
    refuse_special(path)
    if not path.is_dir():
        with path.open("rb"):
            pass


def _listed(suffixes: tuple[str, ...]) -> str:
    """List suffixes in words."""
    words = ["a folder" if suffix == _FOLDER else suffix for suffix in suffixes]
    return " or ".join(words)


_ALL = (
    LandmarkFormat(
        "openface",
        "OpenFace",
        "the columns frame, timestamp, confidence, success (face, confidence for an "
        "image), x_0, ... and y_0, ...",
        _TABLES,
        "_face_tables.openface",
    ),
    LandmarkFormat(
        "pyfeat",
        "py-feat",
        "the columns FaceRectX, FaceRectY, FaceRectWidth, FaceRectHeight, x_0, ... and "
        "y_0, ...",
        _TABLES,
        "_face_tables.pyfeat",
    ),
    LandmarkFormat(
        "mediapipe",
        "MediaPipe",
        "named columns x and y of each point (468 or 478, where it is recognised)",
        _TABLES,
        "_face_tables.mediapipe",
        ("image_size", "columns", "missing"),
    ),
    LandmarkFormat(
        "pts",
        "iBUG, 300-W",
        "'version: 1', 'n_points: N' and N lines 'x y' between braces",
        (".pts", _FOLDER),
        "_keypoints.pts",
    ),
    LandmarkFormat(
        "wflw",
        "WFLW lists",
        "lines of 196 coordinates, 4 of a box, 6 attributes and the image",
        (".txt",),
        "_keypoints.wflw",
    ),
    LandmarkFormat(
        "deeplabcut",
        "DeepLabCut, Lightning Pose",
        "columns of the levels scorer, (individuals,) bodyparts, coords",
        (".csv", ".tsv", ".h5", ".hdf5"),
        "_animals.deeplabcut",
    ),
    LandmarkFormat(
        "sleap",
        "SLEAP analysis",
        "the datasets tracks, node_names and track_names",
        (".h5", ".hdf5"),
        "_animals.sleap",
    ),
    LandmarkFormat(
        "coco",
        "COCO keypoints",
        "images, annotations and categories with keypoints, or a list of results; "
        "write json of other programs as a table",
        (".json",),
        "_keypoints.coco",
        ("part",),
    ),
    LandmarkFormat(
        "openpose",
        "OpenPose",
        "people with pose_keypoints_2d, face_keypoints_2d, ...; a folder has a file "
        "..._keypoints.json for each frame",
        (".json", _FOLDER),
        "_keypoints.openpose",
        ("part",),
    ),
    LandmarkFormat(
        "mmpose",
        "MMPose predictions",
        "instances with keypoints and keypoint_scores, or frames with such instances",
        (".json", _FOLDER),
        "_keypoints.mmpose",
        ("part",),
    ),
    LandmarkFormat(
        "tps",
        "tps of morphometrics",
        "LM=N, N lines 'x y', and lines such as IMAGE=a.jpg, for each specimen",
        (".tps",),
        "_keypoints.tps",
    ),
    LandmarkFormat(
        TABLE,
        "a table with named columns",
        "a line of names such as x_0, y_0 or nose_x, nose_y, and rows of as many cells",
        _TABLES,
        "_tables.named_columns",
        ("columns", "missing", "individuals", "row_per_point"),
    ),
)

FORMATS: Mapping[str, LandmarkFormat] = MappingProxyType({f.name: f for f in _ALL})
