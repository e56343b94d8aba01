"""Other methods of non-rigid structure from motion, to compare with."""

from isa_nrsfm.baselines._compressible import CompressibleNRSfM
from isa_nrsfm.baselines._low_rank import BlockMatrixNRSfM, PseudoInverseNRSfM

__all__ = ["BlockMatrixNRSfM", "CompressibleNRSfM", "PseudoInverseNRSfM"]
