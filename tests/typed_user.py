"""A script that uses the package, for mypy: it is checked strictly, and never run."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

import isa_nrsfm
from isa_nrsfm import AffineNRSfM, Decomposition, FastISA, PooledFastICA
from isa_nrsfm.baselines import BlockMatrixNRSfM
from isa_nrsfm.calibration import canonical_pose, deformation_metric, euclidean_frames
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import landmark_table, load_model, open_table, save_model
from isa_nrsfm.metrics import affine_shape_error, inverse_snr
from isa_nrsfm.plotting import BasisShapeDisplay

Floats = NDArray[np.float64]


def fitted(table: Floats, n_components: int = 4) -> AffineNRSfM:
    isa = FastISA(n_init=2) if n_components > 2 else PooledFastICA()
    return AffineNRSfM(n_components, isa=isa, random_state=0).fit(table)


def of_methods(model: AffineNRSfM, table: Floats, folder: Path) -> Floats:
    found: Decomposition = model.decompose(table)
    image: Floats = model.inverse_transform(found.alpha, found.motion)
    save_model(model, folder / "model.npz")
    loaded: AffineNRSfM = load_model(folder / "model.npz")
    reliable: bool = bool((loaded.diagnostics().reliability > 0.5).all())
    score: float = model.score(table)
    error: float = inverse_snr(table, model.reproject(table)) if reliable else score
    return image * error


def of_attributes(model: AffineNRSfM) -> Floats:
    metric = deformation_metric(model.motion_, model.alpha_)
    shapes = model.mean_shape_, model.basis_
    frames = euclidean_frames(metric, model.motion_, model.alpha_, *shapes)
    upright: Floats = canonical_pose(frames.shapes.mean(axis=0), scheme="ibug-68").shape
    return upright * model.noise_variance_ * model.n_iter_


def of_calibrated_cameras(table: Floats) -> tuple[Floats, str]:
    model = AffineNRSfM("auto", camera="weak_perspective").fit(table).mirrored()
    poses: Floats = model.rotations_ * model.scales_[:, None, None]
    ratio: float = model.camera_noise_ratio_
    return poses * ratio, model.diagnostics().camera_meaning


def of_misspelt_names() -> None:
    isa_nrsfm.AffineNRSFM  # type: ignore[attr-defined] # noqa: B018


def of_misspelt_values() -> None:
    AffineNRSfM(camera="weak")  # type: ignore[arg-type]
    AffineNRSfM(refinement="paper")  # type: ignore[arg-type]
    AffineNRSfM(loss="squared")  # type: ignore[arg-type]
    AffineNRSfM(independence="frames")  # type: ignore[arg-type]
    AffineNRSfM(block_recovery="qr")  # type: ignore[arg-type]


def main(folder: Path) -> float:
    faces = make_face_tracks(n_frames=100, random_state=0)
    points, _ = landmark_table(pd.read_csv(folder / "faces.csv"))
    model = fitted(faces.data).fit(points).fit(open_table(folder / "faces.npy"))
    alpha: Floats = BlockMatrixNRSfM(n_components=2).fit_transform(faces.data)
    BasisShapeDisplay.from_estimator(model).plot()
    error: float = affine_shape_error(faces.shapes, model.reconstruct(faces.data))
    return error + float(alpha.sum())
