"""The fitted model as a function of the rows of a table, one block at a time."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._frames.models import Decomposition, PosteriorFrames, RigidFrames
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._frames.search import FramePosterior
from isa_nrsfm._metric_upgrade.deforming import DeformationMetric, euclidean_frames
from isa_nrsfm._prepare.checks import clean_tracks
from isa_nrsfm._prepare.robust import robust_sizes, robustly_centred
from isa_nrsfm._tables.layout import (
    Layout,
    table_to_tracks,
    tracks_to_table,
)
from isa_nrsfm._tables.sources import Table
from isa_nrsfm._tables.visibility import centred_frames, seen_points

# Number of parts of the points that are held out in turn, and the fixed random seed of
# the partition.
N_FOLDS = 5
FOLD_SEED = 0
# Largest variance of a held-out point due to the camera, relative to that of the noise.
# In 12 scenes of 120 frames, two frames that show six of 23 points multiply the error
# by 1.5 to 52 without a limit, and by 1.0 to 1.8 with this one. With 20 % of all points
# missing it changes the error by at most 1.2 %; a limit of 1 changes it by up to 21 %.
MOST_LEVERAGE = 2.0


class ReadyFrames(NamedTuple):
    """
    Frames that are usable, centred and measured.

    Attributes
    ----------
    usable : ndarray of bool, shape (n_frames,)
        Which frames of a table they are.
    centred : ndarray of shape (n_usable, n_points, 2)
        Their centred tracks, NaN where a point is not seen.
    translation : ndarray of shape (n_usable, 2)
        What was subtracted.
    sizes : ndarray of shape (n_usable,)
        Their sizes.
    """

    usable: NDArray
    centred: NDArray
    translation: NDArray
    sizes: NDArray


class TableModel(NamedTuple):
    """
    What the fit of a new table depends on: model of a frame, shapes and layout.

    Attributes
    ----------
    frames : RigidFrames or PosteriorFrames
        The model of a frame of size one.
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape in the gauge.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes in the gauge.
    layout : {"interleaved", "planar"}
        Order of the columns.
    names : ndarray of shape (2 * n_points,) or None
        Names of the columns.
    unit : float or None
        The one size of all frames of a table; None where each has its own.
    """

    frames: RigidFrames | PosteriorFrames
    mean_shape: NDArray
    basis: NDArray
    layout: Layout
    names: NDArray | None
    unit: float | None

    @one_blas_thread
    def decompose(self, table: Table, deviations: bool = True) -> Decomposition:
        """
        Return cameras, positions and coefficients of the frames of a table.

        Without deviations the standard deviations of the coefficients are NaN.
        """
        K = len(self.basis)
        shapes = ((2, 3), (2,), (K,), (K,))
        fit = partial(_fit, model=self, dtype=table.dtype, deviations=deviations)
        return Decomposition(*table.blocks.collect(fit, shapes, table.dtype))

    @one_blas_thread
    def posterior(self, table: Table) -> FramePosterior:
        """
        Return the fit of each frame by itself, of size one and before the gauge.

        There coefficients have the prior N(0, I). NaN for frames that are not usable.
        Only for `PosteriorFrames`.
        """
        found = table.blocks.map(partial(_posterior, model=self))
        return FramePosterior(*map(np.concatenate, zip(*found, strict=True)))

    @one_blas_thread
    def reconstruct(
        self, table: Table, metric: DeformationMetric | None, scaled: bool
    ) -> NDArray:
        """
        Return the shapes of the frames of a table.

        Parameters
        ----------
        table : Table
            The table.
        metric : DeformationMetric or None
            The metric of space in which shapes are Euclidean; None for affine shapes.
        scaled : bool
            Whether Euclidean shapes have the sizes that an orthographic camera shows.

        Returns
        -------
        ndarray of shape (n_frames, n_points, 3)
            The shapes.
        """
        shape = partial(
            _shapes, model=self, metric=metric, scaled=scaled, dtype=table.dtype
        )
        return table.blocks.collect(shape, (self.mean_shape.shape,), table.dtype)[0]

    @one_blas_thread
    def depth_deviations(self, table: Table) -> NDArray:
        """Compute standard deviations of the depths of points (n_frames, n_points)."""
        found = partial(_depth_deviations, model=self, dtype=table.dtype)
        return table.blocks.collect(found, (self.mean_shape.shape[:1],), table.dtype)[0]

    @one_blas_thread
    def reproject(self, table: Table) -> NDArray:
        """Return the images of the fitted shapes, in the layout of the table."""
        image = partial(_images, model=self, dtype=table.dtype)
        return table.blocks.collect(image, ((table.n_columns,),), table.dtype)[0]

    @one_blas_thread
    def distances(self, table: Table) -> NDArray:
        """Return the lengths of residuals (n_frames, n_points) of frames of size one.

        NaN where a point is missing, and for frames that are not usable.
        """
        found = partial(_distances, model=self)
        return np.concatenate(list(table.blocks.map(found)))

    @one_blas_thread
    def held_out_error(self, table: Table) -> float:
        """Return the inverse SNR of points held out of the fit of their frame."""
        energies = table.blocks.map(partial(_held_out, model=self))
        noise, signal = np.sum(list(energies), axis=0)
        return float(noise / signal) if signal > 0 else float("nan")

    def tracks(self, rows: NDArray) -> NDArray:
        """Return the tracks (n, n_points, 2) of some rows."""
        tracks = table_to_tracks(rows, self.layout)
        return clean_tracks(tracks, self.layout, self.names)

    def ready(self, tracks: NDArray) -> ReadyFrames:
        """Return the usable ones of tracks (n, n_points, 2), ready for the fit."""
        centred, report = centred_frames(tracks)
        usable = report.usable
        if not usable.all():
            centred, report = centred[usable], report.of_frames(usable)
        translation, sizes = report.translation, report.size
        if self.robust and len(centred):
            centred, translation = robustly_centred(tracks[usable])
            sizes = robust_sizes(centred)
        if self.unit is not None:
            sizes = np.full(len(centred), self.unit, dtype=float)
        return ReadyFrames(usable, centred, translation, sizes)

    @property
    def robust(self) -> bool:
        """Whether points far from the model count less."""
        frames = self.frames
        return isinstance(frames, PosteriorFrames) and frames.loss != "linear"


def _fit(
    rows: NDArray, model: TableModel, dtype: Any, deviations: bool = False
) -> Decomposition:
    """Return the fit of some rows (n, 2 * n_points); NaN for those not usable."""
    ready = model.ready(model.tracks(rows))
    fit = model.frames.fit(ready.centred, ready.sizes, deviations)
    fit = fit._replace(translation=fit.translation + ready.translation)
    return Decomposition(*(_of_all(each, ready.usable).astype(dtype) for each in fit))


def _of_all(values: NDArray, usable: NDArray) -> NDArray:
    """Return values of the usable frames as values of all frames, NaN for others."""
    if usable.all():
        return values
    whole = np.full((len(usable), *values.shape[1:]), np.nan)
    whole[usable] = values
    return whole


def _posterior(rows: NDArray, model: TableModel) -> FramePosterior:
    """Return the fit of rows (n, 2 * n_points) by themselves, before the gauge."""
    assert isinstance(model.frames, PosteriorFrames)
    ready = model.ready(model.tracks(rows))
    found = model.frames.posterior(ready.centred / ready.sizes[:, None, None])
    whole = FramePosterior.unknown(len(rows), len(model.basis))
    whole.put(ready.usable, found)
    return whole


def _shapes(
    rows: NDArray,
    model: TableModel,
    metric: DeformationMetric | None,
    scaled: bool,
    dtype: Any,
) -> tuple[NDArray]:
    """Return the shapes (n, n_points, 3) of some rows (n, 2 * n_points)."""
    motion, _, alpha, _ = _fit(rows, model, dtype)
    if metric is None:
        return (compose(model.mean_shape, model.basis, alpha),)
    frames = euclidean_frames(metric, motion, alpha, model.mean_shape, model.basis)
    shapes = frames.shapes
    if scaled:
        shapes = frames.scales[:, None, None] * shapes
    return (shapes.astype(dtype, copy=False),)


def _depth_deviations(rows: NDArray, model: TableModel, dtype: Any) -> tuple[NDArray]:
    """Compute standard deviations of depths (n, n_points) in some rows."""
    assert isinstance(model.frames, PosteriorFrames)
    ready = model.ready(model.tracks(rows))
    found = model.frames.depth_deviations(ready.centred, ready.sizes)
    return (_of_all(found, ready.usable).astype(dtype, copy=False),)


def _images(rows: NDArray, model: TableModel, dtype: Any) -> tuple[NDArray]:
    """Return the images (n, 2 * n_points) of the fitted shapes of some rows."""
    motion, translation, alpha, _ = _fit(rows, model, dtype)
    shapes = compose(model.mean_shape, model.basis, alpha)
    return (tracks_to_table(project(shapes, motion, translation), model.layout),)


def _distances(rows: NDArray, model: TableModel) -> NDArray:
    """Return the lengths of the residuals (n, n_points) of some rows."""
    ready = model.ready(model.tracks(rows))
    fit = model.frames.fit(ready.centred, ready.sizes, False)
    shapes = compose(model.mean_shape, model.basis, fit.alpha)
    off = ready.centred - project(shapes, fit.motion, fit.translation)
    return _of_all(np.linalg.norm(off, axis=2) / ready.sizes[:, None], ready.usable)


def _held_out(rows: NDArray, model: TableModel) -> tuple[float, float]:
    """Return the energies of `held_out_energies` for some rows (n, 2 * n_points)."""
    tracks = model.tracks(rows)
    ready = model.ready(tracks)
    return held_out_energies(
        model.frames, model.mean_shape, model.basis, tracks[ready.usable], ready.sizes
    )


def held_out_energies(
    frames: RigidFrames | PosteriorFrames,
    mean_shape: NDArray,
    basis: NDArray,
    tracks: NDArray,
    sizes: NDArray,
) -> tuple[float, float]:
    """
    Return the energy of the error, and of the signal, of points that are held out.

    The points are divided into five parts, the same for all frames and tables. Each
    part is predicted from the others, frame by frame: camera, position and coefficients
    are fitted without it.

    Parameters
    ----------
    frames : RigidFrames or PosteriorFrames
        The model of a frame.
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape in the gauge of `frames`.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes in the gauge of `frames`.
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is missing.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    noise, signal : float
        ``sum ||m - m_hat||^2`` and ``sum ||m - centroid_i||^2`` over the points, each
        divided by the squared size of its frame. Points are left out if the others of
        the frame do not determine its fit, or if in a frame with missing points the
        noise variance of their prediction exceeds `MOST_LEVERAGE` that of a point, for
        an affine camera of the mean shape. Otherwise a few frames that show hardly
        enough points would decide. The limit does not depend on the basis shapes, so
        that scores of different K are of the same points.
    """
    n_points = tracks.shape[1]
    folds = np.random.RandomState(FOLD_SEED).permutation(n_points) % N_FOLDS
    seen = seen_points(tracks)
    # Complete frames are fitted without the points, others with gaps in their place.
    complete = None
    if isinstance(frames, PosteriorFrames) and frames.loss == "linear" and seen.all():
        complete = frames
    noise = signal = 0.0
    for fold in range(N_FOLDS):
        held = folds == fold
        # Fit without the held-out points
        visible = np.where(held[:, None], np.nan, tracks)
        enough = centred_frames(visible)[1].usable
        usable = np.flatnonzero(enough & seen[:, held].any(axis=1))
        if not len(usable):
            continue
        origin = np.zeros(3), np.zeros((len(basis), 3))  # of mean and basis shapes
        if complete is not None:
            others = complete.of_points(~held)
            fit = others.fit(tracks[usable][:, ~held], sizes[usable], False)
            origin = mean_shape[~held].mean(axis=0), basis[:, ~held].mean(axis=1)
        else:
            fit = frames.fit(visible[usable], sizes[usable], False)
        # Prediction of the held-out points, and its error
        at_origin = mean_shape[held] - origin[0], basis[:, held] - origin[1][:, None]
        shapes = compose(*at_origin, fit.alpha)
        model = project(shapes, fit.motion, fit.translation)
        part = tracks[usable]
        centre = np.nanmean(part, axis=1, keepdims=True)
        weight = sizes[usable, None, None] ** -2.0
        counted = seen[np.ix_(usable, held)] & np.isfinite(model).all(axis=2)
        some = ~seen[usable].all(axis=1)
        leverage = _camera_leverage(mean_shape, seen[usable[some]] & ~held)
        counted[some] &= leverage[:, held] <= MOST_LEVERAGE
        noise += np.sum((weight * (part[:, held] - model) ** 2)[counted])
        signal += np.sum((weight * (part[:, held] - centre) ** 2)[counted])
    return float(noise), float(signal)


def _camera_leverage(mean_shape: NDArray, seen: NDArray) -> NDArray:
    """Return the variance of points (n, n_points) in cameras fitted to seen ones.

    It is relative to the noise variance, for affine cameras of the mean shape.
    """
    points = np.linalg.qr(np.column_stack([mean_shape, np.ones(len(mean_shape))]))[0]
    normal = np.einsum("ij,ja,jb->iab", seen, points, points, optimize=True)
    # A little more: where the seen points are coplanar, the variance is huge.
    inverse = np.linalg.inv(normal + np.finfo(float).eps * np.eye(4))
    return np.asarray(
        np.einsum("ja,iab,jb->ij", points, inverse, points, optimize=True)
    )
