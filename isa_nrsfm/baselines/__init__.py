"""Other methods of non-rigid structure from motion, to compare with."""

from isa_nrsfm.baselines._block_matrix import BlockMatrixNRSfM
from isa_nrsfm.baselines._compressible import CompressibleNRSfM
from isa_nrsfm.baselines._pseudo_inverse import PseudoInverseNRSfM

__all__ = ["BlockMatrixNRSfM", "CompressibleNRSfM", "PseudoInverseNRSfM"]
