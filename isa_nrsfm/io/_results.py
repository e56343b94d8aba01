"""Take landmarks out of the objects of other libraries."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm.io._landmarks import (
    Landmarks,
    assemble,
    assemble_individuals,
    checked_sizes,
    stacked,
)

_MEDIAPIPE_PARTS = ("face_landmarks", "hand_landmarks", "pose_landmarks")
# movement named the axes keypoints and individuals in its earlier versions.
_MOVEMENT_DIMS = {"keypoints": "keypoint", "individuals": "individual"}


def from_mediapipe(results: Iterable[Any], image_sizes: ArrayLike) -> Landmarks:
    """
    Take the landmarks out of results of MediaPipe's face, hand or pose landmarker.

    Parameters
    ----------
    results : iterable of FaceLandmarkerResult
        The results of one image each; HandLandmarkerResult and PoseLandmarkerResult
        will do as well. Any objects with a list ``face_landmarks``, ``hand_landmarks``
        or ``pose_landmarks`` that has, for each face, a list of objects with ``x`` and
        ``y`` are taken.
    image_sizes : array-like of shape (2,) or (n_results, 2)
        Width and height of all images, or of each, in pixels. MediaPipe gives x in
        shares of the width and y in shares of the height.

    Returns
    -------
    Landmarks
        The points in pixels, a row for each face (hand, pose), in the order of the
        results. `frames` has the number of the result and that of the face in it. A
        result without a face has one row without points. Poses have their visibility
        as confidence.

    Raises
    ------
    ValueError
        If an object is not such a result, if faces have different numbers of points,
        or if the sizes are not those of the images.

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
    parts = {part for result in results for part in _parts(result)}
    if len(parts) > 1:
        raise ValueError(f"the results are of more than one kind: {sorted(parts)}")
    sizes = checked_sizes("image_sizes", image_sizes, len(results))
    names = [f"result {i} (counted from 0)" for i in range(len(results))]
    persons = [
        {k: _values(points, name) for k, points in enumerate(getattr(result, *parts))}
        for result, name in zip(results, names, strict=True)
    ]
    if not any(len(values) for each in persons for values in each.values()):
        raise ValueError(f"none of the {len(results)} results has any landmarks")
    frame, individual, values = stacked(persons, names)
    # Faces and hands have no visibility, though some versions set it to zero.
    seen = parts == {"pose_landmarks"} and not np.isnan(values[..., 2]).all()
    return assemble(
        values[..., :2] * sizes[frame][:, None],
        None,
        {"frame": frame, "individual": individual},
        format="mediapipe",
        confidence=values[..., 2] if seen else None,
    )


def from_movement(dataset: Any, individual: str | None = None) -> Landmarks:
    """
    Take the landmarks out of a dataset of poses of the package movement.

    Parameters
    ----------
    dataset : xarray.Dataset
        The poses: ``position`` (time, space, keypoint, individual) and, optionally,
        ``confidence`` without space. The axes may have any order, and keypoint and
        individual may be named in the plural, as earlier versions do.
    individual : str, optional
        The individual to take. By default all.

    Returns
    -------
    Landmarks
        The points, a row for each individual that a frame shows. `frames` has the
        number of the frame, its time and the individual. A frame in which nobody is
        seen has one row without points.

    Raises
    ------
    ValueError
        If the dataset has not these axes, is of points in space, or has no such
        individual.

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
    confidence = None
    if "confidence" in dataset:
        found = _by_axes(dataset, "confidence", axes[:3])
        confidence = np.asarray(found.values, dtype=np.float64)
    tracks = np.asarray(position.values, dtype=np.float64)
    tracks = tracks[..., [space.index("x"), space.index("y")]]
    names = _names(position, 1)
    if individual is not None:
        if individual not in names:
            raise ValueError(
                f"there is no individual {individual!r}; there are {', '.join(names)}"
            )
        chosen = [names.index(individual)]
        tracks, names = tracks[:, chosen], [individual]
        confidence = None if confidence is None else confidence[:, chosen]
    return assemble_individuals(
        tracks,
        names,
        _names(position, 2),
        {"frame": range(len(tracks)), "time": position.coords["time"].values},
        format="movement",
        confidence=confidence,
    )


def _parts(result: Any) -> list[str]:
    """Return which lists of landmarks a result has."""
    parts = [part for part in _MEDIAPIPE_PARTS if hasattr(result, part)]
    if not parts:
        raise ValueError(
            "a result of MediaPipe should have face_landmarks, hand_landmarks or "
            f"pose_landmarks; got {type(result).__name__}"
        )
    return parts


def _values(landmarks: Sequence[Any], where: str) -> NDArray[np.float64]:
    """Return x, y and visibility of landmarks, NaN if absent, (n_points, 3)."""
    try:
        values = [(p.x, p.y, getattr(p, "visibility", None)) for p in landmarks]
        return np.array(values, dtype=np.float64).reshape(-1, 3)
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{where} should have a list of objects with numbers x and y for each "
            f"face: {error}"
        ) from error


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
    dim = variable.dims[axis]
    if dim not in variable.coords:
        raise ValueError(f"the axis {dim} of the dataset has no names")
    return [str(name) for name in variable.coords[dim].values]
