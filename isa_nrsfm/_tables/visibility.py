"""Which points the frames of a table show, and which frames show enough."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

# Least number of points that a frame must show. Each point gives two equations; an
# affine camera with its translation has eight unknowns. Coefficients need no further
# points: their prior determines what the points do not.
FEWEST_POINTS = 4
# Coordinates count as equal up to this many units in the last place of the largest one.
EQUAL = 4


class FrameReport(NamedTuple):
    """
    What frames show.

    Attributes
    ----------
    translation : ndarray of shape (n_frames, 2)
        Centroids of the seen points, NaN for frames without any.
    square : ndarray of shape (n_frames,)
        Sum of the squares of the centred coordinates.
    largest : ndarray of shape (n_frames,)
        Largest magnitude of a coordinate before centring, zero for frames without any.
    n_seen : ndarray of int, shape (n_frames,)
        Number of points that are seen.
    in_one_place : ndarray of bool, shape (n_frames,)
        Whether the root mean square distance of the seen points from their centroid is
        within rounding errors of its coordinates; False for frames without any point.
    on_line : ndarray of bool, shape (n_frames,)
        Whether points are missing and the others on one line, up to rounding.
    """

    translation: NDArray
    square: NDArray
    largest: NDArray
    n_seen: NDArray
    in_one_place: NDArray
    on_line: NDArray

    def of_frames(self, frames: NDArray) -> Self:
        """Return the report of some frames."""
        return type(self)(*(part[frames] for part in self))


class CentredFrames(NamedTuple):
    """
    Frames centred over the points that they show.

    Attributes
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Centred tracks in double precision, zero where a point is not seen.
    translation : ndarray of shape (n_frames, 2)
        Centroids of the seen points, NaN for frames without any.
    seen : ndarray of bool, shape (n_frames, n_points)
        Which points are seen.
    n_seen : ndarray of int, shape (n_frames,)
        How many they are.
    square : ndarray of shape (n_frames,)
        Sum of the squares of the centred coordinates.
    dtype : dtype
        Type of the numbers before centring.
    """

    centred: NDArray
    translation: NDArray
    seen: NDArray
    n_seen: NDArray
    square: NDArray
    dtype: np.dtype

    @classmethod
    def of_tracks(cls, tracks: NDArray) -> Self:
        """Centre tracks (n_frames, n_points, 2), NaN where a point is not seen."""
        centred, translation, seen = centred_over_seen(tracks)
        square = np.einsum("ijc,ijc->i", centred, centred)
        return cls(
            centred, translation, seen, seen.sum(axis=1), square, np.dtype(tracks.dtype)
        )

    def in_one_place(self) -> NDArray:
        """Tell in which frames all seen points are equal, up to rounding."""
        return points_coincide(self.square, self.translation, self.n_seen, self.dtype)

    def on_line(self) -> NDArray:
        """Tell which frames miss points and show the others on a line."""
        return _collinear(self.centred, self.translation, self.seen, self.dtype)

    def usable(self) -> NDArray:
        """Tell which frames show enough, as `usable_frames`."""
        enough = self.n_seen >= FEWEST_POINTS
        return enough & ~self.in_one_place() & ~self.on_line()

    def marked(self) -> NDArray:
        """Return the centred tracks with NaN where a point is not seen, in place."""
        if not self.seen.all():
            self.centred[~self.seen] = np.nan
        return self.centred

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames, all of them without a copy."""
        if frames.all():
            return self
        return self._replace(
            centred=self.centred[frames],
            translation=self.translation[frames],
            seen=self.seen[frames],
            n_seen=self.n_seen[frames],
            square=self.square[frames],
        )

    def sizes(self) -> NDArray:
        """Return the root mean squares of the seen coordinates (n_frames,)."""
        return np.sqrt(self.square / (2 * self.n_seen))


def seen_points(tracks: NDArray) -> NDArray:
    """
    Tell which points are seen.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Whether both coordinates are there.
    """
    if not np.isnan(tracks.sum()):  # one NaN makes the sum NaN: a fast test
        return np.ones(tracks.shape[:2], dtype=bool)
    missing = np.isnan(tracks)
    return ~(missing[..., 0] | missing[..., 1])


def report_frames(tracks: NDArray) -> FrameReport:
    """
    Return what frames show.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Returns
    -------
    FrameReport
        The report.
    """
    frames = CentredFrames.of_tracks(tracks)
    highest, lowest = (
        reduce(tracks, axis=(1, 2), initial=0.0)
        for reduce in (np.fmax.reduce, np.fmin.reduce)
    )
    return FrameReport(
        frames.translation,
        frames.square,
        np.maximum(highest, -lowest),
        frames.n_seen,
        frames.in_one_place(),
        frames.on_line(),
    )


def usable_frames(tracks: NDArray) -> NDArray:
    """
    Tell which frames show enough to determine their camera.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of bool, shape (n_frames,)
        Whether a frame shows at least four points that are not all in one place and,
        if some are missing, not all on one line. A complete frame may show its points
        on a line: that is a flat object seen edge on. Where only some points are seen,
        it is rather that they lie on a line of the object, which leaves the camera
        free to turn around it.
    """
    return CentredFrames.of_tracks(tracks).usable()


def check_frames(report: FrameReport, n_points: int) -> None:
    """
    Refuse frames that do not show enough to determine their camera.

    Parameters
    ----------
    report : FrameReport
        What the frames show.
    n_points : int
        Number of points of a frame.

    Raises
    ------
    ValueError
        If a frame shows fewer than four points, or has missing points and shows the
        others on one line (see `usable_frames`). Those with all points in one place
        are left to `check_places`, those without any point are not looked at.
    """
    n_seen, n_frames = report.n_seen, len(report.n_seen)
    few = (n_seen > 0) & (n_seen < FEWEST_POINTS) & (n_seen < n_points)
    if few.any():
        row = few.argmax()
        raise ValueError(
            f"each frame must show at least {FEWEST_POINTS} points to determine its "
            f"camera; {few.sum()} of {n_frames} frame(s) show fewer (the others are "
            f"NaN), the first is row {row} with {n_seen[row]} point(s): leave such "
            "rows out"
        )
    line = report.on_line & ~report.in_one_place
    if line.any():
        raise ValueError(
            "the points that a frame shows must not all lie on one line where others "
            f"are missing (NaN); they do in {line.sum()} of {n_frames} frame(s), "
            f"the first is row {line.argmax()}: leave such rows out"
        )


def check_places(report: FrameReport, n_points: int) -> None:
    """
    Refuse frames whose seen points are all equal, up to rounding.

    Parameters
    ----------
    report : FrameReport
        What the frames show.
    n_points : int
        Number of points of a frame.

    Raises
    ------
    ValueError
        If there are such frames.
    """
    refuse_one_place(report.in_one_place, report.n_seen < n_points)


def refuse_one_place(coincide: NDArray, incomplete: NDArray) -> None:
    """Refuse frames with all seen points in one place."""
    if coincide.any():
        which = "seen points" if incomplete[coincide].any() else "points"
        raise ValueError(
            f"each frame must have at least two different points; all {which} are "
            f"equal in {coincide.sum()} frame(s), the first is row {coincide.argmax()}"
        )


def zero_where_unseen(tracks: NDArray, seen: NDArray) -> NDArray:
    """Return tracks with zeros where points are not seen."""
    if seen.all():
        return tracks
    return np.where(seen[..., None], tracks, tracks.dtype.type(0))


def centred_over_seen(tracks: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return centred tracks (I, J, 2), centroids (I, 2) and the mask of seen (I, J).

    The tracks are zero where a point is not seen.
    """
    # The same memory order, so that sums are the same to the last bit.
    tracks = np.ascontiguousarray(tracks, dtype=np.float64)
    seen = seen_points(tracks)
    n_seen = seen.sum(axis=1)[:, None]
    # Points as complex numbers x + iy: loops over two coordinates would be slow.
    points = tracks.view(np.complex128)[..., 0]
    if not seen.all():
        points = np.where(seen, points, 0.0)
    total = points.sum(axis=1).view(np.float64).reshape(-1, 2)
    translation = np.full((len(tracks), 2), np.nan)
    np.divide(total, n_seen, where=n_seen > 0, out=translation)
    centred = points - translation.view(np.complex128)
    if not seen.all():
        centred[~seen] = 0.0
    return centred.view(np.float64).reshape(tracks.shape), translation, seen


def points_coincide(
    square: NDArray, translation: NDArray, n_seen: NDArray, dtype: np.dtype
) -> NDArray:
    """Tell in which frames all seen points are equal, up to rounding: (n_frames,).

    The arguments are as in `FrameReport`, with the type of the numbers of the table.
    """
    rounding = EQUAL * np.finfo(dtype).eps * np.linalg.norm(translation, axis=1)
    return (n_seen > 0) & (square <= n_seen * rounding**2)


def _collinear(
    centred: NDArray, translation: NDArray, seen: NDArray, dtype: np.dtype
) -> NDArray:
    """Tell which frames miss points and show the others on a line, up to rounding.

    The arrays are those of `centred_over_seen`, the result is (n_frames,).
    """
    on_line = np.asarray(~seen.all(axis=1))
    centred, translation = centred[on_line], translation[on_line]
    n_seen = seen[on_line].sum(axis=1)
    x, y = centred[..., 0], centred[..., 1]
    # The principal axis by its angle. Eigenvalues of the 2x2 second moment would square
    # the distances from it, and lose half of their digits.
    angle = 0.5 * np.arctan2(2.0 * np.vecdot(x, y), np.vecdot(x, x) - np.vecdot(y, y))
    across = np.cos(angle)[:, None] * y - np.sin(angle)[:, None] * x
    extent = np.linalg.norm(translation, axis=1) + np.abs(centred).max(axis=(1, 2))
    rounding = EQUAL * np.finfo(dtype).eps * extent
    thin = np.vecdot(across, across) <= n_seen * rounding**2
    on_line[on_line] = thin & (n_seen > 0)
    return on_line
