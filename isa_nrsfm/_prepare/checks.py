"""What a table has to be before it is factorised, and what is said if it is not."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bmat, csr_array
from scipy.sparse.csgraph import connected_components

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._tables.column_names import names_layout, parse_coordinate
from isa_nrsfm._tables.layout import (
    Layout,
    table_to_tracks,
)


class HalfPoints(NamedTuple):
    """
    Points of which only one of the two coordinates is there.

    Attributes
    ----------
    n_points : int
        How many there are.
    n_rows : int
        In how many rows.
    first : tuple of int, or None
        Row and point of the first one.
    """

    n_points: int
    n_rows: int
    first: tuple[int, int] | None

    @classmethod
    def merged(cls, parts: "Sequence[HalfPoints]", lengths: list[int]) -> Self:
        """Return the half points of a table from those of its consecutive blocks."""
        start, first = 0, None
        for part, length in zip(parts, lengths, strict=True):
            if first is None and part.first is not None:
                first = (start + part.first[0], part.first[1])
            start += length
        n_points = sum(part.n_points for part in parts)
        return cls(n_points, sum(part.n_rows for part in parts), first)

    def warn(self, layout: Layout, names: NDArray | None) -> None:
        """Warn if there are such points."""
        if self.first is None:
            return
        row, point = self.first
        warn_caller(
            f"{self.n_points} point(s) in {self.n_rows} row(s) have only one of "
            "their two coordinates and count as missing; the first is "
            f"{_describe_point(point, layout, names)} in row {row}",
        )


class PointReport(NamedTuple):
    """
    In which frames points are seen.

    Attributes
    ----------
    n_frames : ndarray of int, shape (n_points,)
        Number of frames that show each point.
    group : ndarray of int, shape (n_points,)
        Connected component of each point. Two points are linked if a frame shows both.
    """

    n_frames: NDArray
    group: NDArray

    @classmethod
    def from_seen(cls, seen: NDArray) -> Self:
        """Return the report from the mask of seen points (n_frames, n_points)."""
        n_frames = seen.sum(axis=0)
        # Nearly always all points are in frames that share one with the fullest frame.
        fullest = seen[np.argsort(seen.sum(axis=1))[-1:]]
        if seen[(seen & fullest).any(axis=1)].any(axis=0).all():
            return cls(n_frames, np.zeros(len(n_frames), dtype=np.intp))
        shown = csr_array(seen)
        # Nodes are the points, then the frames. A frame is linked to what it shows.
        graph = bmat([[None, shown.T], [shown, None]])
        return cls(
            n_frames, connected_components(graph, directed=False)[1][: len(n_frames)]
        )

    @classmethod
    def merged(cls, reports: "Sequence[PointReport]") -> Self:
        """Return the report of a table from those of its blocks."""
        n_points = len(reports[0].group)
        points = np.arange(n_points)
        firsts = []
        for report in reports:
            # Each point is tied to the first one of its group.
            _, first, number = np.unique(
                report.group, return_index=True, return_inverse=True
            )
            firsts.append(first[number])
        rows, columns = np.tile(points, len(reports)), np.concatenate(firsts)
        ties = csr_array((np.ones(len(rows)), (rows, columns)), (n_points, n_points))
        _, group = connected_components(ties, directed=False)
        return cls(np.sum([report.n_frames for report in reports], axis=0), group)


def without_half_points(tracks: NDArray) -> tuple[NDArray, HalfPoints]:
    """
    Return tracks in which the two coordinates of a point are missing together.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a coordinate is missing.

    Returns
    -------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks themselves, or a copy where points of which one coordinate is
        missing have lost the other, too.
    half : HalfPoints
        How many such points there are, and where the first one is.
    """
    if not np.isnan(tracks.sum()):  # one NaN makes the sum NaN: a fast test
        return tracks, HalfPoints(0, 0, None)
    missing = np.isnan(tracks)
    half = missing[..., 0] != missing[..., 1]
    if not half.any():
        return tracks, HalfPoints(0, 0, None)
    row, point = np.argwhere(half)[0]
    found = HalfPoints(
        int(half.sum()), int(half.any(axis=1).sum()), (int(row), int(point))
    )
    return np.where(half[..., None], tracks.dtype.type(np.nan), tracks), found


def clean_tracks(
    tracks: NDArray, layout: Layout = "interleaved", names: NDArray | None = None
) -> NDArray:
    """
    Return tracks in which the two coordinates of a point are missing together.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a coordinate is missing.
    layout : {"interleaved", "planar"}
        Order of the columns of the table.
    names : ndarray of shape (2 * n_points,), optional
        Names of the columns.

    Returns
    -------
    ndarray of shape (n_frames, n_points, 2)
        The tracks themselves, or a copy where points of which one coordinate is
        missing have lost the other, too.

    Warns
    -----
    UserWarning
        If there are such points.
    """
    tracks, half = without_half_points(tracks)
    half.warn(layout, names)
    return tracks


def check_names(names: NDArray | None, layout: Layout) -> None:
    """Refuse column names of another layout than the given one, or of other things."""
    said = None if names is None else names_layout(names)
    if names is None or said in (None, layout):
        return
    others = [str(name) for name in names if not _is_x_or_y(name)]
    if others:
        raise ValueError(
            f"{len(others)} of the {len(names)} columns are not the x or y of a point, "
            f"as the names of the others are; the first is {others[0]!r}. Give only "
            "the columns of points: isa_nrsfm.io.landmark_table(X).points has them"
        )
    shown = ", ".join(map(str, names[:4]))
    order = (
        "neither interleaved nor planar; isa_nrsfm.io.landmark_table(X).points has "
        "them interleaved"
        if said == "other"
        else said
    )
    raise ValueError(
        f"layout={layout!r} contradicts the column names ({shown}, ...), "
        f"whose order is {order}"
    )


def _is_x_or_y(name: str) -> bool:
    """Return whether a column is named as the x or y of a point."""
    coordinate = parse_coordinate(name)
    return coordinate is not None and coordinate.axis < 2


def largest_n_components(n_points: int) -> int:
    """Return the largest K with 3K + 3 directions in n_points centred points."""
    return (n_points - 1) // 3 - 1


def smallest_n_frames(n_components: int) -> int:
    """Return the least number of frames that determines the affine factorisation."""
    # However many the points, W = M B leaves an invertible matrix between its factors:
    # 9 (K + 1)^2 unknowns, less the (K + 1)^2 + 8 of the gauge. A frame has 6 (K + 1)
    # entries of M, but 6 numbers of its camera and K coefficients: 5K equations. So
    # 5K I >= 8 (K + 1)^2 - 8 = 8K (K + 2), rounded up.
    return -(-8 * (n_components + 2) // 5)


def most_for_frames(n_frames: int) -> int:
    """Return the largest K that n_frames frames determine, at least 1."""
    return max(5 * n_frames // 8 - 2, 1)


def check_size(n_frames: int, n_points: int, n_components: int) -> None:
    """Refuse a table that is too small for the number of basis shapes."""
    largest = largest_n_components(n_points)
    if n_components > largest:
        possible = (
            f"with {n_points} points the largest possible n_components is {largest}"
            if largest > 0
            else "at least 7 points are needed for n_components=1"
        )
        raise ValueError(
            f"n_components={n_components} needs at least {3 * n_components + 4} "
            f"points, X has {n_points}; {possible}"
        )
    smallest = smallest_n_frames(n_components)
    if n_frames < smallest:
        possible = ""
        if n_frames >= smallest_n_frames(1):
            most = min(most_for_frames(n_frames), largest)
            possible = f"; the largest possible n_components is {most}"
        raise ValueError(
            f"n_components={n_components} needs at least {smallest} frames (rows), "
            f"X has n_samples={n_frames}{possible}"
        )


def check_points(
    report: PointReport,
    n_seen: NDArray,
    n_components: int,
    layout: Layout = "interleaved",
    names: NDArray | None = None,
) -> None:
    """
    Refuse tables whose seen points do not determine the shapes.

    Equations and unknowns are counted. A point has 3 (K + 1) unknowns, and two
    equations in each frame that shows it. A frame that shows n points has 2 n
    equations, and 8 + K unknowns of its own: camera, translation and coefficients. The
    counts are necessary conditions. The shapes may still be poorly determined.

    Parameters
    ----------
    report : PointReport
        In which frames points are seen.
    n_seen : ndarray of int, shape (n_frames,)
        Number of points that each frame shows.
    n_components : int
        K, the number of basis shapes.
    layout : {"interleaved", "planar"}
        Order of the columns of the table.
    names : ndarray of shape (2 * n_points,), optional
        Names of the columns.

    Raises
    ------
    ValueError
        If a point is seen in too few frames, if too few points are seen in all, or if
        the points fall into groups that no frame shows together.
    """
    n_frames, group = report
    if (n_frames == len(n_seen)).all():
        return
    n_shapes = n_components + 1
    least = -(-3 * n_shapes // 2)
    few = n_frames < least
    if few.any():
        point = int(few.argmax())
        raise ValueError(
            f"n_components={n_components} needs every point in at least {least} "
            f"frames; {few.sum()} of {len(few)} point(s) are seen in fewer, the first "
            f"is {_describe_point(point, layout, names)}, seen in {n_frames[point]}"
        )
    equations = np.maximum(2 * n_seen - 8 - n_components, 0).sum()
    unknowns = 3 * n_shapes * (len(few) - 1) - n_shapes**2 - 8
    if equations < unknowns:
        raise ValueError(
            f"too few points are seen for n_components={n_components}: beyond cameras "
            f"and coefficients they give {equations} equations, but the shapes have "
            f"{unknowns} unknowns; take fewer basis shapes or leave out points that "
            "are rarely seen"
        )
    if (group != group[0]).any():
        apart = int((group != group[0]).argmax())
        raise ValueError(
            f"the points fall into {len(np.unique(group))} groups, and no frame shows "
            f"points of two of them; {_describe_point(apart, layout, names)} is the "
            f"first that is never seen with {_describe_point(0, layout, names)} or "
            "others of its group"
        )


def _describe_point(point: int, layout: Layout, names: NDArray | None) -> str:
    """Return the number of a point, with the names of its columns where known."""
    if names is None:
        return f"point {point}"
    x, y = table_to_tracks(np.asarray(names)[None], layout)[0, point]
    return f"point {point} ({x}, {y})"
