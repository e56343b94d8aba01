"""Camera, position and coefficients of single frames for given shapes.

The result of a frame does not depend on the others. The joint refinement's model of a
frame finds the most probable camera and coefficients together. The paper's model fits
the camera to the mean shape alone, then the coefficients by least squares.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.lazy import cached_property
from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    compose,
    distances,
    full_rotations,
    rigid_cameras,
)
from isa_nrsfm._frames.search import FramePosterior, FrameSearch
from isa_nrsfm._linalg import OF_PRODUCTS, centred, frames_last, lengths
from isa_nrsfm._prepare import robust
from isa_nrsfm._tables import point_patterns, seen_points

# Depths are not determined above this error, relative to their root mean square:
# docs/depth.md, "Undetermined depth".
LARGEST_SHARE = 0.6


class DepthCertainty(NamedTuple):
    """
    Jackknife estimates of the errors of a fit with calibrated cameras.

    Attributes
    ----------
    total : float
        RMS error of the depths, relative to their RMS. Its square is the sum of that of
        the jackknife and `deformation`.
    deformation : float
        Relative squared error by other explanations of the images: the largest ``d
        exp(-4 r)`` of depths twice and a thousand times as large, with cameras that
        turn less. r is the rise of -2 log L of a frame, d <= 1 the squared difference.
        Plus the same of other fits with their evidence. Plus the error of frames that
        may be reversed in depth. With a prior, the mean square of the relative change
        of depths that the prior and the table allow.
    turns : ndarray of shape (3, 3) or None
        Covariance of the rotation vectors, in radians squared, in the camera's axes.
    points : ndarray of shape (n_points,) or None
        Mean variance of the depths of the points, for frames of size one.
    leverage : float or None
        Mean of 1 + |alpha|^2 of the frames, if variances are proportional to it, as for
        equal errors of all shapes. None if all frames have the mean variance.
    residual : float
        Mean squared residual of a point of the fitted frames, of size one.
    images : tuple of two floats
        Error variance of a coordinate of an image, with the errors of the shapes, over
        the noise variance: the first plus the second times the leverage of the frame.
    weighted : bool
        Whether points had weights: `residual` and `images` are those of weight one.
    """

    total: float = np.nan
    deformation: float = np.nan
    turns: NDArray | None = None
    points: NDArray | None = None
    leverage: float | None = None
    residual: float = np.nan
    images: tuple[float, float] = (1.0, 0.0)
    weighted: bool = False

    @property
    def determined(self) -> bool:
        """Whether the table determines depths and rotations; True if not estimated."""
        return not self.total > LARGEST_SHARE

    def of_consensus(
        self, errors: NDArray, depths: NDArray, nearer: float
    ) -> "DepthCertainty":
        """Return that of a consensus with mean squares of errors and depths (J,).

        Groups cannot tell turning from deformation better than all points together.
        Errors that groups share are those of the joint fit, times `nearer`: the mean
        square distance of the groups from the consensus over that from the joint fit.
        """
        joint_errors = 0.0 if self.points is None else self.points
        shared = np.maximum(joint_errors - self.deformation * depths, 0.0)
        points = np.maximum(errors, nearer * shared) + self.deformation * depths
        total = float(np.sqrt(points.sum() / depths.sum()))
        return self._replace(total=total, points=points, leverage=1.0)

    def of_prior(self, errors: NDArray, depths: NDArray) -> "DepthCertainty":
        """Return that of a prior, with error variances (n,) of depths (n, J)."""
        points = np.zeros(depths.shape[1]) if self.points is None else self.points
        total = np.hypot(self.total, np.sqrt(errors.mean() / np.mean(depths**2)))
        return self._replace(total=float(total), points=points + errors.mean())

    def variances(self, alpha: NDArray) -> NDArray:
        """Return variances of depths (n, n_points) of frames of size one."""
        points = np.zeros(1) if self.points is None else self.points
        if self.leverage is None:
            return np.tile(points, (len(alpha), 1))
        return np.outer(leverages(alpha) / self.leverage, points)


def leverages(alpha: NDArray) -> NDArray:
    """Return 1 + |alpha|^2 of frames (n, K)."""
    return np.asarray(1.0 + np.vecdot(alpha, alpha))


NOT_ESTIMATED = DepthCertainty()


# Factors of the coordinates of a mirror image in depth.
MIRROR = np.array([1.0, 1.0, -1.0])


# Least number of visible points for which the likelihood is normal near the fit:
# docs/benchmarks/README.md, "Thresholds".
LEAST_POINTS = 6


class Decomposition(NamedTuple):
    """
    Camera and coefficients of each frame of a table; NaN if too few points are seen.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, in the units of the table per unit of the shapes.
    translation : ndarray of shape (n_frames, 2)
        Images of the shapes' centroid.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of the basis shapes.
    alpha_std : ndarray of shape (n_frames, n_components)
        Their posterior standard deviations. NaN for models of the paper's refinement,
        which have no noise variance.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    alpha_std: NDArray


def leading(fit: Decomposition, n: int) -> Decomposition:
    """Return frames with their first n coefficients."""
    return fit._replace(alpha=fit.alpha[:, :n], alpha_std=fit.alpha_std[:, :n])


class FrameMap(NamedTuple):
    """Map of cameras and coefficients of frames to other, equally good shapes.

    mixing (K + 1, K + 1): maps ``(1, alpha)`` to ``scale * (1, new alpha)``. Each
    camera is multiplied by the scale of its frame.
    space (3, 3): affinity of space, ``new shape = shape @ space.T``.
    """

    mixing: NDArray
    space: NDArray

    @classmethod
    def identity(cls, n_components: int) -> "FrameMap":
        """Return the identity map."""
        return cls(np.eye(n_components + 1), np.eye(3))

    def public(self, shapes: NDArray) -> tuple[NDArray, NDArray]:
        """Return the mean shape (J, 3) and basis (K, J, 3) of shapes (K + 1, 3, J)."""
        mixed = np.tensordot(np.linalg.pinv(self.mixing.T), shapes, 1)
        mean_shape, *basis = mixed.mT @ self.space.T
        return mean_shape, np.reshape(basis, (-1, *mean_shape.shape))

    @property
    def rotation(self) -> NDArray:
        """The map (3, 3) of rotation vectors: `space` of Euclidean shapes, size one."""
        return np.asarray(self.space / np.cbrt(abs(np.linalg.det(self.space))))

    def apply(
        self, motion: NDArray, alpha: NDArray, covariance: NDArray | None
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras, coefficients and standard deviations for the new shapes.

        Standard deviations (n, K) are to first order. They are NaN without covariances
        (n, K, K).
        """
        mixed = self.mixing[:, 0] + alpha @ self.mixing[:, 1:].T
        scale = mixed[:, 0]
        new = mixed[:, 1:] / scale[:, None]
        cameras = scale[:, None, None] * (motion @ np.linalg.inv(self.space))
        if covariance is None:
            return cameras, new, np.full_like(new, np.nan)
        # d new / d alpha, times scale
        slope = self.mixing[1:, 1:] - new[:, :, None] * self.mixing[0, 1:]
        variance = np.vecdot(slope @ covariance, slope)
        deviation = np.sqrt(np.maximum(variance, 0.0))  # less than zero by rounding
        return cameras, new, deviation / np.abs(scale)[:, None]


class LinearisedFrames(NamedTuple):
    """Fits of frames, and the likelihood near them, before the gauge.

    motion (n, 2, 3), translation (n, 2), in the units of the table. alpha (n, K) and
    its posterior covariance (n, K, K). precision (n, K + p, K + p): curvature of minus
    the log-likelihood by coefficients and the p parameters of the camera, the position
    eliminated; NaN for frames with less than `LEAST_POINTS`. slope (n, K + p, 2):
    derivatives of the mean of the image of the visible points by them.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    covariance: NDArray
    precision: NDArray
    slope: NDArray


def rigid_fit(
    rows: NDArray, shapes: NDArray, camera: str
) -> tuple[NDArray, NDArray, NDArray]:
    """Return motion, translation and alpha of rows (n, 2, J) that show the same points.

    The paper's fit: the camera of the mean shape alone, calibrated ones the nearest to
    it. Then the coefficients by least squares, the solution of least norm.
    """
    seen = seen_points(rows)[0]
    shapes = shapes[:, :, seen]
    middles, centre = shapes.mean(axis=2), rows[:, :, seen].mean(axis=2)
    W, shapes = rows[:, :, seen] - centre[..., None], centred(shapes)
    # Directions of all shapes in the place of points, as these may be many
    axes = np.linalg.qr(shapes.reshape(-1, shapes.shape[2]).T)[0]
    W, shapes = W @ axes, shapes @ axes
    motion = rigid_cameras(W.reshape(-1, W.shape[2]), shapes[0].T)
    motion = CAMERAS[camera].nearest(motion)
    images = (motion[:, None] @ shapes[1:]).reshape(len(rows), len(shapes) - 1, -1)
    residuals = (W - motion @ shapes[0]).reshape(len(rows), -1, 1)
    # Smaller images are rounding errors.
    alpha = (np.linalg.pinv(images.mT, rcond=OF_PRODUCTS) @ residuals)[..., 0]
    middle = middles[0] + alpha @ middles[1:]
    return motion, centre - (motion @ middle[..., None])[..., 0], alpha


def derivatives(
    shapes: NDArray, motion: NDArray, alpha: NDArray, camera: str
) -> NDArray:
    """Return derivatives (n, K + p, r, J) of points by coefficients and cameras.

    Shapes are (K + 1, 3, J). Cameras (n, r, 3) have two rows, for images, or three.
    """
    tangents = CAMERAS[camera].tangents(frames_last(motion))
    shaped = compose(shapes[0], shapes[1:], alpha)
    turned = np.moveaxis(tangents, 3, 0) @ shaped[:, None]
    return np.concatenate([motion[:, None] @ shapes[1:], turned], axis=1)


@dataclass(frozen=True, eq=False)
class FrameModel:
    """The model of a frame: its posterior, camera and coefficients.

    shapes (K + 1, 3, J): centred, with coefficients that are drawn from N(0, I).
    noise_variance: that of a coordinate, for frames of size one. starts (n_starts, K):
    further coefficients to start from if the fit from zero is bad. gauge: maps cameras
    and coefficients to those of the public shapes. certainty: uncertainty of the fit of
    the shapes, with calibrated cameras.

    Models of the paper's refinement have no noise variance, NaN: frames are fitted by
    `rigid_fit`, in units of the table.
    """

    shapes: NDArray
    noise_variance: float
    starts: NDArray
    loss: str
    gauge: FrameMap
    camera: str = "affine"
    certainty: DepthCertainty = NOT_ESTIMATED

    @classmethod
    def rigid(cls, mean_shape: NDArray, basis: NDArray, camera: str) -> Self:
        """Return the paper's model of a mean shape (J, 3) and a basis (K, J, 3)."""
        shapes, K = np.concatenate([mean_shape[None], basis]).mT, len(basis)
        gauge = FrameMap.identity(K)
        return cls(shapes, np.nan, np.empty((0, K)), "linear", gauge, camera)

    @property
    def joint(self) -> bool:
        """Whether it is the joint refinement's model, with a noise variance."""
        return not np.isnan(self.noise_variance)

    @cached_property
    def _search(self) -> FrameSearch:
        """The search for frames, shared by all tables."""
        return FrameSearch(self.shapes, CAMERAS[self.camera])

    def with_shapes(self, shapes: NDArray, noise: float, alpha: NDArray) -> Self:
        """Return the model of other shapes, with coefficients (n, K) of frames."""
        starts, gauge = spread_starts(alpha), FrameMap.identity(len(shapes) - 1)
        return replace(
            self, shapes=shapes, noise_variance=noise, starts=starts, gauge=gauge
        )

    @cached_property
    def without_starts(self) -> "FrameModel":
        """The model that fits each frame from zero only."""
        return replace(self, starts=self.starts[:0])

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without cached values."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def fit(
        self, rows: NDArray, sizes: NDArray, deviations: bool, weights: NDArray | None
    ) -> Decomposition:
        """Return the fit of rows (n, 2, J), NaN where missing, of sizes (n,).

        With a robust loss the weights follow from the residuals of the fit.
        """
        if self.joint:
            unit = rows / sizes[:, None, None]
            return self.shown(self.posterior(unit, deviations, weights), sizes)
        K, (_, pattern) = len(self.shapes) - 1, point_patterns(seen_points(rows))
        empty = (np.full((len(rows), *n), np.nan) for n in ((2, 3), (2,), (K,), (K,)))
        fit = Decomposition(*empty)
        # Frames that show the same points together
        order = np.argsort(pattern, kind="stable")
        for frames in np.split(order, np.cumsum(np.bincount(pattern)))[:-1]:
            part = rigid_fit(rows[frames], self.shapes, self.camera)
            fit.motion[frames], fit.translation[frames], fit.alpha[frames] = part
        return fit._replace(motion=fit.motion @ np.linalg.inv(self.gauge.space))

    def shown(self, posterior: FramePosterior, sizes: NDArray) -> Decomposition:
        """Return a fit of frames of size one in units of the table and the gauge."""
        motion, translation, alpha, covariance, *_ = posterior
        has_covariance = covariance.shape[1] == len(self.shapes) - 1
        widened = self.widened(alpha, covariance)[0] if has_covariance else None
        motion, alpha, deviation = self.gauge.apply(motion, alpha, widened)
        motion = motion * sizes[:, None, None]
        return Decomposition(motion, translation * sizes[:, None], alpha, deviation)

    def widened(self, alpha: NDArray, covariance: NDArray) -> tuple[NDArray, NDArray]:
        """Return covariances (n, K, K) with the errors of the shapes.

        The precision is the sum of that of the prior, I, and of the images. The latter
        is divided by the error variance of the images over that of the noise. These
        ratios (n, 1, 1) are returned, too.
        """
        constant, slope = self.certainty.images
        ratio = (constant + slope * leverages(alpha))[:, None, None]
        matrix = np.eye(alpha.shape[1]) + (ratio - 1.0) * covariance
        return np.linalg.solve(matrix, ratio * covariance), ratio

    def linearised(
        self, rows: NDArray, sizes: NDArray, weights: NDArray | None = None
    ) -> LinearisedFrames:
        """Return fits of rows (n, 2, J), NaN where missing, of sizes (n,)."""
        unit = rows / sizes[:, None, None]
        fit = self.posterior(unit, weights=weights)
        weights = 1.0 * seen_points(rows) if weights is None else weights
        if self.loss != "linear":
            distance = distances(unit, self.shapes, *fit[:3])
            deviation = np.sqrt(self.noise_variance)
            weights = robust.frame_weights(
                self.loss, distance, deviation, robust.robust_sizes(unit)
            )
        motion = fit.motion * sizes[:, None, None]
        T = derivatives(self.shapes, motion, fit.alpha, self.camera)
        share = weights / np.maximum(weights.sum(axis=1), 1e-300)[:, None]
        slope = np.einsum("iprj,ij->ipr", T, share)
        T -= slope[..., None]
        T *= np.sqrt(weights / self.noise_variance)[:, None, None]
        T = T.reshape(*T.shape[:2], 2 * rows.shape[2]) / sizes[:, None, None]
        precision = T @ T.mT
        precision[np.count_nonzero(weights, axis=1) < LEAST_POINTS] = np.nan
        covariance, ratio = self.widened(fit.alpha, fit.covariance)
        translation = fit.translation * sizes[:, None]
        moments = fit.alpha, covariance, precision / ratio
        return LinearisedFrames(motion, translation, *moments, slope)

    def point_covariances(
        self, rows: NDArray, sizes: NDArray, weights: NDArray | None = None
    ) -> NDArray:
        """Compute the covariances (n, J, 3, 3) of points in the axes of their camera.

        They are the sum of those of the shapes and that of the frame, ``Z (T^T T / s2 +
        diag(0, I))^-1 Z^T``. T and Z are the derivatives of image and points by
        rotation vector, logarithm of the scale (if free) and coefficients. Weights (n,
        J) multiply the squares. The covariance of a frame is multiplied by its squared
        residual over that of the fit, if it is larger.
        """
        unit = rows / sizes[:, None, None]
        fit = self.posterior(unit, covariances=False, weights=weights)
        weights = 1.0 * seen_points(rows) if weights is None else weights
        covariances = np.full((*weights.shape, 3, 3), np.nan)
        rotations, scales = full_rotations(fit.motion)
        motion = scales[:, None, None] * rotations
        indices = np.flatnonzero(np.isfinite(scales))
        # Few frames at a time: their derivatives take much memory.
        length = max(2**17 // self.shapes.size, 1)
        for first in range(0, len(indices), length):
            frames = indices[first : first + length]
            w = weights[frames, None, None]
            Z = derivatives(self.shapes, motion[frames], fit.alpha[frames], self.camera)
            Z -= (Z * w).sum(axis=3, keepdims=True) / w.sum(axis=3, keepdims=True)
            T = (Z[:, :, :2] * np.sqrt(w)).reshape(*Z.shape[:2], -1)
            prior = np.arange(Z.shape[1]) < fit.alpha.shape[1]
            information = T @ T.mT / self.noise_variance + np.diag(1.0 * prior)
            covariance = np.linalg.pinv(information, hermitian=True)[:, None]
            Z = Z.transpose(0, 3, 2, 1)
            covariances[frames] = Z @ covariance @ Z.mT
        # Errors of the shapes, in the image and in depth, and of the middle of frames.
        weight = weights.sum(axis=1)
        image = self.certainty.images[1] * leverages(fit.alpha) + 1 / weight
        image = self.noise_variance * image[:, None]
        depth = self.certainty.variances(fit.alpha)
        for axis, variance in enumerate((image, image, depth)):
            covariances[..., axis, axis] += variance
        # Frames that the model explains less well than those of the fit
        excess = self.squares(fit, weight)
        excess /= self.certainty.residual or np.nan
        excess = sizes**2 * np.fmax(excess, 1.0)
        return excess[:, None, None, None] * covariances

    def squares(self, fit: FramePosterior, weight: NDArray) -> NDArray:
        """Return mean squared residuals (n,) of points; weight (n,): of all points."""
        prior = self.noise_variance * np.vecdot(fit.alpha, fit.alpha)
        return np.asarray((fit.objective - prior) / weight)

    def posterior(
        self, rows: NDArray, covariances: bool = True, weights: NDArray | None = None
    ) -> FramePosterior:
        """Return the fit of rows (n, 2, J) of size one, before the gauge.

        Weights (n, J) are by default 1. With a robust loss they follow from the
        residuals, as long as the points with positive weights determine a camera.
        """
        noise = self.noise_variance
        fitted = partial(self._search.fit_rows, noise=noise, covariances=covariances)
        if self.loss == "linear":
            return fitted(rows, weights=weights, starts=self.starts)
        # Robust loss: outliers are no reason for further starts. The median of the
        # residuals hardly depends on them. The threshold is as in `FrameSearch.fit`.
        fit = self._reweighted(rows, fitted)
        distance = distances(rows, self.shapes, *fit[:3])
        median = robust.lower_medians(distance, seen_points(rows))[:, 0]
        poor = np.flatnonzero(median > robust.MEDIAN_DISTANCE * np.sqrt(3.0 * noise))
        if len(poor):
            fit.put(poor, self._reweighted(rows[poor], fitted, self.starts))
        return fit

    def posterior_without(
        self, rows: NDArray, hidden: NDArray, weights: NDArray | None = None
    ) -> FramePosterior:
        """Return the fit of rows (n, 2, J) without some of the points (J,)."""
        if weights is not None or not seen_points(rows).all():
            return self.posterior(np.where(hidden, np.nan, rows), False, weights)
        shapes = self.shapes[:, :, ~hidden]
        fit = replace(self, shapes=centred(shapes)).posterior(rows[..., ~hidden], False)
        middles = shapes.mean(axis=2)
        middle = middles[0] + fit.alpha @ middles[1:]
        shift = (fit.motion @ middle[..., None])[..., 0]
        return fit._replace(translation=fit.translation - shift)

    def _reweighted(
        self, rows: NDArray, fitted: Callable[..., Any], starts: NDArray | None = None
    ) -> FramePosterior:
        """Return the fit of rows (n, 2, J) with a robust loss.

        Only the first pass starts again from `starts`: later ones go on from it.
        """
        quick = partial(fitted, covariances=False)
        sizes, deviation = robust.robust_sizes(rows), np.sqrt(self.noise_variance)
        # First without gross outliers
        weights = robust.frame_weights("linear", lengths(rows), 1.0, sizes)
        fit = quick(rows, weights=weights, starts=starts)
        # If too few points remain, use the distant ones.
        lost = np.flatnonzero((weights == 0).any(axis=1) & np.isnan(fit.objective))
        if len(lost):
            weights[lost] = 1.0
            fit.put(lost, quick(rows[lost], starts=starts))
        # Then iteratively reweighted, for the frames whose weights still change
        changing = np.flatnonzero(np.isfinite(fit.objective))
        for _ in range(50):
            part, before = rows[changing], weights[changing]
            distance = distances(part, self.shapes, *(p[changing] for p in fit[:3]))
            new = robust.frame_weights(self.loss, distance, deviation, sizes[changing])
            unsettled = np.abs(new - before).max(axis=1) > 1e-4
            changing, before, new = (x[unsettled] for x in (changing, before, new))
            if not len(changing):
                break
            weights[changing], alpha = new, fit.alpha[changing]
            refit = quick(rows[changing], weights=new, initial=alpha)
            # If the model does not explain a frame, its weights can become so unequal
            # that they determine no camera. Such a frame keeps its fit.
            kept = np.isfinite(refit.objective)
            weights[changing[~kept]] = before[~kept]
            changing = changing[kept]
            fit.put(changing, refit.take(kept))
        return fitted(rows, weights=weights, initial=fit.alpha)


def spread_starts(alpha: NDArray, n_starts: int = 8) -> NDArray:
    """Return at most n_starts rows of alpha (n, K) by farthest point sampling."""
    alpha = alpha[np.isfinite(alpha).all(axis=1)]
    # Squared distance from zero and from the rows chosen so far
    distance = np.einsum("ik,ik->i", alpha, alpha)
    chosen: list[int] = []
    while len(chosen) < n_starts and distance.max(initial=0.0) > 0:
        chosen.append(int(np.argmax(distance)))
        difference = alpha - alpha[chosen[-1]]
        distance = np.minimum(distance, np.einsum("ik,ik->i", difference, difference))
    return alpha[chosen]
