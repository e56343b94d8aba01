"""MUCT: public landmarks of real faces, some of them hidden.

68 landmarks that were marked by hand in 3755 photos, 480 x 640 pixels, of the faces of
276 people: two or three lightings (q to z), each seen by five cameras (a to e) at once.
Camera a is in front of the face. Points that the face itself hides are missing: 2544
points in 840 photos, all of them from the cameras b and c. Subjects 247 and 248 are
identical twins.

The landmarks are in the order of XM2VTS. The database has 76 a face; of these the
file, whose name keeps the number, has 68.

A photo is named like i000qa-fn: the subject, the lighting, the camera, the sex, and
whether glasses are worn (g) or not (n). Three names have a number in the last place, so
that the glasses are taken from the tag. The mirror images of the file are left out.

S. Milborrow, J. Morkel, F. Nicolls: The MUCT Landmarked Face Database. Pattern
Recognition Association of South Africa, 2010. http://www.milbo.org/muct
"""

import numpy as np
from sklearn.utils import Bunch

from isa_nrsfm._compat.scikit_learn import checked_parameters
from isa_nrsfm._tables import table_to_tracks
from isa_nrsfm.datasets._remote import PARAMETERS, SOURCES, DataHome, fetch_file

URL, SHA256 = SOURCES["muct"]

DESCR = f"{__doc__}\nSource: free for academic use, {URL}\n"


@checked_parameters(PARAMETERS)
def fetch_muct(
    *, data_home: DataHome = None, download_if_missing: bool = True
) -> Bunch:
    """
    Load the landmarks of the faces of MUCT; download them if necessary.

    68 landmarks in each of 3755 photos of 276 people from five cameras; NaN for those
    that the face itself hides. The data are free for academic use.

    Parameters
    ----------
    data_home : str or path-like, default=None
        The folder that has the file ``muct76-opencv.csv``, or into which it is
        downloaded. By default it is ``isa_nrsfm`` in the data home of scikit-learn,
        that is ``~/scikit_learn_data/isa_nrsfm``.
    download_if_missing : bool, default=True
        Whether to download the file (4.2 MB) if it is not there. This needs pooch:
        ``pip install "isa-nrsfm[datasets]"``.

    Returns
    -------
    sklearn.utils.Bunch
        Dictionary-like object with the attributes

        data : ndarray of shape (n_frames, 136)
            The table x00, y00, x01, ..., in pixels, x to the right and y down. Points
            that are not seen are NaN.
        target : ndarray of shape (n_frames,)
            The same as `subjects`.
        tracks : ndarray of shape (n_frames, 68, 2)
            The same numbers as in `data`, one (x, y) pair per point.
        visible : ndarray of shape (n_frames, 68), dtype=bool
            False where a point is missing.
        subjects : ndarray of shape (n_frames,), dtype=int
            The number of the person, from 0 to 624, of which 276 occur.
        lighting : ndarray of shape (n_frames,), dtype=str
            The lighting, from q to z.
        camera : ndarray of shape (n_frames,), dtype=str
            The camera, from a (in front of the face) to e.
        sex : ndarray of shape (n_frames,), dtype=str
            The sex of the person, f or m.
        glasses : ndarray of shape (n_frames,), dtype=bool
            Whether glasses are worn.
        names : ndarray of shape (n_frames,), dtype=str
            The names of the photos.
        tags : ndarray of shape (n_frames,), dtype=str
            Attributes of the photos as they are in the file: bits, hexadecimal.
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
    fetch_shark : A sequence with its truth.
    make_face_tracks : Artificial faces with known truth.

    References
    ----------
    .. [1] Milborrow, Morkel, Nicolls, "The MUCT Landmarked Face Database", Pattern
       Recognition Association of South Africa, 2010.

    Examples
    --------
    >>> from isa_nrsfm.datasets import fetch_muct
    >>> faces = fetch_muct()  # doctest: +SKIP
    >>> faces.data.shape  # doctest: +SKIP
    (3755, 136)
    """
    path = fetch_file(URL, SHA256, data_home, download_if_missing)
    header, *rows = np.loadtxt(path, dtype=np.str_, delimiter=",")
    # Without the mirror images of all photos, which are called ir...
    cells = np.array([row for row in rows if not row[0].startswith("ir")])
    names, tags, data = *cells[:, :2].T.copy(), cells[:, 2:].astype(float)
    tracks = table_to_tracks(data)  # a view
    visible = tracks.any(axis=2)  # others are at (0, 0)
    tracks[~visible] = np.nan
    # One column a letter: i000qa-fn.
    letters = names.astype("U9").view("U1").reshape(-1, 9)
    subjects = letters[:, 1:4].astype(int) @ [100, 10, 1]
    return Bunch(
        data=data,
        visible=visible,
        subjects=subjects,
        lighting=letters[:, 4],
        camera=letters[:, 5],
        sex=letters[:, 7],
        glasses=np.array([int(tag, 16) & 0x2 > 0 for tag in tags]),
        names=names,
        tags=tags,
        target=subjects,
        tracks=tracks,
        feature_names=header[2:].tolist(),
        filename=str(path),
        DESCR=DESCR,
    )
