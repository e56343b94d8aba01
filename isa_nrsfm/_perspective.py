"""The fit of perspective images: repeated fits of weak-perspective ones.

`_frames.pinhole` has the equations. Each repeat corrects the images for the depths of
the fit before, and starts from its shapes, until depths and fit agree. Weak-perspective
images determine depths up to their sign, so both mirror images are continued.

Let E be the mean squared distance of points from their images, in sizes of frames. As a
function of g = 1/f it is least for the focal length f. g = 0 is the weak-perspective
fit, and -g the mirror image of the fit for g. Minima of parabolas through the three best
fits lead to an unknown f. Without one of several groups of points the minimum moves,
which gives its deviation (jackknife).
"""

import warnings
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from isa_nrsfm._compat.callbacks import FitProgress, NoProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fit import fit_table, ready_table, supported_components
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import (
    compose,
    nearest_calibrated,
    project,
    reference_camera,
)
from isa_nrsfm._frames.models import MIRROR, Decomposition
from isa_nrsfm._frames.pinhole import Pinhole
from isa_nrsfm._joint.settings import JOINT_TOL, FitSettings
from isa_nrsfm._joint.uncertainty import N_GROUPS, neighbours
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import FrameBlocks

# Depths and fit agree if a repeat changes depths by less than SETTLED, with the default
# tolerance. If MOST_REPEATS end with larger changes than UNSETTLED, they never will.
SETTLED, UNSETTLED, MOST_REPEATS = 2e-3, 0.05, 8
# A mirror image is given up if E is larger than this multiple of the other one's.
WORSE = 1.3
# Focal lengths of the weak-perspective fit and of the first perspective one, in largest
# distances from the principal point, and how much longer the next one is if that fails.
ENDLESS, FIRST, LONGER = 1e7, 2.0, 8.0
# The search ends if the minimum is that near to a fit, as a share of 1/f.
NEAR, MOST_FITS = 0.01, 10

WEAKER = (
    ". The fit is that of weak-perspective cameras, turned to the middle of each object"
)
UNSTEADY = (
    "the fit of perspective has not settled: depths and fit do not agree. The focal "
    f"length may be wrong, or there are too few basis shapes{WEAKER}"
)
NO_PERSPECTIVE = (
    "the table shows no perspective: its focal length is too long, or the objects are "
    "too far away, to estimate it. The fit is that of weak-perspective cameras"
)


class PerspectiveFit(NamedTuple):
    """
    A fit with a known focal length.

    model: that of weak-perspective images. frames: in virtual cameras. converged,
    attributes: as `fit_table` returns them. changes: shares by which repeats have
    changed the depths. energies (J,): contributions of the points to E.
    """

    pinhole: Pinhole
    model: TableModel
    frames: Decomposition
    converged: bool
    attributes: dict[str, Any]
    changes: tuple[float, ...] = ()
    energies: NDArray = np.zeros(0)

    @property
    def energy(self) -> float:
        """Mean squared distance E of the points from their images."""
        return float(self.energies.sum())

    def depths(self, part: slice) -> NDArray:
        """Return depths (n, J) of the points of some frames."""
        return self.model.depths(Decomposition(*(v[part] for v in self.frames)))

    def mirrored(self) -> "PerspectiveFit":
        """Return the mirror image in depth."""
        frames = self.frames._replace(motion=self.frames.motion * MIRROR)
        signs = np.tile(MIRROR, len(self.model.basis))
        covariance = self.attributes["mode_covariance_"] * np.outer(signs, signs)
        attributes = self.attributes | {"mode_covariance_": covariance}
        model = self.model.mirrored()
        return self._replace(model=model, frames=frames, attributes=attributes)


class PerspectiveTable(NamedTuple):
    """A table of perspective images, and what all its fits have in common."""

    source: FrameBlocks
    weights: NDArray | None
    isa: Any
    settings: FitSettings
    principal_point: tuple[float, float]

    @property
    def robust(self) -> bool:
        """Whether the middle of a frame is a median."""
        return self.settings.loss != "linear"

    def pinhole(self, focal_length: float) -> Pinhole:
        """Return the camera with a focal length."""
        return Pinhole(focal_length, self.principal_point)

    def straight(
        self, pinhole: Pinhole, n_components: int, fit: PerspectiveFit | None
    ) -> ScaledTable:
        """Return weak-perspective images, for the depths of a fit, or for equal ones."""
        by_frame: tuple[NDArray, ...] = ()
        function = partial(_straight, pinhole=pinhole, robust=self.robust)
        if fit is not None:
            function = partial(function, model=fit.model)
            by_frame = fit.frames.motion, fit.frames.alpha
        rows = self.source.derive(function, *by_frame)
        rows.empty = self.source.empty
        return ready_table(rows, self.weights, n_components, self.settings)

    def fit(
        self,
        pinhole: Pinhole,
        n_components: int,
        before: PerspectiveFit | None = None,
        progress: FitProgress | NoProgress | None = None,
        **options: Any,
    ) -> PerspectiveFit:
        """Return the fit of images that are corrected for the depths of another fit.

        It has the mirror image with those depths. Options are those of `fit_table`.
        """
        table = self.straight(pinhole, n_components, before)
        progress = progress or NoProgress()
        result = fit_table(
            table, n_components, self.isa, self.settings, progress, **options
        )
        fit = PerspectiveFit(pinhole, *result)
        if before is not None:
            if fit.attributes["isa_"] is None:
                fit.attributes["isa_"] = before.attributes["isa_"]
            parts = [(before.depths(p), fit.depths(p)) for p in self.source.slices]
            same, other, total = (
                sum(float(np.nansum((z - sign * old) ** 2)) for old, z in parts)
                for sign in (1.0, -1.0, 0.0)
            )
            change = float(np.sqrt(min(same, other) / (total or 1.0)))
            fit = fit._replace(changes=(*before.changes, change))
            fit = fit.mirrored() if other < same else fit
        motion, translation, alpha, _ = fit.frames
        squares = self.source.map(
            partial(_squares, fit=fit, robust=self.robust), motion, translation, alpha
        )
        square, counts = np.sum(list(squares), axis=0)
        return fit._replace(energies=square / counts.sum())

    def settled(
        self, pinhole: Pinhole, n_components: int, *fits: PerspectiveFit
    ) -> list[PerspectiveFit]:
        """Repeat fits until depths and fits agree; return them, the best first.

        A fit also ends if it is clearly worse than the best one.
        """
        running, ended = [fit._replace(changes=()) for fit in fits], []
        while running:
            with warnings.catch_warnings(action="ignore"):  # the last fit warns
                running = [
                    self.fit(pinhole, n_components, fit, start=fit.model)
                    for fit in running
                ]
            best = min(fit.energy for fit in [*running, *ended])
            ends = [self._ends(fit, best) for fit in running]
            ended += [f for f, end in zip(running, ends, strict=True) if end]
            running = [f for f, end in zip(running, ends, strict=True) if not end]
        return sorted(ended, key=lambda fit: fit.energy)

    def first(
        self,
        pinhole: Pinhole,
        n_components: int | None,
        progress: FitProgress | NoProgress,
    ) -> PerspectiveFit:
        """Return the fit for equal depths, of as many basis shapes as are relevant."""
        auto, pinhole = n_components is None, pinhole._replace(near=False)
        with warnings.catch_warnings(action="ignore"):  # the last fit warns
            if n_components is None:
                n_components = self.supported(pinhole, None)
            return self.fit(pinhole, n_components, None, progress, free=auto)

    def with_fewer_shapes(self, fit: PerspectiveFit) -> PerspectiveFit:
        """Return a fit of as many basis shapes as corrected images have."""
        supported, pinhole = self.supported(fit.pinhole, fit), fit.pinhole
        if supported == len(fit.model.basis):
            return fit
        with warnings.catch_warnings(action="ignore"):
            new = self.fit(pinhole, supported, fit, free=True)
        return self.settled(pinhole, len(new.model.basis), new)[0]

    def reach(self, rows: NDArray) -> float:
        """Return the largest coordinate of rows, from the principal point."""
        centre = np.reshape(self.principal_point, (2, 1))
        return float(np.fmax.reduce(np.abs(rows - centre), axis=None, initial=0.0))

    def supported(self, pinhole: Pinhole, fit: PerspectiveFit | None) -> int:
        """Return the number of relevant basis shapes, for the depths of a fit."""
        with warnings.catch_warnings(action="ignore"):
            table = self.straight(pinhole, 1, fit)
        return supported_components(table, self.isa, self.settings)[0]

    def started(self, start: TableModel, n_components: int) -> PerspectiveFit:
        """Return the fit from the model of a similar table, with its focal length."""
        assert start.pinhole is not None
        weights = () if self.weights is None else (self.weights,)
        frames = self.source.joined(lambda *block: start.in_virtual_cameras(*block)[0], *weights)
        model, pinhole = start._replace(pinhole=None), start.pinhole
        fit = PerspectiveFit(pinhole, model, frames, True, {"isa_": None})
        return self.settled(pinhole, n_components, fit)[0]

    def around(self, first: PerspectiveFit, errors: bool) -> dict[float, PerspectiveFit]:
        """Return fits for a given 1/f, its mirror image, and, for errors, neighbours."""
        f, n_components = first.pinhole.focal_length, len(first.model.basis)
        images = first, first.mirrored()
        better, worse = self.settled(self.pinhole(f), n_components, *images)
        fits = {1.0 / f: better, -1.0 / f: worse}
        for share in (0.8, 1.25) if errors and better.changes[-1] < UNSETTLED else ():
            pinhole = self.pinhole(f / share)
            (fits[share / f],) = self.settled(pinhole, n_components, better)
        return fits

    def searched(
        self, n_components: int | None, progress: FitProgress | NoProgress
    ) -> dict[float, PerspectiveFit]:
        """Return fits around the minimum of E; 0 is the weak-perspective fit."""
        reach = max(np.max(np.abs(self.principal_point)), *self.source.map(self.reach))
        first = self.first(self.pinhole(FIRST * reach), n_components, progress)
        n_components, g = len(first.model.basis), 1.0 / (FIRST * reach)
        far = self.first(self.pinhole(ENDLESS * reach), n_components, NoProgress())
        fits = {0.0: far} | self.around(first, False)
        if far.energy < fits[g].energy:  # a long focal length, or none
            pinhole = self.pinhole(LONGER / g)
            images = self.settled(pinhole, n_components, far, far.mirrored())
            fits |= dict(zip((g / LONGER, -g / LONGER), images, strict=True))
        while len(fits) < MOST_FITS:
            lowest = min(fits, key=lambda g: fits[g].energy)
            if lowest <= 0:
                break
            below = max(g for g in fits if g < lowest)
            above = min((g for g in fits if g > lowest), default=0.0)
            place = minimum(fits).place
            if not above:
                place = 1.5 * lowest
            elif not below < place < above:
                place = float(np.sqrt(lowest * above))
            elif min(abs(g - place) for g in fits) < NEAR * place:
                # A parabola through distant fits is biased.
                place = 0.9 * lowest
                if sum(abs(g / lowest - 1.0) < 0.15 for g in fits) > 1:
                    break
            pinhole = self.pinhole(1.0 / place)
            (fits[place],) = self.settled(pinhole, n_components, fits[lowest])
        return fits

    def _ends(self, fit: PerspectiveFit, best: float) -> bool:
        """Return whether further repeats of a fit would not help."""
        n_repeats, change = len(fit.changes), fit.changes[-1]
        if n_repeats >= 2 and fit.energy > WORSE * best:
            return True
        if n_repeats >= MOST_REPEATS * (1 if change > UNSETTLED else 2):
            return True
        return change < SETTLED * self.settings.tol / JOINT_TOL


class Minimum(NamedTuple):
    """The minimum of E: its place g = 1/f, and the standard deviation of g."""

    place: float
    deviation: float



def minimum(fits: dict[float, PerspectiveFit]) -> Minimum:
    """Return the minimum of the parabola through the three best fits."""
    g = np.array(sorted(fits, key=lambda g: fits[g].energy)[:3])
    energies = np.array([fits[place].energies for place in g.tolist()])
    groups = neighbours(fits[float(g[0])].model.mean_shape.T)

    def vertex(kept: NDArray) -> float:
        """Return the minimum of the parabola for some of the points."""
        unit = np.abs(g).max()
        square, slope, _ = np.polyfit(g / unit, energies[:, kept].sum(axis=1), 2)
        if not square > 0:  # it has no minimum between the fits
            return float(np.sign(-slope) * np.inf)
        return float(-0.5 * slope / square * unit)

    every = vertex(np.ones(len(groups), dtype=bool))
    parts = np.array([vertex(groups != group) for group in range(N_GROUPS)])
    if not np.isfinite(parts).all():
        return Minimum(every, np.inf)
    return Minimum(every, float(np.sqrt(N_GROUPS - 1) * parts.std()))


def fit_perspective(
    table: PerspectiveTable,
    n_components: int | None,
    focal_length: float | None,
    progress: FitProgress | NoProgress,
    start: TableModel | None = None,
    errors: bool = False,
) -> tuple[TableModel, Decomposition, bool, dict[str, Any]]:
    """Fit perspective images as `fit_table` fits weak-perspective ones.

    `n_components` and `focal_length` are estimated if they are None. A fit that starts
    from the model of a similar table has its focal length.
    """
    fits: dict[float, PerspectiveFit] = {}
    deviation, why = 0.0, ""
    if start is not None and n_components is not None:
        best = table.started(start, n_components)
    elif focal_length is not None:
        pinhole = table.pinhole(focal_length)
        first = table.first(pinhole, n_components, progress)
        fits = table.around(first, errors)
        best = fits[1.0 / focal_length]
        if best.changes[-1] > UNSETTLED or best.energy > first.energy:
            best, why = first, UNSTEADY
    else:
        fits = table.searched(n_components, progress)
        place, deviation = minimum(fits)
        if min(fits, key=lambda g: fits[g].energy) <= 0 or place < 2.0 * deviation:
            best, why = fits[0.0], NO_PERSPECTIVE
        else:
            pinhole, nearest = table.pinhole(1.0 / place), nearest_to(fits, place)
            (best,) = table.settled(pinhole, len(nearest.model.basis), nearest)
    if n_components is None and not why:
        best = table.with_fewer_shapes(best)
    # The last fit, with warnings and errors of depths
    pinhole, before = best.pinhole._replace(near=not why), None if why else best
    options = {"start": best.model, "errors": errors}
    fit = table.fit(pinhole, len(best.model.basis), before, **options)
    attributes = fit.attributes | {"isa_": best.attributes["isa_"]}
    frames = fit.model.frames
    if errors and not why:
        place = 1.0 / pinhole.focal_length
        other, least = minimum(fits), max(g for g in fits if g < 0)
        share = deviation / place
        if not deviation and np.isfinite(other.deviation):
            # The table may contradict a given focal length
            square = (other.place - place) ** 2 - other.deviation**2
            share = np.sqrt(max(square, 0.0)) / place
        total = np.hypot(frames.certainty.total, share * depth_slope(fits, place))
        total = float(total)
        frames = replace(frames, certainty=frames.certainty._replace(total=total))
        attributes |= {
            "depth_uncertainty_": total,
            "mirror_certainty_": better_than(fits[-least], fits[least]),
        }
    if why:
        warn_caller(why)
    model = fit.model._replace(frames=frames, pinhole=pinhole)
    weights = () if table.weights is None else (table.weights,)
    decompose = partial(model.decompose, dtype=np.float64)
    shown = table.source.joined(decompose, *weights)
    seen = np.isfinite(shown.motion).all(axis=(1, 2))
    sizes = attributes["_frame_sizes"][seen]
    row, scale = nearest_calibrated(
        reference_camera(shown.motion[seen] / sizes[:, None, None], sizes)[None]
    )
    dtype = table.source.empty.dtype
    centre = shown.translation[seen].mean(axis=0)
    attributes |= {
        "reference_motion_": (scale * row[0]).astype(dtype),
        "reference_translation_": centre.astype(dtype),
        "focal_length_": np.inf if why == NO_PERSPECTIVE else pinhole.focal_length,
        "focal_length_std_": deviation * pinhole.focal_length**2,
    }
    shown = Decomposition(*(part.astype(dtype) for part in shown))
    return model, shown, fit.converged, attributes


def better_than(fit: PerspectiveFit, other: PerspectiveFit) -> float:
    """Return the probability that E is smaller than that of another fit, by groups."""
    groups = neighbours(fit.model.mean_shape.T)
    off = np.bincount(groups, other.energies - fit.energies)
    deviation = off.std(ddof=1) / np.sqrt(len(off))
    return float(student.cdf(off.mean() / deviation, len(off) - 1))


def nearest_to(fits: dict[float, PerspectiveFit], place: float) -> PerspectiveFit:
    """Return the fit with the nearest g."""
    return fits[min(fits, key=lambda g: abs(g - place))]


def depth_slope(fits: dict[float, PerspectiveFit], place: float) -> float:
    """Return the relative change of the depths by a relative change of g."""
    g, other = sorted((g for g in fits if g >= 0), key=lambda g: abs(g - place))[:2]
    whole = slice(None)
    z, changed = fits[g].depths(whole), fits[other].depths(whole)
    share = np.sqrt(np.nansum((z - changed) ** 2) / np.nansum(z**2))
    return float(share * place / abs(g - other))


def _straight(
    rows: NDArray,
    motion: NDArray | None = None,
    alpha: NDArray | None = None,
    *,
    pinhole: Pinhole,
    robust: bool,
    model: TableModel | None = None,
) -> NDArray:
    """Return weak-perspective images (n, 2, J) of rows, for the depths of a model."""
    images, _ = pinhole.virtual(rows, robust)
    if model is None or motion is None or alpha is None:
        return images
    fit = Decomposition(motion, motion[:, :, 0], alpha, alpha)
    return pinhole.straight(images, model.depths(fit))


def _squares(
    rows: NDArray,
    motion: NDArray,
    translation: NDArray,
    alpha: NDArray,
    *,
    fit: PerspectiveFit,
    robust: bool,
) -> NDArray:
    """Return squared distances (J,) from the images, in sizes of frames, and counts."""
    images, _ = fit.pinhole.virtual(rows, robust)
    shapes = compose(fit.model.mean_shape, fit.model.basis, alpha)
    flat = project(shapes, motion, translation).swapaxes(1, 2)
    depths = fit.model.depths(Decomposition(motion, translation, alpha, alpha))
    square = np.sum((fit.pinhole.images(flat, depths) - images) ** 2, axis=1)
    centred = images - np.nanmean(images, axis=2, keepdims=True)
    square /= np.nanmean(centred**2, axis=(1, 2))[:, None]
    return np.array([np.nansum(square, axis=0), np.isfinite(square).sum(axis=0)])
