"""Fitted models as files for other programs.

Shape models for MATLAB, OpenFace and own code, animated shapes for programs that show
glTF, a page for a browser that lets anybody look at them, and what people measure: head
pose and distances. Shapes are Euclidean ones
as far as the cameras tell them (`isa_nrsfm.calibration`), upright and frontal.
"""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__all__ = [
    "FramePoses",
    "PointDistributionModel",
    "ShapeArrays",
    "frame_poses",
    "point_distances",
    "point_distribution_model",
    "read_pdm",
    "shape_arrays",
    "write_glb",
    "write_pdm",
    "write_shapes",
    "write_viewer",
]

if TYPE_CHECKING:
    from isa_nrsfm.export._gltf import write_glb
    from isa_nrsfm.export._point_distribution import (
        PointDistributionModel,
        point_distribution_model,
        read_pdm,
        write_pdm,
    )
    from isa_nrsfm.export._poses import FramePoses, frame_poses, point_distances
    from isa_nrsfm.export._shape_arrays import ShapeArrays, shape_arrays, write_shapes
    from isa_nrsfm.export._viewer import write_viewer
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.export._gltf": ["write_glb"],
            "isa_nrsfm.export._point_distribution": [
                "PointDistributionModel",
                "point_distribution_model",
                "read_pdm",
                "write_pdm",
            ],
            "isa_nrsfm.export._poses": [
                "FramePoses",
                "frame_poses",
                "point_distances",
            ],
            "isa_nrsfm.export._shape_arrays": [
                "ShapeArrays",
                "shape_arrays",
                "write_shapes",
            ],
            "isa_nrsfm.export._viewer": ["write_viewer"],
        },
    )
