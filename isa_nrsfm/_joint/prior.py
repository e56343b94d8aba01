"""A fitted model as the prior of the shapes of another table.

The public shapes, mean shape and basis, are N times the shapes B (K + 1, 3, J) of a
fit. The basis is that of the model. The mean shape of the table, B_0, differs by ``E =
B_0 - A_0`` from that of the model, and -2 log L has the additional term
``||E||^2 / tau^2``.

Cameras have rotation and scale. So A_0 is the similarity of B_0 that lies nearest:
neither E nor its prior contain a rotation or scale of A_0. For vectors w this is ::

    <E, w x A_0> = 0,   <E, A_0> = 0,

linear equations that are exact for changes of any size: ``A_0 B_0^T`` is symmetric.
Otherwise the mean shape of a table of few views turns, and shrinks, as if all people
deformed more than those of the model. Orthographic cameras have no scales: E may have
one.

The width tau follows from the table (MacKay, "Bayesian interpolation", 1992): with the
posterior covariance of E, the coefficients' moments held fixed, and the number n of
coordinates that E is free to change, ::

    g = n - tr(cov E) / tau^2,   tau^2 <- ||E||^2 / g.

Rotation, mirror image, scale and mixing of the shapes are those of the model.

E alone hardly changes the depths as a whole: objects may be flatter or deeper than
those of the model. So A_0, the basis and the prior of E are stretched by a factor along
the mean line of sight. Its logarithm is normal, with the deviation `DEPTH_SPREAD`.
Objects that turn determine it. To first order in the rotations it has no effect.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import stacked_motion
from isa_nrsfm._frames.models import FrameMap, FrameModel
from isa_nrsfm._linalg import OF_DISTANCES, centred

# All of these: docs/benchmarks/README.md, "Thresholds".
# Width of the first fit, in sizes of frames.
FIRST_WIDTH = 0.05
# Relative change of the width below which it is settled.
SETTLED_WIDTH = 0.02
# Standard deviation of the logarithm of the depths of objects over those of a prior.
DEPTH_SPREAD = 0.15
# Factor of the depths of compared fits: with three points, the first one in the middle,
# Gauss-Hermite quadrature has this distance and the weights 4, 1 and 1.
STEP = float(np.exp(np.sqrt(3.0) * DEPTH_SPREAD))
# Floor of the noise variance, as a share of the mean square; share of the tolerance.
LEAST_NOISE, TOL_SHARE = 5e-4, 0.1


class ShapePrior(NamedTuple):
    """A normal prior of the mean shape, with a fixed basis.

    shapes (K + 1, 3, J): A. gauge: maps frames to the public shapes. scaled: whether
    cameras have scales. depth_error: variance of the depths of each public shape of the
    model. width: tau. n_determined: number of coordinates of the mean shape that the
    table determines. stretch (3, 3): of the shapes of the model.
    """

    shapes: NDArray
    gauge: FrameMap
    scaled: bool
    depth_error: float
    width: float = FIRST_WIDTH
    n_determined: float = 0.0
    stretch: NDArray = np.eye(3)

    @classmethod
    def of_model(
        cls, frames: FrameModel, scale: float, gauge: FrameMap, scaled: bool
    ) -> "ShapePrior":
        """Return the prior with a model's shapes times a scale, for a gauge."""
        certainty = frames.certainty
        error = 0.0 if certainty.points is None else np.mean(certainty.points)
        error *= scale**2 / (certainty.leverage or len(frames.shapes))
        return cls(scale * frames.shapes, gauge, scaled, float(error))

    @property
    def changes(self) -> NDArray:
        """Changes (K + 1,) of the shapes for one of the public mean shape."""
        return self.gauge.mixing[0]

    @property
    def along(self) -> NDArray:
        """The changes for each axis, (3 (K + 1), 3)."""
        return np.kron(self.changes[:, None], np.eye(3))

    @property
    def variance(self) -> NDArray:
        """Prior covariance (3, 3) of a point of the public mean shape."""
        return max(self.width, OF_DISTANCES) ** 2 * self.stretch @ self.stretch.T

    def stretched(self, stretch: NDArray) -> "ShapePrior":
        """Return the prior of objects that are stretched by a symmetric matrix."""
        shapes = stretch @ self.shapes
        return self._replace(shapes=shapes, stretch=stretch @ self.stretch)

    @property
    def cost(self) -> float:
        """Minus twice the log prior density of the depths of the objects."""
        return float((np.linalg.slogdet(self.stretch)[1] / DEPTH_SPREAD) ** 2)

    @property
    def distance(self) -> float:
        """RMS distance of a coordinate of the mean shape from that of the model."""
        A = self.mean_shape(np.linalg.solve(self.stretch, self.shapes))
        square = np.mean((self.mean_shape(self.shapes) - A) ** 2)
        return float(np.hypot(self.width, np.sqrt(square)))

    def of_points(self, kept: NDArray) -> "ShapePrior":
        """Return the prior of some of the points."""
        return self._replace(shapes=centred(self.shapes[:, :, kept]))

    def mean_shape(self, shapes: NDArray) -> NDArray:
        """Return the public mean shape (3, J), in the axes of the frames."""
        return np.tensordot(np.linalg.pinv(self.gauge.mixing.T)[0], shapes, 1)

    def similarities(self) -> NDArray:
        """Return orthonormal changes (3 or 4, 3, J) that E does not contain."""
        A = self.mean_shape(self.shapes)
        turned = np.cross(np.eye(3)[:, None], A.T).mT
        changes = np.concatenate([turned, A[None]]) if self.scaled else turned
        axes = np.linalg.svd(changes.reshape(len(changes), -1), full_matrices=False)[2]
        return axes.reshape(changes.shape)

    def projected(self, steps: NDArray) -> NDArray:
        """Return steps (K + 1, 3, J) of the shapes without similarities of A_0."""
        axes = self.similarities()
        components = np.tensordot(axes, np.tensordot(self.changes, steps, 1), 2)
        change = np.tensordot(components, axes, 1) / np.vdot(self.changes, self.changes)
        return steps - np.multiply.outer(self.changes, change)

    def term(self, shapes: NDArray) -> tuple[float, NDArray]:
        """Return the term of -2 log L, and its derivative by the shapes."""
        E = self.mean_shape(shapes - self.shapes)
        row = np.linalg.pinv(self.gauge.mixing.T)[0]
        weighed = np.linalg.solve(self.variance, E)
        return float(np.vdot(E, weighed)), 2.0 * np.multiply.outer(row, weighed)

    def covariance(self, curvature: NDArray, noise: float) -> NDArray:
        """Return covariances of E (m, 3, 3) of points, for curvatures without prior."""
        along = self.along
        precision = along.T @ curvature @ along / noise
        return np.linalg.inv(precision + np.linalg.inv(self.variance))

    def inverse(self, curvature: NDArray, noise: float) -> NDArray:
        """Return inverses of curvatures (m, 3 (K + 1), 3 (K + 1)) with the prior."""
        along = self.along
        return along @ self.covariance(curvature, noise) @ along.T / noise

    def updated(
        self, shapes: NDArray, curvature: NDArray, noise: float
    ) -> "ShapePrior":
        """Return the prior with the width that follows from a fit."""
        E, axes = self.mean_shape(shapes - self.shapes), self.similarities()
        unit = np.linalg.inv(self.variance)
        C = self.covariance(curvature, noise)
        C = np.broadcast_to(unit @ C, (E.shape[1], 3, 3))
        trace = np.einsum("jaa->", C) - np.einsum("naj,jab,nbj->", axes, C, axes)
        n_determined = max(E.size - len(axes) - trace, 1e-9 * E.size)
        width = self.width * float(np.sqrt(np.vdot(E, unit @ E) / n_determined))
        return self._replace(width=width, n_determined=float(n_determined))

    def depth_errors(
        self, information: NDArray, noise: float, sight: NDArray, alpha: NDArray
    ) -> NDArray:
        """Return error variances (I,) of depths of frames of size one.

        Information (3 (K + 1), 3 (K + 1)) of a point of the shapes, for noise of
        variance one; public lines of sight (I, 3), times the scales, and coefficients.
        Depths of the model have errors, which the basis keeps.
        """
        variances = np.full((len(self.shapes), 3), OF_DISTANCES**2)
        variances[0] += max(self.width, OF_DISTANCES) ** 2
        variances[:, 2] += self.depth_error
        along = np.kron(self.gauge.mixing.T, self.gauge.rotation.T)
        precision = along.T @ information @ along / noise
        precision[3:] = precision[:, 3:] = 0.0
        covariance = np.linalg.inv(precision + np.diag(1.0 / variances.ravel()))
        size = np.cbrt(abs(np.linalg.det(self.gauge.space)))
        X = size * stacked_motion(sight[:, None], alpha)
        return np.vecdot(X @ covariance, X)
