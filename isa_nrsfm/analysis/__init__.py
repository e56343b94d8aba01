"""Relate coefficients to labels, people and time, and compare frames."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.analysis._association import (
        Association as Association,
        association as association,
        predictability as predictability,
    )
    from isa_nrsfm.analysis._within_groups import (
        AlignedFrames as AlignedFrames,
        BetweenShare as BetweenShare,
        WithinGroups as WithinGroups,
        between_share as between_share,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
