"""Names, suffixes and frames of exported files."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from isa_nrsfm._fitted_model import in_camera_axes, removed_part
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm.skeletons._column_names import checked_names


def names_of_components(names: Any, n_components: int) -> list[str]:
    """Return the names of the coefficients, by default alpha_1, alpha_2, ..."""
    default = [f"alpha_{k + 1}" for k in range(n_components)]
    return checked_names("names", names, default)


def point_places(names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of points by their names, or by their numbers."""
    named = {name: j for j, name in enumerate(names)}
    return {str(j): j for j in range(len(names))} | named


def suffix_of(path: str | os.PathLike[str], suffixes: Sequence[str]) -> str:
    """Return the suffix of a path in lower case, which must be one of those given."""
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise ValueError(
            f"path must end in {' or '.join(suffixes)}; got {os.fspath(path)}"
        )
    return suffix


def frames_of_table(
    model: Any, X: Any, point_weight: Any = None
) -> tuple[NDArray, NDArray]:
    """Return cameras and coefficients of a table or of frames that are fitted.

    Rotations lead to the axes of the camera, if known. None is the fitted table.
    """
    if X is None:
        alpha = model.alpha_ + removed_part(model, model.motion_)
        return in_camera_axes(model, model.motion_, model.translation_), alpha
    if not isinstance(X, Decomposition):
        X = model.decompose(X, point_weight=point_weight)
    return in_camera_axes(model, X.motion, X.translation), X.alpha
