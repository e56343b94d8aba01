"""Write the results of a fit to a folder, and find out which run its files are of.

The report has the SHA-256 digests of the model and the other files of its run.
"""

import hashlib
import json
import warnings
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, export
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm.cli._reading import Frames, drawing_files
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.io import load_model, save_model, write_table
from isa_nrsfm.skeletons._column_names import names_of_points

PAGE = "report.html"
REPORT = "report.json"
# The files of every fit; docs/command_line.md has their contents.
RESULTS = (
    PAGE,
    "model.npz",
    "alpha.csv",
    "cameras.csv",
    "shapes.csv",
    "shapes.npz",
    "viewer.html",
)


class Fit(NamedTuple):
    """A fit to write and draw: model, frames, smoothing, lines.

    ``explained`` is the table of the model, ``inverse_snr`` (n_frames,) that of frames.
    """

    estimator: AffineNRSfM
    frames: Frames
    smooth: Any
    drawn: dict[str, Any]
    explained: NDArray
    inverse_snr: NDArray


def check_outputs(
    args: Namespace, inputs: Iterable[str], targets: Iterable[Path], own: Any = ()
) -> None:
    """Raise if files of inputs would be replaced, or others but for own ones by name.

    With --force only inputs are kept.
    """
    existing = [target for target in targets if target.exists()]
    for source in (*inputs, *drawing_files(args)):
        if any(target.samefile(source) for target in existing):
            raise ValueError(
                f"{source} would be overwritten by the results: choose another --output"
            )
    others = [str(path) for path in existing if path.is_file() and path.name not in own]
    if others and not args.force:
        raise ValueError(
            f"existing files would be replaced: {', '.join(others)}. Choose another "
            "--output, or replace them with --force"
        )


def write_alpha(
    path: Path, frames: Frames, alpha: NDArray, std: NDArray | None, further: Any = None
) -> None:
    """Write coefficients after the row number and the other columns of the table.

    Frames that could not be fitted have empty coefficients. Results with the name of
    another column get an underscore.
    """
    names = names_of_components(None, alpha.shape[1])
    results = pd.DataFrame(alpha, index=frames.X.index, columns=names)
    if std is not None:
        results[[f"{name}_std" for name in names]] = std
    if further is not None:
        results = results.join(further)
    results = results.reindex(frames.points.index)
    results.insert(0, "row", results.index)
    taken = {str(name) for name in frames.other.columns}
    if renamed := [name for name in results if name in taken]:
        warn_caller(
            f"the table has columns {', '.join(renamed)}: results of these names have "
            "an underscore after theirs"
        )
    while not taken.isdisjoint(results):
        results = results.rename(columns=lambda name: f"{name}{'_' * (name in taken)}")
    parts = [results.iloc[:, :1], frames.other, results.iloc[:, 1:]]
    write_table(pd.concat(parts, axis=1), path)


def write_results(folder: Path, fit: Fit, unit: float = 1.0, **shown: Any) -> None:
    """Write cameras, shapes, the viewer with the `shown` data, and the model.

    The cameras have a row for each frame, empty if it could not be fitted. `unit` is
    the length of a unit of the shapes, for positions.
    """
    estimator, frames, smooth, drawn, *_ = fit
    X, motion = frames.X, estimator.motion_
    cameras = pd.DataFrame(
        np.hstack([motion.reshape(-1, 6), estimator.translation_]),
        index=X.index,
        columns=[*(f"m{i}{j}" for i in range(2) for j in range(3)), "tx", "ty"],
    )
    cameras["inverse_snr"] = fit.inverse_snr
    if hasattr(estimator, "positions_"):
        names = [f"position_{axis}" for axis in "xyz"]
        cameras[names] = unit * estimator.positions_
    shown["camera"] = None
    if frames_of(estimator).certainty.determined:  # otherwise the fit has warned
        try:
            with warnings.catch_warnings(action="error", category=UserWarning):
                poses = export.frame_poses(estimator, X, **frames.weighting, **drawn)
            columns = pd.DataFrame(poses._asdict(), index=X.index)
            columns = columns.dropna(axis="columns", how="all")
            shown["camera"] = "weak_perspective" if len(columns.columns) else None
            if smooth is not None:
                poses = export.frame_poses(estimator, smooth.decomposition, **drawn)
                for name in columns.columns.intersection(["yaw", "pitch", "roll"]):
                    columns[f"{name}_smooth"] = getattr(poses, name)
            cameras = cameras.join(columns)
        except (ValueError, UserWarning) as error:
            warn_caller(
                f"viewer.html has affine shapes, and cameras.csv has no angles: {error}"
            )
    cameras = cameras.reindex(frames.points.index)
    cameras.insert(0, "row", cameras.index)
    write_table(cameras, folder / "cameras.csv")
    shapes = [estimator.mean_shape_, *estimator.basis_]
    names = ["mean", *(f"basis_{k}" for k in range(1, len(shapes)))]
    points = pd.DataFrame(
        np.hstack(shapes),
        columns=[f"{name}_{axis}" for name in names for axis in "XYZ"],
    )
    points.insert(0, "point", names_of_points(estimator))
    write_table(points, folder / "shapes.csv")
    export.write_shapes(estimator, folder / "shapes.npz")
    shown |= {"X": X, **frames.weighting, **drawn}
    export.write_viewer(estimator, folder / "viewer.html", **shown)
    save_model(estimator, folder / "model.npz")


def read_model(args: Namespace) -> AffineNRSfM:
    """Load a model; its missing points have the coordinates of those of its fit.

    These are in the report beside the model. Without a report of that model there are
    none. Warn if files beside it are not of the run of the report.
    """
    estimator, path = load_model(args.model), Path(args.model)
    folder, recorded = path.parent, entry_of_report(path.parent, "sha256")
    if path.name not in recorded:  # without a report, or with one of something else
        return estimator
    beside = digests_of(folder, [each for each in recorded if Path(each).name == each])
    differing = [each for each in beside if beside[each] != recorded[each]]
    if differing:
        warn_caller(
            f"{folder / REPORT} is of another run than {', '.join(differing)} beside "
            "it, or these were changed since"
        )
    if path.name not in differing:
        missing = entry_of_report(folder, "table").get("missing_values", [])
        args.missing_value = [*args.missing_value, *missing]
    return estimator


def entry_of_report(folder: Path, name: str) -> dict[str, Any]:
    """Return an entry of the report in a folder, without one an empty dict."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        return dict(report[name])
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def digests_of(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the digests of the named files that exist in a folder."""
    found = {}
    for name in names:
        if (folder / name).is_file():
            with (folder / name).open("rb") as file:
                found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
