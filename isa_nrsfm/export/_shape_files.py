"""Files of a model: its arrays, point distribution models, points of its frames."""

import os
from collections.abc import Sequence
from functools import partial
from itertools import islice
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file, savemat
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import files_together, reading, whole_file
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.scikit_learn import Interval, checked_parameters
from isa_nrsfm._compat.stored_arrays import write_arrays
from isa_nrsfm._estimator import check_class
from isa_nrsfm._fitted_model import frames_of, points_in_space
from isa_nrsfm._linalg import procrustes
from isa_nrsfm.analysis._advice import Facts, depth_advice
from isa_nrsfm.export import _upright
from isa_nrsfm.plotting._views import Origin
from isa_nrsfm.skeletons._column_names import names_of_components, names_of_points


class ShapeArrays(NamedTuple):
    """
    The arrays of a fitted model.

    The image of frame i is ``(mean_shape + tensordot(alpha[i], basis, 1)) @
    motion[i].T + translation[i]``. Perspective cameras show it in the same view, but
    near points larger (`AffineNRSfM.inverse_transform`).

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
    # Those that were not kept are of no frames.
    kept = {"alpha": (0, n_components), "motion": (0, 2, 3), "translation": (0, 2)}
    arrays = [
        np.asarray(getattr(model, f"{name}_", np.empty(kept.get(name, 0))))
        for name in ShapeArrays._fields[:-2]
    ]
    names = names_of_points(model), names_of_components(None, n_components)
    return ShapeArrays(*arrays, *(np.array(each, dtype=str) for each in names))


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
    suffix = _upright.suffix_of(path, [".npz", ".mat"])
    arrays = shape_arrays(model)._asdict()
    with whole_file(path) as file:
        if suffix == ".npz":
            write_arrays(file, arrays)
        else:
            for name in ("point_names", "component_names"):
                arrays[name] = arrays[name].astype(object)
            savemat(file, arrays, oned_as="column")


NUMBER_OF_MODES = Interval(Integral, 1, None, closed="left")
SHARE_OF_VARIANCE = Interval(Real, 0, 1, closed="neither")
COMMENTS = (
    "The mean values of the components: x, y and z of all points",
    "The principal components (eigenvectors), one per column",
    "The variances of the components (eigenvalues)",
)


class PointDistributionModel(NamedTuple):
    """
    A point distribution model: mean, principal axes and variances of shapes.

    A shape is ``mean + tensordot(scores, modes, 1)``. In the space x points right, y
    down and z away from the viewer.

    Attributes
    ----------
    mean : ndarray of shape (n_points, 3)
        The mean shape, centred.
    modes : ndarray of shape (n_modes, n_points, 3)
        Principal axes, orthonormal as vectors of 3 n_points numbers, by decreasing
        variance. The number of largest magnitude of each is positive.
    eigenvalues : ndarray of shape (n_modes,)
        Variances: the mean squares of the scores over the frames.
    """

    mean: NDArray
    modes: NDArray
    eigenvalues: NDArray

    def scaled(self, factor: float) -> Self:
        """
        Return the model in another unit of length.

        Parameters
        ----------
        factor : float
            Scale factor of the lengths. For millimetres, a distance on the object in
            millimetres divided by the same distance on `mean`.

        Returns
        -------
        PointDistributionModel
            With ``factor * mean`` and ``factor ** 2 * eigenvalues``.
        """
        mean, eigenvalues = factor * self.mean, factor**2 * self.eigenvalues
        return self._replace(mean=mean, eigenvalues=eigenvalues)


@checked_parameters({"n_modes": [NUMBER_OF_MODES, SHARE_OF_VARIANCE, None]})
def point_distribution_model(
    model: Any,
    *,
    n_modes: float | None = None,
    camera: _upright.Camera = "weak_perspective",
    origin: Origin = "auto",
) -> PointDistributionModel:
    """
    Return the point distribution model of the frames that a model was fitted to.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    n_modes : int, float or None, default=None
        Number of modes. If between 0 and 1, the smallest number of modes whose share of
        the variance reaches it. If None, the number of basis shapes.
    camera : {"weak_perspective", None}, default="weak_perspective"
        Camera model for a model with affine cameras. "weak_perspective" takes the
        Euclidean shapes of the frames, as from `AffineNRSfM.reconstruct`, aligned by
        rotations and scales. None takes the affine shapes unchanged. A model with
        calibrated cameras has Euclidean shapes, which are aligned in the same way.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero in the table: "upper" for images, whose y points down, "lower"
        for a y that points up. "auto" is "lower" if 68 points of a face would otherwise
        be upside down.

    Returns
    -------
    PointDistributionModel
        Named tuple of mean, modes and eigenvalues. Lengths are in units of images of
        medium scale, with calibrated cameras in those of `AffineNRSfM.mean_shape_`.

    Raises
    ------
    ValueError
        If the model has kept no frames, if the cameras see fewer than three directions
        of space, if a parameter is not of the kind given above, or if the shapes have
        fewer principal axes than `n_modes`.

    Warns
    -----
    UserWarning
        If the cameras turn too little to determine the metric.

    See Also
    --------
    write_pdm : Write the model to a file, for example for OpenFace.

    Notes
    -----
    The modes are principal axes, not the independent basis shapes: uncorrelated,
    orthogonal, and sorted by variance. Shapes are aligned as in generalised Procrustes
    analysis [1]_, with scales that bring them to the tangent space of the mean: their
    differences from it are orthogonal to it.

    References
    ----------
    .. [1] J. C. Gower, "Generalized Procrustes analysis", Psychometrika 40, 1975.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import point_distribution_model
    >>> faces = make_face_tracks(n_frames=40, n_components=1, random_state=0)
    >>> model = AffineNRSfM(n_components=1, random_state=0).fit(faces.data)
    >>> pdm = point_distribution_model(model)
    >>> pdm.mean.shape, pdm.modes.shape, pdm.eigenvalues.shape
    ((68, 3), (1, 68, 3), (1,))
    """
    space = _upright.upright_space(model, camera, origin)
    shapes = space.shapes(None)
    shapes = shapes[np.isfinite(shapes).all(axis=(1, 2))]
    if space.camera is not None:
        shapes = _aligned(shapes)
    mean = shapes.mean(axis=0)
    modes, variances = _principal_axes((shapes - mean).reshape(len(shapes), -1))
    kept: Any = n_modes
    if n_modes is None:
        kept = len(model.basis_)
    elif not isinstance(kept, Integral):
        share = np.cumsum(variances) / variances.sum()
        kept = np.searchsorted(share, kept) + 1
    elif int(kept) > len(variances):
        raise ValueError(
            f"n_modes must be at most {len(variances)}, the number of principal axes "
            f"of the shapes; got {n_modes}"
        )
    modes = modes[:kept].reshape(-1, *mean.shape)
    return PointDistributionModel(mean, modes, variances[:kept])


def write_pdm(pdm: PointDistributionModel, path: str | os.PathLike[str]) -> None:
    """
    Write a point distribution model to a file.

    Parameters
    ----------
    pdm : PointDistributionModel
        The model.
    path : str or path-like
        The file. Its suffix determines the format: ``.txt`` is the text of OpenFace and
        the CLM framework, ``.mat`` has the variables M, V and E of their MATLAB
        code, ``.npz`` has the arrays of the named tuple. An existing file is replaced.

    Raises
    ------
    ValueError
        If the suffix is another one, or the shapes of the arrays are inconsistent.
    OSError
        If the file cannot be written.

    See Also
    --------
    read_pdm : Read such a file.

    Notes
    -----
    The text has three matrices: mean (3n x 1), principal components (3n x m) and
    variances (1 x m), with the x of all n points first, then y, then z. Each has
    comment lines that begin with ``#``, its numbers of rows and columns, the number 6
    (for doubles), and its rows. In MATLAB M is 3n x 1, V 3n x m and E m x 1.
    """
    suffix = _upright.suffix_of(path, [".txt", ".mat", ".npz"])
    mean, modes, eigenvalues = checked = PointDistributionModel(*map(np.asarray, pdm))
    fitting = mean.ndim == 2 and mean.shape[1] == 3 and eigenvalues.ndim == 1
    if not fitting or modes.shape != (*eigenvalues.shape, *mean.shape):
        raise ValueError(
            "mean must have shape (n_points, 3), modes (n_modes, n_points, 3) and "
            f"eigenvalues (n_modes,); got {mean.shape}, {modes.shape} and "
            f"{eigenvalues.shape}"
        )
    M = mean.T.reshape(-1, 1)
    V = modes.transpose(2, 1, 0).reshape(mean.size, len(eigenvalues))
    with whole_file(path) as file:
        if suffix == ".npz":
            write_arrays(file, checked._asdict())
        elif suffix == ".mat":
            savemat(file, {"M": M, "V": V, "E": eigenvalues[:, None]})
        else:
            matrices = (M, V, eigenvalues[None])
            for comment, matrix in zip(COMMENTS, matrices, strict=True):
                n_rows, n_columns = matrix.shape
                # OpenCV calls matrices of doubles 6.
                file.write(f"# {comment}\n{n_rows}\n{n_columns}\n6\n".encode())
                np.savetxt(file, matrix, fmt="%.17g")


def read_pdm(path: str | os.PathLike[str]) -> PointDistributionModel:
    """
    Read a point distribution model from a file.

    Parameters
    ----------
    path : str or path-like
        A text file (``.txt``) of `write_pdm` or OpenFace.

    Returns
    -------
    PointDistributionModel
        Named tuple of mean, modes and eigenvalues. Further matrices, such as modes of
        expressions alone, are ignored.

    Raises
    ------
    ValueError
        If the suffix is not ``.txt``, or if the file does not have three finite
        matrices of consistent shapes.
    OSError
        If the file cannot be opened.

    See Also
    --------
    write_pdm : Write such a file.
    """
    _upright.suffix_of(path, [".txt"])
    with reading(path, "a point distribution model"):
        M, V, E = _read_matrices(path)
        n_points, n_modes = M.size // 3, E.size
        if M.size != 3 * n_points or V.shape != (3 * n_points, n_modes):
            raise ValueError(
                "it should have a mean of 3n numbers, components of shape (3n, m) and "
                f"m variances; got {M.size}, {V.shape} and {E.size}"
            )
        if not all(np.isfinite(part).all() for part in (M, V, E)):
            raise ValueError("its numbers should be finite; got NaN or infinity")
        modes = V.reshape(3, n_points, n_modes).transpose(2, 1, 0)
        return PointDistributionModel(M.reshape(3, n_points).T, modes, E.ravel())


def _read_matrices(path: str | os.PathLike[str]) -> list[NDArray]:
    """Read the three matrices of a text."""
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    words = (word for line in lines if line[:1] != "#" for word in line.split())
    matrices = []
    for comment in COMMENTS:
        try:
            n_rows, n_columns, _ = map(int, islice(words, 3))
            numbers = [*map(float, islice(words, n_rows * n_columns))]
            matrices.append(np.reshape(numbers, (n_rows, n_columns)))
        except ValueError as error:
            raise ValueError(
                f"where there should be {comment.partition(':')[0].lower()}: {error}"
            ) from error
    return matrices


def _aligned(shapes: NDArray) -> NDArray:
    """Return centred shapes turned to their mean, and scaled to its tangent space."""
    shapes = aligned = shapes - shapes.mean(axis=1, keepdims=True)
    mean = shapes.mean(axis=0)
    for _ in range(100):
        turned = shapes @ procrustes(shapes.mT @ mean)
        # <aligned shape, mean> = <mean, mean>
        scales = np.sum(mean**2) / np.sum(turned * mean, axis=(1, 2), keepdims=True)
        aligned = scales * turned
        previous, mean = mean, aligned.mean(axis=0)
        if np.linalg.norm(mean - previous) <= 1e-12 * np.linalg.norm(mean):
            break
    return aligned


def _principal_axes(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return orthonormal principal axes of centred rows and the variances on them."""
    # This imports all linear models, which the other functions do not need.
    from sklearn.decomposition import PCA

    wide = len(rows) < rows.shape[1]
    pca = PCA(svd_solver="full" if wide else "covariance_eigh").fit(rows)
    variances = pca.explained_variance_ * (1 - 1 / len(rows))
    # Axes with a smaller share of the largest variance are rounding errors.
    large = variances > 1e-10 * variances[0]
    return pca.components_[large], variances[large]


POINT_SUFFIXES = (".nc", ".h5", ".csv", ".trc")
_SCORER, _KEY = "isa_nrsfm_3d", "df_with_missing"
_TRC = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame"


class FramePoints(NamedTuple):
    """
    Points of frames in the axes of their camera; NaN where a frame has no camera.

    Attributes
    ----------
    position : ndarray of shape (n_frames, n_points, 3)
        x and y are places in the table, in its units, also of missing points. z is the
        depth from the origin of the shape, away from the viewer, in the same units; NaN
        where the table does not determine it.
    position_std : ndarray of shape (n_frames, n_points, 3)
        Their standard deviations, with the errors of camera, coefficients and shapes.
    determined : ndarray of bool, shape (n_frames, n_points)
        Whether the depth is determined.
    """

    position: NDArray
    position_std: NDArray
    determined: NDArray


def frame_points(model: Any, X: Any, *, point_weight: Any = None) -> FramePoints:
    """
    Return the points of frames in space, and their standard deviations.

    Parameters
    ----------
    model : AffineNRSfM
        A model with calibrated cameras and the joint refinement.
    X : array-like of shape (n_frames, 2 * n_points)
        A table with the points of the fitted one.
    point_weight : array-like of shape (n_frames, n_points), default=None
        Weights of the points, as in ``model.fit``.

    Returns
    -------
    FramePoints
        Named tuple of position, position_std and determined.

    Raises
    ------
    ValueError
        If the model has affine cameras, or was not refined jointly.

    Warns
    -----
    UserWarning
        If the fitted table does not determine the depth: z is NaN.

    Notes
    -----
    The deviations are of one frame: errors of its points depend on each other, and
    those of the shapes are common to all frames. The sign of z is a convention unless
    `mirror_certainty_` is known. Cameras of perspective have the object in true
    proportions, in units of the table at its distance.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import frame_points
    >>> options = {"camera": "weak_perspective", "random_state": 0}
    >>> faces = make_face_tracks(40, n_components=1, **options)
    >>> model = AffineNRSfM(1, **options).fit(faces.data)
    >>> points = frame_points(model, faces.data)
    >>> points.position.shape, points.position_std.shape, points.determined.all()
    ((40, 68, 3), (40, 68, 3), np.True_)
    """
    check_class(model, "model")
    position, std = map(np.array, points_in_space(model, X, point_weight))
    if not frames_of(model).certainty.determined:
        warn_caller(depth_advice(Facts(model)))
        position[..., 2] = std[..., 2] = np.nan
    return FramePoints(position, std, np.isfinite(position[..., 2]))


def write_points(
    model: Any,
    path: str | os.PathLike[str],
    X: Any,
    *,
    point_weight: Any = None,
    fps: float | None = None,
) -> None:
    """
    Write points in space with standard deviations for programs of movement analysis.

    Parameters
    ----------
    model : AffineNRSfM
        A model with calibrated cameras and the joint refinement.
    path : str or path-like
        The file. ``.nc`` is a dataset of movement in netCDF, ``.h5`` and ``.csv`` are
        files of DeepLabCut in 3D, ``.trc`` is one of OpenSim. Existing files are
        replaced.
    X : array-like of shape (n_frames, 2 * n_points)
        A table with the points of the fitted one, of one individual.
    point_weight : array-like of shape (n_frames, n_points), default=None
        Weights of the points, as in ``model.fit``.
    fps : float, default=None
        Frames per second, which ``.trc`` needs. None for times in frames.

    Raises
    ------
    ValueError
        If the suffix is another one, if `fps` is not positive or is needed, or for the
        reasons of `frame_points`.
    OSError
        If a file cannot be written.

    See Also
    --------
    frame_points : The points, and what their deviations mean.

    Notes
    -----
    The dataset has the variables position, position_std and determined. Its axes are
    named as in movement from version 0.17 on, keypoint and individual. The other
    formats have no place for deviations: a second file of the same layout, with
    ``_std`` at the end of its name, has them; empty cells, in ``.trc`` nan, are not
    determined.
    """
    suffix, path = _upright.suffix_of(path, POINT_SUFFIXES), Path(path)
    if fps is None and suffix == ".trc":
        raise ValueError("fps, the frames per second, is needed for .trc files")
    if fps is not None and not 0 < fps < np.inf:
        raise ValueError(f"fps must be a number above zero; got {fps!r}")
    points = frame_points(model, X, point_weight=point_weight)
    names = names_of_points(model)
    with files_together(path.parent) as folder:
        if suffix == ".nc":
            sign = np.float64(getattr(model, "mirror_certainty_", np.nan))
            _write_netcdf(folder / path.name, points, names, fps, sign)
            return
        write: Any = partial(_write_trc, fps=fps)
        std = points.position_std
        if suffix != ".trc":
            write = _write_deeplabcut
            std = np.dstack([std, points.determined.astype(float)])
        write(folder / path.name, points.position, names)
        write(folder / f"{path.stem}_std{path.suffix}", std, names)


def _write_netcdf(
    path: Path, points: FramePoints, names: Sequence[str], fps: Any, sign: float
) -> None:
    """Write a dataset of movement, as classic netCDF."""
    times = np.arange(len(points.position)) / (fps or 1.0)
    texts = {"space": "xyz", "keypoint": names, "individual": ["individual_0"]}
    with netcdf_file(path, "w", version=2) as file:
        file.createDimension("time", len(times))
        file.createVariable("time", "f8", ("time",))[:] = times
        for name, words in texts.items():
            letters = np.array([word.encode() for word in words], dtype="S")
            size = letters.dtype.itemsize
            file.createDimension(name, len(words))
            file.createDimension(f"{name}_letters", size)
            axis = file.createVariable(name, "c", (name, f"{name}_letters"))
            axis[:] = letters.view("S1").reshape(len(words), size)
            setattr(axis, "_Encoding", "utf-8")  # noqa: B010
        axes = ("time", "space", "keypoint", "individual")
        for name in ("position", "position_std"):
            values = getattr(points, name).swapaxes(1, 2)[..., None]
            file.createVariable(name, "f8", axes)[:] = values
        for name, kind in (("confidence", "f4"), ("determined", "i1")):
            values = points.determined if kind == "i1" else np.nan * points.determined
            file.createVariable(name, kind, axes[:1] + axes[2:])[:] = values[..., None]
        file.variables["determined"].dtype = "bool"
        unit = "seconds" if fps else "frames"
        attributes = {"source_software": "isa_nrsfm", "ds_type": "poses", "fps": fps}
        attributes |= {"time_unit": unit, "mirror_certainty": sign}
        for name, value in attributes.items():
            if value is not None:
                setattr(file, name, value)


def _write_deeplabcut(path: Path, values: NDArray, names: Sequence[str]) -> None:
    """Write values (n_frames, n_points, 3), or 4 with a flag, as DeepLabCut does."""
    levels, coords = ["scorer", "bodyparts", "coords"], ["x", "y", "z", "determined"]
    coords = coords[: values.shape[2]]
    columns = pd.MultiIndex.from_product([[_SCORER], names, coords], names=levels)
    frame = pd.DataFrame(values.reshape(len(values), -1), columns=columns)
    if path.suffix.lower() == ".csv":
        frame.to_csv(path)
    else:
        import_optional("tables", extra="tables")
        frame.to_hdf(path, key=_KEY, format="table", mode="w")


def _write_trc(path: Path, values: NDArray, names: Sequence[str], fps: Any) -> None:
    """Write values (n_frames, n_points, 3) as OpenSim writes them, NaN as nan."""
    n_frames, n_points, _ = values.shape
    axes = "\t".join(f"X{j}\tY{j}\tZ{j}" for j in range(1, n_points + 1))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        f"{_TRC} OrigNumFrames".replace(" ", "\t"),
        "\t".join(map(str, (fps, fps, n_frames, n_points, "px", fps, 1, n_frames))),
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}\n",
    ]
    table = pd.DataFrame(values.reshape(n_frames, -1))
    table.insert(0, "time", np.arange(n_frames) / fps)
    table.index += 1
    rows = table.to_csv(sep="\t", header=False, lineterminator="\n", na_rep="nan")
    path.write_text("\n".join([*head, rows]), encoding="utf-8")
