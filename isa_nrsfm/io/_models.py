"""Save and load fitted models without pickle."""

import os
from pathlib import Path

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm.io._model_contents import model_contents, model_from_contents
from isa_nrsfm.io._old_models import contents_of_old, is_old_model
from isa_nrsfm.io._skops_values import read_values

#: The types that a model file contains beside those that skops trusts by itself: none.
#: Files that named types of this package are read as well, by their plain contents.
TRUSTED_TYPES: tuple[str, ...] = ()


def save_model(estimator: AffineNRSfM, path: str | os.PathLike[str]) -> None:
    """
    Save a fitted model to a file that is safe to share.

    The file is written by skops. It holds a dict of numbers, texts and arrays under
    public names, and no code, so that opening it runs nothing and later versions read
    it. `load_model` is tried on it before it is put in place: the file is written as a
    whole or not at all.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted estimator. Arrays that are memory maps (a path as `keep_frames`) go
        into the file, which needs no other one; callbacks are left out.
    path : str or path-like
        The file to write, by custom with the suffix ``.skops``. An existing file is
        replaced.

    Raises
    ------
    ValueError
        If the estimator is no AffineNRSfM, is not fitted, or has parts that
        `load_model` would refuse: they are named. Strategies are `FastISA` and
        `PooledFastICA`, not subclasses or others.
    ImportError
        If skops is not installed.
    OSError
        If the file cannot be written.

    See Also
    --------
    load_model : Load the model again.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
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
    contents = skops_io.dumps(model_contents(estimator))
    try:
        model_from_contents(read_values(contents))
    except ValueError as error:
        raise ValueError(f"the estimator cannot be saved: {error}") from error
    write_whole(path, contents)


def load_model(path: str | os.PathLike[str]) -> AffineNRSfM:
    """
    Load a model that `save_model` has saved.

    Files of this and of all earlier versions of the package are read. Numbers, texts
    and arrays are read and checked, and nothing else, so that files of unknown origin
    do no harm.

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
        If the file is no model file, is damaged, was written by a newer version, or has
        entries that are missing, not known, of the wrong type or shape or that do not
        belong together, or objects that are not part of a model, or if it unpacks to
        more than it is large. What is wrong is named.
    OSError
        If the file cannot be opened.

    Warns
    -----
    UserWarning
        If the model was fitted with a parameter that there is no more, and that a new
        fit would need for the same result.

    See Also
    --------
    save_model : Save a model.
    """
    stored = Path(path).read_bytes()
    try:
        values = read_values(stored)
    except ValueError as error:
        raise ValueError(
            f"{os.fspath(path)} is not a model file written by save_model, or it is "
            f"damaged: {error}"
        ) from error
    try:
        contents = contents_of_old(values) if is_old_model(values) else values
        return model_from_contents(contents)
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from error
