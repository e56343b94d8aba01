"""The parts of fits of frames, by their names."""

from isa_nrsfm._frames.models import frame_search

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
    )


def fit_posterior(tracks, shapes, noise, camera="affine", **given):
    """Return the fit of frames by a new search."""
    return frame_search(camera, shapes).fit_tracks(tracks, noise, **given)
