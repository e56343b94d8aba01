"""The face prior: a fitted model of faces for tables that do not determine depths."""

from collections.abc import Sequence
from importlib.resources import files
from numbers import Integral

import numpy as np
from sklearn.utils import check_scalar

from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.models import DepthCertainty, FrameMap, FrameModel
from isa_nrsfm._parameters import FACE_PRIORS


def load_face_prior(
    n_components: int | None = None, *, layout: str = "ibug-68"
) -> AffineNRSfM:
    """
    Return a model of faces, to be the prior of tables with landmarks of faces.

    Frontal photos do not determine depths. This prior supplies the depths of faces, and
    how people and expressions differ. Coefficients of all tables of a layout that are
    fitted with it can be compared.

    Parameters
    ----------
    n_components : int, default=None
        K, the number of principal components of the shapes, at most 40. None is 40.
    layout : {"ibug-68", "ibug-51", "xm2vts-68", "xm2vts-53", "muct-76", "muct-61"}, \
default="ibug-68"
        The points, by the name of their layout in `isa_nrsfm.skeletons.SKELETONS`.

    Returns
    -------
    AffineNRSfM
        A fitted model with weak-perspective cameras. Depths point away from the viewer,
        y down. It has no frames of its own: figures, exports and diagnostics need a
        fit of a table with this prior.

    Raises
    ------
    ValueError, TypeError
        If `n_components` is not a whole number between 1 and 40, or there is no prior
        of the layout.

    Notes
    -----
    The shapes are those of ICT-FaceKit (Li et al., "Learning formation of
    physically-based face attributes", CVPR 2020), copyright 2020 USC Institute for
    Creative Technologies, MIT licence: 100 people with 25 expressions each, drawn from
    its identities and expressions. They are artificial and no random sample of mankind.
    Its landmarks are the inner points of iBUG-68. All other points are interpolated on
    its mesh, where annotators of photos click. The basis shapes are the principal
    components for iBUG-68, also for other layouts. ``benchmarks/face_prior.py`` makes
    the file.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import load_face_prior
    >>> prior = load_face_prior()
    >>> prior.basis_.shape
    (40, 68, 3)
    >>> model = AffineNRSfM("auto", camera="weak_perspective", prior=prior)
    """
    if layout not in FACE_PRIORS:
        raise ValueError(f"the layouts are {', '.join(FACE_PRIORS)}; got {layout!r}")
    return model_of_points(FACE_PRIORS[layout], n_components)


def model_of_points(
    points: Sequence[int], n_components: int | None = None
) -> AffineNRSfM:
    """Return the model of some of the points in the file."""
    path = files("isa_nrsfm.datasets") / "face_prior.npz"
    with path.open("rb") as file, np.load(file) as arrays:
        stored = {name: arrays[name].astype(np.float64) for name in arrays.files}
    n_stored = len(stored["shapes"]) - 1
    K = n_stored if n_components is None else n_components
    check_scalar(K, "n_components", Integral, min_val=1, max_val=n_stored)
    C, every = stored["moments"], stored["shapes"]
    layouts = (every[:, numbers] for numbers in (points, FACE_PRIORS["ibug-68"]))
    some, ibug = (B - B.mean(axis=1, keepdims=True) for B in layouts)
    # Frames of these points have size one, and their mean shape: those of iBUG-68 have
    # in the file.
    square, square_in_file = (
        np.einsum("ab,kja,kjb->", C, B, B) / B.shape[1] for B in (some, ibug)
    )
    share, size = square / square_in_file, np.sqrt(np.mean(some[0] ** 2))
    C, shapes = C * size**2 / share, some / size
    mean_shape, basis = shapes[0], shapes[1 : K + 1]
    noise, inverse_snr, floor, total, residual, *images = stored["numbers"].tolist()
    # Components that are left out become noise of the two coordinates of an image.
    others = shapes[K + 1 :]
    left = np.einsum("ab,kja,kjb->", C, others, others) / (2 * len(mean_shape))
    known = {"residual": residual / share + 2.0 * left, "images": tuple(images)}
    variances = stored["points"][points] / share
    certainty = DepthCertainty(total, 0.0, stored["turns"], variances, **known)
    noise, camera = noise / share + left, "weak_perspective"
    shapes = np.ascontiguousarray(shapes[: K + 1].mT)
    gauge, starts = FrameMap.identity(K), np.zeros((0, K))
    frames = FrameModel(shapes, noise, starts, "linear", gauge, camera, certainty)
    share = stored["energy_share"][:K]
    model = AffineNRSfM(K, camera="weak_perspective")
    model.__dict__ |= {
        "_model": TableModel(frames, mean_shape, basis, K, "interleaved", None),
        "_n_features_out": K,
        "n_components_": K,
        "n_features_in_": 2 * len(mean_shape),
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
        "rank_floor_": floor,
        "reference_motion_": stored["view"],
        "reference_translation_": np.zeros(2),
        "isa_": None,
        "n_iter_": 0,
    }
    return model
