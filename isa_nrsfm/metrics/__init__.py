"""Measures of a factorisation, invariant to the ambiguities of images."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.metrics._affine_shapes import (
        affine_shape_error as affine_shape_error,
        basis_similarity as basis_similarity,
    )
    from isa_nrsfm.metrics._euclidean_shapes import (
        mean_shape_error_3d as mean_shape_error_3d,
    )
    from isa_nrsfm.metrics._reprojection import inverse_snr as inverse_snr
    from isa_nrsfm.metrics._subspaces import subspace_distance as subspace_distance
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.metrics._affine_shapes": [
                "affine_shape_error",
                "basis_similarity",
            ],
            "isa_nrsfm.metrics._euclidean_shapes": ["mean_shape_error_3d"],
            "isa_nrsfm.metrics._reprojection": ["inverse_snr"],
            "isa_nrsfm.metrics._subspaces": ["subspace_distance"],
        },
    )
