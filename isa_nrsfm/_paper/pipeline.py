"""The paper's pipeline: from a factorisation to basis shapes.

Brandt, Ackermann, Grasshof, "Uncalibrated Non-Rigid Factorisation by Independent
Subspace Analysis" (2018): independent subspaces, block structure, refinement, each in
a module of its own.
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
    MotionProducts,
    leading_blocks,
    lifted_moments,
    motion_products,
    recover_blocks,
    structure_energies,
)
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._paper.options import PAPER_OPTIONS, PaperOptions


class PaperResult(NamedTuple):
    """
    What the paper's pipeline finds, before a gauge is chosen.

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0 of the rigid factorisation.
    basis : ndarray of shape (n_components, n_points, 3)
        ``B_k = E_k B_ISA,k``; zero for subspaces without motion.
    mode_covariance : ndarray of shape (3 * n_components, 3 * n_components)
        ``(J / 2I) M_ISA^T M_ISA``, in the order of the basis.
    n_iter : int
        Steps of the refinement, 1 without a refinement.
    converged : bool
        Whether it has converged.
    """

    mean_shape: NDArray
    basis: NDArray
    mode_covariance: NDArray
    n_iter: int
    converged: bool


def run_paper_pipeline(
    factors: Factorisation,
    n_components: int,
    isa: Any,
    *,
    block_recovery: str,
    refinement: str | None,
    max_iter: int,
    tol: float,
    report: Callable[[str], None],
    options: PaperOptions = PAPER_OPTIONS,
) -> PaperResult:
    """
    Run the stages of the paper after the factorisation.

    Parameters
    ----------
    factors : Factorisation
        Of the measurement matrix.
    n_components : int
        K.
    isa : object
        Strategy of independent subspace analysis; it is fitted here.
    block_recovery : str
        Method of `recover_blocks`.
    refinement : {"alternating", None}
        Whether the blocks are refined.
    max_iter : int
        The most steps of the refinement.
    tol : float
        Tolerance of the refinement.
    report : callable
        Called with the name of each stage that has ended.
    options : PaperOptions
        What steers the stages.

    Returns
    -------
    PaperResult
        Shapes before a gauge is chosen.
    """
    n_rows, n_points = len(factors.motion), factors.signals.shape[1]
    products = motion_products(factors.rigid_motion, factors.motion)
    moments = lifted_moments(products, options.lift_ridge)
    components = _independent_subspaces(
        isa,
        np.round(factors.signals, options.signal_decimals),
        products,
        moments,
        n_points / n_rows,
    )
    report("independent subspaces")

    # Block structure. E_k is the inverse of D_k.
    products = products.rotated(components)
    E = np.linalg.pinv(recover_blocks(products, block_recovery), rcond=OF_RANKS)
    n_iter, converged = 1, True
    if refinement == "alternating":
        subspaces = components.reshape(len(E), 3, -1)
        lifted = leading_blocks(moments, subspaces, options.n_lifted_starts)
        plain = np.broadcast_to(np.eye(3), (len(E), 1, 3, 3))
        starts = np.concatenate([E[:, None], lifted, plain], axis=1)
        E, _, n_iter, converged = refine_alternating(
            products, starts, max_iter=max_iter, tol=tol, options=options
        )
    report("block structure and refinement")

    # Shapes. Subspaces that W has no rank for stay zero.
    basis = np.zeros((n_components, 3, n_points))
    basis[: len(E)] = E @ (components @ factors.signals).reshape(-1, 3, n_points)
    used = 3 * len(E)
    covariance = np.zeros((3 * n_components, 3 * n_components))
    covariance[:used, :used] = products.gram * (n_points / n_rows)
    return PaperResult(
        factors.rigid_shape.T,
        basis.transpose(0, 2, 1),
        covariance,
        n_iter,
        converged,
    )


def _independent_subspaces(
    isa: Any,
    signals: NDArray,
    products: MotionProducts,
    moments: NDArray,
    scale: float,
) -> NDArray:
    """
    Fit a strategy to the signals and return its orthogonal unmixing matrix.

    If `fit` of the strategy has a parameter `covariance`, it gets the covariance over
    the images, ``C = (J / 2I) M'^T M'`` (Brandt et al. 2018, section 3.3). Their mean
    term is left out: it would depend on the rotation of single images. If it has a
    parameter `criterion`, it gets the function `structure_energies`, which values
    candidates for subspaces by their block structure.

    Signals are (n_signals, n_points), moments as of `lifted_moments`, `scale` is J /
    2I.
    """
    fit_params: dict[str, Any] = {}
    if has_fit_parameter(isa, "covariance"):
        fit_params["covariance"] = products.gram * scale
    if has_fit_parameter(isa, "criterion"):
        fit_params["criterion"] = partial(structure_energies, moments)
    samples = signals.T
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
