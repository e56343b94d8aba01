"""The texts that parameters of `AffineNRSfM` may be, each default first.

The command line offers them in its help, which must not wait for NumPy or scikit-learn:
this module imports nothing.
"""

BLOCK_RECOVERIES = ("generalized_eigen", "eigen", "irls")
REFINEMENTS = ("joint", "alternating")
CAMERA_NAMES = ("affine", "weak_perspective", "orthographic")
INDEPENDENCE = ("shapes", "coefficients")
LOSSES = ("linear", "huber", "cauchy")
