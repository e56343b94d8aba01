"""The fit of perspective images: repeated fits of weak-perspective ones.

`_frames.camera_models` has the equations. Each repeat corrects the images for the
depths of the fit before, and starts from its shapes, until depths and fit agree.
Weak-perspective images determine depths up to their sign, so both mirror images are
continued.

Let E be the mean squared distance of points from their images, in sizes of frames. As a
function of g = 1/f it is least for the focal length f. g = 0 is the weak-perspective
fit, and -g the mirror image of the fit for g. For an unknown f, steps up and down lead
to the best fit: f is the minimum of the parabola through the best three. Without one of
several groups of points it moves, which gives its deviation (jackknife).
"""

import warnings
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, stdtr

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import FitProgress, NoProgress
from isa_nrsfm._fit import (
    PERSPECTIVE_STAGE,
    TableFit,
    fit_table,
    mean_camera,
    mirror_image,
    supported_components,
)
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import Pinhole, common, pinhole_of
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._joint.settings import JOINT_TOL, FitSettings
from isa_nrsfm._joint.uncertainty import N_GROUPS, neighbours
from isa_nrsfm._prepare.robust import robust_square
from isa_nrsfm._prepare.scaling import ScaledTable, scaled_table
from isa_nrsfm._tables.blocks import FrameBlocks

# Effects of these constants: docs/benchmarks/README.md, "Thresholds".
# Depths and fit agree if a repeat changes depths by less than SETTLED, with the default
# tolerance. If MOST_REPEATS end with larger changes than UNSETTLED, they never will.
SETTLED, UNSETTLED, MOST_REPEATS = 2e-3, 0.05, 8
# Factor of the tolerance of all fits but the last one, and of SETTLED for focal lengths
# that are only compared.
ROUGH, COMPARED = 4.0, 5.0
# A mirror image is given up if E is larger than this multiple of the other one's.
WORSE = 1.3
# Focal lengths of the weak-perspective fit and of the first perspective one, in largest
# distances from the principal point, and how much longer the next one is if that fails.
ENDLESS, FIRST, LONGER = 1e7, 2.0, 8.0
# Factors of the steps of the search for the minimum, from the best fit up and down; its
# error, as a share of 1/f; and the largest number of fits.
STEPS, NEAR, MOST_FITS = (1.5, 1.1), 0.01, 16

# Why perspective is not taken.
UNSTEADY = (
    "the fit of perspective has not settled: depths and fit do not agree. The focal "
    "length may be wrong, or the objects may turn too little"
)
NOT_BETTER = (
    "perspective predicts held-out points no better than weak perspective. The focal "
    "length or the principal point may be wrong, or the objects too far away"
)
NO_PERSPECTIVE = (
    "no perspective was found: the focal length is very long, or there are too few "
    "basis shapes to estimate it. If it is known, give focal_length"
)
WEAK = "The fit is that of weak-perspective cameras"


class PerspectiveFit(NamedTuple):
    """
    A fit with a known focal length, of weak-perspective images in virtual cameras.

    model: with the perspective camera. frames, converged, attributes: as `fit_table`
    returns them. changes: shares by which repeats have changed the depths. energies
    (J,): contributions of the points to E.
    """

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

    @property
    def pinhole(self) -> Pinhole:
        """The perspective camera."""
        assert self.model.pinhole is not None
        return self.model.pinhole

    @property
    def n_components(self) -> int:
        """Number of basis shapes."""
        return self.model.n_components

    def depths(self, part: slice) -> NDArray:
        """Return depths (n, J) of the points of some frames."""
        return self.model.depths(self.frames.motion[part], self.frames.alpha[part])

    def change(self, other: "PerspectiveFit", parts: list[slice]) -> float:
        """Return the distance of depths from others, relative to these.

        It is negative if the mirror image is nearer.
        """
        pairs = (np.nan_to_num([fit.depths(p) for fit in (self, other)]) for p in parts)
        products = sum(np.einsum("aij,bij->ab", pair, pair) for pair in pairs)
        (own, common), (_, others) = np.asarray(products)
        square = max(own - 2.0 * abs(common) + others, 0.0) / (own or 1.0)
        return float(np.copysign(np.sqrt(square), common))

    def ends(self, tol: float, best: float) -> bool:
        """Return whether further repeats would not help: for the best E of others."""
        n_repeats, change = len(self.changes), self.changes[-1]
        most = MOST_REPEATS if change > UNSETTLED else 2 * MOST_REPEATS
        most = 2 if self.energy > WORSE * best else most
        return change < tol or n_repeats >= most

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
    progress: FitProgress | NoProgress

    def pinhole(self, focal_length: float, near: bool = True) -> Pinhole:
        """Return the camera with a focal length."""
        robust = self.settings.loss != "linear"
        return pinhole_of(focal_length, self.principal_point, robust, near)

    def straight(
        self, pinhole: Pinhole | None, n_components: int, fit: PerspectiveFit | None
    ) -> ScaledTable:
        """Return weak-perspective images, for the depths of a fit, or equal ones.

        Without a camera they are those of the table.
        """
        model = None if fit is None else fit.model
        known = () if fit is None else (fit.frames.motion, fit.frames.alpha)
        function = partial(_straight, pinhole=pinhole, model=model)
        rows = self.source.derive(function, *known)
        return scaled_table(rows, self.weights, n_components, self.settings)

    def fit(
        self,
        pinhole: Pinhole | None,
        n_components: int | None,
        before: PerspectiveFit | None = None,
        *,
        last: bool = False,
        progress: FitProgress | NoProgress | None = None,
        **changes: Any,
    ) -> PerspectiveFit:
        """Return the fit of images that are corrected for the depths of another fit.

        It has the mirror image with those depths. None stands for as many basis shapes
        as are relevant. Fits before the last one are joint fits with principal axes and
        a larger tolerance, from the other fit and its cameras. `changes` are those of
        the settings.
        """
        isa, quiet = self.isa, NoProgress()
        settings = self.settings._replace(start=None, known=None)
        if not last:
            settings = settings._replace(
                independence=None,
                tol=ROUGH * settings.tol,
                whole=False,  # all directions of a shape would explain the perspective
                refinement="joint",
                remove_pose=False,
                errors=False,
            )
            if before is not None:
                settings = settings._replace(start=before.model, placed=before.frames)
        settings = settings._replace(**{"free": n_components is None} | changes)
        if n_components is None:
            table = self.straight(pinhole, 1, before)
            n_components = supported_components(table, isa, settings, quiet)
            if before is not None and n_components == before.n_components:
                return before
        table = self.straight(pinhole, n_components, before)
        args = table, n_components, isa, settings, progress or quiet
        fit = PerspectiveFit(*fit_table(*args))
        fit = fit._replace(model=fit.model._replace(pinhole=pinhole))
        if before is not None:
            change = fit.change(before, self.source.slices)
            fit = fit.mirrored() if change < 0 else fit
            fit.attributes["isa_"] = fit.attributes["isa_"] or before.attributes["isa_"]
            fit = fit._replace(changes=(*before.changes, abs(change)))
        squares = self.source.map(partial(_squares, model=fit.model), *fit.frames)
        square, counts = np.sum(list(squares), axis=0)
        return fit._replace(energies=square / counts.sum())

    def settled(
        self,
        pinhole: Pinhole,
        n_components: int,
        *fits: PerspectiveFit,
        tol: float = SETTLED,
    ) -> list[PerspectiveFit]:
        """Repeat fits until depths and fits agree; return them, the best first.

        A fit also ends if it is clearly worse than the best one.
        """
        tol *= self.settings.tol / JOINT_TOL
        running = [fit._replace(changes=()) for fit in fits]
        ended: list[PerspectiveFit] = []
        while running:
            self.progress.step()
            running = [self.fit(pinhole, n_components, fit) for fit in running]
            best = min(fit.energy for fit in [*running, *ended])
            ended += [fit for fit in running if fit.ends(tol, best)]
            running = [fit for fit in running if not fit.ends(tol, best)]
        return sorted(ended, key=lambda fit: fit.energy)

    def images(self, first: PerspectiveFit, f: float) -> dict[float, PerspectiveFit]:
        """Return the fits for 1/f and -1/f from a first fit."""
        images, pinhole = (first, first.mirrored()), self.pinhole(f)
        better, worse = self.settled(pinhole, first.n_components, *images)
        if self.log_odds(better, worse) < 0:
            better, worse = worse, better
        return {1.0 / f: better, -1.0 / f: worse}

    def preferred(self, model: TableModel, weak: TableModel) -> bool:
        """Return whether held-out points prefer a model to weak perspective."""
        known = () if self.weights is None else (self.weights,)
        ours, theirs = (m.held_out_error(self.source, *known) for m in (model, weak))
        return ours < theirs

    def log_odds(self, fit: PerspectiveFit, image: PerspectiveFit) -> float:
        """Return the log odds of a fit against its mirror image.

        The evidence is a test of E over groups of points, and the prior, if any.
        """
        gain = image.energies - fit.energies
        gain = np.bincount(neighbours(fit.model.mean_shape.T), gain)
        t = gain.mean() / gain.std(ddof=1) * np.sqrt(len(gain))
        odds = float(logit(stdtr(len(gain) - 1, t)))
        if np.isnan(self.settings.mirror_certainty):
            return odds
        prior = self.settings.prior.mean_shape
        sign = np.sign(np.vdot(fit.model.mean_shape[:, 2], prior[:, 2]))
        return odds + float(sign * logit(self.settings.mirror_certainty))

    def started(self, model: TableModel, n_components: Any) -> PerspectiveFit:
        """Return the fit from the model of a similar table, with its focal length."""
        frames = self.source.joined(model.in_virtual_cameras)
        fit = PerspectiveFit(model, frames, True, {"isa_": None})
        return self.settled(fit.pinhole, n_components, fit)[0]

    def near(self, fits: dict[float, PerspectiveFit], place: float) -> PerspectiveFit:
        """Return the fit for g, from that with the nearest one."""
        fit = fits[min((g for g in fits if g > 0), key=lambda g: abs(g - place))]
        rough, pinhole = COMPARED * SETTLED, self.pinhole(1.0 / place)
        return self.settled(pinhole, fit.n_components, fit, tol=rough)[0]

    def searched(self, n_components: int | None) -> dict[float, PerspectiveFit]:
        """Return fits around the minimum of E; 0 is the weak-perspective fit."""
        f = FIRST * max(self.source.map(self._reach))
        virtual = self.pinhole(f, near=False)
        first = self.fit(virtual, n_components, progress=self.progress)
        far = self.fit(self.pinhole(ENDLESS * f, near=False), first.n_components)
        fits = {0.0: far, **self.images(first, f)}
        if far.energy < fits[1.0 / f].energy:  # a long focal length, or none
            fits |= self.images(far, LONGER * f)
        for step in STEPS:
            while len(fits) < MOST_FITS and (lowest := best_of(fits)) > 0:
                places = lowest * step, lowest / step
                new = [p for p in places if min(abs(g / p - 1) for g in fits) > NEAR]
                if not new:
                    break
                fits[new[0]] = self.near(fits, new[0])
        return fits

    def _reach(self, rows: NDArray) -> float:
        """Return the largest coordinate of points and image, from its middle."""
        centre = self.pinhole(1.0).centre
        largest = np.fmax.reduce(np.abs(rows - centre), axis=None, initial=0.0)
        return float(max(largest, *np.abs(centre[:, 0])))


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
        square, slope, _ = np.polyfit(g, energies[:, kept].sum(axis=1), 2)
        return float(-0.5 * slope / square) if square > 0 else np.inf

    every = vertex(groups >= 0)
    parts = np.array([vertex(groups != group) for group in range(N_GROUPS)])
    if not np.isfinite(parts).all():
        return every, np.inf
    # Few groups: the error has a t distribution, whose deviation is larger.
    n_free = N_GROUPS - 1
    return every, float(parts.std() * np.sqrt(n_free * n_free / (n_free - 2)))


def fit_perspective(
    table: PerspectiveTable, n_components: int | None, given: Any
) -> TableFit:
    """Fit perspective images as `fit_table` fits weak-perspective ones.

    `n_components` and the given focal length are estimated if they are None; the table
    has the mean of several. A fit from the model of a similar table has that of it.
    If perspective is not found, its fit does not settle, or held-out points do not
    prefer it, the fit is that of weak-perspective cameras, with a warning. The model of
    that fit may be known, as "weak".
    """
    settings, errors = table.settings, table.settings.errors
    fits: dict[float, PerspectiveFit] = {}
    deviation, why, prior = 0.0, "", settings.prior
    # Like all fits with calibrated cameras, it does not depend on the number reported.
    number = None if settings.all_directions else n_components
    with warnings.catch_warnings(action="ignore"):  # the last fit warns
        if settings.start is not None:
            best = table.started(settings.start, n_components)
        elif given is not None:
            f = common(given)
            virtual = table.pinhole(f, near=False)
            first = table.fit(virtual, number, progress=table.progress)
            fits = {0.0: first, **table.images(first, f)}
            best = fits[1.0 / f]
            if best.changes[-1] > UNSETTLED and prior is None:
                why = UNSTEADY
            elif errors:  # neighbours tell how far a focal length contradicts the table
                places = 0.8 / f, 1.25 / f
                fits |= {place: table.near(fits, place) for place in places}
        else:
            fits, number = table.searched(n_components), n_components
            place, deviation = minimum(fits)
            deviation = float(np.hypot(deviation, 0.5 * NEAR * place))  # of the search
            if best_of(fits) > 0 and place > 2.0 * deviation:
                best = table.near(fits, place)
            else:
                why = NO_PERSPECTIVE
        if number is None and not why:
            best = table.fit(best.pinhole, None, best)
            best = table.settled(best.pinhole, best.n_components, best)[0]
    # The last fits, with warnings and errors of depths
    last = partial(table.fit, last=True)
    if not why:
        n_last = n_components or best.n_components
        fit = last(best.pinhole, n_last, best)
        if fit.changes[-1] > UNSETTLED:  # all directions show more than a few
            fit = last(best.pinhole, n_last, fit)
    plain = partial(last, None, n_components or 1, free=n_components is None)
    if not why and settings.start is None:
        with warnings.catch_warnings(action="ignore"):
            weak = (settings.known or {}).get("weak") or plain(errors=False).model
        why = "" if table.preferred(fit.model, weak) else NOT_BETTER
    table.progress(PERSPECTIVE_STAGE)
    if why:
        warn_caller(f"{why}. {WEAK}")
        return plain()[:4]
    model, _, converged, attributes, *_ = fit
    f = best.pinhole.focal_length
    if errors and model.frames.joint:
        certainty = model.frames.certainty
        error = focal_error(fits, 1.0 / f, deviation, table.source.slices)
        total = float(np.hypot(certainty.total, error))
        certainty = certainty._replace(total=total)
        model = model._replace(frames=replace(model.frames, certainty=certainty))
        least = min(abs(g) for g in fits if g < 0)
        probability = float(expit(table.log_odds(fits[least], fits[-least])))
        attributes |= {"depth_uncertainty_": total, "mirror_certainty_": probability}
    # Frames as new tables have them
    weights = () if table.weights is None else (table.weights,)
    decompose = partial(model.decompose, dtype=np.float64)
    frames: Decomposition = table.source.joined(decompose, *weights)
    dtype = table.source.empty.dtype
    sizes, known = attributes["_frame_sizes"], model.frames.certainty.determined
    shown = np.isfinite(sizes)
    seen = Decomposition(*(values[shown] for values in frames))
    view = mean_camera(seen, sizes[shown], "perspective")
    attributes |= {name: value.astype(dtype) for name, value in view.items()}
    attributes |= {
        "isa_": best.attributes["isa_"],
        "focal_length_": f if given is None else np.array(given, dtype=float)[()],
        "focal_length_std_": deviation * f**2 if known or not deviation else np.inf,
    }
    frames = Decomposition(*(part.astype(dtype) for part in frames))
    return model, frames, converged, attributes


def focal_error(
    fits: dict[float, PerspectiveFit], g: float, deviation: float, parts: list[slice]
) -> float:
    """Return the relative error of the depths due to that of the focal length.

    The error of 1/f is its deviation. For a given f it is the distance of the minimum
    of E, as far as the deviation of the minimum does not explain it.
    """
    if not deviation:
        place, other = minimum(fits)
        deviation = np.sqrt(np.fmax((place - g) ** 2 - other**2, 0.0))
    first, second = sorted((o for o in fits if o >= 0), key=lambda o: abs(o - g))[:2]
    change = abs(fits[first].change(fits[second], parts))
    return float(change * deviation / abs(second - first))


def _straight(
    rows: NDArray, *frames: NDArray, pinhole: Pinhole | None, model: TableModel | None
) -> NDArray:
    """Return weak-perspective images (n, 2, J) of rows, for the depths of a model.

    Frames are cameras and coefficients. Without a model depths are equal.
    """
    if pinhole is None:
        return rows
    images = pinhole.virtual(rows)
    return images if model is None else pinhole.straight(images, model.depths(*frames))


def _squares(rows: NDArray, *fit: NDArray, model: TableModel) -> NDArray:
    """Return sums (J,) of squared distances, in sizes of frames, and counts."""
    square = model.distances(rows, *model.in_table_cameras(rows, *fit)[:3]) ** 2
    if model.frames.loss != "linear":
        square = robust_square(square, model.frames.noise_variance)
    return np.array([np.nansum(square, axis=0), np.isfinite(square).sum(axis=0)])
