"""Write the results of a fit to a folder."""

import contextlib
import io
import json
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from isa_nrsfm import AffineNRSfM, Decomposition, export
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.texts import as_utf8
from isa_nrsfm._compat.whole_files import check_replaceable, write_whole
from isa_nrsfm._transformer import frames_of
from isa_nrsfm.cli._frames import Frames
from isa_nrsfm.cli._progress import show_stage
from isa_nrsfm.cli._runs import DIGESTS, REPORT, digests_of, files_of_report
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.io import save_model, write_table
from isa_nrsfm.metrics._reprojection import frame_energies

if TYPE_CHECKING:
    import pandas as pd

    from isa_nrsfm import AffineNRSfMCV

FIGURES = {
    "basis_shapes.png": "mean shape and basis shapes",
    "mode_covariance.png": "covariance of the deformations over the images, 3x3 blocks",
    "reprojection.png": "some frames, as observed and as the model has them",
}
CHOICE_FIGURE = {"choice.png": "held-out error by the number of basis shapes"}
TABLES = {
    "alpha.csv": "row of the table, its other columns, the coefficients of each frame",
    "cameras.csv": "row of the table, camera of each frame: the image of a 3D point "
    "(X, Y, Z) is x = m00 X + m01 Y + m02 Z + tx, y = m10 X + m11 Y + m12 Z + ty; of "
    "calibrated cameras a scale times two rows of a rotation; "
    "inverse_snr is the energy of the reprojection error relative to the frame's; yaw, "
    "pitch and roll in degrees, zero for a frontal, upright object, where the cameras "
    "tell them",
}
ARRAYS = {
    "shapes.npz": "mean_shape, basis, alpha, cameras and names as arrays; the shape of "
    "a frame is mean_shape + sum_k alpha_k basis[k]",
}
NOT_TOLD = "viewer.html has affine shapes, and cameras.csv no angles"
PAGE = {"viewer.html": "the shapes and the frames in 3D, for any browser"}
MODEL = {"model.npz": "the fitted model, for isa-nrsfm transform"}


def component_names(n_components: int) -> list[str]:
    """Name the coefficients, counted from 1: number 0 is the mean shape."""
    return names_of_components(None, n_components)


def old_figures(folder: Path, new: Iterable[str]) -> list[str]:
    """Return the names of figures of an earlier run, which its report lists.

    Of others that no new file replaces it is said that they are old.
    """
    listed = files_of_report(folder)
    old = sorted(name for name in listed if name.endswith(".png"))
    others = sorted(
        name for name in {*FIGURES} - {*old, *new} if (folder / name).exists()
    )
    if others:
        warn_caller(f"{folder} has figures of an earlier run: {', '.join(others)}")
    return old


def check_outputs(targets: Iterable[Path], inputs: Iterable[str]) -> None:
    """Raise if files cannot be replaced by results, or are inputs."""
    targets = list(targets)
    for source in inputs:
        refuse_overwriting(source, targets)
    for target in targets:
        check_replaceable(target)


def refuse_overwriting(source: str, targets: Iterable[Path]) -> None:
    """Raise if an output file would replace an input file."""
    for target in targets:
        if target.exists() and target.samefile(source):
            raise ValueError(
                f"{source} would be overwritten by the results: choose another --output"
            )


def beside_other_columns(
    results: "pd.DataFrame", other: "pd.DataFrame"
) -> "pd.DataFrame":
    """Put the row number and a table's other columns in front of the results.

    An underscore is added to the names of results that the other columns have, too.
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
            f"the table has columns named like results, which are called "
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
    labels: "pd.Series | None" = None,
    times: Any = None,
    edges: Any = "auto",
    origin: Any = "auto",
) -> None:
    """Write model, coefficients with further columns, cameras, shapes and the viewer.

    The tables have a row for each frame, empty for those that could not be fitted. The
    labels and times are those of the frames in the viewer.
    """
    fit = fitted_frames(estimator)
    alpha = alpha_table(fit, frames, std=std).join(further)
    write_table(beside_other_columns(alpha, frames.other), folder / "alpha.csv")

    X = frames.points[frames.usable]
    if frames_of(estimator).certainty.determined:
        poses = told_poses(estimator, X, NOT_TOLD, edges=edges, origin=origin)
    else:  # the fit has warned
        pd = import_optional("pandas", extra="io")
        poses = pd.DataFrame(index=X.index)
    cameras = camera_table(estimator, fit, X).join(poses)
    cameras = cameras.reindex(frames.points.index)
    cameras.insert(0, "row", cameras.index)
    write_table(cameras, folder / "cameras.csv")

    export.write_shapes(estimator, folder / "shapes.npz")
    export.write_viewer(
        estimator,
        folder / "viewer.html",
        X=X,
        edges=edges,
        origin=origin,
        labels=labels,
        times=times,
        camera="weak_perspective" if len(poses.columns) else None,
    )
    save_model(estimator, folder / "model.npz")


def camera_table(
    estimator: AffineNRSfM, fit: Decomposition, X: "pd.DataFrame"
) -> "pd.DataFrame":
    """Return cameras and reprojection errors of frames, with the index of the table."""
    pd = import_optional("pandas", extra="io")
    cameras = pd.DataFrame(
        np.hstack([fit.motion.reshape(-1, 6), fit.translation]),
        index=X.index,
        columns=[*(f"m{i}{j}" for i in range(2) for j in range(3)), "tx", "ty"],
    )
    energy, error, _ = frame_energies(X, fitted_table(estimator, fit), estimator.layout)
    cameras["inverse_snr"] = error / energy
    return cameras


def told_poses(
    estimator: AffineNRSfM, X: "pd.DataFrame", otherwise: str, **drawn: Any
) -> "pd.DataFrame":
    """Return yaw, pitch, roll, scale and deviations of frames as columns.

    There are none, with a warning that says what is done otherwise, where the cameras
    hardly tell the metric of space.
    """
    pd = import_optional("pandas", extra="io")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            poses = export.frame_poses(estimator, X, **drawn)
    except (ValueError, UserWarning) as error:
        warn_caller(f"{otherwise}: {error}")
        return pd.DataFrame(index=X.index)
    columns = pd.DataFrame(poses._asdict(), index=X.index)
    return columns.dropna(axis="columns", how="all")


def write_page(path: Path, estimator: AffineNRSfM, X: Any, **drawn: Any) -> None:
    """Write the viewer, with affine shapes where the cameras hardly tell others."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            export.write_viewer(estimator, path, X=X, **drawn)
    except (ValueError, UserWarning) as error:
        warn_caller(f"{path.name} has affine shapes: {error}")
        export.write_viewer(estimator, path, X=X, camera=None, **drawn)


def alpha_table(fit: Decomposition, frames: Frames, *, std: bool) -> "pd.DataFrame":
    """Return the coefficients of all frames, empty for those that are not usable."""
    pd = import_optional("pandas", extra="io")
    names = component_names(fit.alpha.shape[1])
    alpha = pd.DataFrame(fit.alpha, columns=names)
    if std:
        alpha[[f"{name}_std" for name in names]] = fit.alpha_std
    alpha.index = frames.points.index[frames.usable]
    return alpha.reindex(frames.points.index)


def fitted_frames(estimator: AffineNRSfM) -> Decomposition:
    """Return cameras and coefficients of the table that a model was fitted to."""
    alpha = estimator.alpha_
    std = getattr(estimator, "alpha_std_", np.full_like(alpha, np.nan))
    return Decomposition(estimator.motion_, estimator.translation_, alpha, std)


def fitted_table(estimator: AffineNRSfM, fit: Decomposition) -> np.ndarray:
    """Return a table as the model has it."""
    return estimator.inverse_transform(fit.alpha, fit.motion, fit.translation)


def write_figures(
    folder: Path,
    estimator: AffineNRSfM,
    points: "pd.DataFrame",
    random_state: int,
    search: "AffineNRSfMCV | None" = None,
    **drawn: Any,
) -> None:
    """Draw the figures without a screen, that of the choice if there was a search."""
    import_optional("matplotlib", extra="plot").use("Agg")
    from isa_nrsfm.plotting import (
        BasisShapeDisplay,
        ComponentChoiceDisplay,
        ModeCovarianceDisplay,
        ReprojectionDisplay,
    )

    figures: list[Callable[[], Any]] = [
        lambda: BasisShapeDisplay.from_estimator(estimator, **drawn),
        lambda: ModeCovarianceDisplay.from_estimator(estimator),
        lambda: ReprojectionDisplay.from_estimator(
            estimator, points, random_state=random_state, **drawn
        ),
        lambda: ComponentChoiceDisplay.from_estimator(search),
    ]
    names = [*FIGURES, *(CHOICE_FIGURE if search is not None else ())]
    for name, draw in zip(names, figures, strict=False):
        with figure_named(name):
            write_figure(folder / name, draw().figure_)


@contextlib.contextmanager
def figure_named(name: str) -> Iterator[None]:
    """Warn if a figure cannot be drawn: results do not depend on it."""
    show_stage(name)
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        warn_caller(f"{name} was not drawn: {error or type(error).__name__}")


def write_figure(path: Path, figure: Any) -> None:
    """Write a figure, and close it."""
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=150)
    import_optional("matplotlib.pyplot", extra="plot").close(figure)
    write_whole(path, image.getvalue())


def write_report(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    """Write the report as JSON, in which NaN and infinities become null.

    It gets the digests of those of its files that are in the folder, beside those that
    it has. Return it.
    """
    digests = report.get(DIGESTS, {}) | digests_of(folder, report["files"])
    report = report | {DIGESTS: digests}
    text = json.dumps(_plain(report), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(folder / REPORT, f"{text}\n".encode())
    return report


def _plain(value: Any) -> Any:
    """Turn a value into what JSON can hold."""
    if isinstance(value, dict):
        return {as_utf8(str(key)): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, int):
        return value
    return as_utf8(value if isinstance(value, str) else repr(value))
