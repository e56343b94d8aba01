"""The face prior: a fitted model of faces for tables that do not determine depths."""

from importlib.resources import files
from numbers import Integral

import numpy as np
from sklearn.utils import check_scalar

from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.models import DepthCertainty, FrameMap, PosteriorFrames


def load_face_prior(n_components: int | None = None) -> AffineNRSfM:
    """
    Return a model of faces, to be the prior of tables with 68 landmarks (iBUG-68).

    Frontal photos do not determine depths. With this prior they need not: it knows how
    deep faces are, and how people and expressions differ. Coefficients of all tables
    that are fitted with it can be compared.

    Parameters
    ----------
    n_components : int, default=None
        K, the number of principal components of the shapes, at most 40. None is 40.

    Returns
    -------
    AffineNRSfM
        A fitted model with weak-perspective cameras. Depths point away from the viewer,
        y down. It has no frames of its own: figures, exports and diagnostics need a
        fit of a table with this prior.

    Raises
    ------
    ValueError, TypeError
        If `n_components` is not a whole number between 1 and 40.

    Notes
    -----
    The shapes are those of ICT-FaceKit (Li et al., "Learning formation of
    physically-based face attributes", CVPR 2020), copyright 2020 USC Institute for
    Creative Technologies, MIT licence: 100 people with 25 expressions each, drawn from
    its identities and expressions. They are artificial and no random sample of mankind.
    The points of the jaw are interpolated on its mesh where annotators of photos click.
    ``benchmarks/face_prior.py`` makes the file.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import load_face_prior
    >>> prior = load_face_prior()
    >>> prior.basis_.shape
    (40, 68, 3)
    >>> model = AffineNRSfM("auto", camera="weak_perspective", prior=prior)
    """
    path = files("isa_nrsfm.datasets") / "face_prior.npz"
    with path.open("rb") as file, np.load(file) as arrays:
        stored = {name: arrays[name].astype(np.float64) for name in arrays.files}
    most = len(stored["basis"])
    K = most if n_components is None else n_components
    check_scalar(K, "n_components", Integral, min_val=1, max_val=most)
    mean_shape, basis = stored["mean_shape"], stored["basis"][:K]
    noise, inverse_snr, rank_floor, *certain = stored["numbers"].tolist()
    # Components that are left out become noise of the two coordinates of an image.
    C, others = stored["moments"], stored["basis"][K:]
    left = np.einsum("ab,kja,kjb->", C, others, others) / (2 * len(mean_shape))
    total, residual, constant, slope = certain
    certainty = DepthCertainty(
        total,
        0.0,
        stored["turns"],
        stored["points"],
        residual=residual + 2.0 * left,
        images=(constant, slope),
    )
    noise, camera = noise + left, "weak_perspective"
    shapes = np.ascontiguousarray(np.concatenate([mean_shape[None], basis]).mT)
    gauge, starts = FrameMap.identity(K), np.zeros((0, K))
    frames = PosteriorFrames(shapes, noise, starts, "linear", gauge, camera, certainty)
    share, n_features = stored["energy_share"][:K], 2 * len(mean_shape)
    model = AffineNRSfM(K, camera="weak_perspective")
    model.__dict__ |= {
        "_model": TableModel(frames, mean_shape, basis, K, "interleaved", None),
        "_n_features_out": K,
        "n_components_": K,
        "n_features_in_": n_features,
        "camera_": camera,
        "frames_scaled_": True,
        "mean_shape_": mean_shape,
        "basis_": basis,
        "noise_variance_": noise,
        "depth_uncertainty_": total,
        "mirror_certainty_": 1.0,
        "reliability_": stored["reliability"][:K],
        "energy_share_": share / share.sum(),
        "mode_covariance_": np.kron(np.eye(K), C) / 2,
        "singular_values_": stored["singular_values"][: 3 * K + 3],
        "inverse_snr_": inverse_snr,
        "rank_floor_": rank_floor,
        "reference_motion_": stored["view"],
        "reference_translation_": np.zeros(2),
        "isa_": None,
        "n_iter_": 0,
    }
    return model
