"""Independent subspace analysis: estimators that can be used separately."""

from isa_nrsfm.isa._base import SqrtDensity
from isa_nrsfm.isa._fastisa import FastISA
from isa_nrsfm.isa._pooled_fastica import PooledFastICA

__all__ = ["FastISA", "PooledFastICA", "SqrtDensity"]
