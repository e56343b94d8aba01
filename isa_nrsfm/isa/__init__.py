"""Independent subspace analysis: strategies that can be used on their own."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.isa._density import SqrtDensity as SqrtDensity
    from isa_nrsfm.isa._fastisa import FastISA as FastISA
    from isa_nrsfm.isa._pooled_fastica import PooledFastICA as PooledFastICA
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.isa._density": ["SqrtDensity"],
            "isa_nrsfm.isa._fastisa": ["FastISA"],
            "isa_nrsfm.isa._pooled_fastica": ["PooledFastICA"],
        },
    )
