"""The coordinates in which shapes and coefficients are given."""
