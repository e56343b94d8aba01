"""The search for the most probable camera and coefficients of one complete frame.

The algebra of `newton` with LAPACK. The search for many
frames takes as long for one frame as for sixteen: 4 to 7 times as long as this one.
Frames that are not regular are left to it.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.newton import LARGE_RISE, REVERSED, SAME_WELL, calibrated_starts
from isa_nrsfm._frames.search import (
    LARGEST_DAMPING,
    MAX_STEPS,
    FramePosterior,
    FrameSearch,
    largest_objective,
)

# Rotations of affine cameras
UNKNOWN = np.full((3, 3), np.nan)


class _Camera:
    """A calibrated camera M (2, 3), its objective, and the coefficients' posterior."""

    def __init__(self, search: "SingleSearch", M: NDArray, frame: "_Frame"):
        P, energy, noise = frame
        H = (search.pairs @ (M.T @ M).ravel()).reshape(search.K + 1, -1)
        seen = P.reshape(-1, 6) @ M.ravel()
        damped = H[1:, 1:].copy()
        damped.flat[:: search.K + 1] += noise
        self.M, self.Q, right = M, np.linalg.inv(damped), seen[1:] - H[1:, 0]
        self.alpha = self.Q @ right
        self.log_determinant = np.linalg.slogdet(damped)[1] - search.K * np.log(noise)
        square = energy - 2.0 * seen[0] + H[0, 0] - right @ self.alpha
        self.value = square + noise * self.log_determinant


# ``P_k^T`` (K + 1, 2, 3) of `newton`, energy and noise variance
_Frame = tuple[NDArray, float, float]
_Moments = tuple[NDArray, NDArray, NDArray]
# Camera (2, 3), alpha (K,), covariances of alpha and rotation, objective
_Fit = tuple[NDArray, NDArray, NDArray, NDArray, float]


class SingleSearch:
    """The search for one frame, of the shapes of a search for many."""

    def __init__(self, search: FrameSearch):
        shapes = search.shared.shapes
        n_shapes, _, n_points = shapes.shape
        self.model, self.space, self.K = search.model, search.space, n_shapes - 1
        self.rows = shapes.reshape(-1, n_points)
        gram = np.einsum("kaj,lbj->klab", shapes, shapes, optimize=True)
        gram = 0.5 * (gram + gram.swapaxes(2, 3))
        self.pairs = gram.reshape(-1, 9)
        # 2 G_kl (9 n_shapes, n_shapes): rows (k, a, b), columns l
        self.sums = 2.0 * gram.transpose(0, 2, 3, 1).reshape(-1, n_shapes)

    def fit(self, points: NDArray, noise: float) -> FramePosterior | None:
        """Fit a frame (2, J); None if it is not complete and regular.

        Objectives are ``||W - M S(a)||^2 + noise |a|^2``.
        """
        points = points.astype(np.float64, copy=False)
        centre = points.mean(axis=1)
        if not np.isfinite(centre).all():
            return None
        largest = largest_objective(points.shape[1], noise)
        W = points - centre[:, None]
        energy = float(np.vdot(W, W))
        P = (self.rows @ W.T).reshape(-1, 3, 2).swapaxes(1, 2)
        noise = max(noise, 1e-13 * energy)
        search = self._calibrated if self.model.calibrated else self._affine
        try:
            with np.errstate(all="ignore"):
                fit = search((P, energy, noise))
        except np.linalg.LinAlgError:
            return None
        if fit is None or not fit[-1] <= largest:
            return None
        M, alpha, covariance, turns, objective = fit
        motion, turns = M @ self.space, self.space.T @ turns @ self.space
        parts = motion, centre, alpha, covariance, turns, objective, True
        return FramePosterior(*(np.array(part)[None] for part in parts))

    def _affine(self, frame: _Frame) -> _Fit | None:
        """Minimise over the coefficients, with the best camera for them."""
        P, energy, noise = frame
        K, alpha, before, ended = self.K, np.zeros(self.K), np.inf, False
        tol = 1e-12 * (energy + noise)
        for n_steps in range(MAX_STEPS):
            c = np.append(1.0, alpha)
            T = (self.sums @ c).reshape(-1, 3, 3)
            inverse = np.linalg.inv(0.5 * _sum(c, T))
            Y = _sum(c, P)
            M = Y @ inverse
            Q = (M.T @ M).ravel()
            held = (self.pairs @ Q).reshape(K + 1, K + 1)[1:, 1:].copy()
            held.flat[:: K + 1] += noise
            slope = P[1:].reshape(K, 6) @ M.ravel() - noise * alpha
            slope -= 0.5 * (T[1:].reshape(K, 9) @ Q)
            if n_steps == 0:
                alpha = np.linalg.solve(held, slope)
                continue
            F = M @ T[1:] - P[1:]
            hessian = held - (F @ inverse).reshape(K, 6) @ F.reshape(K, 6).T
            np.linalg.cholesky(hessian)  # raises an error unless it is definite
            value = energy - np.vdot(M, Y) + noise * (alpha @ alpha)
            if ended:
                covariance = noise * np.linalg.inv(hessian)
                return M, alpha, covariance, UNKNOWN, max(value, 0.0)
            if not value <= before + tol:
                return None
            step = np.linalg.solve(hessian, slope)
            before, alpha, ended = value, alpha + step, slope @ step <= tol
        return None

    def _calibrated(self, frame: _Frame) -> _Fit | None:
        """Minimise over cameras, with the coefficients integrated out."""
        P, energy, noise = frame
        affine = P[0] @ np.linalg.inv(0.5 * self.sums[:9, 0].reshape(3, 3))
        starts = calibrated_starts(self.model, affine[..., None])
        cameras = [_Camera(self, M[..., 0], frame) for M in starts]
        start = min(cameras, key=lambda camera: camera.value)
        minimum = self._minimum(start, frame)
        if minimum is None:
            return None
        moments = self._moments(minimum, P, noise)
        if not self._rise(minimum, moments) > LARGE_RISE * minimum.value:
            # A lower minimum from the reversed camera is left to the other search.
            other = _Camera(self, minimum.M * REVERSED.T, frame)
            limit = minimum.value - 1e-10 * (energy + noise)
            if self._minimum(other, frame, minimum, limit) is not None:
                return None
        _, hessian, _, through = self._derivatives(minimum, P, moments)
        turns = np.linalg.inv(hessian)
        covariance = noise * (minimum.Q + through @ turns @ through.T)
        objective = max(minimum.value - noise * minimum.log_determinant, 0.0)
        turns = noise * turns[:3, :3]
        return minimum.M, minimum.alpha, covariance, turns, objective

    def _derivatives(
        self, camera: _Camera, P: NDArray, moments: _Moments
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return gradient, Hessian, its definite part, and Q times the coupling."""
        M, n, (c, A, F) = camera.M, self.model.n_parameters, moments
        G = M @ A - _sum(c, P)
        D = self.model.tangents(M)
        flat = D.reshape(n, 6)
        gradient, definite = flat @ G.ravel(), (D @ A).reshape(n, 6) @ flat.T
        mixed = G.T @ M
        bent = np.empty((n, n))
        bent[3:], bent[:, 3:] = gradient, gradient[:, None]
        bent[:3, :3] = 0.5 * (mixed + mixed.T) - np.trace(mixed) * np.eye(3)
        coupling = F @ flat.T
        through = camera.Q @ coupling
        return gradient, definite + bent - coupling.T @ through, definite, through

    def _moments(self, camera: _Camera, P: NDArray, noise: float) -> _Moments:
        """Return ``c = (1, alpha)``, A (3, 3) and F (K, 6) of `newton`."""
        c = np.append(1.0, camera.alpha)
        E = np.outer(c, c)
        E[1:, 1:] += noise * camera.Q
        T = (self.sums @ c).reshape(-1, 3, 3)
        F = (camera.M @ T[1:] - P[1:]).reshape(-1, 6)
        return c, (E.ravel() @ self.pairs).reshape(3, 3), F

    def _rise(self, camera: _Camera, moments: _Moments) -> float:
        """Return the least rise of the objective on the way to the reversed camera."""
        _, A, F = moments
        Y = -F.T @ camera.Q @ F
        Y[:3, :3] += A
        Y[3:, 3:] += A
        z = (camera.M * (REVERSED.T < 0)).ravel()
        size = np.linalg.norm(z)
        if size == 0 or np.linalg.eigvalsh(Y)[0] <= 0:
            return 0.0
        return float(size**2 / ((z / size) @ np.linalg.solve(Y, z / size)))

    def _minimum(
        self,
        camera: _Camera,
        frame: _Frame,
        known: _Camera | None = None,
        limit: float = np.inf,
    ) -> _Camera | None:
        """Return a minimum; None if not found, or if it will not be below the limit."""
        P, energy, noise = frame
        tol, damping = 1e-12 * (energy + noise), 0.0
        radius = SAME_WELL * np.linalg.norm(camera.M - known.M) if known else 0.0
        for _ in range(MAX_STEPS):
            moments = self._moments(camera, P, noise)
            gradient, hessian, definite, _ = self._derivatives(camera, P, moments)
            while np.linalg.eigvalsh(hessian + damping * definite)[0] <= 0:
                damping = max(8.0 * damping, 0.1)
                if damping > LARGEST_DAMPING:
                    return None
            step = -np.linalg.solve(hessian + damping * definite, gradient)
            gain = -gradient @ step
            if known is not None and (
                camera.value - 10.0 * gain > limit
                or np.linalg.norm(camera.M - known.M) < radius
            ):
                return None
            M = self.model.moved(camera.M, self.model.limited(step))
            moved = _Camera(self, M, frame)
            if damping == 0 and gain <= tol:
                return moved if moved.value < limit else None
            if moved.value <= camera.value + tol:
                camera, damping = moved, 0.1 * damping if damping > 0.01 else 0.0
            else:
                damping = max(8.0 * damping, 0.1)
        return None


def _sum(c: NDArray, matrices: NDArray) -> NDArray:
    """Return ``sum_k c_k A_k`` of matrices (k, m, n), faster than `np.tensordot`."""
    return np.asarray(c @ matrices.reshape(len(c), -1)).reshape(matrices.shape[1:])
