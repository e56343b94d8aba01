"""Figures of a factorisation, drawn with matplotlib."""

from isa_nrsfm.plotting._basis_shapes import BasisShapeDisplay
from isa_nrsfm.plotting._coefficients import CoefficientsDisplay
from isa_nrsfm.plotting._mode_covariance import ModeCovarianceDisplay
from isa_nrsfm.plotting._reprojection import ReprojectionDisplay

__all__ = [
    "BasisShapeDisplay",
    "CoefficientsDisplay",
    "ModeCovarianceDisplay",
    "ReprojectionDisplay",
]
