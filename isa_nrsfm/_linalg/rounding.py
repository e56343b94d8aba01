"""Limits of rounding errors, in double precision.

Each is a share of the numbers that a result was computed from, above the unit roundoff
1.1e-16 by the observed loss of its kind of operations. None is critical: with all of
them halved, or doubled, ``python -m benchmarks.accuracy tables`` prints the same
digits.
"""

# Sums of squares, and what is compared with them: a few units of the last place.
OF_SUMS = 1e-15
# Products and decompositions of matrices.
OF_PRODUCTS = 1e-14
# Results of several such steps, as Schur complements and normalised differences.
OF_STEPS = 1e-13
# What is left where large numbers cancel.
OF_DIFFERENCES = 1e-12
# Singular values, and eigenvalues, of directions that a matrix does not have, relative
# to the largest.
OF_RANKS = 1e-10
# Square roots of what is left, as distances are.
OF_DISTANCES = 1e-9
