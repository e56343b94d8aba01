"""Relate coefficients to labels, people and time, and compare frames."""

from isa_nrsfm.analysis._aligned_frames import AlignedFrames
from isa_nrsfm.analysis._association import Association, association, predictability
from isa_nrsfm.analysis._within_groups import BetweenShare, WithinGroups, between_share

__all__ = [
    "AlignedFrames",
    "Association",
    "BetweenShare",
    "WithinGroups",
    "association",
    "between_share",
    "predictability",
]
