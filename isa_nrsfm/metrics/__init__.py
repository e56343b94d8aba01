"""Measures of a factorisation, invariant to the ambiguities of images."""

from isa_nrsfm.metrics._reprojection import inverse_snr
from isa_nrsfm.metrics._shapes import (
    affine_shape_error,
    basis_similarity,
    mean_shape_error_3d,
)
from isa_nrsfm.metrics._subspaces import subspace_distance

__all__ = [
    "affine_shape_error",
    "basis_similarity",
    "inverse_snr",
    "mean_shape_error_3d",
    "subspace_distance",
]
