"""The parts of fits of frames, by their names."""

# What a fitted model has of each frame.
ATTRIBUTES_OF_FRAMES = ("motion_", "translation_", "alpha_", "alpha_std_")


def camera_and_alpha(fits):
    """Return motion, translation and coefficients."""
    return fits.motion, fits.translation, fits.alpha


def numbers_of(fits):
    """Return all that is a number for each frame."""
    return (
        *camera_and_alpha(fits),
        fits.covariance,
        fits.objective,
        fits.residual,
    )
