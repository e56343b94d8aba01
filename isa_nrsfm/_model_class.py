"""The check of what is given for a model."""

from isa_nrsfm import AffineNRSfM


def check_class(estimator: object, where: str) -> None:
    """Raise if an object is not the estimator of this package."""
    if not isinstance(estimator, AffineNRSfM):
        raise ValueError(
            f"{where} should be an AffineNRSfM; got {type(estimator).__name__}"
        )
