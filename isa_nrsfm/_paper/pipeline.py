"""The paper's pipeline: independent subspaces, block structure, refinement.

Brandt, Ackermann, Grasshof, "Uncalibrated Non-Rigid Factorisation by Independent
Subspace Analysis" (2018).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.validation import has_fit_parameter

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._paper.alternating import refine_alternating
from isa_nrsfm._paper.block_structure import (
    leading_blocks,
    lifted_moments,
    motion_products,
    recover_blocks,
    structure_energies,
)
from isa_nrsfm._paper.factors import Factorisation


class PaperResult(NamedTuple):
    """Result of the paper's pipeline, before a gauge is chosen.

    shapes (K + 1, 3, J): B_0 of the rigid factorisation, and ``B_k = E_k B_ISA,k``;
    zero for subspaces without motion. mode_covariance (3K, 3K): ``(J / 2I) M_ISA^T
    M_ISA``, in the order of the basis. n_iter: steps of the refinement, 1 without a
    refinement.
    """

    shapes: NDArray
    mode_covariance: NDArray
    n_iter: int
    converged: bool


def run_paper_pipeline(
    factors: Factorisation,
    n_components: int,
    isa: Any,
    *,
    block_recovery: str,
    max_iter: int,
    tol: float,
    report: Callable[[str], None],
) -> PaperResult:
    """Fit the strategy `isa`, recover blocks and refine them unless max_iter is 0."""
    n_rows, n_points = len(factors.motion), factors.signals.shape[1]
    products = motion_products(factors.rigid_motion, factors.motion)
    moments = lifted_moments(products)
    covariance = products.gram * (n_points / n_rows)
    components = _independent_subspaces(isa, factors.signals, covariance, moments)
    report("independent subspaces")

    # Block structure. E_k is the inverse of D_k.
    products = products.rotated(components)
    E = np.linalg.pinv(recover_blocks(products, block_recovery), rcond=OF_RANKS)
    n_iter, converged = 1, True
    if max_iter:
        lifted = leading_blocks(moments, components.reshape(len(E), 3, -1))
        plain = np.broadcast_to(np.eye(3), (len(E), 1, 3, 3))
        starts = np.concatenate([E[:, None], lifted, plain], axis=1)
        E, _, n_iter, converged = refine_alternating(
            products, starts, max_iter=max_iter, tol=tol
        )
    report("block structure and refinement")

    # Shapes. Subspaces beyond the rank of W stay zero.
    shapes = np.zeros((n_components + 1, 3, n_points))
    shapes[0] = factors.rigid_shape
    shapes[1 : len(E) + 1] = E @ (components @ factors.signals).reshape(len(E), 3, -1)
    covariance = np.zeros((3 * n_components, 3 * n_components))
    covariance[: 3 * len(E), : 3 * len(E)] = products.gram * (n_points / n_rows)
    return PaperResult(shapes, covariance, n_iter, converged)


def _independent_subspaces(
    isa: Any, signals: NDArray, covariance: NDArray, moments: NDArray
) -> NDArray:
    """Fit a strategy to signals (n_signals, n_points) and return its unmixing matrix.

    If its `fit` has a parameter `covariance`, this is ``C = (J / 2I) M'^T M'``, the
    covariance over the images (Brandt et al. 2018, section 3.3). No mean is subtracted,
    as it would depend on the rotation of single images. A parameter `criterion` is
    `structure_energies`.
    """
    fit_params: dict[str, Any] = {}
    if has_fit_parameter(isa, "covariance"):
        fit_params["covariance"] = covariance
    if has_fit_parameter(isa, "criterion"):
        fit_params["criterion"] = partial(structure_energies, moments)
    # Fixed-point iterations from random starts magnify rounding errors, so that another
    # order of frames or points could lead to another optimum. Five decimals are far
    # coarser than rounding errors, and far finer than the errors of the signals.
    samples = np.round(signals, 5).T
    isa.fit(samples[np.lexsort(samples.T)], **fit_params)
    n_signals = len(signals)
    if isa.components_.shape != (n_signals, n_signals):
        raise ValueError(
            f"isa must give components_ of shape {(n_signals, n_signals)}; "
            f"got {isa.components_.shape}"
        )
    # The nearest orthogonal matrix: the signals are white, up to rounding.
    U, _, Vt = np.linalg.svd(isa.components_)
    return U @ Vt
