"""Truncated files, and those of other formats, are refused in words."""

import landmark_files as files
import numpy as np
import pytest

from isa_nrsfm.io import FORMATS, read_landmarks

TRACKS = files.scene(n_frames=3)
# Of each format a small file.
WRITERS = {
    "openface": lambda d: files.write_openface(d / "a.csv", TRACKS),
    "pyfeat": lambda d: files.write_pyfeat(d / "a.csv", TRACKS),
    "mediapipe": lambda d: files.write_mesh(d / "a.csv", TRACKS, shares=False),
    "pts": lambda d: files.write_pts(d / "a", TRACKS[:1]) / "image_000.pts",
    "wflw": lambda d: files.write_wflw(d / "a.txt", files.scene(2, 98)),
    "deeplabcut": lambda d: files.write_deeplabcut(
        d / "a.csv", files.deeplabcut_frame(TRACKS)
    ),
    "coco": lambda d: files.write_json(d / "a.json", files.coco_annotations(TRACKS)),
    "table": lambda d: files.write_mesh(d / "a.csv", TRACKS, shares=False),
}
BINARY_WRITERS = {
    "deeplabcut": lambda d: files.write_deeplabcut(
        d / "a.h5", files.deeplabcut_frame(TRACKS)
    ),
    "sleap": lambda d: files.write_sleap(d / "a.h5", TRACKS[:, None], names=["a"]),
}


def read_or_refuse(path, content, format):
    """Read a file with some content; return the landmarks, or None if refused."""
    path.write_bytes(content)
    try:
        return read_landmarks(path, format)
    except (ValueError, OSError) as error:
        message = str(error)
    assert str(path) in message
    return None


def truncated(content, n_pieces):
    """Return beginnings of a file, and the whole."""
    return [content[:n] for n in np.linspace(0, len(content), n_pieces).astype(int)]


@pytest.mark.parametrize("format", WRITERS)
def test_truncated_files_are_refused(format, tmp_path):
    path = WRITERS[format](tmp_path)
    content = path.read_bytes()
    whole = read_landmarks(path, format)
    for part in truncated(content, 24):
        found = read_or_refuse(path, part, format)
        # The end of a line, or of the last number, hides that there was more.
        assert found is None or found.points.shape[1] == whole.points.shape[1]
    for part in truncated(content, 24)[:6]:
        assert read_or_refuse(path, part, format) is None


@pytest.mark.parametrize("format", BINARY_WRITERS)
@pytest.mark.filterwarnings("default")
def test_truncated_hdf5_files_are_refused(format, tmp_path):
    path = BINARY_WRITERS[format](tmp_path)
    content = path.read_bytes()
    for part in truncated(content, 20)[:-1]:
        assert read_or_refuse(path, part, format) is None
    path.write_bytes(content[:-100])
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read as HDF5"):
        read_landmarks(path)


@pytest.mark.parametrize("wrong", FORMATS)
@pytest.mark.filterwarnings("default")
def test_files_of_other_formats_are_refused(wrong, tmp_path):
    for format, write in {**WRITERS, **BINARY_WRITERS}.items():
        path = write(tmp_path)
        if path.suffix == ".h5" and wrong in ("sleap", "deeplabcut"):
            pytest.importorskip("tables", reason="needs the extra h5")
        if format != wrong and {format, wrong} & {"mediapipe", "table"} == set():
            assert read_or_refuse(path, path.read_bytes(), wrong) is None
