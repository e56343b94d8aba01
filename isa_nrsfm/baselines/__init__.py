"""Other methods of non-rigid structure from motion, to compare with."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.baselines._block_matrix import BlockMatrixNRSfM as BlockMatrixNRSfM
    from isa_nrsfm.baselines._compressible import CompressibleNRSfM as CompressibleNRSfM
    from isa_nrsfm.baselines._pseudo_inverse import (
        PseudoInverseNRSfM as PseudoInverseNRSfM,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.baselines._block_matrix": ["BlockMatrixNRSfM"],
            "isa_nrsfm.baselines._compressible": ["CompressibleNRSfM"],
            "isa_nrsfm.baselines._pseudo_inverse": ["PseudoInverseNRSfM"],
        },
    )
