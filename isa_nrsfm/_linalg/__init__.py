"""Small matrices and vectors, many at a time."""
