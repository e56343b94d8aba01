"""Measures of a factorisation, invariant to the ambiguities of images."""

from isa_nrsfm.metrics._measures import (
    affine_shape_error,
    basis_similarity,
    inverse_snr,
    mean_shape_error_3d,
    subspace_distance,
)

__all__ = [
    "affine_shape_error",
    "basis_similarity",
    "inverse_snr",
    "mean_shape_error_3d",
    "subspace_distance",
]
