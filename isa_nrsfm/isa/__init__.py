"""Independent subspace analysis: estimators that can be used separately."""

from isa_nrsfm.isa._fastisa import FastISA
from isa_nrsfm.isa._pooled_fastica import PooledFastICA
from isa_nrsfm.isa._steps import SqrtDensity

__all__ = ["FastISA", "PooledFastICA", "SqrtDensity"]
