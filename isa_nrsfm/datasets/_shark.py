"""The shark: a public sequence of a deforming shape, with its truth.

An artificial shark of 91 points that moves and bends, in 240 frames, with the true 3D
points of every frame. The images are orthographic and without noise: the first two
coordinates of the points in the frame of the camera.

The centred measurement matrix has rank 5: that of a mean shape and of one basis shape
of rank 2. The file is that of Torresani's code for non-rigid structure from motion.

L. Torresani, A. Hertzmann, C. Bregler: Nonrigid Structure-from-Motion: Estimating Shape
and Motion with Hierarchical Priors. IEEE Transactions on Pattern Analysis and Machine
Intelligence 30 (2008), 878-892.
"""

from scipy.io import loadmat
from sklearn.utils import Bunch

from isa_nrsfm._compat.scikit_learn import checked_parameters
from isa_nrsfm._tables import tracks_to_table
from isa_nrsfm.datasets._remote import PARAMETERS, SOURCES, DataHome, fetch_file

URL, SHA256 = SOURCES["shark"]

DESCR = f"{__doc__}\nSource: free for non-commercial use, {URL}\n"


@checked_parameters(PARAMETERS)
def fetch_shark(
    *, data_home: DataHome = None, download_if_missing: bool = True
) -> Bunch:
    """
    Load the shark of Torresani, Hertzmann, Bregler; download it if necessary.

    An artificial shark of 91 points in 240 frames with the true 3D points, which papers
    on non-rigid structure from motion compare their results on. The data are free for
    non-commercial use.

    Parameters
    ----------
    data_home : str or path-like, default=None
        The folder that has the file ``jaws.mat``, or into which it is downloaded. By
        default it is ``isa_nrsfm`` in the data home of scikit-learn, that is
        ``~/scikit_learn_data/isa_nrsfm``.
    download_if_missing : bool, default=True
        Whether to download the file (0.5 MB) if it is not there. This needs pooch:
        ``pip install "isa-nrsfm[datasets]"``.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (240, 182)
            The table x_0, y_0, x_1, ..., in the units of `shapes`.
        tracks : ndarray of shape (240, 91, 2)
            The same numbers, one (x, y) pair per point.
        shapes : ndarray of shape (240, 91, 3)
            The true points of every frame in the coordinates of its camera, not
            centred: `tracks` are the first two of them. They turn with the camera, so
            that no one affinity maps the shapes of a fit to all of them, which
            `metrics.affine_shape_error` supposes.
        feature_names : list of str
            The names of the columns of `data`.
        filename : str
            The path of the file.
        DESCR : str
            What the data are, where they come from and the paper to cite.

    Raises
    ------
    OSError
        If the file is not there and cannot be downloaded, or not with
        `download_if_missing=False`; or if the file that is there is another one.
    ImportError
        If the file has to be downloaded and pooch is not installed.

    See Also
    --------
    fetch_muct : Landmarks of real faces.
    make_nonrigid_tracks : Artificial tables with known truth.

    References
    ----------
    .. [1] Torresani, Hertzmann, Bregler, "Nonrigid Structure-from-Motion: Estimating
       Shape and Motion with Hierarchical Priors", IEEE Transactions on Pattern Analysis
       and Machine Intelligence 30(5), 2008.

    Examples
    --------
    >>> from isa_nrsfm.datasets import fetch_shark
    >>> shark = fetch_shark()  # doctest: +SKIP
    >>> shark.data.shape  # doctest: +SKIP
    (240, 182)
    """
    path = fetch_file(URL, SHA256, data_home, download_if_missing)
    # (3 n_frames, n_points): the x of all frames, then the y, then the z.
    coordinates = loadmat(path)["P3_gt"]
    n_points = coordinates.shape[1]
    shapes = coordinates.reshape(3, -1, n_points).transpose(1, 2, 0).copy()
    tracks = shapes[..., :2].copy()
    return Bunch(
        data=tracks_to_table(tracks),
        tracks=tracks,
        shapes=shapes,
        feature_names=[f"{axis}_{j}" for j in range(n_points) for axis in "xy"],
        filename=str(path),
        DESCR=DESCR,
    )
