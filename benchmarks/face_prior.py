"""
Make the face prior of the package from a public face model.

    python -m benchmarks.face_prior [--muct]

Shapes are those of ICT-FaceKit (MIT licence): 100 people with 25 expressions each,
drawn from its identities and expressions. Its 51 inner landmarks are taken as they are.
Its jaw lies nearer to the nose than where annotators click, which spoils depths. So the
17 points of the jaw are interpolated on its mesh where a fit of annotated photos has
them. The points of MUCT are interpolated in the same way: the model of the 14 of them
that iBUG-68 has, too, gives the cameras of the photos, and these the mean place of each
point. Its eight further points on the eyelids are between those of iBUG-68. Only these
places come from the photos. Needs ``ict_bu3dfe_like_68.npz``,
``ict_bu3dfe_like_basis.npz``, ``faces_wild_68_combined.npz`` and ``muct_68.npz`` in the
folder ISA_NRSFM_DATA. Writes ``isa_nrsfm/datasets/face_prior.npz``; with ``--muct``
only its points of MUCT.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from benchmarks._sets import FACES, ICT, MUCT, Case, as_table, load_arrays
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets._face_prior import load_face_prior, model_of_points
from isa_nrsfm.io import save_model
from isa_nrsfm.skeletons import get_skeleton

DENSE = Case("ICT-FaceKit mesh", "ict_bu3dfe_like_basis", 40)
# Photos of this source are left out: they serve for checks of the result.
CHECKED = "ls3dw_aflw2000_reannotated"
JAW, INNER, N_COMPONENTS = slice(0, 17), slice(17, 68), 40
# The same points of MUCT and iBUG-68: corners of the eyes, lips, nose.
SAME = np.array([27, 29, 34, 32, 48, 50, 51, 52, 54, 56, 57, 58, 67, 41])
SAME_IBUG = np.array([36, 39, 42, 45, 48, 50, 51, 52, 54, 56, 57, 58, 30, 33])
# Lids of iBUG-68, and the points of MUCT-76 at a quarter and three quarters of them.
LIDS = {
    (36, 37, 38, 39): (68, 69),
    (39, 40, 41, 36): (70, 71),
    (45, 44, 43, 42): (72, 73),
    (42, 47, 46, 45): (74, 75),
}
# y points up in ICT-FaceKit, and z to the viewer. In images y points down.
TURN, MIRROR = np.diag([1.0, -1.0, -1.0]), np.array([-1.0, 1.0, 1.0])
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
    parser.add_argument("--muct", action="store_true", help="only the points of MUCT")
    only_muct = parser.parse_args().muct
    faces, dense, photos, muct = map(load_arrays, (ICT, DENSE, FACES, MUCT))
    path = Path(__file__).parents[1] / "isa_nrsfm" / "datasets" / "face_prior.npz"
    cameras = (TURN @ faces["R"] @ TURN)[:, :2]
    if not only_muct:
        np.savez(path, **stored(ibug_model(faces, dense, photos, cameras)))
    with np.load(path) as file:
        arrays = dict(file)
    shapes = muct_shapes(faces, dense, muct, cameras)
    arrays["shapes"] = np.float32(np.concatenate([arrays["shapes"][:, :68], shapes], 1))
    variance = arrays["points"][:68].mean()
    arrays["points"] = np.append(arrays["points"][:68], np.full(76, variance))
    np.savez(path, **arrays)
    print(f"{path}: {path.stat().st_size} bytes")


def ibug_model(faces, dense, photos, cameras):
    """Return the arrays of a model file of the fit of images of iBUG-68."""
    W = photos["W2d"][photos["source"] != CHECKED]
    annotated = AffineNRSfM(20, camera="weak_perspective", random_state=0)
    annotated.fit(W.reshape(len(W), -1))
    weights = vertex_weights(faces["S3d"].mean(axis=0), dense, annotated.mean_shape_)
    return fitted(landmarks(dense, weights) @ TURN, cameras)


def muct_shapes(faces, dense, photos, cameras):
    """Return mean and basis shapes (41, 76, 3) of MUCT-76, those of iBUG-68 in front.

    The images of the points are regressed on the coefficients and cameras of iBUG-68.
    """
    model, inner = load_face_prior(), faces["S3d"].mean(axis=0)
    of_ibug = vertex_weights(inner, dense, model.mean_shape_)
    places = in_model(muct_places(photos["W2d"]), SAME, inner[SAME_IBUG])
    vertices, opposite = mean_face(dense)
    skeleton, tree = get_skeleton("muct-76"), KDTree(vertices)
    swapped = np.arange(76)
    swapped[[*skeleton.right, *skeleton.left]] = [*skeleton.left, *skeleton.right]
    weights = np.zeros((76, len(vertices)))
    for point, place in enumerate((places + places[swapped[:68]] * MIRROR) / 2):
        near, share = on_mesh(place, vertices, tree)
        weights[point, near] += share / 2
        weights[swapped[point], opposite[near]] += share / 2
    nodes = np.arange(4) / 3
    for lid, new in LIDS.items():  # cubics through four points
        for point, place in zip(new, (0.25, 0.75), strict=True):
            powers = np.vander([*nodes, place], 4)
            weights[point] = powers[4] @ np.linalg.inv(powers[:4]) @ of_ibug[[*lid]]
    images, known = (
        (landmarks(dense, w) @ TURN @ cameras.mT) for w in (weights, of_ibug)
    )
    motion, position, alpha, _ = model.decompose(as_table(known))
    factors = np.insert(alpha, 0, 1.0, axis=1)
    A = np.einsum("nk,nra->nrka", factors, motion).reshape(2 * len(alpha), -1)
    images = (images - position[:, None]).swapaxes(1, 2).reshape(len(A), -1)
    shapes = np.linalg.lstsq(A, images, rcond=None)[0]
    return shapes.reshape(-1, 3, 76).swapaxes(1, 2)


def muct_places(W):
    """Return mean places (68, 3) of the points of photos (n, 68, 2), y upwards."""
    fit = model_of_points(SAME_IBUG, 9).decompose(as_table(W[:, SAME]))
    scales = np.linalg.norm(fit.motion[:, 0], axis=1)[:, None]
    M, W = (
        fit.motion / scales[..., None],
        (W - fit.translation[:, None]) / scales[:, None],
    )
    seen = np.isfinite(W[..., 0])
    places = [
        np.linalg.lstsq(M[s].reshape(-1, 3), W[s, j].ravel(), rcond=None)[0]
        for j, s in enumerate(seen.T)
    ]
    return np.array(places) @ TURN


def mean_face(dense):
    """Return the mean face (n_vertices, 3), and the opposite vertices."""
    vertices = dense["mean"] + sum(
        np.tensordot(dense[f"{part}_coeffs"].mean(0), dense[part], 1)
        for part in ("identity", "expression")
    )
    return vertices, KDTree(dense["mean"]).query(dense["mean"] * MIRROR)[1]


def on_mesh(place, vertices, tree):
    """Return the 12 vertices nearest to a place, and barycentric coordinates."""
    _, near = tree.query(place, 12)
    # Non-negative weights with sum one
    A = np.vstack([vertices[near].T, np.full(len(near), 1e3)])
    share, _ = nnls(A, np.append(place, 1e3))
    return near, share / share.sum()


def vertex_weights(inner, dense, annotated):
    """Return weights (68, n_vertices) of the vertices of a mesh for landmarks.

    inner (68, 3): landmarks of the model; annotated (68, 3): those of photos.
    """
    vertices, opposite = mean_face(dense)
    tree = KDTree(vertices)
    weights = np.zeros((68, len(vertices)))
    weights[np.arange(17, 68), tree.query(inner[INNER])[1]] = 1.0
    # The annotated face in the axes of the model, by its inner points; its mirror image
    # in depth if that is nearer
    points, to = np.arange(68)[INNER], inner[INNER]
    both = [in_model(annotated * (1, 1, sign), points, to) for sign in (1.0, -1.0)]
    jaw = min(both, key=lambda face: np.sum((face[INNER] - to) ** 2))[JAW]
    jaw = (jaw + jaw[::-1] * MIRROR) / 2
    for point, place in enumerate(jaw[:9]):
        near, share = on_mesh(place, vertices, tree)
        weights[point, near] += share
        weights[16 - point, opposite[near]] += share
    weights[8] /= 2.0  # its own opposite
    return weights


def in_model(annotated, points, to):
    """Return a face after the similarity that brings some of its points to others."""
    moved, centred = annotated - annotated[points].mean(0), to - to.mean(0)
    turn, _ = Rotation.align_vectors(centred, moved[points])
    moved = turn.apply(moved)
    scale = np.vdot(centred, moved[points]) / np.vdot(moved[points], moved[points])
    return scale * moved + to.mean(0)


def landmarks(dense, weights):
    """Return the landmarks (n, n_points, 3) of all faces."""
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
        "shapes": np.concatenate([model["mean_shape_"][None], model["basis_"]]),
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
