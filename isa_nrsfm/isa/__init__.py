"""Independent subspace analysis: strategies that can be used on their own."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__all__ = ["FastISA", "PooledFastICA", "SqrtDensity"]

if TYPE_CHECKING:
    from isa_nrsfm.isa._density import SqrtDensity
    from isa_nrsfm.isa._fastisa import FastISA
    from isa_nrsfm.isa._pooled_fastica import PooledFastICA
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.isa._density": ["SqrtDensity"],
            "isa_nrsfm.isa._fastisa": ["FastISA"],
            "isa_nrsfm.isa._pooled_fastica": ["PooledFastICA"],
        },
    )
