"""Relate coefficients to labels and people, and compare frames."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__all__ = [
    "AlignedFrames",
    "Association",
    "BetweenShare",
    "WithinGroups",
    "association",
    "between_share",
    "predictability",
]

if TYPE_CHECKING:
    from isa_nrsfm.analysis._aligned_frames import AlignedFrames
    from isa_nrsfm.analysis._association import (
        Association,
        association,
        predictability,
    )
    from isa_nrsfm.analysis._within_groups import (
        BetweenShare,
        WithinGroups,
        between_share,
    )
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.analysis._aligned_frames": ["AlignedFrames"],
            "isa_nrsfm.analysis._association": [
                "Association",
                "association",
                "predictability",
            ],
            "isa_nrsfm.analysis._within_groups": [
                "BetweenShare",
                "WithinGroups",
                "between_share",
            ],
        },
    )
