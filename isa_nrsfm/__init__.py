"""Non-rigid structure from motion by independent subspace analysis."""

__version__ = "0.1.0"
