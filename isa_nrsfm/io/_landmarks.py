"""What every reader of landmark formats returns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.skeletons import Skeleton, find_skeleton
from isa_nrsfm.skeletons._recognition import LAYOUTS_OF_READERS, numbered

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Landmarks:
    """
    Landmarks read from a file or from the results of another program.

    All tables have one row a frame and the same index, 0, 1, .... Where a frame shows
    several individuals, each has a row of its own.

    Parameters
    ----------
    points : DataFrame of shape (n_frames, 2 * n_points)
        The landmarks, float64, columns x0, y0, x1, y1, ... under names such as
        ``x_0, y_0`` or ``nose_x, nose_y``. In pixels, where the format does not say
        otherwise. NaN marks a missing point.
    frames : DataFrame of shape (n_frames, n_other)
        What the source says of each frame, such as its number, file or individual.
    confidence : DataFrame of shape (n_frames, n_points) or None
        How sure the source is of each point, in its own scale, NaN where it does not
        say. A confidence of the frame is that of all its points. None where the
        format has no confidences.
    failed : ndarray of bool, shape (n_frames,)
        Frames in which tracking failed or found nothing. All their points are NaN.
    format : str
        Name of the format, one of `isa_nrsfm.io.FORMATS`, "mediapipe" or "movement".
    point_names : tuple of str, length n_points
        Names of the points.
    skeleton : Skeleton or None
        What joins the points, where the file says it, or the program that has written
        it is known for one layout (`isa_nrsfm.skeletons`).
    """

    points: "pd.DataFrame"
    frames: "pd.DataFrame"
    confidence: "pd.DataFrame | None"
    failed: NDArray[np.bool_]
    format: str
    point_names: tuple[str, ...]
    skeleton: Skeleton | None = None


class IndividualRows(NamedTuple):
    """
    Points of several individuals, a row each.

    ``frame`` and ``individual`` are the numbers of both; the latter is -1 in the row of
    a frame in which nobody is seen.
    """

    tracks: NDArray[np.float64]
    confidence: NDArray[np.float64] | None
    frame: NDArray[np.intp]
    individual: NDArray[np.intp]


def assemble(
    tracks: NDArray[np.float64],
    point_names: Sequence[str],
    frames: "pd.DataFrame",
    *,
    format: str,
    columns: Sequence[str] | None = None,
    confidence: NDArray[np.float64] | None = None,
    failed: NDArray[np.bool_] | None = None,
    skeleton: Skeleton | None = None,
) -> Landmarks:
    """
    Put landmarks together in the one form that all readers return.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The points, NaN where missing.
    point_names : sequence of str, length n_points
        Names of the points.
    frames : DataFrame of shape (n_frames, n_other)
        What is known of each frame. Its index is replaced.
    format : str
        Name of the format.
    columns : sequence of str, length 2 * n_points, optional
        Names of the columns. By default those of the points with ``_x`` and ``_y``.
    confidence : ndarray of shape (n_frames, n_points), optional
        Confidences of the points.
    failed : ndarray of bool, shape (n_frames,), optional
        Frames for which the source says that tracking failed.
    skeleton : Skeleton, optional
        What joins the points. By default the layout that the format and the names of
        the points tell, if they tell one.

    Returns
    -------
    Landmarks
        The landmarks. Failed frames are those of ``failed`` and those without points.

    Raises
    ------
    ValueError
        If there is no frame, a coordinate is infinite, or two columns have one name.
    """
    pd = import_optional("pandas", extra="io")
    n_frames, n_points, _ = tracks.shape
    if n_frames == 0:
        raise ValueError("there are no frames in it")
    if columns is None:
        columns = [f"{name}_{axis}" for name in point_names for axis in "xy"]
    lost = np.asarray(np.isnan(tracks).all(axis=(1, 2)))
    if failed is not None:
        lost |= failed
        tracks = np.where(lost[:, None, None], np.nan, tracks)
    infinite = np.isinf(tracks)
    if infinite.any():
        frame, point, axis = (int(i) for i in np.argwhere(infinite)[0])
        raise ValueError(
            f"{columns[2 * point + axis]} is infinite in row {frame} (counted from 0)"
        )
    names = [*map(str, frames.columns), *columns]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"two columns are called {twice!r}")
    return Landmarks(
        points=pd.DataFrame(
            tracks.reshape(n_frames, 2 * n_points), columns=list(columns)
        ),
        # The copy is in one piece, so that further columns can be added quickly.
        frames=frames.set_axis(pd.RangeIndex(n_frames), axis=0).copy(),
        confidence=None
        if confidence is None
        else pd.DataFrame(confidence, columns=list(point_names)),
        failed=lost,
        format=format,
        point_names=tuple(point_names),
        skeleton=skeleton or _told(format, point_names),
    )


def _told(format: str, point_names: Sequence[str]) -> Skeleton | None:
    """Return the layout of a format or of names; mere numbers of points tell none."""
    if format not in LAYOUTS_OF_READERS and numbered(point_names):
        return None
    return find_skeleton(len(point_names), point_names, format)


def numbered_columns(n_points: int) -> list[str]:
    """Name the columns of points that have numbers only, counted from 0."""
    return list(chain.from_iterable((f"x_{j}", f"y_{j}") for j in range(n_points)))


def each_individual(
    tracks: NDArray[np.float64], confidence: NDArray[np.float64] | None
) -> IndividualRows:
    """
    Give each individual that a frame shows a row of its own.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_individuals, n_points, 2)
        The points, NaN where missing.
    confidence : ndarray of shape (n_frames, n_individuals, n_points) or None
        Their confidences.

    Returns
    -------
    IndividualRows
        The rows by frames, in a frame by individuals. A single individual has a row in
        every frame. Of several, those of which the frame shows no point have none; a
        frame in which nobody is seen has one row without points.
    """
    if tracks.shape[1] == 0:
        raise ValueError("expected points of one individual or more; got none")
    shown = np.asarray(~np.isnan(tracks).all(axis=(2, 3)))
    if shown.shape[1] == 1:
        rows = np.ones_like(shown)
    else:
        rows = shown.copy()
        rows[~shown.any(axis=1), 0] = True
    frame, individual = np.nonzero(rows)
    absent = ~shown[frame, individual] & (shown.shape[1] > 1)
    return IndividualRows(
        tracks=tracks[frame, individual],
        confidence=None if confidence is None else confidence[frame, individual],
        frame=frame,
        individual=np.where(absent, -1, individual),
    )


def name_individuals(individual: NDArray[np.intp], names: Sequence[Any]) -> list[Any]:
    """Return the name of each row's individual, None where there is none."""
    return [None if i < 0 else names[i] for i in individual]


def drop_unsure_points(landmarks: Landmarks, min_confidence: float) -> Landmarks:
    """
    Make points NaN that the source is not sure of.

    Parameters
    ----------
    landmarks : Landmarks
        The landmarks.
    min_confidence : float
        Points with a lower confidence become NaN. Those without one are kept.

    Returns
    -------
    Landmarks
        The same, with fewer points. `failed` stays as it is.

    Raises
    ------
    ValueError
        If the landmarks have no confidences, or the threshold is not a finite number.
    """
    if isinstance(min_confidence, bool | str) or not math.isfinite(min_confidence):
        raise ValueError(
            f"min_confidence must be a finite number; got {min_confidence!r}"
        )
    if landmarks.confidence is None:
        raise ValueError(
            f"min_confidence is given, but these landmarks ({landmarks.format}) have "
            "no confidences"
        )
    unsure = landmarks.confidence.to_numpy() < min_confidence
    return replace(
        landmarks, points=landmarks.points.mask(np.repeat(unsure, 2, axis=1))
    )
