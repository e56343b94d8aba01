"""Print the inverse SNR of fits over many seeds, and what the choices change.

Run ``python -m benchmarks.accuracy [n_seeds]``.
"""

import sys
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning

from benchmarks._data import CASES, load_table
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._block_structure import BLOCK_RECOVERIES

VARIANTS = {
    "PooledFastICA": {},
    "FastISA": {"isa": FastISA()},
    **{
        f"no refinement, {name}": {"block_recovery": name, "refinement": None}
        for name in BLOCK_RECOVERIES
    },
}


def main(n_seeds):
    """Print a table for each data set."""
    for case in CASES:
        X = load_table(case)
        if X is None:
            continue
        print(f"\n{case.title}: inverse SNR in percent over {n_seeds} seeds")
        print(f"{'':36}{'min':>9}{'median':>9}{'max':>9}")
        for title, parameters in VARIANTS.items():
            models = [
                AffineNRSfM(
                    case.n_components,
                    scale_frames=case.scale_frames,
                    random_state=seed,
                    **parameters,
                ).fit(X)
                for seed in range(n_seeds)
            ]
            values = [100 * model.inverse_snr_ for model in models]
            least, median, most = np.percentile(values, [0, 50, 100])
            print(f"{title:36}{least:9.4f}{median:9.4f}{most:9.4f}")
        print(f"{'rank floor':36}{100 * models[0].rank_floor_:9.4f}")


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
