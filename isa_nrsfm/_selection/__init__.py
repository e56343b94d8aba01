"""Choice of the number of basis shapes: a path over K, and the selection on it."""
