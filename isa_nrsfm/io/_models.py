"""Save and load fitted models without pickle."""

import os
from pathlib import Path

from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.callbacks import without_callbacks
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._estimator import AffineNRSfM, check_class

#: The types beside those that skops trusts by itself that a model file may contain.
TRUSTED_TYPES = (
    "isa_nrsfm._estimator.AffineNRSfM",
    "isa_nrsfm._frames.models.PosteriorFrames",
    "isa_nrsfm._frames.models.RigidFrames",
    "isa_nrsfm._frames.basis_change.FrameMap",
    "isa_nrsfm.isa._density.SqrtDensity",
    "isa_nrsfm.isa._fastisa.FastISA",
    "isa_nrsfm.isa._pooled_fastica.PooledFastICA",
)


def save_model(estimator: AffineNRSfM, path: str | os.PathLike[str]) -> None:
    """
    Save a fitted model to a file that is safe to share.

    The file is written by skops: it holds numbers, text and names of classes, but no
    code, and so opening it runs nothing.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted estimator.
    path : str or path-like
        The file to write, by custom with the suffix ``.skops``. An existing file is
        replaced.

    Raises
    ------
    ValueError
        If the estimator is no AffineNRSfM, is not fitted, or has parts of types other
        than `TRUSTED_TYPES`, which `load_model` would refuse.
    OSError
        If the file cannot be written.

    See Also
    --------
    load_model : Load the model again.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>>     >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.io import load_model, save_model
    >>> table = make_face_tracks(n_frames=50, random_state=0).data
    >>> model = AffineNRSfM(n_components=2, random_state=0).fit(table)
    >>> with TemporaryDirectory() as folder:
    ...     save_model(model, Path(folder, "faces.skops"))
    ...     loaded = load_model(Path(folder, "faces.skops"))
    >>> bool((loaded.transform(table) == model.transform(table)).all())
    True
    """
    skops_io = import_optional("skops.io", extra="share")
    check_class(estimator, "estimator")
    check_is_fitted(estimator)
    contents = skops_io.dumps(without_callbacks(estimator))
    _refuse_untrusted(skops_io.get_untrusted_types(data=contents), "the estimator")
    Path(path).write_bytes(contents)


def load_model(path: str | os.PathLike[str]) -> AffineNRSfM:
    """
    Load a model that `save_model` has saved.

    Only objects of types that skops trusts and of `TRUSTED_TYPES` are created, so that
    files of unknown origin do no harm.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    AffineNRSfM
        The fitted estimator.

    Raises
    ------
    ValueError
        If the file is no model file, is damaged, contains other types (they are named),
        or something other than an AffineNRSfM.
    OSError
        If the file cannot be opened.

    See Also
    --------
    save_model : Save a model.
    """
    skops_io = import_optional("skops.io", extra="share")
    contents = Path(path).read_bytes()
    not_a_model = f"{os.fspath(path)} is not a model file written by save_model"
    # What a foreign or damaged file makes of the reader is not documented by skops.
    try:
        untrusted = skops_io.get_untrusted_types(data=contents)
    except Exception as error:
        raise ValueError(not_a_model) from error
    _refuse_untrusted(untrusted, os.fspath(path))
    try:
        model = skops_io.loads(contents, trusted=list(TRUSTED_TYPES))
    except Exception as error:
        raise ValueError(f"{not_a_model}, or it is damaged: {error}") from error
    check_class(model, os.fspath(path))
    check_is_fitted(model)
    return model


def _refuse_untrusted(types: list[str], where: str) -> None:
    """Raise if there are types that are not trusted."""
    untrusted = sorted(set(types) - set(TRUSTED_TYPES))
    if untrusted:
        raise ValueError(
            f"{where} contains objects that are not part of a model: "
            f"{', '.join(untrusted)}"
        )
