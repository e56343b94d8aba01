"""The fitted model, applied to a table block by block, and as a prior of others."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from sklearn.base import clone

from isa_nrsfm import _tables as tables
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._frames import camera_models, models
from isa_nrsfm._frames.camera_models import Pinhole, compose, full_rotations, zoomed
from isa_nrsfm._frames.models import MIRROR, Decomposition, FrameModel, LinearisedFrames
from isa_nrsfm._frames.search import FramePosterior
from isa_nrsfm._joint.prior import LEAST_NOISE, TOL_SHARE, ShapePrior
from isa_nrsfm._joint.problem import JointState
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._linalg import padded
from isa_nrsfm._parameters import named
from isa_nrsfm._prepare.robust import median_noise, robust_sizes, robustly_centred
from isa_nrsfm._prepare.scaling import FEWEST_COMPARED, ScaledTable
from isa_nrsfm._tables import FrameBlocks, of_all_rows, seen_points, spread
from isa_nrsfm.calibration import DeformationMetric, euclidean_frames

# Level of the two-sided test by which missing points decide on the mirror image: false
# decisions are in docs/depth.md, "The mirror image".
MIRROR_LEVEL = 0.01
# Least distance of points from the fit, in sizes of frames, of `TableModel.misfit`:
# docs/benchmarks/README.md, "Thresholds".
LEAST_MISFIT = 0.005
# Rows on which held-out points are compared, at most.
MOST_ROWS = 300
# Of points (n, J), zero where missing; None where all are one
Weights = NDArray | None


class TableModel(NamedTuple):
    """Model of a frame, shapes and layout: all that is needed to fit a new table.

    Methods take rows (n, 2, n_points) of a table and return NaN for frames with too few
    visible points. The mean shape (J, 3) and the basis (D, J, 3) are in the gauge. The
    first n_components coefficients are reported; shapes and images are of all.
    `unit` is the common size of all frames, or None if each frame has its own. With a
    pinhole the rows are perspective images, and frames those of weak-perspective ones.
    `axes` is a camera of known focal length that has taken weak-perspective images.
    """

    frames: FrameModel
    mean_shape: NDArray
    basis: NDArray
    n_components: int
    layout: tables.Layout
    unit: float | None
    pinhole: Pinhole | None = None
    axes: Pinhole | None = None

    def decompose(
        self,
        rows: NDArray,
        weights: Weights = None,
        deviations: bool = True,
        dtype: Any = None,
    ) -> Decomposition:
        """Return cameras, positions and coefficients, in the dtype of the rows.

        Weights (n, n_points) are zero where points are missing, by default one.
        """
        dtype = rows.dtype if dtype is None else dtype
        straight = self.straightened(rows, weights)
        usable, centred, translation, sizes, weights = self._ready(straight, weights)
        fit = self.frames.fit(centred, sizes, deviations, weights)
        fit = fit._replace(translation=fit.translation + translation)
        fit = self.in_table_cameras(rows, *(of_all_rows(part, usable) for part in fit))
        return Decomposition(*(part.astype(dtype) for part in fit))

    def in_table_cameras(self, rows: NDArray, *fit: NDArray) -> Decomposition:
        """Return fits of rows in virtual cameras with the cameras of the table."""
        motion, translation, *coefficients = fit
        if self.pinhole is not None:
            motion, translation = self.pinhole.real(rows, motion, translation)
        return Decomposition(motion, translation, *coefficients)

    def in_camera_axes(self, motion: NDArray, translation: NDArray) -> NDArray:
        """Return cameras (n, 2, 3) whose rotations lead to the axes of the camera.

        Weak-perspective rotations lead to the line of sight to the shape's origin.
        """
        if self.axes is None:
            return motion
        sight = self.axes.rays(np.asarray(translation)[..., None])[..., 0]
        turns = camera_models.turns_to(sight)
        R, scales = full_rotations(np.asarray(motion))
        turned = scales[:, None, None] * (turns.mT @ R)[:, :2]
        return turned.astype(motion.dtype, copy=False)

    def cameras(self, fit: Decomposition) -> dict[str, NDArray]:
        """Return the attributes of calibrated cameras of frames, by name."""
        motion, translation = fit[:2]
        R, scales = full_rotations(self.in_camera_axes(motion, translation))
        found = {"rotations_": R, "scales_": scales}
        if (lens := self.pinhole or self.axes) is not None:
            place = lens.positions(motion, translation)
            place[np.isinf(place).any(axis=1)] = np.nan  # no focal length
            found["positions_"] = place.astype(motion.dtype)
        return found

    def straightened(self, rows: NDArray, weights: Weights = None) -> NDArray:
        """Return weak-perspective images.

        Depths and fits of a frame are repeated until they agree.
        """
        pinhole = self.pinhole
        if pinhole is None:
            return rows
        images = pinhole.virtual(rows)
        straight, depths = images.copy(), np.zeros(images[:, 0].shape)
        weak = self._replace(frames=self.frames.without_starts, pinhole=None)
        moving = np.arange(len(rows))
        for _ in range(30 if pinhole.near else 0):
            moving = padded(moving)
            moving_weights = None if weights is None else weights[moving]
            fit = weak.decompose(straight[moving], moving_weights, deviations=False)
            before = depths[moving]
            depths[moving] = self.depths(fit.motion, fit.alpha)
            straight[moving] = pinhole.straight(images[moving], depths[moving])
            change = np.square(depths[moving] - before).sum(axis=1)
            large = change > 1e-6 * np.square(depths[moving]).sum(axis=1)
            moving = np.unique(moving[large])
            if not len(moving):
                break
        return straight

    def depths(self, motion: NDArray, alpha: NDArray) -> NDArray:
        """Return the depths (n, J) of points, in units of the table."""
        shapes = compose(self.mean_shape, self.basis, alpha)
        return np.vecdot(shapes, camera_models.line_of_sight(motion)[:, None])

    def mirrored_attributes(self, known: dict[str, Any]) -> dict[str, Any]:
        """Return the attributes of the mirror image in depth, from those of a fit."""
        signs, K = MIRROR.astype(self.mean_shape.dtype), self.n_components
        names = "mean_shape_", "basis_", "reference_motion_", "motion_"
        factors: dict[str, NDArray] = dict.fromkeys(names, signs)
        factors["pose_effect_"] = np.array([[1.0], [-1.0], [1.0]])
        factors["mode_covariance_"] = np.outer(np.tile(signs, K), np.tile(signs, K))
        found = {name: known[name] * factors[name] for name in factors if name in known}
        if "rotations_" in known:
            R, sight = known["rotations_"], np.eye(3)[2:]
            if self.axes is not None:
                sight = self.axes.rays(known["translation_"][..., None])[..., 0]
            length = np.square(sight).sum(axis=1)[:, None, None]
            across = np.eye(3) - 2.0 * sight[:, :, None] * sight[:, None] / length
            found["rotations_"] = (across @ R * signs).astype(R.dtype)
        found["mirror_certainty_"] = 1.0 - known.get("mirror_certainty_", np.nan)
        gauge = self.frames.gauge
        gauge = gauge._replace(space=MIRROR[:, None] * gauge.space)
        frames, mean_shape = replace(self.frames, gauge=gauge), self.mean_shape * signs
        basis = self.basis * signs
        model = self._replace(frames=frames, mean_shape=mean_shape, basis=basis)
        return found | {"_model": model}

    def mirror_certainty(self, rows: FrameBlocks, frames: Decomposition) -> float:
        """
        Return the probability that the depth of fitted frames has the right sign.

        Points that the object hides are farther away. The probability that point j of
        frame i is missing is modelled as ``a_i + b_j + c_i d_j + beta z_ij``, with the
        depth z_ij along the line of sight, and its mean d_j over the frames. a, b and c
        are effects of frames and points that have nothing to do with hiding: frames in
        profile may lose more points, and more of those of one depth (c). The sign of
        beta is that of ``sum_i T_i``, ``T_i = sum_j (y_ij - mean_i y_ij) r_ij``, with
        y_ij one for missing points, and r_i the part of z_i without d. r is orthogonal
        to a, b and c. To first order in the rotations out of the image plane it does
        not depend on the affinity of space. If masks are independent of the view, T_i
        has mean zero, even if points are missing together. Its variance is ``sum_i
        T_i^2``, and in videos twice the covariances at the lags before the first one
        that is not positive. Both signs have equal odds beforehand.

        NaN if a test of ``beta = 0`` is not significant.
        """
        sight, n_frames = full_rotations(frames.motion)[0][:, 2], len(frames.motion)
        bent = np.einsum("kja,ka->j", self.basis, frames.alpha.T @ sight)
        depth = self.mean_shape @ sight.mean(axis=0) + bent / n_frames
        visible = sum(rows.map(lambda part: seen_points(part).sum(axis=0))) / n_frames

        def scores(part: NDArray, sight: NDArray, alpha: NDArray) -> Any:
            shapes = compose(self.mean_shape, self.basis, alpha)
            z = np.vecdot(shapes, sight[:, None])
            r = z - np.outer(z @ depth, depth) / (depth @ depth or 1.0)
            return np.vecdot(visible - seen_points(part), r)

        T = np.concatenate([*rows.map(scores, sight, frames.alpha)])
        power = np.abs(np.fft.rfft(T - T.mean(), 2 * n_frames)) ** 2
        covariances = np.fft.irfft(power, 2 * n_frames)[1 : n_frames + 1]
        positive = np.logical_and.accumulate(covariances > 0)
        variance = T @ T + 2.0 * covariances[positive].sum()
        probability = float(ndtr(T.sum() / np.sqrt(variance or 1.0)))
        decided = min(probability, 1.0 - probability) < MIRROR_LEVEL / 2
        return probability if decided else np.nan

    def posterior(self, rows: NDArray, weights: Weights = None) -> FramePosterior:
        """Return the fit of each frame, of size one, before the gauge."""
        rows = self.straightened(rows, weights)
        usable, centred, _, sizes, weights = self._ready(rows, weights)
        whole = FramePosterior.unknown(len(rows), len(self.basis))
        unit = centred / sizes[:, None, None]
        whole.put(usable, self.frames.posterior(unit, weights=weights))
        return whole

    def misfit(self, distance: NDArray) -> float:
        """Return the typical distance of points (n, J) from fits over the expected one.

        Noise and errors of the shapes are expected, and distances that are tiny for the
        size of a frame. Few outliers have no effect.
        """
        constant, slope = self.frames.certainty.images
        ratio = constant + slope * len(self.frames.shapes)  # mean leverage of frames
        expected = max(ratio * self.frames.noise_variance, LEAST_MISFIT**2)
        lengths = distance[np.isfinite(distance)]
        return median_noise(lengths) / float(np.sqrt(expected)) if len(lengths) else 0.0

    def linearised(self, rows: NDArray, weights: Weights = None) -> LinearisedFrames:
        """Return each fit and the likelihood near it, before the gauge."""
        rows = self.straightened(rows, weights)
        usable, centred, translation, sizes, weights = self._ready(rows, weights)
        fit = self.frames.linearised(centred, sizes, weights)
        fit = fit._replace(translation=fit.translation + translation)
        return LinearisedFrames(*(of_all_rows(part, usable) for part in fit))

    def shapes(
        self, fit: Decomposition, metric: DeformationMetric | None, scaled: bool
    ) -> NDArray:
        """Return the shapes (n, n_points, 3) of frames that are fitted.

        A metric of space makes them Euclidean. `scaled` multiplies each by the scale of
        its camera, as orthographic cameras need.
        """
        basis = self.basis[: fit.alpha.shape[1]]
        if metric is None:
            return compose(self.mean_shape, basis, fit.alpha)
        frames = euclidean_frames(metric, fit.motion, fit.alpha, self.mean_shape, basis)
        sizes = frames.scales[:, None, None] if scaled else 1.0
        return (sizes * frames.shapes).astype(fit.alpha.dtype, copy=False)

    def turned(self, shapes: NDArray, fit: Decomposition) -> NDArray:
        """Return shapes (n, J, 3) of frames in the axes of their camera."""
        rotations, _ = full_rotations(self.in_camera_axes(*fit[:2]))
        return shapes @ rotations.mT

    def uncertain_shapes(
        self, rows: NDArray, weights: Weights = None, turned: bool = False
    ) -> tuple[NDArray, NDArray]:
        """Return shapes (n, J, 3) and standard deviations (n, J) of their depths."""
        fit, shapes, variances = self._uncertain(rows, weights)
        shapes = self.turned(shapes, fit) if turned else shapes
        _, scales = full_rotations(fit.motion)
        deviations = np.sqrt(variances[..., 2]) / scales[:, None]
        return shapes.astype(rows.dtype), deviations.astype(rows.dtype)

    def points_in_space(
        self, rows: NDArray, weights: Weights = None
    ) -> tuple[NDArray, NDArray]:
        """Return points and standard deviations (n, J, 3) in the axes of their camera.

        x and y are places in the table, z is the depth beyond the origin of the shape,
        in the same units.
        """
        fit, shapes, variances = self._uncertain(rows, weights)
        points = self.turned(shapes, fit) * full_rotations(fit.motion)[1][:, None, None]
        points[..., :2] += fit.translation[:, None]
        return points, np.sqrt(variances)

    def _uncertain(
        self, rows: NDArray, weights: Weights
    ) -> tuple[Decomposition, NDArray, NDArray]:
        """Return frames, shapes, variances (n, J, 3) of points in units of the table.

        They are along the axes of the camera.
        """
        straight = self.straightened(rows, weights)
        weak = self._replace(pinhole=None)
        virtual = weak.decompose(straight, weights, False, dtype=np.float64)
        fit = self.in_table_cameras(rows, *virtual)
        usable, centred, _, sizes, weights = self._ready(straight, weights)
        covariances = self.frames.point_covariances(centred, sizes, weights)
        # Turned from the camera of the images, if it is another one
        rotations, _ = full_rotations(self.in_camera_axes(*fit[:2]))
        turns = (rotations @ full_rotations(virtual.motion)[0].mT)[usable, None]
        variances = np.diagonal(turns @ covariances @ turns.mT, axis1=2, axis2=3)
        shapes = compose(self.mean_shape, self.basis, fit.alpha)
        return fit, shapes, of_all_rows(variances, usable)

    def reproject(self, fit: Decomposition, *shares: NDArray) -> NDArray:
        """Return images of fitted frames as a table, zoomed back by shares (n, 1)."""
        shapes = compose(self.mean_shape, self.basis, fit.alpha)
        images = self.images(shapes, fit.motion, fit.translation)
        lens = self.pinhole or self.axes
        if lens is not None and shares:
            images = zoomed(images, 1.0 / shares[0][..., None], lens.centre[:, 0])
        return tables.tracks_to_table(images, self.layout)

    def images(self, shapes: NDArray, motion: NDArray, translation: NDArray) -> NDArray:
        """Return images (n, J, 2) of shapes (n, J, 3) in the cameras of the table."""
        if self.pinhole is None:
            return camera_models.project(shapes, motion, translation)
        return self.pinhole.projected(shapes, motion, translation)

    def distances(self, rows: NDArray, *fit: NDArray) -> NDArray:
        """Return lengths of residuals (n, n_points), in sizes of their frames.

        Fits are cameras, positions, coefficients and weights of the points, if any.
        Residuals are multiplied by the roots of these if the fitted table had weights.
        """
        motion, translation, alpha, *weights = fit
        usable, _, _, sizes, _ = self._ready(rows)
        shapes = compose(self.mean_shape, self.basis, alpha)
        images = self.images(shapes, motion, translation).swapaxes(1, 2)
        distance = np.linalg.norm(rows - images, axis=1)
        if weights and self.frames.certainty.weighted:
            distance *= np.sqrt(weights[0])
        return distance / of_all_rows(sizes, usable)[:, None]

    def held_out(self, rows: NDArray, weights: Weights = None) -> NDArray:
        """Return squared errors and signals (n, J, 2) of held-out points.

        The points are divided into five parts, the same for all tables. Each part is
        predicted from the others: camera, position and coefficients of each frame are
        fitted without it. The squares are ``||m - m_hat||^2`` and ``||m -
        centroid_i||^2``, divided by the squared sizes (n,) of frames, and multiplied by
        weights (n, J), if given.

        A point is left out, as NaN, if the other points of its frame do not determine
        the fit. In frames with missing points it is also left out if the affine camera
        of the mean shape adds more than twice the noise variance to its prediction: a
        few such frames would dominate the score. This does not depend on the basis, so
        scores of different K use the same points.
        """
        mask, _, _, sizes, weights = self._ready(rows, weights)
        squares = np.full((*rows.shape[::2], 2), np.nan)
        rows, numbers = rows[mask], np.flatnonzero(mask)
        folds = np.random.RandomState(0).permutation(rows.shape[2]) % 5
        seen = seen_points(rows)
        counts = np.ones(seen.shape) if weights is None else weights
        counts = counts * sizes[:, None] ** -2.0
        # With perspective the other points keep their depths.
        frames, weak = self.frames, self._replace(pinhole=None)
        straight = self.straightened(rows, weights)
        linear = self.pinhole is None and frames.joint and frames.loss == "linear"
        tracks = np.ascontiguousarray(rows.transpose(0, 2, 1))
        mean_of = np.mean if seen.all() else np.nanmean  # which takes a copy
        signal = np.square(tracks - mean_of(tracks, 1, keepdims=True)).sum(axis=2)
        for fold in range(5):
            held = folds == fold
            # Fit without the held-out points
            visible = np.where(held, np.nan, straight)
            enough = tables.centred_frames(visible)[1].usable
            usable = np.flatnonzero(enough & seen[:, held].any(axis=1))
            if not len(usable):
                continue
            usable_weights = None if weights is None else weights[usable]
            if linear:
                unit = rows[usable] / sizes[usable, None, None]
                posterior = frames.posterior_without(unit, held, usable_weights)
                fit = frames.shown(posterior, sizes[usable])
            else:
                fit = weak.decompose(visible[usable], usable_weights, False)
                fit = self.in_table_cameras(rows[usable], *fit)
            # Prediction of the held-out points, and its error
            shapes = compose(self.mean_shape[held], self.basis[:, held], fit.alpha)
            predicted = self.images(shapes, fit.motion, fit.translation)
            places = np.ix_(usable, np.flatnonzero(held))
            error = np.square(tracks[places] - predicted).sum(axis=2)
            counted = seen[places] & np.isfinite(error)
            gaps = ~seen[usable].all(axis=1)
            # Effect of the threshold 2: docs/benchmarks/README.md, "Thresholds"
            leverage = _camera_leverage(self.mean_shape, seen[usable[gaps]] & ~held)
            counted[gaps] &= leverage[:, held] <= 2.0
            found = counts[places][..., None] * np.stack([error, signal[places]], 2)
            found[~counted] = np.nan
            squares[np.ix_(numbers[usable], places[1][0])] = found
        return squares

    def held_out_sums(self, *rows_and_weights: NDArray) -> NDArray:
        """Return the sums (1, 2) of squared errors and signals of held-out points."""
        return np.nansum(self.held_out(*rows_and_weights), axis=(0, 1))[None]

    def held_out_error(self, table: FrameBlocks, *weights: NDArray) -> float:
        """Return the share of the energy of held-out points that is not explained.

        Of at most `MOST_ROWS` rows. Of robust fits it is that of the median point, with
        normally distributed errors.
        """
        sample = spread(np.arange(table.n_frames), MOST_ROWS)
        squares = self.held_out(table.take(sample), *(w[sample] for w in weights))
        return unexplained_share(squares, self.frames.loss != "linear")

    def optimism(self, table: FrameBlocks, *weights: NDArray) -> float:
        """Return the squared error of new frames over that of the fitted ones.

        The shapes have seen all points of these, also held-out ones. With n coordinates
        that determine the shapes of N, it is ``exp(2 n / N)`` (Akaike, "A new look at
        the statistical model identification", 1974). Of at most `MOST_ROWS` rows.
        """
        sample = spread(np.arange(table.n_frames), MOST_ROWS)
        fit = self.posterior(table.take(sample), *(w[sample] for w in weights))
        constant, slope = self.frames.certainty.images
        leverage = np.nanmean(models.leverages(fit.alpha))
        return float(np.exp(2.0 * slope * leverage / constant))

    def _ready(
        self, rows: NDArray, weights: Weights = None
    ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray | None]:
        """Return a mask of usable rows; these centred, centres, sizes and weights."""
        centred, report = tables.centred_frames(rows)
        usable = report.usable
        parts = centred, report.translation, report.size
        centred, translation, sizes = (part[usable] for part in parts)
        if self.frames.loss != "linear" and len(centred):
            centred, translation = robustly_centred(rows[usable])
            sizes = robust_sizes(centred)
        if weights is not None:
            weights = weights[usable]
            sizes = tables.weighted_sizes(rows[usable], weights)
        if self.unit is not None:
            sizes = np.full(len(centred), self.unit, dtype=float)
        return usable, centred, translation, sizes, weights


def unexplained_share(squares: NDArray, robust: bool) -> float:
    """Return `held_out_error` of squared errors and signals (n, J, 2)."""
    error, signal = np.moveaxis(squares, 2, 0)
    if np.isnan(error).all():
        return np.nan
    if robust:
        return float(np.nanmedian(error) / (2 * np.log(2)))  # frames have size one
    return float(np.nansum(error) / np.nansum(signal))


def frames_of(estimator: Any) -> Any:
    """Return the fitted model of single frames of an estimator."""
    return estimator._model.frames


def points_in_space(
    estimator: Any, X: Any, point_weight: Any = None
) -> tuple[NDArray, NDArray]:
    """Return points of a table and deviations (n, J, 3) of `TableModel`."""
    table, weights = estimator._opened(X, point_weight)
    estimator._jointly_fitted("points in space", calibrated=True)
    points, deviations = table.collect(estimator._model.points_in_space, *weights)
    return points, deviations


def sees_perspective(estimator: Any) -> bool:
    """Return whether perspective decides between the mirror images in depth."""
    pinhole = estimator._model.pinhole
    return pinhole is not None and pinhole.near


def in_camera_axes(estimator: Any, motion: NDArray, translation: NDArray) -> NDArray:
    """Return cameras (n, 2, 3) of `TableModel`."""
    turned: NDArray = estimator._model.in_camera_axes(motion, translation)
    return turned


def removed_part(estimator: Any, motion: Any) -> Any:
    """Return the part (n, K) of coefficients that `remove_pose` removes, or zero."""
    effect = getattr(estimator, "pose_effect_", None)
    if effect is None:
        return 0.0
    return camera_models.pose_part(np.asarray(motion), effect)


def _camera_leverage(mean_shape: NDArray, seen: NDArray) -> NDArray:
    """Return variances of points (n, J) due to cameras, over the noise variance."""
    points = np.linalg.qr(np.column_stack([mean_shape, np.ones(len(mean_shape))]))[0]
    normal = np.einsum("ij,ja,jb->iab", seen, points, points, optimize=True)
    # A tiny ridge: if the seen points are coplanar, the variance is huge.
    inverse = np.linalg.inv(normal + np.finfo(float).eps * np.eye(4))
    return np.einsum("ja,iab,jb->ij", points, inverse, points, optimize=True)


# Distance of points from the shapes of a prior, in sizes of frames, beyond its noise,
# from which they are other points; misfit of frames, with calibrated and with affine
# cameras, that noise and other people do not reach: docs/benchmarks/README.md,
# "Thresholds".
OTHER_POINTS, LARGEST_MISFIT, OF_AFFINE = 0.15, 1.8, 5.0


def of_fits(
    estimator: Any,
    result: Callable[..., Any],
    X: Any,
    point_weight: Any = None,
    *,
    deviations: bool = False,
) -> Any:
    """Return a result of the fits of a table's rows, and of their focal shares.

    Warn if the table does not fit the model. Fits of tables that are read later are not
    kept.
    """
    later = tables.is_read_later(X)
    table, weights = estimator._opened(X, point_weight, judged=later)
    shares, n = estimator._focal_shares(table), len(weights)
    fits = partial(estimator._model.decompose, deviations=deviations)

    def results(rows: NDArray, *by_frame: NDArray) -> Any:
        return result(fits(rows, *by_frame[:n]), *by_frame[n:])

    if later:
        return table.collect(results, *weights, *shares)
    fit = table.collect(fits, *weights)
    warn_if_foreign(estimator, table, fit, *weights)
    return result(fit, *shares)


def hold_open(estimator: Any, X: Any, point_weight: Any = None) -> None:
    """Open a fitted table once for all methods that it is given to."""
    estimator._held = X, point_weight, estimator._opened(X, point_weight, judged=False)


def warn_if_foreign(
    estimator: Any, table: FrameBlocks, fit: Decomposition | None, *weights: NDArray
) -> None:
    """Warn if frames lie farther from the shapes of a model than its noise explains.

    Without fits of all frames, some are fitted.
    The noise of a weighted fit is not comparable to unweighted residuals.
    """
    model, held = estimator._model, estimator._held
    if not model.frames.joint or (held and held[2][0] is table):
        return
    certainty, camera = model.frames.certainty, model.frames.camera
    if table.n_frames < FEWEST_COMPARED or (certainty.weighted and not weights):
        return
    sample = spread(np.arange(table.n_frames), 100)
    rows, row_weights = table.take(sample), [w[sample] for w in weights]
    if fit is None:
        fit = model.decompose(rows, *row_weights, deviations=False, dtype=np.float64)
    else:
        fit = Decomposition(*(part[sample] for part in fit))
    distance = model.distances(rows, *fit[:3], *row_weights)
    misfit = model.misfit(distance)
    if misfit > (OF_AFFINE if camera == "affine" else LARGEST_MISFIT):
        way = "Fit X separately"
        if far_points(distance, model.frames):
            way = (
                "Check whether X has the same points in the same order as the fitted "
                "table, or fit X separately"
            )
        elif camera != "affine" and certainty.determined:
            before, after = adapting_errors(estimator, rows, *row_weights)
            if after < before:
                way = (
                    "Adapt the model to X: AutoNRSfM(model, prior=model).fit(X). Held-"
                    "out points of some rows then have an inverse SNR of "
                    f"{after:.2g}, now {before:.2g} (isa-nrsfm fit TABLE --prior "
                    "model.npz)"
                )
        warn_caller(
            f"the points of X lie {misfit:.2g} times as far from the shapes of the "
            "model as its noise explains: they come from another annotator or tracker, "
            "show other objects or people (a model of one person does not generalise "
            "to others), or move as the fitted table does not show. Shapes, depths and "
            f"coefficients may be wrong. {way}"
        )


def adapting_errors(
    estimator: Any, rows: NDArray, *weights: NDArray
) -> tuple[float, ...]:
    """Return the inverse SNR of held-out points of every other row (n, 2, J).

    Without and with adapting the model to the rows between them. NaN if these are
    refused: rows without a fit are, and half the rows, many of whose points are wrong,
    can look like other points.
    """
    layout, pinhole = estimator._model.layout, estimator._model.pinhole
    parameters = {"layout": layout, "focal_length": pinhole and pinhole.focal_length}
    parameters |= {"n_components": "auto", "refinement": "joint", "prior": estimator}
    adapted = clone(estimator).set_params(**parameters, keep_frames=False)
    of_points = weights[0][::2] if weights else None
    with warnings.catch_warnings(action="ignore"):
        try:
            X = tables.tracks_to_table(rows[::2].mT, layout)
            adapted.fit(X, point_weight=of_points)
        except ValueError:
            return np.nan, np.nan
    test_rows = [each[1::2] for each in (rows, *weights)]
    parts = [each._model.held_out_sums(*test_rows)[0] for each in (estimator, adapted)]
    return tuple(float(noise / signal) for noise, signal in parts)


def far_points(distance: NDArray, frames: Any) -> float:
    """Return how far points (n, J) lie from shapes; zero if they are these points."""
    if frames.loss == "linear":
        distance = distance[np.isfinite(distance).any(axis=1)]
        square = np.median(np.nanmean(distance**2, axis=1))
    else:  # without outliers
        square = 2.0 * median_noise(distance[np.isfinite(distance)]) ** 2
    mismatch = square > OTHER_POINTS**2 + 2.0 * frames.noise_variance
    return float(np.sqrt(square)) if mismatch else 0.0


def fitted_prior(prior: Any) -> Any:
    """Return the estimator in a search or in a FrozenEstimator."""
    return getattr(prior, "best_estimator_", getattr(prior, "estimator", prior))


def checked_prior(estimator: Any, n_points: int) -> dict[str, Any]:
    """Return the settings of the prior of a table's fit, or raise."""
    if estimator.prior is None:
        return {}
    prior, n_components = fitted_prior(estimator.prior), estimator.n_components
    model = getattr(prior, "_model", None)
    if not isinstance(model, TableModel):
        raise ValueError(
            f"prior must be a fitted AffineNRSfM; got {prior!r}. A search over several "
            "priors clones them: give sklearn.frozen.FrozenEstimator(prior)"
        )
    if not model.frames.joint or prior.camera_ == "affine":
        raise ValueError(
            "prior must be fitted with calibrated cameras and the joint refinement; "
            f"got {named('camera', prior.camera_)}, "
            f"{named('refinement', prior.refinement)}. Fit it with "
            f"{named('camera', 'weak_perspective')}"
        )
    if not model.frames.certainty.determined:
        raise ValueError(
            "the depth of the prior is not determined: its depth_uncertainty_ is "
            f"{model.frames.certainty.total:.2g}. Fit it to a table in which the "
            "objects turn"
        )
    if (prior.camera_ == "orthographic") != (estimator.camera == "orthographic"):
        raise ValueError(
            f"the prior was fitted with {named('camera', prior.camera_)}; got "
            f"{named('camera', estimator.camera)}. Set the same camera"
        )
    if len(model.mean_shape) != n_points:
        raise ValueError(
            f"the prior has {len(model.mean_shape)} points, the table {n_points}. Give "
            "the table the points of the prior, in the same order"
        )
    if n_components not in ("auto", K := model.n_components):
        raise ValueError(
            f"{named('n_components')} must be that of the prior, {K}, or auto, which "
            f"takes it; got {n_components}"
        )
    return {"prior": model, "mirror_certainty": prior.mirror_certainty_}


def prior_start(
    table: ScaledTable, settings: FitSettings, checked: bool
) -> tuple[JointState, FitSettings]:
    """Return a start from the shapes of a prior, and settings of its fit.

    `checked`: raise if the table does not show the points of the prior.
    """
    model = settings.prior
    frames = model.frames
    sample = spread(np.arange(table.rows.n_frames), 200)
    rows = table.rows.take(sample)
    weights = None if table.weights is None else table.weights[sample]
    frames = replace(frames, camera="weak_perspective", loss=settings.loss)
    fit = frames.posterior(rows, False, weights)
    share = far_points(camera_models.distances(rows, frames.shapes, *fit[:3]), frames)
    if checked and share:
        raise ValueError(
            f"the table does not show the points of the prior: they lie {share:.0%} of "
            "the size of the object from its shapes. Check whether the columns have "
            "the same points in the same order"
        )
    gauge, scale, scaled = frames.gauge, 1.0, settings.camera != "orthographic"
    if not scaled:
        scale = float(np.nanmedian(full_rotations(fit.motion)[1]))
        gauge = gauge._replace(space=table.unit / model.unit * gauge.space)
    noise = max(frames.noise_variance, LEAST_NOISE)
    start = JointState(scale * frames.shapes, np.empty((0, 2, 3)), noise)
    settings = settings._replace(
        shape_prior=ShapePrior.of_model(frames, scale, gauge, scaled),
        limits=settings.limits._replace(least_noise=LEAST_NOISE),
        tol=TOL_SHARE * settings.tol,
    )
    return start, settings
