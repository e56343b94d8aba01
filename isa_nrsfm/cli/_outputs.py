"""Write the results of a fit to a folder."""

import json
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from isa_nrsfm import AffineNRSfM, Decomposition, export
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.texts import as_utf8
from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm._transformer import frames_of
from isa_nrsfm.cli._reading import Frames
from isa_nrsfm.cli._runs import DIGESTS, REPORT, digests_of
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.io import save_model, write_table
from isa_nrsfm.metrics._reprojection import frame_energies

if TYPE_CHECKING:
    import pandas as pd

PAGE = "report.html"
# The files of every fit and their contents, of which the text has the first clause.
RESULTS = {
    PAGE: "this report with its figures, for any browser",
    "model.npz": "the fitted model, for isa-nrsfm transform",
    "alpha.csv": "row of the table, its other columns, the coefficients of each frame",
    "cameras.csv": "row of the table, camera of each frame: the image of a 3D point "
    "(X, Y, Z) is x = m00 X + m01 Y + m02 Z + tx, y = m10 X + m11 Y + m12 Z + ty; for "
    "calibrated cameras a scale times two rows of a rotation; inverse_snr is the "
    "energy of the reprojection error relative to that of the frame; yaw, pitch and "
    "roll in degrees, zero for a frontal, upright object, if the cameras determine "
    "them",
    "shapes.npz": "mean_shape, basis, alpha, cameras and names as arrays; the shape of "
    "a frame is mean_shape + sum_k alpha_k basis[k]",
    "viewer.html": "the shapes and the frames in 3D, for any browser",
}


def refuse_overwriting(sources: Iterable[str], targets: Iterable[Path]) -> None:
    """Raise if an output file would replace an input file."""
    existing = [target for target in targets if target.exists()]
    for source in sources:
        if any(target.samefile(source) for target in existing):
            raise ValueError(
                f"{source} would be overwritten by the results: choose another --output"
            )


def beside_other_columns(
    results: "pd.DataFrame", other: "pd.DataFrame"
) -> "pd.DataFrame":
    """Put the row number and a table's other columns in front of the results.

    Results with the name of another column get an underscore.
    """
    pd = import_optional("pandas", extra="io")
    taken = {str(name) for name in other.columns}
    names = {"row": "row"} | {str(name): str(name) for name in results.columns}
    for name in names:
        while names[name] in taken:
            names[name] += "_"
    renamed = [f"{new} (not {name})" for name, new in names.items() if new != name]
    if renamed:
        warn_caller(
            "the table has columns with the names of results, which were renamed to "
            f"{', '.join(renamed)}",
        )
    row = pd.Series(results.index, index=results.index, name=names["row"])
    return pd.concat([row, other, results.rename(columns=names)], axis=1)


def write_results(
    folder: Path,
    estimator: AffineNRSfM,
    frames: Frames,
    further: "pd.DataFrame",
    *,
    std: bool,
    drawn: dict[str, Any],
    **shown: Any,
) -> None:
    """Write model, coefficients with further columns, cameras, shapes and the viewer.

    The tables have a row for each frame, empty if it could not be fitted.
    """
    pd = import_optional("pandas", extra="io")
    fit, X = fitted_frames(estimator), frames.X
    alpha = alpha_table(fit, frames, std=std).join(further)
    write_table(beside_other_columns(alpha, frames.other), folder / "alpha.csv")

    cameras = pd.DataFrame(
        np.hstack([fit.motion.reshape(-1, 6), fit.translation]),
        index=X.index,
        columns=[*(f"m{i}{j}" for i in range(2) for j in range(3)), "tx", "ty"],
    )
    energy, error, _ = frame_energies(X, fitted_table(estimator, fit), estimator.layout)
    cameras["inverse_snr"] = error / energy
    camera: Literal["weak_perspective"] | None = None
    if frames_of(estimator).certainty.determined:  # otherwise the fit has warned
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", UserWarning)
                poses = export.frame_poses(estimator, X, **drawn)
            columns = pd.DataFrame(poses._asdict(), index=X.index)
            columns = columns.dropna(axis="columns", how="all")
            cameras = cameras.join(columns)
            camera = "weak_perspective" if len(columns.columns) else None
        except (ValueError, UserWarning) as error:
            warn_caller(
                f"viewer.html has affine shapes, and cameras.csv has no angles: {error}"
            )
    cameras = cameras.reindex(frames.points.index)
    cameras.insert(0, "row", cameras.index)
    write_table(cameras, folder / "cameras.csv")

    export.write_shapes(estimator, folder / "shapes.npz")
    export.write_viewer(
        estimator, folder / "viewer.html", X=X, camera=camera, **drawn, **shown
    )
    save_model(estimator, folder / "model.npz")


def alpha_table(fit: Decomposition, frames: Frames, *, std: bool) -> "pd.DataFrame":
    """Return the coefficients of all frames, empty for those that are not usable."""
    pd = import_optional("pandas", extra="io")
    names = names_of_components(None, fit.alpha.shape[1])
    alpha = pd.DataFrame(fit.alpha, columns=names)
    if std:
        alpha[[f"{name}_std" for name in names]] = fit.alpha_std
    alpha.index = frames.X.index
    return alpha.reindex(frames.points.index)


def fitted_frames(estimator: AffineNRSfM) -> Decomposition:
    """Return cameras and coefficients of the table that a model was fitted to."""
    alpha = estimator.alpha_
    std = getattr(estimator, "alpha_std_", np.full_like(alpha, np.nan))
    return Decomposition(estimator.motion_, estimator.translation_, alpha, std)


def fitted_table(estimator: AffineNRSfM, fit: Decomposition) -> np.ndarray:
    """Return the table of the model."""
    return estimator.inverse_transform(fit.alpha, fit.motion, fit.translation)


def write_report(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    """Write the report and digests of its files as JSON, NaN as null; return it."""
    digests = report.get(DIGESTS, {}) | digests_of(folder, report["files"])
    report = report | {DIGESTS: digests}
    text = json.dumps(_plain(report), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(folder / REPORT, f"{text}\n".encode())
    return report


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {as_utf8(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, int):
        return value
    return as_utf8(value if isinstance(value, str) else repr(value))
