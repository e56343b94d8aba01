"""Agreement of the coefficients of fits of different people, and its words."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._frames.camera_models import pose_effect, pose_part
from isa_nrsfm._frames.gauge import independent_gauge
from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._joint.uncertainty import HalfTables

# Least correlation of what counts as the same coefficient, as for the congruence of
# factors: Lorenzo-Seva, ten Berge, "Tucker's congruence coefficient as a meaningful
# index of factor similarity", 2006.
SAME = 0.85
# Largest number of coefficients that are named together.
MOST_TOGETHER = 3


@one_blas_thread
def stability(
    tables: HalfTables, gauge: FrameMap, n_components: int
) -> tuple[NDArray, NDArray]:
    """Return root mean squares (K,) of correlations between halves, and stable sets.

    The set of a coefficient, a row of a mask (K, K), has the fewest coefficients, it
    first, of which a combination is the same as it in another half.
    """

    def scores(gauge: FrameMap) -> NDArray:
        """Return coefficients (I, K) with mean zero and norm one; zero if constant."""
        cameras, alpha, _ = gauge.apply(tables.motion, tables.alpha, None)
        alpha = alpha[:, :n_components]
        if tables.kind[-1]:
            alpha = alpha - pose_part(cameras, pose_effect(cameras, alpha))
        alpha = alpha - alpha.mean(axis=0)
        size = np.linalg.norm(alpha, axis=0)
        return np.asarray(alpha / np.where(size > 0, size, 1.0))

    whole, found = scores(gauge), list[NDArray]()
    for shapes, half in zip(tables.shapes, tables.halves, strict=True):
        motion, alpha = tables.motion[half], tables.alpha[half]
        own_scores = scores(independent_gauge(shapes, motion, alpha, *tables.kind)[2])
        found.append(
            own_scores[:, linear_sum_assignment(-np.abs(whole.T @ own_scores))[1]]
        )
    every, n, K = np.hstack(found), len(found), n_components
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
