"""Non-rigid structure from motion by independent subspace analysis."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__version__ = "0.1.0"

__all__ = [
    "AffineNRSfM",
    "AffineNRSfMCV",
    "Decomposition",
    "FastISA",
    "PooledFastICA",
    "SmoothedCoefficients",
    "WithinGroups",
    "__version__",
    "association",
]

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
    from isa_nrsfm._estimator import AffineNRSfM
    from isa_nrsfm._frames.models import Decomposition
    from isa_nrsfm._selection.estimator import AffineNRSfMCV
    from isa_nrsfm._transformer import SmoothedCoefficients
    from isa_nrsfm.analysis import WithinGroups, association
    from isa_nrsfm.isa import FastISA, PooledFastICA
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "isa_nrsfm._estimator": ["AffineNRSfM"],
            "isa_nrsfm._selection.estimator": ["AffineNRSfMCV"],
            "isa_nrsfm._frames.models": ["Decomposition"],
            "isa_nrsfm._transformer": ["SmoothedCoefficients"],
            "isa_nrsfm.analysis": ["WithinGroups", "association"],
            "isa_nrsfm.isa": ["FastISA", "PooledFastICA"],
        },
        subpackages=[
            "analysis",
            "baselines",
            "calibration",
            "cli",
            "datasets",
            "export",
            "io",
            "isa",
            "metrics",
            "plotting",
            "skeletons",
        ],
    )
