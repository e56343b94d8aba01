"""Non-rigid structure from motion by independent subspace analysis."""

from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._selection.estimator import AffineNRSfMCV
from isa_nrsfm._transformer import Decomposition
from isa_nrsfm.isa import FastISA, PooledFastICA

__version__ = "0.1.0"

__all__ = [
    "AffineNRSfM",
    "AffineNRSfMCV",
    "Decomposition",
    "FastISA",
    "PooledFastICA",
    "__version__",
]
