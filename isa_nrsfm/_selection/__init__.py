"""Choice of the number of basis shapes: a path over K, and what is chosen on it."""
