import subprocess
import sys

import numpy as np
import pytest

from isa_nrsfm import plotting


@pytest.mark.subprocess
def test_matplotlib_is_imported_only_to_draw():
    code = (
        "import sys, isa_nrsfm.plotting; "
        "sys.exit(any(name.startswith('matplotlib') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    "display",
    [
        plotting.BasisShapeDisplay(mean_shape=np.eye(3), basis=np.ones((1, 3, 3))),
        plotting.ComponentChoiceDisplay(n_components=[1], scores=[[-0.1]]),
        plotting.ModeCovarianceDisplay(mode_covariance=np.eye(3)),
        plotting.ReprojectionDisplay(
            observed=[[[0.0, 0.0], [1.0, 1.0]]], reprojected=[[[0.0, 0.0], [1.0, 1.0]]]
        ),
    ],
    ids=lambda display: type(display).__name__,
)
def test_without_matplotlib_the_extra_is_named(monkeypatch, display):
    for name in [
        name for name in sys.modules if name.partition(".")[0] == "matplotlib"
    ]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"isa-nrsfm\[plot\]"):
        display.plot()


def test_public_names():
    assert plotting.__all__ == [
        "BasisShapeDisplay",
        "CoefficientsDisplay",
        "ComponentChoiceDisplay",
        "ModeCovarianceDisplay",
        "ReprojectionDisplay",
    ]
