"""How far a table determines what was fitted to it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller

# The information matrix of the weak directions is computed from this many frames.
INFORMATIVE_FRAMES = 400
# Directions of the coefficients with a lower reliability are not supported by the
# table: noise has zero.
LEAST_RELIABILITY = 0.1
# Chance may be so many times its expected value. On tables of rigid objects (60 to
# 1,000 frames, 68 to 478 points, one to four basis shapes) all reliabilities are zero
# then; with 1.0 some are 0.9 (``python -m benchmarks.recovery rigid``).
CHANCE_MARGIN = 1.5
# Variances of directions below this share of the largest are rounding errors.
NO_VARIANCE = 1e-14
# Entries of V_k with a larger standard deviation count as not determined.
LARGEST_DEVIATION = 0.1
# Bounds on the noise variance with calibrated cameras over that with affine ones. Below
# the first, cameras are calibrated as far as the table tells. Above the second they
# hardly are. Measured on artificial tables: 1.02 for weak-perspective cameras, up to
# 1.2 for perspective ones at 8 to 2.5 radii, 22 to 48 for cameras that stretch the
# image. Motion capture with too few basis shapes has 1.1 to 4
# (``python -m benchmarks.accuracy cameras``).
SAME_NOISE, OTHER_CAMERAS = 1.3, 10.0


class Diagnostics(NamedTuple):
    """
    How far a table determines a fit.

    Attributes
    ----------
    camera_singular_values : ndarray of shape (3,)
        How much the images show of each direction of space: singular values of the
        stacked cameras, divided by the root of the number of rows. Frames have size
        one, and the mean shape is white.
    deformation_amplitude : float
        Root mean square of the deformation over that of the mean shape, in the space in
        which the mean shape is white.
    reliability : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are not uncertainty, of their
        own or of the shapes, along uncorrelated directions, decreasing. Directions near
        zero are noise: the table does not support as many basis shapes.
    effective_frames : ndarray of shape (n_components,)
        Effective number of frames that speak for each basis shape, ``(sum_i
        alpha_ik^2)^2 / sum_i alpha_ik^4``.
    weak_deviations : ndarray of shape (8 * n_components,)
        Standard deviations of the weakly determined parts of the basis shapes,
        increasing. Shapes ``B_k + V_k B_0`` differ from B_k in the images only by terms
        of second order in the deformation. Of each V_k (3x3) all but the trace can be
        determined. These are the standard deviations along the principal directions of
        all V_k, as far as they come from the noise, given the rest of the shapes. A
        value of 0.1 adds a tenth of the mean shape, per standard deviation of a
        coefficient. Calibrated cameras absorb rotations only: for them these are upper
        bounds.
    camera_noise_ratio : float
        Noise variance of the fit with calibrated cameras, divided by that of the fit
        with affine ones; NaN for models that were saved before it was measured.
    camera_meaning : str
        What that ratio says of the cameras, in a sentence.
    """

    camera_singular_values: NDArray
    deformation_amplitude: float
    reliability: NDArray
    effective_frames: NDArray
    weak_deviations: NDArray
    camera_noise_ratio: float
    camera_meaning: str


def diagnose(
    mean_shape: NDArray,
    basis: NDArray,
    motion: NDArray,
    alpha: NDArray,
    noise_variance: float,
    reliability: NDArray,
    camera_noise_ratio: float,
    loss: str,
) -> Diagnostics:
    """
    Return how far a table determines a fit, and warn where it does not.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape, white.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras of frames of size one.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    noise_variance : float
        Variance of a coordinate of frames of size one.
    reliability : ndarray of shape (n_components,)
        As of `reliabilities`.
    camera_noise_ratio : float
        As of `Diagnostics`.
    loss : {"linear", "huber", "cauchy"}
        That of the fit.

    Returns
    -------
    Diagnostics
        The figures.

    Warns
    -----
    UserWarning
        If the table does not support so many basis shapes, or not the weak directions.
    """
    rows = motion.reshape(-1, 3)
    deformation = np.einsum(
        "ik,il,kjc,ljc->", alpha, alpha, basis, basis, optimize=True
    ) / len(alpha)
    fourth = np.sum(alpha**4, axis=0)
    square = np.sum(alpha**2, axis=0) ** 2
    # The traces of the V_k, one direction each, are not determined: left out.
    information = weak_information(mean_shape, basis, motion, alpha)
    known = np.linalg.eigvalsh(information)[::-1][: 8 * len(basis)]
    floats = np.finfo(float)
    known = np.maximum(known, max(floats.eps * known[0], floats.tiny))
    found = Diagnostics(
        np.linalg.svd(rows, compute_uv=False) / np.sqrt(len(rows)),
        float(np.sqrt(deformation / np.sum(mean_shape**2))),
        reliability,
        np.divide(square, fourth, where=fourth > 0, out=np.zeros_like(square)),
        np.sqrt(noise_variance / known),
        camera_noise_ratio,
        camera_meaning(camera_noise_ratio),
    )
    unsupported = int(np.sum(reliability < LEAST_RELIABILITY))
    if unsupported:
        warn_caller(_unsupported(len(basis), unsupported, loss))
    elif found.weak_deviations[-1] > LARGEST_DEVIATION:
        warn_caller(
            "the table hardly determines the part of the basis shapes that cameras "
            "absorb: its largest standard deviation is "
            f"{found.weak_deviations[-1]:.2g} of the mean shape; take more frames or "
            "fewer basis shapes",
        )
    return found


def _unsupported(n_components: int, unsupported: int, loss: str) -> str:
    """Return the warning that some basis shapes may be noise."""
    if unsupported == n_components:
        text = (
            "no deformation was found beyond the noise: the object may be rigid, and "
            "all coefficients may be noise"
        )
    else:
        text = (
            f"the table does not support n_components={n_components}: {unsupported} "
            "direction(s) of the coefficients may well be noise; take at most "
            f"n_components={n_components - unsupported}"
        )
    if loss == "linear":
        text += '. If some points are far from where they belong, take loss="cauchy"'
    return text


def camera_meaning(ratio: float) -> str:
    """
    Return what the noise of calibrated cameras says of the cameras.

    Parameters
    ----------
    ratio : float
        Noise variance with calibrated cameras, divided by that with affine ones; NaN
        where it was not measured.

    Returns
    -------
    str
        A sentence.
    """
    if np.isnan(ratio):
        return "not known: the model was saved before this was measured"
    if ratio < SAME_NOISE:
        what = "calibrated cameras explain the table as well as affine ones"
    elif ratio < OTHER_CAMERAS:
        what = (
            "affine cameras explain more than calibrated ones: there may be too few "
            "basis shapes, whose part the cameras take over, perspective, or images "
            "that were stretched a little"
        )
    else:
        what = (
            "the cameras are hardly calibrated ones: images were stretched, or there "
            "are far too few basis shapes"
        )
    return f"{what} (noise variance {ratio:.3g} times that of affine cameras)"


def reliabilities(
    alpha: NDArray, covariance: NDArray, moments: NDArray, noise: float
) -> NDArray:
    """
    Return the shares of the variance of coefficients that are neither noise nor chance.

    Parameters
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    covariance : ndarray of shape (n_components, n_components)
        Mean over the frames of their posterior covariances.
    moments, noise : ndarray of shape (n_components, n_components), and float
        Sums over the blocks of frames, as of `shown_frames`.

    Returns
    -------
    ndarray of shape (n_components,)
        Squared correlations of the coefficients with the true ones, along uncorrelated
        directions, decreasing. Zero for directions that noise alone explains, and for
        those without any variance.

    Notes
    -----
    With known shapes they are the eigenvalues of ``(S + C)^-1 S``, with S the second
    moment of the coefficients and C the mean covariance: ``S + C`` is the whole
    variance. Estimated shapes follow the noise. A shape of ``gamma`` numbers a frame
    raises the variance along it from ``1 + l`` to ``y = (1 + l) (1 + gamma / l)`` noise
    variances, and noise alone to ``(1 + sqrt(gamma))^2``. The squared correlation is
    ``(l^2 - gamma) / (l (l + 1))`` (Benaych-Georges, Nadakuditi, "The singular values
    and vectors of low rank perturbations of large rectangular random matrices", 2012).
    Here ``y = 1 / (1 - share)``; gamma is y times the share of S that is chance.
    """
    known = alpha / np.sqrt(len(alpha))  # known.T @ known is S
    variance, axes = np.linalg.eigh(known.T @ known + covariance)
    kept = variance > NO_VARIANCE * variance[-1]
    white = axes[:, kept] / np.sqrt(variance[kept])
    # Squared singular values are the eigenvalues, with less rounding error.
    _, deviations, turn = np.linalg.svd(known @ white, full_matrices=False)
    own = white @ turn.T
    share = deviations**2
    left = np.einsum("kd,kl,ld->d", own, covariance, own)  # 1 / y
    caused = np.einsum("kd,kl,ld->d", own, moments, own) / (noise or 1.0)
    gamma = CHANCE_MARGIN * np.maximum(caused, 0.0)  # gamma share / y
    gamma = np.divide(gamma, share, where=share > 0, out=np.ones_like(share))
    rest = share - gamma
    found = (rest > 0) & (rest**2 > 4 * gamma * left)
    rest, gamma, left = rest[found], gamma[found], left[found]
    signal = (rest + np.sqrt(rest**2 - 4 * gamma * left)) / 2  # l / y
    correlation = (signal**2 - gamma * left) / (signal * (signal + left))
    shares = np.zeros(len(kept))
    shares[: len(signal)] = np.sort(correlation)[::-1]
    return shares


def weak_information(
    mean_shape: NDArray, basis: NDArray, motion: NDArray, alpha: NDArray
) -> NDArray:
    """
    Return the information matrix of V_k in the basis shapes ``B_k + V_k B_0``.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras of frames of size one.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (9 * n_components, 9 * n_components)
        Information matrix of V_1, ..., V_K for noise of variance one. Cameras and
        coefficients of the frames are unknown, the rest of the shapes is known.
    """
    n_frames, n_components = alpha.shape
    chosen = np.unique(np.linspace(0, n_frames - 1, INFORMATIVE_FRAMES).astype(int))
    total = np.zeros((9 * n_components, 9 * n_components))
    for i in chosen:
        shape = mean_shape + np.tensordot(alpha[i], basis, 1)
        shape = shape - shape.mean(axis=0)
        # Derivatives of the image (2J) in camera and coefficients span `tangent`.
        cameras = np.kron(np.eye(2), shape)
        moved = (basis @ motion[i].T).transpose(2, 1, 0).reshape(-1, n_components)
        tangent, _ = np.linalg.qr(np.hstack([cameras, moved]))
        # Derivatives in the nine entries of V, before the factor alpha_k. What camera
        # and coefficients can imitate is projected out.
        strain = np.einsum("ra,jb->rjab", motion[i], mean_shape).reshape(-1, 9)
        strain = strain - tangent @ (tangent.T @ strain)
        total += np.kron(np.outer(alpha[i], alpha[i]), strain.T @ strain)
    return total * (n_frames / len(chosen))
