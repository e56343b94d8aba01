"""Coefficients of frames in order of time."""
