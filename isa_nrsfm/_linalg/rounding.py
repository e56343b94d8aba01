"""Limits of rounding errors, in double precision.

Each limit is relative to the numbers that a result was computed from. It exceeds the
unit roundoff 1.1e-16 by the observed loss of its kind of operations. None is critical:
if all are halved, or doubled, ``python -m benchmarks.accuracy tables`` prints the same
digits.
"""

# Sums of squares, and numbers compared with them: a few units of the last place.
OF_SUMS = 1e-15
# Products and decompositions of matrices.
OF_PRODUCTS = 1e-14
# Results of several such steps, as Schur complements and normalised differences.
OF_STEPS = 1e-13
# Remainders of large numbers that cancel.
OF_DIFFERENCES = 1e-12
# Singular values and eigenvalues of directions beyond the rank of a matrix, relative to
# the largest.
OF_RANKS = 1e-10
# Square roots of such remainders, such as distances.
OF_DISTANCES = 1e-9
