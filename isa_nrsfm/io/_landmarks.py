"""The result of all readers, and landmarks of the objects of other libraries."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm.skeletons import Skeleton, find_skeleton, skeleton_of_names
from isa_nrsfm.skeletons._recognition import LAYOUTS_OF_READERS, numbered

_PARTS = ("face", "hand", "pose", "left_hand", "right_hand")
# movement named the axes keypoints and individuals in its earlier versions.
_MOVEMENT_DIMS = {"keypoints": "keypoint", "individuals": "individual"}


@dataclass(frozen=True, eq=False)
class Landmarks:
    """
    Landmarks read from a file or from the results of another program.

    All tables have one row per frame and the same index, 0, 1, .... Where a frame shows
    several individuals, each has its own row.

    Parameters
    ----------
    points : DataFrame of shape (n_frames, 2 * n_points)
        The landmarks, float64, columns x0, y0, x1, y1, ... under names such as
        ``x_0, y_0`` or ``nose_x, nose_y``. In pixels, unless the format has other
        units. NaN marks a missing point.
    frames : DataFrame of shape (n_frames, n_other)
        Further columns of the source, such as number, file or individual.
    confidence : DataFrame of shape (n_frames, n_points) or None
        Confidence of each point, in the scale of the source, NaN if it is not known. A
        confidence of the frame is that of all its points. None for formats without
        confidences.
    failed : ndarray of bool, shape (n_frames,)
        Frames in which tracking failed or found nothing. All their points are NaN.
    format : str
        Name of the format, one of `isa_nrsfm.io.FORMATS`, "mediapipe", "movement" or
        "sleap-io".
    point_names : tuple of str, length n_points
        Names of the points.
    skeleton : Skeleton or None
        Edges between the points, if the file has them or the program that has written
        it has one known layout (`isa_nrsfm.skeletons`).
    """

    points: "pd.DataFrame"
    frames: "pd.DataFrame"
    confidence: "pd.DataFrame | None"
    failed: NDArray[np.bool_]
    format: str
    point_names: tuple[str, ...]
    skeleton: Skeleton | None = None

    def __repr__(self) -> str:
        """Return the numbers of frames and points instead of the tables."""
        size = f"{len(self.points)} frames of {len(self.point_names)} points"
        return f"Landmarks({size}, format={self.format!r})"

    def without_unsure_points(self, min_confidence: float) -> "Landmarks":
        """
        Return the landmarks with points of low confidence as NaN.

        Parameters
        ----------
        min_confidence : float
            Points with a lower confidence become NaN. Those without one are kept.

        Returns
        -------
        Landmarks
            The same, with fewer points. `failed` stays as it is.

        Raises
        ------
        ValueError
            If there are no confidences, none is as high, or the threshold is not a
            finite number.
        """
        if isinstance(min_confidence, bool | str) or not math.isfinite(min_confidence):
            raise ValueError(
                f"min_confidence must be a finite number; got {min_confidence!r}"
            )
        if self.confidence is None:
            raise ValueError(
                f"min_confidence is given, but these landmarks ({self.format}) have "
                "no confidences"
            )
        unsure = unsure_points(self.confidence.to_numpy(), min_confidence)
        return replace(self, points=self.points.mask(np.repeat(unsure, 2, axis=1)))


def unsure_points(confidence: NDArray, least: float) -> NDArray[np.bool_]:
    """Return which points (n_frames, n_points) have a lower confidence; not all."""
    if (unsure := confidence < least).all():
        raise ValueError(
            f"no point has a confidence of {least:g} or more: they are from "
            f"{confidence.min():.3g} to {confidence.max():.3g}"
        )
    if least <= 1 and (largest := np.nanmax(confidence, initial=0.0)) > 2:
        warn_caller(
            f"confidences are up to {largest:g}, and no probabilities: a threshold of "
            f"{least:g} leaves out {unsure.sum():,} of {unsure.size:,} points"
        )
    return np.asarray(unsure)


def assemble(
    tracks: NDArray[np.float64],
    point_names: Sequence[str] | None,
    frames: "pd.DataFrame | dict[str, Any]",
    *,
    format: str,
    columns: Sequence[str] | None = None,
    confidence: Any = None,
    skeleton: Skeleton | None = None,
) -> Landmarks:
    """Put landmarks together in the one form that all readers return, and check them.

    `tracks` (n_frames, n_points, 2) are NaN where points are missing. Points whose
    names are None have numbers from 0 and columns ``x_0, y_0``, ...; other columns are
    by default the names with ``_x`` and ``_y``. `frames` has further columns of each
    frame. The skeleton is by default that of the layout that the format or the names of
    the points determine.
    """
    n_frames, n_points, _ = tracks.shape
    if n_frames == 0 or n_points == 0:
        raise ValueError(f"there are no {'points' if n_frames else 'frames'} in it")
    if point_names is None:
        point_names = [str(j) for j in range(n_points)]
        columns = [f"{axis}_{j}" for j in point_names for axis in "xy"]
    elif columns is None:
        columns = [f"{name}_{axis}" for name in point_names for axis in "xy"]
    table = tracks.reshape(n_frames, -1)
    if (infinite := np.argwhere(np.isinf(table))).size:
        row, place = infinite[0]
        raise ValueError(f"{columns[place]} is infinite in row {row} (counted from 0)")
    frames = pd.DataFrame(frames)
    refuse_same_names([*map(str, frames.columns), *columns])
    if skeleton is None and (format in LAYOUTS_OF_READERS or not numbered(point_names)):
        skeleton = find_skeleton(n_points, point_names, format)
    if confidence is not None:
        confidence = pd.DataFrame(np.asarray(confidence), columns=list(point_names))
    points, names = pd.DataFrame(table, None, columns, copy=False), tuple(point_names)
    # The copy is in one piece, so that further columns can be added quickly.
    frames = frames.set_axis(pd.RangeIndex(n_frames), axis=0).copy()
    failed = np.asarray(np.isnan(table).all(axis=1))
    return Landmarks(points, frames, confidence, failed, format, names, skeleton)


def joined(parts: Mapping[str, Landmarks]) -> Landmarks:
    """Put landmarks of files below each other, with the name of each as column file."""
    (first, found), *_ = parts.items()
    for name, each in parts.items():
        if [*each.points] != [*found.points]:
            raise ValueError(
                f"{first} has {len(found.point_names)} points, {name} has "
                f"{len(each.point_names)}: all files must have the same, in one order"
            )

    below = partial(pd.concat, ignore_index=True)
    sure = [each.confidence for each in parts.values() if each.confidence is not None]
    return replace(
        found,
        points=below(each.points for each in parts.values()),
        frames=below(each.frames.assign(file=name) for name, each in parts.items()),
        confidence=below(sure) if len(sure) == len(parts) else None,
        failed=np.concatenate([each.failed for each in parts.values()]),
    )


def assemble_individuals(
    tracks: NDArray[np.float64],
    names: Sequence[Any] | None,
    point_names: Sequence[str],
    frames: Mapping[str, Sequence[Any]],
    *,
    confidence: NDArray[np.float64] | None = None,
    instance_scores: NDArray[np.float64] | None = None,
    **known: Any,
) -> Landmarks:
    """Give each individual that a frame shows its own row.

    A single individual has a row in every frame. Of several, those without a visible
    point have none. A frame in which nobody is seen has one row without points.
    `tracks` are (n_frames, n_individuals, n_points, 2). Without names no column
    ``individual``.
    """
    if tracks.shape[1] == 0:
        raise ValueError("expected points of one individual or more; got none")
    visible = np.asarray(~np.isnan(tracks).all(axis=(2, 3)))
    several = visible.shape[1] > 1
    rows = visible.copy() if several else np.ones_like(visible)
    rows[~visible.any(axis=1), 0] = True
    frame, individual = np.nonzero(rows)
    nobody = several & ~visible[frame, individual]
    places, who = frame.tolist(), zip(individual.tolist(), nobody, strict=True)
    columns: dict[str, Any] = {n: [v[i] for i in places] for n, v in frames.items()}
    if names is not None:
        columns["individual"] = [None if absent else names[i] for i, absent in who]
    if instance_scores is not None and not np.isnan(instance_scores).all():
        scores = np.where(nobody, np.nan, instance_scores[frame, individual])
        columns["instance_score"] = scores
    if confidence is not None:
        known["confidence"] = confidence[frame, individual]
    return assemble(tracks[frame, individual], point_names, columns, **known)


def stacked(
    persons: Sequence[Mapping[int, NDArray[np.float64]]], names: Sequence[str]
) -> tuple[list[int], Any, NDArray[np.float64]]:
    """Return image, person and values (n_rows, n_points, n_values) of all persons.

    `persons` are those of each image by their numbers, `names` those of the images. An
    image without persons has a row of NaN.
    """
    points = next(values for each in persons for values in each.values())
    nobody = {None: np.full(points.shape, np.nan)}
    rows = [
        (i, number, values)
        for i, each in enumerate(persons)
        for number, values in (each or nobody).items()
    ]
    first = next(i for i, each in enumerate(persons) if each)
    for i, _, values in rows:
        if len(values) != len(points):
            raise ValueError(
                f"{names[first]} has {len(points)} points, {names[i]} has "
                f"{len(values)}: all must have the same number"
            )
    images, numbers, stack = zip(*rows, strict=True)
    return list(images), pd.array(numbers, dtype="Int64"), np.stack(stack)


def checked_sizes(name: str, sizes: Any, n_images: int) -> NDArray[np.float64]:
    """Return width and height (n_images, 2) of images in pixels, or raise."""
    try:
        found = np.asarray(sizes, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    fits = found.shape in ((2,), (n_images, 2))
    if not (fits and ((found > 0) & (found < 1e7)).all()):
        raise ValueError(
            f"{name} must be a width and a height in pixels, such as (1920, 1080), for "
            f"all images or for each of the {n_images}; got {sizes!r:.60}"
        )
    return np.broadcast_to(found, (n_images, 2))


def refuse_same_names(names: Sequence[str]) -> None:
    """Raise if two columns have the same name."""
    stripped = pd.Index(filter(None, map(str.strip, names)), dtype=object)
    if len(twice := stripped[stripped.duplicated()]):
        raise ValueError(
            f"more than one column is called {twice[0]!r}: each needs its own name, "
            "such as x0, y0, x1, y1"
        )


def from_mediapipe(
    results: Iterable[Any], image_sizes: ArrayLike, part: str | None = None
) -> Landmarks:
    """
    Take the landmarks out of results of MediaPipe's landmarkers.

    Parameters
    ----------
    results : iterable of FaceLandmarkerResult
        The results of one image each; HandLandmarkerResult, PoseLandmarkerResult,
        HolisticLandmarkerResult and those of the older solutions will do as well. Any
        objects with a list ``face_landmarks``, ``hand_landmarks`` or ``pose_landmarks``
        that has, for each face, a list of objects with ``x`` and ``y`` are taken.
    image_sizes : array-like of shape (2,) or (n_results, 2)
        Width and height of all images, or of each, in pixels. MediaPipe gives x in
        fractions of the width and y in fractions of the height.
    part : {"face", "hand", "pose", "left_hand", "right_hand"}, optional
        The part to take, if the results have several, as those of holistic landmarkers.

    Returns
    -------
    Landmarks
        The points in pixels, a row for each face (hand, pose), in the order of the
        results. `frames` has the number of the result, that of the face in it, and for
        hands the ``handedness``. A result without a face has one row without points.
        Poses have their visibility as confidence.

    Raises
    ------
    ValueError
        If an object is not such a result, if none of several parts is chosen, if faces
        have different numbers of points, or if the sizes are not those of the images.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from isa_nrsfm.io import from_mediapipe
    >>> face = [SimpleNamespace(x=0.25, y=0.5), SimpleNamespace(x=0.5, y=0.75)]
    >>> results = [SimpleNamespace(face_landmarks=[face]),
    ...            SimpleNamespace(face_landmarks=[])]
    >>> landmarks = from_mediapipe(results, image_sizes=(640, 480))
    >>> landmarks.points
         x_0    y_0    x_1    y_1
    0  160.0  240.0  320.0  360.0
    1    NaN    NaN    NaN    NaN
    >>> landmarks.failed
    array([False,  True])
    """
    results = list(results)
    parts = list(dict.fromkeys(each for result in results for each in _parts(result)))
    if results and part not in (parts if part or len(parts) > 1 else [None]):
        raise ValueError(
            f"the results have {', '.join(parts)}: choose one with part, such as "
            f"part={parts[0]!r}; got part={part!r}"
        )
    part = part or "".join(parts)
    sizes = checked_sizes("image_sizes", image_sizes, len(results))
    names = [f"result {i} (counted from 0)" for i in range(len(results))]
    pairs = zip(results, names, strict=True)
    persons = [dict(enumerate(_persons(each, part, name))) for each, name in pairs]
    if not any(len(values) for each in persons for values in each.values()):
        raise ValueError(f"none of the {len(results)} results has any landmarks")
    frame, individual, values = stacked(persons, names)
    frames = {"frame": frame, "individual": individual}
    if part == "hand":
        hands = (_entry(result, "handedness") or () for result in results)
        sides = [dict(enumerate(map(_side, each))) for each in hands]
        side = [sides[i].get(k) for i, k in zip(frame, individual, strict=True)]
        frames |= {"handedness": side} if any(side) else {}
    # Faces and hands have no visibility, though some versions set it to zero.
    sure = values[..., 2]
    confidence = sure if part == "pose" and not np.isnan(sure).all() else None
    tracks = values[..., :2] * sizes[frame][:, None]
    return assemble(tracks, None, frames, format="mediapipe", confidence=confidence)


def from_movement(dataset: Any) -> Landmarks:
    """
    Take the landmarks out of a dataset of poses of the package movement.

    Parameters
    ----------
    dataset : xarray.Dataset
        The poses: ``position`` (time, space, keypoint, individual) and, optionally,
        ``confidence`` without space. The axes may have any order, and keypoint and
        individual may be named in the plural, as earlier versions do.

    Returns
    -------
    Landmarks
        The points, a row for each individual that a frame shows. `frames` has the
        number of the frame, its time and the individual. A frame in which nobody is
        seen has one row without points.

    Raises
    ------
    ValueError
        If the dataset has not these axes, or is of points in space.

    Examples
    --------
    >>> from movement import sample_data           # doctest: +SKIP
    >>> from isa_nrsfm.io import from_movement
    >>> dataset = sample_data.fetch_dataset(       # doctest: +SKIP
    ...     "SLEAP_three-mice_Aeon_proofread.analysis.h5")
    >>> from_movement(dataset).points              # doctest: +SKIP
    """
    axes = ("time", "individual", "keypoint", "space")
    position = _by_axes(dataset, "position", axes)
    space = _names(position, 3)
    if sorted(space) != ["x", "y"]:
        raise ValueError(
            "the positions must be in an image, with space x and y; got "
            f"{', '.join(space)}"
        )
    known: dict[str, Any] = {"format": "movement"}
    if "confidence" in dataset:
        found = _by_axes(dataset, "confidence", axes[:3])
        known["confidence"] = np.asarray(found.values, dtype=np.float64)
    tracks = np.asarray(position.values, dtype=np.float64)
    tracks = tracks[..., [space.index("x"), space.index("y")]]
    frames = {"frame": range(len(tracks)), "time": position.coords["time"].values}
    names = _names(position, 1), _names(position, 2)
    return assemble_individuals(tracks, *names, frames, **known)


def from_sleap_io(labels: Any) -> Landmarks:
    """
    Take the landmarks out of labels of the package sleap-io.

    It reads projects of SLEAP (``.slp``), NWB, poses of YOLO, Label Studio and others.

    Parameters
    ----------
    labels : sleap_io.Labels
        The labelled frames, of one skeleton.

    Returns
    -------
    Landmarks
        The points, a row for each instance, in the order of videos and frames. `frames`
        has the video, the number of the frame and that of the instance in it, and where
        they are known ``individual`` (the track) and ``instance_score``. A frame
        without instances has one row without points. Predictions that were corrected
        by hand are left out. Points labelled by hand have no confidence.

    Raises
    ------
    ValueError
        If the object has no labelled frames, or instances of different skeletons.

    Examples
    --------
    >>> import sleap_io                            # doctest: +SKIP
    >>> from isa_nrsfm.io import from_sleap_io
    >>> labels = sleap_io.load_file("mice.slp")    # doctest: +SKIP
    >>> from_sleap_io(labels).points               # doctest: +SKIP
    """
    rows = []
    try:
        for frame in labels:
            file, found = frame.video.filename, list(frame.instances)
            video = file if isinstance(file, str) else str([*file, ""][0])
            corrected = [id(getattr(each, "from_predicted", None)) for each in found]
            kept = [each for each in found if id(each) not in corrected]
            places = enumerate(kept or [None])
            rows += [(video, frame.frame_idx, k, each) for k, each in places]
        skeletons = [row[3].skeleton for row in rows if row[3] is not None]
        kinds = {(tuple(s.node_names), tuple(s.edge_names)) for s in skeletons}
        ((nodes, edges),) = kinds
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            "labels of sleap-io should have labelled frames, with instances of one "
            f"skeleton; got {type(labels).__name__}: {error}"
        ) from error
    rows.sort(key=lambda row: row[:3])
    videos, numbers, of_frame, instances = zip(*rows, strict=True)
    values = np.full((len(rows), len(nodes), 3), np.nan)
    for row, each in zip(values, instances, strict=True):
        if each is not None:
            points = each.numpy(**{"scores": True} if hasattr(each, "score") else {})
            row[:, : points.shape[1]] = points
    tracks = [getattr(each, "track", None) for each in instances]
    frames: dict[str, Any] = {"video": videos, "frame": numbers, "instance": of_frame}
    frames["individual"] = [getattr(track, "name", None) for track in tracks]
    frames["instance_score"] = [getattr(each, "score", None) for each in instances]
    frames = {name: each for name, each in frames.items() if {*each} != {None}}
    sure = values[..., 2] if "instance_score" in frames else None
    known: dict[str, Any] = {"format": "sleap-io", "confidence": sure}
    if edges:
        given = {"name": "SLEAP", "source": "labels of sleap-io"}
        known["skeleton"] = skeleton_of_names(edges, nodes, **given)
    return assemble(values[..., :2], nodes, frames, **known)


def _entry(result: Any, name: str) -> Any:
    """Return an entry of a result of MediaPipe, also of older versions, or None."""
    found = getattr(result, name, None)
    return getattr(result, f"multi_{name}", None) if found is None else found


def _parts(result: Any) -> list[str]:
    """Return the parts of which a result has points, or may have."""
    names = {*dir(result)}
    found = [p for p in _PARTS if names & {f"{p}_landmarks", f"multi_{p}_landmarks"}]
    if not found:
        raise ValueError(
            "a result of MediaPipe should have face_landmarks, hand_landmarks or "
            f"pose_landmarks; got {type(result).__name__}"
        )
    return found


def _persons(result: Any, part: str, where: str) -> list[NDArray[np.float64]]:
    """Return x, y and visibility of the faces of a result, NaN if absent.

    Each is (n_points, 3). Older versions have messages with a list called landmark.
    These, and holistic landmarkers, may have one face instead of a list, or None.
    """
    found, values = _entry(result, f"{part}_landmarks"), []
    try:
        faces = [] if found is None else list(getattr(found, "landmark", found))
        for face in [faces] if faces and hasattr(faces[0], "x") else faces:
            points = getattr(face, "landmark", face)
            coordinates = [(p.x, p.y, getattr(p, "visibility", None)) for p in points]
            values.append(np.array(coordinates, dtype=np.float64).reshape(-1, 3))
        return values
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{where} should have a list of objects with numbers x and y for each "
            f"face: {error}"
        ) from error


def _side(hand: Any) -> str | None:
    """Return the side of a hand in a result of MediaPipe."""
    first = next(iter(getattr(hand, "classification", hand)), None)
    return getattr(first, "category_name", None) or getattr(first, "label", None)


def _by_axes(dataset: Any, name: str, wanted: tuple[str, ...]) -> Any:
    """Return a variable of a dataset with its axes in the order that is wanted."""
    try:
        variable = dataset[name]
        dims = tuple(variable.dims)
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(
            f"a dataset of movement should have {name}; got {type(dataset).__name__}"
        ) from error
    singular = [_MOVEMENT_DIMS.get(dim, dim) for dim in dims]
    if sorted(singular) != sorted(wanted):
        raise ValueError(
            f"{name} should have the axes {', '.join(wanted)}; got {', '.join(dims)}"
        )
    return variable.transpose(*(dims[singular.index(dim)] for dim in wanted))


def _names(variable: Any, axis: int) -> list[str]:
    """Return the names along an axis."""
    if (dim := variable.dims[axis]) not in variable.coords:
        raise ValueError(f"the axis {dim} of the dataset has no names")
    return [str(name) for name in variable.coords[dim].values]
