"""Diagnostics of a fit: figures, their messages, a summary, and the stability.

Stability is the agreement of the coefficients of fits of different people.
"""

import html
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from sklearn.base import TransformerMixin
from sklearn.utils import estimator_html_repr

from isa_nrsfm._compat.lazy import cached_property
from isa_nrsfm._compat.scikit_learn import CoefficientsMixin, one_blas_thread
from isa_nrsfm._compat.texts import aligned, first_items, percent
from isa_nrsfm._fitted_model import removed_part
from isa_nrsfm._frames.camera_models import pose_effect, pose_part
from isa_nrsfm._frames.gauge import independent_gauge
from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._joint.uncertainty import HalfTables
from isa_nrsfm._linalg import OF_RANKS, polar
from isa_nrsfm._parameters import named
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.analysis import _advice
from isa_nrsfm.analysis._advice import SAME_UNIT, camera_meaning
from isa_nrsfm.analysis._frame_columns import unit_columns
from isa_nrsfm.skeletons._column_names import names_of_points

# Threshold of the pose share of a coefficient. Real faces of 68 points, K = 8, have up
# to 0.70 with the jaw; generated faces, whose points are fixed, at most 0.03.
MOST_POSE = 0.3


class Diagnostics(NamedTuple):
    """
    Figures and messages on how well a table determines its fit.

    Attributes
    ----------
    camera_singular_values : ndarray of shape (3,)
        Visibility of each direction of space in the images: singular values of the
        stacked cameras of frames of size one, over the root of the number of rows.
    deformation_amplitude : float
        RMS of the deformation, relative to that of the mean shape.
    reliability : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are signal, not uncertainty of
        coefficients or shapes. They belong to uncorrelated directions, in decreasing
        order. Directions near zero are noise: the table does not support as many basis
        shapes.
    stability : tuple of str
        Whether each coefficient is reproduced by a fit of other people with a
        correlation of at least .85 (`stability_`): "stable", "only together with" up to
        two others, whose combination is reproduced, or "unstable". Empty if not known.
    effective_frames : ndarray of shape (n_components,)
        Effective number of frames that determine each basis shape, ``(sum_i
        alpha_ik^2)^2 / sum_i alpha_ik^4``.
    weak_deviations : ndarray of shape (8 * n_components,)
        Standard deviations of the weakly determined parts of the basis shapes,
        increasing. Shapes ``B_k + V_k B_0`` differ from B_k in the images only by terms
        of second order in the deformation. Each V_k (3x3) can be determined except for
        its trace. These are standard deviations along the principal directions of all
        V_k. They include the noise only: the rest of the shapes is taken as known. 0.1
        adds a tenth of the mean shape, per standard deviation of a coefficient.
        Calibrated cameras absorb rotations only: for them these are upper bounds.
    depth_uncertainty : float
        Expected RMS error of the depths of the frames, relative to their RMS. NaN for
        affine cameras, whose depth is known up to an affinity only.
    camera_noise_ratio : float
        Noise variance of the fit with calibrated cameras, divided by that of the fit
        with affine ones; NaN for models that were saved before it was measured.
    camera_meaning : str
        Meaning of that ratio, in a sentence.
    pose_share : ndarray of shape (n_components,)
        Share of the variance of each coefficient that the pose predicts: R^2 of a
        linear regression on the rotation, for each fifth of the rows fitted to the
        others. Zero or negative if there is no relation, also in small tables. It does
        not depend on the scale of the depths. NaN with fewer than 20 frames, or if the
        frames turn by less than the error of their rotations.
    pose_removed : ndarray of shape (n_components,)
        Share of the variance of each coefficient that `remove_pose` has removed.
    outlier_share : float
        Share of the points of a table with gross residuals, more than 8 robust standard
        deviations. NaN without a table.
    outlier_energy : float
        Share of the squared residuals that these have. Above 0.04, the table has
        outliers.
    outliers : ndarray of shape (n_outliers, 2)
        Row and point of each gross residual, the largest first.
    messages : tuple of str
        What happened, why, and what to do: at most three, the most important first;
        empty if all is well. If the fit is poor, only that is named. If the table has
        outliers and the loss is linear, only these and a depth that is not determined.
    held_out_error : float
        Share of the energy of points left out of the fit of their frame that the others
        do not predict, in at most 300 rows: minus `AffineNRSfM.score`, and of the
        median point if the loss is robust. NaN without a table.
    fit : str
        "good" if `held_out_error` is at most 2 %, "fair" up to 20 %, otherwise "poor".
    depth : str
        "good" if `depth_uncertainty` is at most 20 %, "fair" up to 60 %, otherwise
        "poor". Both are empty if they are not known.
    """

    camera_singular_values: NDArray
    deformation_amplitude: float
    reliability: NDArray
    stability: tuple[str, ...]
    effective_frames: NDArray
    weak_deviations: NDArray
    depth_uncertainty: float
    camera_noise_ratio: float
    camera_meaning: str
    pose_share: NDArray
    pose_removed: NDArray
    outlier_share: float
    outlier_energy: float
    outliers: NDArray
    messages: tuple[str, ...] = ()
    held_out_error: float = np.nan
    fit: str = ""
    depth: str = ""

    def __repr__(self) -> str:
        """Return the messages, the figures of the table and those of coefficients."""
        error = "not estimated"
        if math.isfinite(self.depth_uncertainty):
            error = f"{percent(self.depth_uncertainty)} of the depth"
        shares = first_items((f"{share:.2f}" for share in self.reliability), 12)
        shown = ["" if math.isnan(s) else percent(max(s, 0.0)) for s in self.pose_share]
        columns: dict[str, Sequence[str]] = {
            "": [f"alpha_{k + 1}" for k in range(len(shown))],
            "effective frames": [f"{n:.1f}" for n in self.effective_frames],
            "pose share": shown,
        }
        if self.pose_removed.any():
            columns["removed"] = [*map(percent, self.pose_removed)]
        columns["in another fit"] = self.stability
        quality = "" if not self.fit else f"{self.fit.upper()}, "
        quality += f"{percent(self.held_out_error)} of left-out points unexplained"
        lines = [
            f"fit: {quality if self.fit else 'not known without the table'}",
            f"depth: {self.depth.upper() or 'not known for affine cameras'}",
            *(self.messages or ["no warning"]),
            f"cameras: {self.camera_meaning}",
            f"depth error: {error}",
            f"deformation: {percent(self.deformation_amplitude)} of the mean shape",
            f"reliability, along uncorrelated directions: {shares}",
            aligned(columns),
        ]
        return "\n".join(lines)


class DiagnosedMixin(CoefficientsMixin, TransformerMixin):
    """A transformer to coefficients that tells of them what it is asked."""

    # A pipeline passes groups only if they are requested.
    __metadata_request__fit: ClassVar[dict[str, bool]] = {"groups": False}
    _halves: HalfTables | None
    _model: Any

    @cached_property
    def _stability(self) -> tuple[NDArray, NDArray]:
        """Stability (K,) and stable sets (K, K) of the coefficients."""
        if "_halves" not in vars(self):
            needs = "stability_ and stable_sets_ need a joint fit without a prior"
            raise AttributeError(needs, name="stability_", obj=self)
        K = self._model.n_components
        if self._halves is None:
            return np.full(K, np.nan), np.zeros((K, K), dtype=bool)
        return stability(self._halves, self._model.frames.gauge, K)

    @cached_property
    def stability_(self) -> NDArray:
        """Expected correlation (K,) of each coefficient with that of another fit."""
        return self._stability[0]

    @cached_property
    def stable_sets_(self) -> NDArray:
        """Coefficients (K, K) in whose space each one lies in another fit, too."""
        return self._stability[1]

    def _html_repr(self) -> str:
        """Return scikit-learn's diagram for notebooks, and a summary."""
        picture = estimator_html_repr(self)
        return picture + summary_html(self) if hasattr(self, "basis_") else picture


@one_blas_thread()
def diagnose(
    estimator: Any, table: FrameBlocks | None, weights: Sequence[NDArray], rows: Any
) -> Diagnostics:
    """Return the diagnostics of a joint fit whose frames were kept.

    `table` is that of the fit, with weights of its points, if any, and `rows` are the
    names of the rows.
    """
    model = estimator._model  # with the directions that are not reported
    frames, sizes = model.frames, estimator._frame_sizes
    distance, held_out_error = None, np.nan
    if table is not None:
        if table.n_frames != len(sizes):
            raise ValueError(
                f"diagnostics needs the fitted table, which has {len(sizes)} rows; got "
                f"X with {table.n_frames}"
            )
        fit = table.joined(partial(model.decompose, deviations=False), *weights)[:3]
        distance = table.joined(model.distances, *fit, *weights)
        held_out_error = model.held_out_error(table, *weights)
    fitted = np.isfinite(sizes)
    motion = np.asarray(estimator.motion_)[fitted] / sizes[fitted, None, None]
    remaining = np.asarray(estimator.alpha_, dtype=np.float64)
    coefficients = remaining + removed_part(estimator, estimator.motion_)
    alpha, remaining = coefficients[fitted], remaining[fitted]
    mean_shape = estimator.mean_shape_.astype(np.float64)
    basis = estimator.basis_.astype(np.float64)
    images, flat = motion.reshape(-1, 3), basis.reshape(len(basis), -1)
    deformation = np.vdot(alpha.T @ alpha, flat @ flat.T) / len(alpha)
    square, fourth = np.sum(alpha**2, axis=0) ** 2, np.sum(alpha**4, axis=0)
    # The traces of the V_k, one direction each, are not determined. Leave them out.
    information = weak_information(mean_shape, basis, motion, alpha)
    eigenvalues = np.linalg.eigvalsh(information)[::-1][: 8 * len(basis)]
    floats = np.finfo(float)
    eigenvalues = np.maximum(eigenvalues, max(floats.eps * eigenvalues[0], floats.tiny))
    ratio = getattr(estimator, "camera_noise_ratio_", np.nan)
    turns = frames.certainty.turns
    error = 0.0 if turns is None else float(np.trace(turns))
    share, variance = pose_share(motion, remaining, error), alpha.var(axis=0)
    without = remaining - pose_part(motion, pose_effect(motion, remaining))
    removable = np.nanmax(pose_share(motion, without, error), initial=0.0) <= MOST_POSE
    removed = variance - remaining.var(axis=0)
    found = Diagnostics(
        np.linalg.svd(images, compute_uv=False) / np.sqrt(len(images)),
        float(np.sqrt(deformation / np.sum(mean_shape**2))),
        estimator.reliability_,
        stability_words(estimator),
        np.divide(square, fourth, where=fourth > 0, out=np.zeros_like(square)),
        np.sqrt(frames.noise_variance / eigenvalues),
        frames.certainty.total,
        ratio,
        camera_meaning(ratio),
        share,
        np.divide(removed, variance, where=variance > 0, out=np.zeros_like(variance)),
        *_advice.gross_residuals(distance),
        held_out_error=held_out_error,
        fit=_advice.verdict(held_out_error, *_advice.FIT),
        depth=_advice.verdict(frames.certainty.total, *_advice.DEPTH),
    )
    facts = _advice.Facts(
        estimator,
        held_out_error=held_out_error,
        deviation=found.weak_deviations[-1],
        outlier_energy=found.outlier_energy,
        outliers=outlier_text(found, rows, names_of_points(estimator)),
        few=_few_frames(found, coefficients, rows),
        pose=_of_pose(found, estimator, removable),
    )
    return found._replace(messages=_advice.advice(facts))


def pose_share(motion: NDArray, alpha: NDArray, error: float = 0.0) -> NDArray:
    """Return the share of the variance of coefficients that the pose predicts.

    R^2 (n_components,) in fifths of the rows that are left out of a regression on the
    nine entries of the nearest rotations, second order in yaw, pitch and roll. NaN for
    zero coefficients, with fewer than 20 frames, or if the mean square of the rotations
    from their mean is below their error, radians squared: coefficients cause it.
    """
    rows = polar(motion)[0]
    third = np.cross(rows[:, 0], rows[:, 1])
    predictors = np.hstack([np.ones((len(alpha), 1)), rows.reshape(-1, 6), third])
    # Of small rotations, the entries have twice the mean square of the vectors.
    if len(alpha) < 20 or predictors.var(axis=0).sum() < 2.0 * error:
        return np.full(alpha.shape[1], np.nan)
    left_out = alpha.copy()
    # Neighbours of single frames of a video predict them without any relation to the
    # pose, fifths do not: docs/benchmarks/README.md, "Thresholds".
    for part in np.array_split(np.arange(len(alpha)), 5):
        known, others = (np.delete(x, part, axis=0) for x in (predictors, alpha))
        left_out[part] -= predictors[part] @ np.linalg.lstsq(known, others, OF_RANKS)[0]
    energy = np.sum((alpha - alpha.mean(axis=0)) ** 2, axis=0)
    energy[energy == 0] = np.nan
    return np.asarray(1 - np.sum(left_out**2, axis=0) / energy)


def outlier_text(found: Diagnostics, rows: Any, names: Sequence[str]) -> str:
    """Describe the outliers; empty if they are few enough to ignore."""
    if not found.outlier_energy > _advice.MOST_GROSS:
        return ""
    frames = np.unique(found.outliers[:, 0])
    points, counts = np.unique(found.outliers[:, 1], return_counts=True)
    most = points[np.argsort(-counts, kind="stable")]
    return (
        f"the table has outliers: {len(found.outliers)} points "
        f"({100 * found.outlier_share:.2g} %) in {len(frames)} frames are more than "
        f"{_advice.GROSS:g} standard deviations from the model, in the rows "
        f"{first_items((rows[i] for i in frames), 5)}, most often the points "
        f"{first_items((names[j] for j in most), 5)}"
    )


def _few_frames(found: Diagnostics, alpha: NDArray, rows: Any) -> str:
    """Describe coefficients that a few frames decide; empty if there are none."""
    n_frames = np.count_nonzero(~np.isnan(alpha[:, 0]))
    effective = found.effective_frames
    # Smallest numbers without outliers, on the tables named at MOST_GROSS: 20 of 307 to
    # 320 of 1000 frames. With outliers: 1 to 20.
    few = (effective > 0) & (effective < min(10.0, 0.1 * n_frames))
    phrases = [
        f"alpha_{k + 1} ({effective[k]:.1f} effective frames, most row "
        f"{rows[np.nanargmax(np.abs(alpha[:, k]))]})"
        for k in np.flatnonzero(few)
    ]
    text = (
        f"a few of the {n_frames} frames determine {first_items(phrases, 5)}. Look for "
        "wrong landmarks in the frames with the largest coefficients"
    )
    return text if phrases else ""


def _of_pose(found: Diagnostics, model: Any, removable: bool) -> str:
    """Describe coefficients that the pose predicts; empty if there are none.

    removable: whether none is left with `remove_pose`.
    """
    large = np.flatnonzero(found.pose_share > MOST_POSE)
    if not len(large):
        return ""
    phrases = [f"{100 * found.pose_share[k]:.0f} % of alpha_{k + 1}" for k in large]
    text = f"the pose predicts {first_items(phrases, 5)}"
    shape, mean_shape = model.basis_[np.nanargmax(found.pose_share)], model.mean_shape_
    deformation = shape - mean_shape @ np.linalg.lstsq(mean_shape, shape)[0]
    if 2 * np.sum(deformation**2) < np.sum(shape**2):
        return f"{text}: they stretch the whole shape. Make sure that {SAME_UNIT}"
    if model.remove_pose:
        return (
            f"{text}, beyond what {named('remove_pose')} has removed. Compare "
            "coefficients of similar views only"
        )
    way = f"if it moves alike in all views, use {named('remove_pose', True)}"
    if model.camera_ == "affine":
        way = "use isa_nrsfm.AutoNRSfM(AffineNRSfM(remove_pose=True)).fit(X)"
    elif not removable:
        way = "compare coefficients of similar views only"
    layout = _advice.layout_of(model)
    if layout is None or not layout.contour or model.prior is not None:
        return (
            f"{text}: points slide over the surface as the view changes, or the object "
            f"moves otherwise in other views: {way}"
        )
    return (
        f"{text}: {len(layout.contour)} points of {layout.name} follow the visible "
        "outline, which slides over the surface as the head turns. Fit the other "
        "points alone (--points inner; in Python the columns "
        f"get_skeleton({layout.name!r}).inner_columns), and {way}"
    )


def weak_information(
    mean_shape: NDArray, basis: NDArray, motion: NDArray, alpha: NDArray
) -> NDArray:
    """Return the information matrix (9K, 9K) of V_1, ..., V_K in ``B_k + V_k B_0``.

    Assumes noise of variance one, frames of size one with unknown cameras (I, 2, 3) and
    coefficients, and known shapes except for V_k.
    """
    n_frames, n_components = alpha.shape
    chosen = np.unique(np.linspace(0, n_frames - 1, 400).astype(int))
    total = np.zeros((9 * n_components, 9 * n_components))
    for i in chosen:
        shape = mean_shape + np.tensordot(alpha[i], basis, 1)
        shape = shape - shape.mean(axis=0)
        # Derivatives of the image (2J) in camera and coefficients span `tangent`.
        cameras = np.kron(np.eye(2), shape)
        moved = (basis @ motion[i].T).transpose(2, 1, 0).reshape(-1, n_components)
        tangent, _ = np.linalg.qr(np.hstack([cameras, moved]))
        # Derivatives in the nine entries of V, before the factor alpha_k. Changes that
        # camera and coefficients can imitate are projected out.
        strain = np.einsum("ra,jb->rjab", motion[i], mean_shape).reshape(-1, 9)
        strain = strain - tangent @ (tangent.T @ strain)
        total += np.kron(np.outer(alpha[i], alpha[i]), strain.T @ strain)
    return total * (n_frames / len(chosen))


def summary_html(model: Any) -> str:
    """Return the key figures and the diagnostics of a fitted model as HTML."""
    n_components, n_points, _ = model.basis_.shape
    text = (
        f"{n_components} basis shapes of {n_points} points\ninverse SNR: "
        f"{percent(model.inverse_snr_)}, rank floor {percent(model.rank_floor_)}"
    )
    if hasattr(model, "noise_variance_") and hasattr(model, "motion_"):
        text += f"\n{model.diagnostics()!r}"
    return f'<pre class="isa-nrsfm-summary">{html.escape(text)}</pre>'


# Least correlation of what counts as the same coefficient, as for the congruence of
# factors: Lorenzo-Seva, ten Berge, "Tucker's congruence coefficient as a meaningful
# index of factor similarity", 2006.
SAME = 0.85
# Largest number of coefficients that are named together.
MOST_TOGETHER = 3


@one_blas_thread()
def stability(tables: HalfTables, gauge: FrameMap, K: int) -> tuple[NDArray, NDArray]:
    """Return root mean squares (K,) of correlations between halves, and stable sets.

    The set of a coefficient, a row of a mask (K, K), has the fewest coefficients, it
    first, of which a combination is the same as it in another half.
    """

    def scores(gauge: FrameMap) -> NDArray:
        """Return coefficients (I, K) with mean zero and norm one; zero if constant."""
        cameras, alpha, _ = gauge.apply(tables.motion, tables.alpha, None)
        alpha = alpha[:, :K]
        if tables.kind[-1]:
            alpha = alpha - pose_part(cameras, pose_effect(cameras, alpha))
        return unit_columns(alpha)

    whole, found = scores(gauge), list[NDArray]()
    for shapes, half in zip(tables.shapes, tables.halves, strict=True):
        motion, alpha = tables.motion[half], tables.alpha[half]
        other = scores(independent_gauge(shapes, motion, alpha, *tables.kind)[2])
        pairs = linear_sum_assignment(-np.abs(whole.T @ other))
        found.append(other[:, pairs[1]])
    every, n = np.hstack(found), len(found)
    cross = (every.T @ every).reshape(n, K, n, K).swapaxes(1, 2)
    within, others = cross[np.arange(n), np.arange(n)], ~np.eye(n, dtype=bool)

    def same(k: int, chosen: list[int]) -> float:
        """Return the mean multiple correlation of coefficient k with those chosen."""
        inverse = np.linalg.pinv(within[:, chosen][:, :, chosen], hermitian=True)
        r = cross[:, :, k, chosen]
        return float(np.einsum("hgs,gst,hgt->hg", r, inverse, r)[others].mean() ** 0.5)

    sets = np.zeros((K, K), dtype=bool)
    for k in range(K):
        chosen = [k]
        while same(k, chosen) < SAME and len(chosen) < min(MOST_TOGETHER, K):
            remaining = [i for i in range(K) if i not in chosen]
            chosen.append(max(remaining, key=lambda i: same(k, [*chosen, i])))
        sets[k, chosen] = same(k, chosen) >= SAME
    return np.array([same(k, [k]) for k in range(K)]), sets


def stability_words(model: Any) -> tuple[str, ...]:
    """Return a word for each coefficient of a model; empty if it is not known."""
    known = getattr(model, "stability_", np.full(len(model.basis_), np.nan))
    if np.isnan(known).any():
        return ("",) * len(known)
    words, sets = [], np.asarray(model.stable_sets_)
    for k, chosen in enumerate(sets):
        others = first_items(f"alpha_{i + 1}" for i in np.flatnonzero(chosen) if i != k)
        word = f"only together with {others}" if others else "stable"
        words.append(word if chosen.any() else "unstable")
    return tuple(words)
