"""Fitted models as files for other programs.

Shape models for MATLAB, OpenFace and other code, animated shapes in glTF, a page that
shows them in any browser, points in space with deviations, head poses and distances.
Shapes are Euclidean if the cameras determine them (`isa_nrsfm.calibration`), upright
and frontal.
"""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.export._shape_files import (
        FramePoints as FramePoints,
        PointDistributionModel as PointDistributionModel,
        ShapeArrays as ShapeArrays,
        frame_points as frame_points,
        point_distribution_model as point_distribution_model,
        read_pdm as read_pdm,
        shape_arrays as shape_arrays,
        write_pdm as write_pdm,
        write_points as write_points,
        write_shapes as write_shapes,
    )
    from isa_nrsfm.export._upright import (
        FramePoses as FramePoses,
        frame_poses as frame_poses,
        point_distances as point_distances,
        pose_function as pose_function,
    )
    from isa_nrsfm.export._viewer import (
        write_glb as write_glb,
        write_viewer as write_viewer,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
