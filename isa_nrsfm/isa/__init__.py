"""Independent subspace analysis: estimators that can be used separately."""

from isa_nrsfm.isa._strategies import FastISA, PooledFastICA

__all__ = ["FastISA", "PooledFastICA"]
