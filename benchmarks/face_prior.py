"""
Make the face prior of the package from a public face model.

    python -m benchmarks.face_prior

Shapes are those of ICT-FaceKit (MIT licence): 100 people with 25 expressions each,
drawn from its identities and expressions. Its 51 inner landmarks are taken as they are.
Its jaw lies nearer to the nose than where annotators click, which spoils depths. So the
17 points of the jaw are interpolated on its mesh where a fit of annotated photos has
them. Only these places come from the photos. Needs ``ict_bu3dfe_like_68.npz``,
``ict_bu3dfe_like_basis.npz`` and ``faces_wild_68_combined.npz`` in the folder
ISA_NRSFM_DATA. Writes ``isa_nrsfm/datasets/face_prior.npz``.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks._sets import FACES, ICT, Case, load_arrays
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.io import save_model

DENSE = Case("ICT-FaceKit mesh", "ict_bu3dfe_like_basis", 40)
# Photos of this source are left out: they serve for checks of the result.
CHECKED = "ls3dw_aflw2000_reannotated"
JAW, INNER, N_COMPONENTS = slice(0, 17), slice(17, 68), 40
NUMBERS = (
    *("noise_variance_", "inverse_snr_", "rank_floor_", "depth_uncertainty_"),
    "frames.residual",
)


def main():
    """Make the model, and write its file."""
    about = __doc__.strip().split("\n")[0]
    parser = argparse.ArgumentParser(
        "python -m benchmarks.face_prior", description=about
    )
    parser.parse_args()
    faces, dense, photos = map(load_arrays, (ICT, DENSE, FACES))
    W = photos["W2d"][photos["source"] != CHECKED]
    annotated = AffineNRSfM(20, camera="weak_perspective", random_state=0)
    annotated.fit(W.reshape(len(W), -1))
    weights = vertex_weights(faces["S3d"].mean(axis=0), dense, annotated.mean_shape_)
    shapes = landmarks(dense, weights)
    # y points up in the model, and z to the viewer. In images y points down.
    turn = np.diag([1.0, -1.0, -1.0])
    shapes = (shapes - shapes.mean(axis=1, keepdims=True)) @ turn
    model = fitted(shapes, (turn @ faces["R"] @ turn)[:, :2])
    path = Path(__file__).parents[1] / "isa_nrsfm" / "datasets" / "face_prior.npz"
    np.savez(path, **stored(model))
    print(f"{path}: {path.stat().st_size} bytes")


def vertex_weights(inner, dense, annotated):
    """Return weights (68, n_vertices) of the vertices of a mesh for landmarks.

    inner (68, 3): landmarks of the model; annotated (68, 3): those of photos.
    """
    vertices = dense["mean"] + sum(
        np.tensordot(dense[f"{part}_coeffs"].mean(0), dense[part], 1)
        for part in ("identity", "expression")
    )
    tree, mirror = KDTree(vertices), np.array([-1.0, 1.0, 1.0])
    _, opposite = KDTree(dense["mean"]).query(dense["mean"] * mirror)
    weights = np.zeros((68, len(vertices)))
    weights[np.arange(17, 68), tree.query(inner[INNER])[1]] = 1.0
    # The annotated face in the axes of the model, by its inner points; its mirror image
    # in depth if that is nearer
    jaws = [jaw_in(annotated * (1.0, 1.0, sign), inner) for sign in (1.0, -1.0)]
    _, jaw = min(jaws, key=lambda pair: pair[0])
    jaw = (jaw + jaw[::-1] * mirror) / 2
    for point, place in enumerate(jaw[:9]):
        _, near = tree.query(place, 12)
        # Barycentric coordinates: non-negative weights with sum one
        A = np.vstack([vertices[near].T, np.full(len(near), 1e3)])
        share, _ = nnls(A, np.append(place, 1e3))
        weights[point, near] += share / share.sum()
        weights[16 - point, opposite[near]] += share / share.sum()
    weights[8] /= 2.0  # its own opposite
    return weights


def jaw_in(annotated, inner):
    """Return the error of the inner points, and the jaw, after a similarity."""
    moved, to = annotated - annotated[INNER].mean(0), inner[INNER]
    centred = to - to.mean(0)
    turn, _ = Rotation.align_vectors(centred, moved[INNER])
    moved = turn.apply(moved)
    scale = np.vdot(centred, moved[INNER]) / np.vdot(moved[INNER], moved[INNER])
    moved = scale * moved + to.mean(0)
    return np.sum((moved[INNER] - to) ** 2), moved[JAW]


def landmarks(dense, weights):
    """Return the landmarks (n, 68, 3) of all faces."""
    return weights @ dense["mean"] + sum(
        np.tensordot(dense[f"{part}_coeffs"], weights @ dense[part].astype(float), 1)
        for part in ("identity", "expression")
    )


def fitted(shapes, cameras):
    """Return the arrays of a model file of the fit of images of shapes (n, 68, 3)."""
    table = (shapes @ cameras.mT).reshape(len(shapes), -1)
    model = AffineNRSfM(N_COMPONENTS, camera="weak_perspective", independence=None)
    model.fit(table)
    with TemporaryDirectory() as folder:
        path = Path(folder, "face_prior.npz")
        save_model(model, path)
        with np.load(path) as file:
            return dict(file)


def stored(model):
    """Return what `isa_nrsfm.datasets.load_face_prior` reads, in single precision."""
    header = json.loads(model["header"].tobytes())
    frames = {f"frames.{name}": value for name, value in header["frames"].items()}
    model = {**header["attributes"], **frames, **model}
    M = model["motion_"] / model["frames.sizes"][:, None, None]
    single = {
        "mean_shape": model["mean_shape_"],
        "basis": model["basis_"],
        "view": model["reference_motion_"],
        "moments": np.mean(M.mT @ M, axis=0),
        "singular_values": model["singular_values_"],
        "reliability": model["reliability_"],
        "energy_share": model["energy_share_"],
        "turns": model["frames.turns"],
        "points": model["frames.depth_variances"],
        "numbers": [*(model[n] for n in NUMBERS), *model["frames.image_errors"]],
    }
    return {name: np.float32(values) for name, values in single.items()}


if __name__ == "__main__":
    main()
