"""What coefficients say of labels, of people, and of differences between frames."""

from isa_nrsfm.analysis._aligned_frames import AlignedFrames
from isa_nrsfm.analysis._association import Association, association, predictability
from isa_nrsfm.analysis._within_groups import WithinGroups, between_share

__all__ = [
    "AlignedFrames",
    "Association",
    "WithinGroups",
    "association",
    "between_share",
    "predictability",
]
