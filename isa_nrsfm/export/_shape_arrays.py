"""The arrays of a fitted model, for NumPy and for MATLAB."""

import os
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.stored_arrays import write_arrays
from isa_nrsfm._compat.whole_files import whole_file
from isa_nrsfm._estimator import check_class
from isa_nrsfm.export._names import names_of_components, suffix_of
from isa_nrsfm.skeletons._column_names import names_of_points


class ShapeArrays(NamedTuple):
    """
    The arrays of a fitted model.

    The image of frame i is ``(mean_shape + tensordot(alpha[i], basis, 1)) @
    motion[i].T + translation[i]``.

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape, in the space of the cameras; Euclidean if these are calibrated.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes, for one standard deviation of their coefficients.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of the frames of the table; of no frames if none were kept.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras of the frames.
    translation : ndarray of shape (n_frames, 2)
        Images of the shapes' origin.
    energy_share : ndarray of shape (n_components,)
        Share of each basis shape in the energy of the deformations.
    reference_motion : ndarray of shape (2, 3)
        The mean view.
    reference_translation : ndarray of shape (2,)
        Its position.
    point_names : ndarray of shape (n_points,)
        Names of the points: those in the names of the columns, or their numbers.
    component_names : ndarray of shape (n_components,)
        Names of the coefficients.
    """

    mean_shape: NDArray
    basis: NDArray
    alpha: NDArray
    motion: NDArray
    translation: NDArray
    energy_share: NDArray
    reference_motion: NDArray
    reference_translation: NDArray
    point_names: NDArray
    component_names: NDArray


def shape_arrays(model: Any) -> ShapeArrays:
    """
    Return the arrays of a fitted model.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model.

    Returns
    -------
    ShapeArrays
        Named tuple of arrays: the attributes of the model and names.

    Raises
    ------
    ValueError
        If the model is no AffineNRSfM.

    See Also
    --------
    write_shapes : Write these arrays to a file.
    """
    check_class(model, "model")
    check_is_fitted(model)
    n_components = len(model.basis_)
    kept = hasattr(model, "alpha_")
    return ShapeArrays(
        mean_shape=model.mean_shape_,
        basis=model.basis_,
        alpha=np.asarray(model.alpha_) if kept else np.empty((0, n_components)),
        motion=np.asarray(model.motion_) if kept else np.empty((0, 2, 3)),
        translation=np.asarray(model.translation_) if kept else np.empty((0, 2)),
        energy_share=model.energy_share_,
        reference_motion=model.reference_motion_,
        reference_translation=model.reference_translation_,
        point_names=np.array(names_of_points(model), dtype=str),
        component_names=np.array(names_of_components(None, n_components), dtype=str),
    )


def write_shapes(model: Any, path: str | os.PathLike[str]) -> None:
    """
    Write the arrays of a fitted model for NumPy or for MATLAB.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model.
    path : str or path-like
        The file, with the suffix ``.npz`` or ``.mat``. An existing file is replaced.

    Raises
    ------
    ValueError
        If the suffix is another one.
    OSError
        If the file cannot be written.

    See Also
    --------
    shape_arrays : The arrays that are written, under the same names.
    isa_nrsfm.io.save_model : Save the model itself.

    Notes
    -----
    In MATLAB and Octave names are cell arrays of text, and alpha(i, k) is the
    coefficient k of frame i, mean_shape(j, :) point j, squeeze(basis(k, j, :)) its
    drift.
    """
    suffix = suffix_of(path, [".npz", ".mat"])
    arrays = shape_arrays(model)._asdict()
    with whole_file(path) as file:
        if suffix == ".npz":
            write_arrays(file, arrays)
        else:
            for name in ("point_names", "component_names"):
                arrays[name] = arrays[name].astype(object)
            savemat(file, arrays, oned_as="column")
