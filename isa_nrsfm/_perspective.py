"""The fit of perspective images: repeated fits of weak-perspective ones.

`_frames.pinhole` has the equations. Each repeat corrects the images for the depths of
the fit before, and starts from its shapes, until depths and fit agree. Weak-perspective
images determine depths up to their sign, so both mirror images are continued.

Let E be the mean squared distance of points from their images, in sizes of frames. As a
function of g = 1/f it is least for the focal length f. g = 0 is the weak-perspective
fit, and -g the mirror image of the fit for g. Minima of parabolas through the three
best fits lead to an unknown f. Without one of several groups of points the minimum
moves, which gives its deviation (jackknife).
"""

import warnings
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from isa_nrsfm._compat.callbacks import FitProgress, NoProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fit import (
    fit_table,
    mean_camera,
    mirror_image,
    ready_table,
    supported_components,
)
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import compose, project
from isa_nrsfm._frames.models import Decomposition, PosteriorFrames
from isa_nrsfm._frames.pinhole import Pinhole, common
from isa_nrsfm._joint.settings import JOINT_TOL, FitSettings
from isa_nrsfm._joint.uncertainty import N_GROUPS, neighbours
from isa_nrsfm._prepare.robust import robust_square
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import centred_frames

# Effects of the next two lines: docs/benchmarks/README.md, "Thresholds".
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

UNSTEADY = (
    "the fit of perspective has not settled: depths and fit do not agree. The focal "
    "length may be wrong, the objects may turn too little, or there are too few basis "
    "shapes. The fit is that of weak-perspective cameras, turned to each object"
)
NO_PERSPECTIVE = (
    "no perspective was found: the focal length is very long, or there are too few "
    "basis shapes to estimate it. If it is known, give focal_length. The fit is that "
    "of weak-perspective cameras"
)


class PerspectiveFit(NamedTuple):
    """
    A fit with a known focal length.

    model: that of weak-perspective images. frames: in virtual cameras. converged,
    attributes: as `fit_table` returns them. changes: shares by which repeats have
    changed the depths. energies (J,): contributions of the points to E. earlier: at
    most three fits before, the last one first.
    """

    pinhole: Pinhole
    model: TableModel
    frames: Decomposition
    converged: bool
    attributes: dict[str, Any]
    changes: tuple[float, ...] = ()
    energies: NDArray = np.zeros(0)
    earlier: tuple["PerspectiveFit", ...] = ()

    @property
    def energy(self) -> float:
        """Mean squared distance E of the points from their images."""
        return float(self.energies.sum())

    @property
    def n_components(self) -> int:
        """Number of basis shapes."""
        return len(self.model.basis)

    def depths(self, part: slice) -> NDArray:
        """Return depths (n, J) of the points of some frames."""
        return self.model.depths(self.frames.motion[part], self.frames.alpha[part])

    @property
    def for_depths(self) -> list["PerspectiveFit"]:
        """The fits whose depths correct the next images: several if they oscillate."""
        slow = any(new > 0.5 * old for old, new in pairwise(self.changes))
        return [self, *self.earlier] if slow else [self]

    def mirrored(self) -> "PerspectiveFit":
        """Return the mirror image in depth."""
        image = mirror_image(self.model, self.frames, self.attributes)
        return self._replace(model=image[0], frames=image[1], attributes=image[2])


class PerspectiveTable(NamedTuple):
    """A table of perspective images, and what all its fits have in common."""

    source: FrameBlocks
    weights: NDArray | None
    isa: Any
    settings: FitSettings
    principal_point: Any

    def pinhole(self, focal_length: float, near: bool = True) -> Pinhole:
        """Return the camera with a focal length."""
        x, y = map(float, self.principal_point)
        return Pinhole(focal_length, (x, y), self.settings.loss != "linear", near)

    def straight(
        self, pinhole: Pinhole, n_components: int, fit: PerspectiveFit | None
    ) -> ScaledTable:
        """Return weak-perspective images, for the depths of a fit, or equal ones."""
        if fit is None:
            rows = self.source.derive(lambda rows: pinhole.virtual(rows)[0])
        else:
            fits = fit.for_depths
            by_frame = [v for f in fits for v in (f.frames.motion, f.frames.alpha)]
            models = [f.model for f in fits]
            function = partial(_straight, pinhole=pinhole, models=models)
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
        table, settings = self.straight(pinhole, n_components, before), self.settings
        progress = progress or NoProgress()
        result = fit_table(table, n_components, self.isa, settings, progress, **options)
        fit = PerspectiveFit(pinhole, *result)
        if before is not None:
            parts = [(before.depths(p), fit.depths(p)) for p in self.source.slices]
            same, other, total = (
                sum(float(np.nansum((z - sign * old) ** 2)) for old, z in parts)
                for sign in (1.0, -1.0, 0.0)
            )
            change = float(np.sqrt(min(same, other) / (total or 1.0)))
            fit = fit.mirrored() if other < same else fit
            fit.attributes["isa_"] = fit.attributes["isa_"] or before.attributes["isa_"]
            earlier = (before._replace(earlier=()), *before.earlier)[:3]
            fit = fit._replace(changes=(*before.changes, change), earlier=earlier)
        squares = self.source.map(partial(_squares, fit=fit), *fit.frames[:3])
        square, counts = np.sum(list(squares), axis=0)
        return fit._replace(energies=square / counts.sum())

    def quick_fit(self, *args: Any, **options: Any) -> PerspectiveFit:
        """Return a fit without warnings: the last fit warns."""
        with warnings.catch_warnings(action="ignore"):
            return self.fit(*args, **options)

    def settled(
        self, pinhole: Pinhole, n_components: int, *fits: PerspectiveFit
    ) -> list[PerspectiveFit]:
        """Repeat fits until depths and fits agree; return them, the best first.

        A fit also ends if it is clearly worse than the best one.
        """
        running = [fit._replace(changes=(), earlier=()) for fit in fits]
        ended: list[PerspectiveFit] = []
        while running:
            running = [
                self.quick_fit(pinhole, n_components, fit, start=fit.model)
                for fit in running
            ]
            best = min(fit.energy for fit in [*running, *ended])
            ended += [fit for fit in running if self._ends(fit, best)]
            running = [fit for fit in running if not self._ends(fit, best)]
        return sorted(ended, key=lambda fit: fit.energy)

    def _ends(self, fit: PerspectiveFit, best: float) -> bool:
        """Return whether further repeats of a fit would not help."""
        n_repeats, change = len(fit.changes), fit.changes[-1]
        most = MOST_REPEATS if change > UNSETTLED else 2 * MOST_REPEATS
        agrees = change < SETTLED * self.settings.tol / JOINT_TOL
        return agrees or n_repeats >= (2 if fit.energy > WORSE * best else most)

    def first(
        self,
        focal_length: float,
        n_components: int | None,
        progress: FitProgress | NoProgress,
    ) -> PerspectiveFit:
        """Return the fit for equal depths, of as many basis shapes as are relevant."""
        pinhole, auto = self.pinhole(focal_length, near=False), n_components is None
        if n_components is None:
            n_components = self.supported(pinhole, None)
        return self.quick_fit(pinhole, n_components, None, progress, free=auto)

    def supported(self, pinhole: Pinhole, fit: PerspectiveFit | None) -> int:
        """Return the number of relevant basis shapes, for the depths of a fit."""
        with warnings.catch_warnings(action="ignore"):
            table = self.straight(pinhole, 1, fit)
        return supported_components(table, self.isa, self.settings)[0]

    def corrected_number(self, fit: PerspectiveFit) -> PerspectiveFit:
        """Return a fit with as many basis shapes as images without perspective have."""
        supported = self.supported(fit.pinhole, fit)
        if supported == fit.n_components:
            return fit
        fit = self.quick_fit(fit.pinhole, supported, fit, free=True)
        return self.settled(fit.pinhole, fit.n_components, fit)[0]

    def started(self, start: TableModel, n_components: int) -> PerspectiveFit:
        """Return the fit from the model of a similar table, with its focal length."""
        assert start.pinhole is not None
        frames = self.source.joined(lambda rows: start.in_virtual_cameras(rows)[0])
        model, pinhole = start._replace(pinhole=None), start.pinhole
        fit = PerspectiveFit(pinhole, model, frames, True, {"isa_": None})
        return self.settled(pinhole, n_components, fit)[0]

    def images(self, first: PerspectiveFit, f: float) -> dict[float, PerspectiveFit]:
        """Return the fits for 1/f and -1/f from a first fit."""
        images, pinhole = (first, first.mirrored()), self.pinhole(f)
        better, worse = self.settled(pinhole, first.n_components, *images)
        return {1.0 / f: better, -1.0 / f: worse}

    def searched(
        self, n_components: int | None, progress: FitProgress | NoProgress
    ) -> dict[float, PerspectiveFit]:
        """Return fits around the minimum of E; 0 is the weak-perspective fit."""
        f = FIRST * max(self.source.map(self._reach))
        first = self.first(f, n_components, progress)
        far = self.first(ENDLESS * f, first.n_components, NoProgress())
        fits = {0.0: far, **self.images(first, f)}
        if far.energy < fits[1.0 / f].energy:  # a long focal length, or none
            fits |= self.images(far, LONGER * f)
        while len(fits) < MOST_FITS and (lowest := best_of(fits)) > 0:
            below = max(g for g in fits if g < lowest)
            above = min((g for g in fits if g > lowest), default=0.0)
            place, _ = minimum(fits)
            if not above:
                place = 1.5 * lowest
            elif not below < place < above:
                place = float(np.sqrt(lowest * above))
            elif min(abs(g - place) for g in fits) < NEAR * place:
                # A parabola through distant fits is biased.
                place = 0.9 * lowest
                if sum(abs(g / lowest - 1.0) < 0.15 for g in fits) > 1:
                    break
            fits[place] = self.near(fits, place)
        return fits

    def _reach(self, rows: NDArray) -> float:
        """Return the largest coordinate of points and image, from its middle."""
        centre = self.pinhole(1.0).centre
        largest = np.fmax.reduce(np.abs(rows - centre), axis=None, initial=0.0)
        return float(max(largest, *np.abs(centre[:, 0])))

    def near(self, fits: dict[float, PerspectiveFit], place: float) -> PerspectiveFit:
        """Return the fit for g, from that with the nearest one."""
        fit = fits[min((g for g in fits if g > 0), key=lambda g: abs(g - place))]
        return self.settled(self.pinhole(1.0 / place), fit.n_components, fit)[0]


def best_of(fits: dict[float, PerspectiveFit]) -> float:
    """Return the g of the fit with the least E."""
    return min(fits, key=lambda g: fits[g].energy)


def minimum(fits: dict[float, PerspectiveFit]) -> tuple[float, float]:
    """Return the minimum of a parabola through the three best fits, its deviation."""
    g = sorted(fits, key=lambda g: fits[g].energy)[:3]
    energies = np.array([fits[place].energies for place in g])
    groups = neighbours(fits[g[0]].model.mean_shape.T)

    def vertex(kept: NDArray) -> float:
        """Return the minimum for some of the points, or infinity if there is none."""
        unit = np.max(np.abs(g))
        square, slope, _ = np.polyfit(g / unit, energies[:, kept].sum(axis=1), 2)
        return float(-0.5 * slope / square * unit) if square > 0 else np.inf

    every = vertex(groups >= 0)
    parts = np.array([vertex(groups != group) for group in range(N_GROUPS)])
    if not np.isfinite(parts).all():
        return every, np.inf
    # Few groups: the error has a t distribution, whose deviation is larger.
    n_free = N_GROUPS - 1
    return every, float(parts.std() * np.sqrt(n_free * n_free / (n_free - 2)))


def fit_perspective(
    table: PerspectiveTable,
    n_components: int | None,
    given: Any,
    progress: FitProgress | NoProgress,
    start: TableModel | None = None,
    errors: bool = False,
) -> tuple[TableModel, Decomposition, bool, dict[str, Any]]:
    """Fit perspective images as `fit_table` fits weak-perspective ones.

    `n_components` and the given focal length are estimated if they are None; the table
    has the mean of several. A fit from the model of a similar table has that of it.
    """
    focal_length = None if given is None else common(given)
    fits: dict[float, PerspectiveFit] = {}
    deviation, why = 0.0, ""
    if start is not None and n_components is not None:
        best = table.started(start, n_components)
    elif focal_length is not None:
        first = table.first(focal_length, n_components, progress)
        fits = table.images(first, focal_length)
        best = fits[1.0 / focal_length]
        if best.changes[-1] > UNSETTLED or best.energy > first.energy:
            best, why = first, UNSTEADY
        elif errors:  # neighbours tell how far a focal length contradicts the table
            places = [share / focal_length for share in (0.8, 1.25)]
            fits |= {place: table.near(fits, place) for place in places}
    else:
        fits = table.searched(n_components, progress)
        place, deviation = minimum(fits)
        deviation = float(np.hypot(deviation, 0.5 * NEAR * place))  # of the search
        if best_of(fits) > 0 and place > 2.0 * deviation:
            best = table.near(fits, place)
        else:
            best, why = fits[0.0], NO_PERSPECTIVE
    if n_components is None and not why:
        best = table.corrected_number(best)
    # The last fit, with warnings and errors of depths
    fit = table.fit(
        best.pinhole,
        best.n_components,
        None if why else best,
        start=best.model,
        errors=errors,
    )
    f, attributes = best.pinhole.focal_length, fit.attributes
    model = fit.model._replace(pinhole=best.pinhole)
    if why:
        warn_caller(why)
    elif errors and isinstance(model.frames, PosteriorFrames):
        certainty = model.frames.certainty
        total = float(np.hypot(certainty.total, focal_error(fits, f, deviation)))
        certainty = certainty._replace(total=total)
        model = model._replace(frames=replace(model.frames, certainty=certainty))
        least = max(g for g in fits if g < 0)
        probability = better_than(fits[-least], fits[least])
        attributes |= {"depth_uncertainty_": total, "mirror_certainty_": probability}
    # Frames as new tables have them
    weights = () if table.weights is None else (table.weights,)
    decompose = partial(model.decompose, dtype=np.float64)
    frames: Decomposition = table.source.joined(decompose, *weights)
    shown = np.isfinite(frames.motion).all(axis=(1, 2))
    seen, sizes = Decomposition(*(v[shown] for v in frames)), attributes["_frame_sizes"]
    dtype = table.source.empty.dtype
    for name, value in mean_camera(seen, sizes[shown], "perspective").items():
        attributes[name] = value.astype(dtype)
    known = not deviation or model.frames.certainty.determined
    if why == NO_PERSPECTIVE:
        f = np.inf
    attributes |= {
        "isa_": best.attributes["isa_"],
        "focal_length_": f if given is None else np.array(given, dtype=float)[()],
        "focal_length_std_": deviation * f**2 if known else np.inf,
    }
    frames = Decomposition(*(part.astype(dtype) for part in frames))
    return model, frames, fit.converged, attributes


def focal_error(
    fits: dict[float, PerspectiveFit], focal_length: float, deviation: float
) -> float:
    """Return the relative error of the depths due to that of the focal length.

    The error of 1/f is its deviation. For a given f it is the distance of the minimum
    of E, as far as the deviation of the minimum does not explain it.
    """
    g = 1.0 / focal_length
    if not deviation:
        place, other = minimum(fits)
        deviation = np.sqrt(np.fmax((place - g) ** 2 - other**2, 0.0))
    first, second = sorted((g for g in fits if g >= 0), key=lambda o: abs(o - g))[:2]
    z, moved = (fits[place].depths(slice(None)) for place in (first, second))
    change = np.sqrt(np.nansum((moved - z) ** 2) / np.nansum(z**2))
    return float(change * deviation / abs(second - first))


def better_than(fit: PerspectiveFit, other: PerspectiveFit) -> float:
    """Return the probability that E is less than that of another fit, by groups."""
    gain = np.bincount(
        neighbours(fit.model.mean_shape.T), other.energies - fit.energies
    )
    deviation = gain.std(ddof=1) / np.sqrt(len(gain))
    return float(stdtr(len(gain) - 1, gain.mean() / deviation))


def _straight(
    rows: NDArray, *by_frame: NDArray, pinhole: Pinhole, models: list[TableModel]
) -> NDArray:
    """Return weak-perspective images (n, 2, J) of rows, for weighted means of depths.

    Cameras and coefficients of the frames follow each other, for one model each. Each
    model has half of the weight of the one before it.
    """
    fits = zip(models, by_frame[::2], by_frame[1::2], strict=True)
    depths = [model.depths(motion, alpha) for model, motion, alpha in fits]
    weights = 0.5 ** np.arange(len(depths))
    mean = np.average(depths, axis=0, weights=weights)
    return pinhole.straight(pinhole.virtual(rows)[0], mean)


def _squares(
    rows: NDArray,
    motion: NDArray,
    translation: NDArray,
    alpha: NDArray,
    fit: PerspectiveFit,
) -> NDArray:
    """Return sums (J,) of squared distances, in sizes of frames, and counts."""
    images, _ = fit.pinhole.virtual(rows)
    shapes = compose(fit.model.mean_shape, fit.model.basis, alpha)
    flat = project(shapes, motion, translation).swapaxes(1, 2)
    depths = fit.model.depths(motion, alpha)
    square = np.sum((fit.pinhole.images(flat, depths) - images) ** 2, axis=1)
    size = centred_frames(images)[1].size
    square /= np.where(size > 0, size, np.nan)[:, None] ** 2
    if fit.pinhole.robust and isinstance(fit.model.frames, PosteriorFrames):
        square = robust_square(square, fit.model.frames.noise_variance)
    return np.array([np.nansum(square, axis=0), np.isfinite(square).sum(axis=0)])
