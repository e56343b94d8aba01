"""
Write a shape model and an interactive page
===========================================

Trackers such as OpenFace fit a *point distribution model* to images: a mean shape,
principal axes of the 3D shapes, and their variances. This example estimates such a
model from a table of landmarks, and writes an interactive page of the shapes.
"""

# sphinx_gallery_thumbnail_number = 1
import html
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import (
    point_distribution_model,
    read_pdm,
    write_glb,
    write_pdm,
    write_viewer,
)
from isa_nrsfm.plotting import BasisShapeDisplay

faces = make_face_tracks(n_frames=300, random_state=0)
model = AffineNRSfM(4, random_state=0).fit(faces.data)

# %%
# The modes are not the independent basis shapes. They are the principal axes of the
# aligned Euclidean shapes of the frames: orthogonal, with uncorrelated scores,
# strongest first.

pdm = point_distribution_model(model)
print("mean", pdm.mean.shape, "modes", pdm.modes.shape)
print("standard deviations", np.sqrt(pdm.eigenvalues).round(3))

# %%
# Images do not determine the unit of length. Here it is determined by one known
# distance, that of the outer eye corners in millimetres.

known = np.linalg.norm(faces.neutral_shape[36] - faces.neutral_shape[45])
pdm = pdm.scaled(known / np.linalg.norm(pdm.mean[36] - pdm.mean[45]))
print(f"width of the mean face {np.ptp(pdm.mean[:, 0]):.1f} mm, ", end="")
print(f"in truth {np.ptp(faces.mean_shape[:, 0]):.1f} mm")

display = BasisShapeDisplay(
    mean_shape=pdm.mean,
    basis=pdm.modes * np.sqrt(pdm.eigenvalues)[:, None, None],
    energy_share=pdm.eigenvalues / pdm.eigenvalues.sum(),
    component_names=[f"Mode {k + 1}" for k in range(4)],
)
display.plot(n_columns=2)

# %%
# The files
# ---------
#
# OpenFace reads ``pdm.txt`` as the shape model of a landmark detector. In glTF files
# (``.glb``), which 3D programs open, each basis shape is a morph target. The page has a
# slider for each basis shape. On the command line, use ``isa-nrsfm export model.npz
# --output pdm.txt``, ``face.glb`` or ``viewer.html``.

correlation = np.abs(np.corrcoef(faces.alpha.T, model.alpha_.T)[:4, 4:])
names = [faces.component_names[k] for k in correlation.argmax(axis=0)]
with TemporaryDirectory() as folder:
    write_pdm(pdm, Path(folder, "pdm.txt"))
    write_glb(model, Path(folder, "face.glb"), names=names)
    write_viewer(model, Path(folder, "viewer.html"), labels=faces.labels, names=names)
    for path in sorted(Path(folder).iterdir()):
        print(f"{path.name:12} {path.stat().st_size / 1000:.0f} kB")
    again = read_pdm(Path(folder, "pdm.txt"))
    page = Path(folder, "viewer.html").read_text(encoding="utf-8")
print("the same model again:", np.allclose(again.modes, pdm.modes))

# %%
# The page, embedded in this one. Drag to rotate the face.


class Framed:
    """A page in a frame of a notebook or of this documentation."""

    def _repr_html_(self):
        style = "width: 100%; height: 44rem; border: 1px solid #8888"
        return f'<iframe style="{style}" srcdoc="{html.escape(page)}"></iframe>'


Framed()
