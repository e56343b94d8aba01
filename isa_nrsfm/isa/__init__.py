"""Independent subspace analysis: strategies that can be used on their own."""

from isa_nrsfm.isa._density import SqrtDensity
from isa_nrsfm.isa._fastisa import FastISA
from isa_nrsfm.isa._pooled_fastica import PooledFastICA

__all__ = ["FastISA", "PooledFastICA", "SqrtDensity"]
