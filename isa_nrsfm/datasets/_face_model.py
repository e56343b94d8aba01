"""Define a symmetric 68-point face and its expressions.

Millimetres. The origin lies between the nose tip and the ears' plane, x points to the
right in the image, y down and z away from the camera: the nose tip has the smallest
z. Only the half on the left of the image (the subject's right) and the middle are
written down, at the indices of the iBUG-68 scheme; the other half is the mirror image.
"""

from collections.abc import Sequence
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.skeletons import get_skeleton

N_POINTS = 68

COMPONENT_NAMES = (
    *("jaw open", "smile", "brow raise", "blink"),
    *("lip pucker", "brow lower", "nose wrinkle", "face width"),
)
# As often negative as positive; the others are expressions.
SIGNED_COMPONENTS = ("face width",)


def mirror_points() -> NDArray[np.intp]:
    """Return the point that mirrors each of the 68 points, in iBUG-68 order."""
    face = get_skeleton("ibug-68")
    mirror = np.arange(N_POINTS)
    mirror[[*face.left, *face.right]] = [*face.right, *face.left]
    return mirror


def neutral_shape() -> NDArray[np.float64]:
    """Return the face at rest, shape (68, 3), in millimetres."""
    return _shapes(["neutral"])[0]


def deformations(n_components: int) -> NDArray[np.float64]:
    """Return the first deformations at full strength, (n_components, 68, 3), mm."""
    return _shapes(COMPONENT_NAMES[:n_components])


def _shapes(names: Sequence[str]) -> NDArray[np.float64]:
    """Return shapes (n, 68, 3) of the table; points that it does not list are zero."""
    columns = [("name", "U20"), ("point", int), ("place", float, 3)]
    with (files("isa_nrsfm.datasets") / "face_model.csv").open() as file:
        table = np.loadtxt(file, delimiter=",", dtype=columns)
    shapes = np.zeros((len(names), N_POINTS, 3))
    for shape, name in zip(shapes, names, strict=True):
        rows = table[table["name"] == name]
        shape[mirror_points()[rows["point"]]] = rows["place"] * (-1.0, 1.0, 1.0)
        shape[rows["point"]] = rows["place"]
    return shapes
