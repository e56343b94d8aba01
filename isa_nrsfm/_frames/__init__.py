"""Camera, position and coefficients of single frames, for given shapes."""
