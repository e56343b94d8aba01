"""Non-rigid structure from motion by independent subspace analysis."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__version__ = "0.1.0"

if TYPE_CHECKING:
    from isa_nrsfm import (
        analysis as analysis,
        baselines as baselines,
        calibration as calibration,
        cli as cli,
        datasets as datasets,
        export as export,
        io as io,
        isa as isa,
        metrics as metrics,
        plotting as plotting,
        skeletons as skeletons,
    )
    from isa_nrsfm._estimator import AffineNRSfM as AffineNRSfM
    from isa_nrsfm._frames.models import Decomposition as Decomposition
    from isa_nrsfm._selection import (
        AffineNRSfMCV as AffineNRSfMCV,
        AutoNRSfM as AutoNRSfM,
    )
    from isa_nrsfm.analysis import (
        WithinGroups as WithinGroups,
        association as association,
    )
    from isa_nrsfm.analysis._smoothing import (
        SmoothedCoefficients as SmoothedCoefficients,
    )
    from isa_nrsfm.isa import FastISA as FastISA, PooledFastICA as PooledFastICA
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
