"""From affine to Euclidean space: metric upgrade of cameras and shapes, upright poses.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of space,
so its lengths and angles have no meaning. If the cameras are known to be orthographic
or scaled orthographic (weak perspective), the space can be upgraded to true angles and
proportions. This holds for square pixels and objects that are small compared with their
distance. ``AffineNRSfM(camera="weak_perspective")`` and ``"orthographic"`` fit such
cameras, and their shapes need no upgrade. For affine cameras, and for cameras of other
programs:

- `metric_upgrade` finds the affinity from the cameras, `euclidean_shapes` applies it;
- `deformation_metric` and `euclidean_frames` do the same for shapes that deform. They
  also recover the part of the deformation that affine cameras absorb;
- `orthonormal_cameras` finds orthographic cameras directly in the motion factor of a
  deforming shape, as mixtures of its columns;
- `canonical_pose` turns a shape upright and frontal, and `view_angles` returns yaw,
  pitch and roll of each frame.

In the image x points right and y points down; in space z points away from the camera,
so that ``R`` with rows x, y and z is a rotation. The unit of length, the coordinate
axes and the sign of the depth remain unknown: the mirror image, ``z -> -z``, has the
same images.
"""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.calibration._canonical_pose import (
        CanonicalPose as CanonicalPose,
        ViewAngles as ViewAngles,
        angle_deviations as angle_deviations,
        canonical_pose as canonical_pose,
        view_angles as view_angles,
    )
    from isa_nrsfm.calibration._metric_upgrade import (
        DeformationMetric as DeformationMetric,
        EuclideanFrames as EuclideanFrames,
        MetricUpgrade as MetricUpgrade,
        deformation_metric as deformation_metric,
        euclidean_frames as euclidean_frames,
        euclidean_shapes as euclidean_shapes,
        metric_upgrade as metric_upgrade,
    )
    from isa_nrsfm.calibration._orthonormal_cameras import (
        OrthonormalCameras as OrthonormalCameras,
        orthonormal_cameras as orthonormal_cameras,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
