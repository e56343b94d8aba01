"""Figures of a factorisation, drawn with matplotlib."""

from isa_nrsfm.plotting._frame_displays import CoefficientsDisplay, ReprojectionDisplay
from isa_nrsfm.plotting._model_displays import BasisShapeDisplay, ModeCovarianceDisplay

__all__ = [
    "BasisShapeDisplay",
    "CoefficientsDisplay",
    "ModeCovarianceDisplay",
    "ReprojectionDisplay",
]
