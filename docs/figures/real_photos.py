"""Fit the landmarks of 3755 photos and draw what the fit tells about them.

Usage: ``python docs/figures/real_photos.py [DATA_HOME]``. Without the folder DATA_HOME,
the file is downloaded (4.2 MB).
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import between_share
from isa_nrsfm.datasets import fetch_muct
from isa_nrsfm.export import frame_poses
from isa_nrsfm.skeletons import get_skeleton

faces = fetch_muct(data_home=sys.argv[1] if len(sys.argv) > 1 else None)
inner = get_skeleton("xm2vts-68").inner_columns  # without the jaw
tables = {"all points": faces.data, "without the jaw": faces.data[:, inner]}
models = {
    name: AffineNRSfM(6, independence="coefficients", random_state=0).fit(table)
    for name, table in tables.items()
}
model = models["without the jaw"]

plt.rcParams["font.size"] = 11
figure = plt.figure(figsize=(10, 6.5), layout="constrained")
top, bottom = figure.subfigures(2, 1, height_ratios=(2, 3))
camera_a = np.nanmean(model.motion_[faces.camera == "a"], axis=0)
edges = get_skeleton("xm2vts-53").edges
for k, axis in enumerate(top.subplots(1, 4)):
    for amount, colour in [(-2, "tab:blue"), (0, "0.6"), (2, "tab:orange")]:
        shape = model.mean_shape_ + amount * model.basis_[k]
        lines = (shape @ camera_a.T)[edges].transpose(2, 1, 0)
        axis.plot(*lines, color=colour, linewidth=1.2)
    axis.set(title=f"Coefficient {k + 1}", aspect="equal")
    axis.invert_yaxis()
    axis.set_axis_off()

pose, jaw, subjects = bottom.subplots(1, 3)
angles = frame_poses(model, tables["without the jaw"])
for camera in "abcde":
    of_camera = faces.camera == camera
    yaw, pitch = angles.yaw[of_camera], angles.pitch[of_camera]
    pose.scatter(yaw, pitch, s=2, label=camera)
    print(
        f"camera {camera}: median yaw {np.nanmedian(yaw):.0f}, "
        f"pitch {np.nanmedian(pitch):.0f} degrees"
    )
pose.set(title="Pose by camera", xlabel="yaw, degrees", ylabel="pitch, degrees")
pose.legend(markerscale=4)

places = np.arange(1, 7)
for k, (name, table) in enumerate(tables.items()):
    share = models[name].diagnostics(table).pose_share
    jaw.bar(places + 0.4 * k - 0.2, share, width=0.4, label=name)
    print(f"share that the pose predicts, {name}: {np.round(share, 2)}")
jaw.set(title="Share that the pose predicts", xlabel="coefficient", ylim=(0, 1))
jaw.legend()

between = between_share(model.alpha_, faces.subjects).between
subjects.bar(places, between)
subjects.set(title="Share between people", xlabel="coefficient", ylim=(0, 1))
print(f"share between people: {np.round(between, 2)}")
figure.savefig(Path(__file__).with_suffix(".png"), dpi=90)
