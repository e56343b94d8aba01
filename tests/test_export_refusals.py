"""Arguments of exporters that are refused, before anything is written."""

from functools import partial

import numpy as np
import pytest
from export_models import N_FRAMES, blob_model, calibrated_model, face_model, faces
from refusals import refused
from sklearn.decomposition import PCA
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.export import (
    frame_poses,
    point_distances,
    point_distribution_model,
    write_glb,
    write_pdm,
    write_shapes,
    write_viewer,
)

distances = partial(point_distances, pairs=[(48, 54)])
POINTS, SHAPES = "must name points 0 to 67; got 0 to", r"\(n_pairs, 2\).*\(n_triangles"
CASES = [
    (write_glb, {"edges": [[0, 68]]}, f"{POINTS} 68"),
    (write_glb, {"edges": [[0, 1, 70]]}, f"{POINTS} 70"),
    (write_glb, {"edges": [[0, 1, 2, 3]]}, SHAPES),
    (write_glb, {"edges": [[0.5, 1, 2]]}, SHAPES),
    (write_glb, {"names": ["one"]}, "names must hold 3 names; got 1"),
    (write_glb, {"camera": "perspective"}, "camera must be"),
    (write_viewer, {"labels": ["a"]}, "labels must hold 150 labels, one per row; got"),
    (write_viewer, {"labels": range(N_FRAMES)}, "at most 30 different .* got 150"),
    (write_viewer, {"n_frames": -1}, "n_frames must be a whole number .*; got -1"),
    (write_viewer, {"n_frames": 2.5}, "n_frames must be a whole number .*; got 2.5"),
    (write_viewer, {"names": ["jaw"]}, "names must hold 3 names"),
    (write_viewer, {"edges": [[0, 99]]}, POINTS),
    (write_viewer, {"depth_std": np.ones(68)}, "depth_std needs a model with calibr"),
    (write_viewer, {"origin": "left"}, "origin must be"),
    (frame_poses, {"camera": None}, "angles need calibrated cameras"),
    (distances, {"camera": None}, "distances need calibrated cameras"),
    (distances, {"pairs": [(1, 99)]}, "no point 99; the 68 points"),
    (distances, {"pairs": [(1, 1)]}, "two different points"),
    (distances, {"length": 0.0}, "length must be a positive number; got 0"),
    *(
        (
            point_distribution_model,
            {"n_modes": each},
            "n_modes.* must be an int in the range",
        )
        for each in (0, -1, 1.0, 1.5, 0.0, np.nan, True, "all")
    ),
]


@pytest.mark.parametrize(("function", "options", "message"), CASES)
def test_bad_options(tmp_path, function, options, message):
    suffix = {write_glb: ".glb", write_viewer: ".html"}.get(function)
    path = [] if suffix is None else [tmp_path / f"model{suffix}"]
    refused(message, function, face_model(), *path, **options)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("depth_std", "message"),
    [
        (np.ones(67), r"depth_std must have shape \(150, 68\) or \(68,\); got \(67,\)"),
        (np.ones((149, 68)), r"must have shape .*; got \(149, 68\)"),
        (np.full(68, -0.5), "must not be negative; its least value is -0.5"),
        (np.full(68, np.inf), "depth_std contains infinity"),
        ("wide", "could not convert string to float"),
    ],
)
def test_bad_deviations(tmp_path, depth_std, message):
    with pytest.raises(ValueError, match=message):
        write_viewer(calibrated_model(), tmp_path / "a.html", depth_std=depth_std)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("write", "suffixes"),
    [
        (write_glb, ".glb"),
        (write_viewer, ".html or .htm"),
        (write_shapes, ".npz or .mat"),
        (write_pdm, ".txt or .mat or .npz"),
    ],
)
def test_other_suffixes(tmp_path, write, suffixes):
    model = face_model()
    if write is write_pdm:
        model = point_distribution_model(model)
    with pytest.raises(ValueError, match=f"path must end in {suffixes}; got .*a.csv"):
        write(model, tmp_path / "a.csv")


def test_models_that_have_no_frames_of_their_own():
    refused("model should be an AffineNRSfM; got PCA", frame_poses, PCA())
    refused(None, frame_poses, AffineNRSfM(), error=NotFittedError)
    with pytest.raises(ValueError, match='camera must be "weak_perspective" or None'):
        frame_poses(blob_model(), camera="orthographic")
    table = faces().data[:40]
    without = AffineNRSfM(1, refinement=None, random_state=0, keep_frames=False)
    refused("exporting shapes needs the cameras", frame_poses, without.fit(table))
