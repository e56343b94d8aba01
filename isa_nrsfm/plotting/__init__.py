"""Figures of a factorisation, drawn with matplotlib."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.plotting._basis_shapes import BasisShapeDisplay as BasisShapeDisplay
    from isa_nrsfm.plotting._coefficients import (
        CoefficientsDisplay as CoefficientsDisplay,
    )
    from isa_nrsfm.plotting._component_choice import (
        ComponentChoiceDisplay as ComponentChoiceDisplay,
    )
    from isa_nrsfm.plotting._mode_covariance import (
        ModeCovarianceDisplay as ModeCovarianceDisplay,
    )
    from isa_nrsfm.plotting._reprojection import (
        ReprojectionDisplay as ReprojectionDisplay,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.plotting._basis_shapes": ["BasisShapeDisplay"],
            "isa_nrsfm.plotting._coefficients": ["CoefficientsDisplay"],
            "isa_nrsfm.plotting._component_choice": ["ComponentChoiceDisplay"],
            "isa_nrsfm.plotting._mode_covariance": ["ModeCovarianceDisplay"],
            "isa_nrsfm.plotting._reprojection": ["ReprojectionDisplay"],
        },
    )
