"""Summary of a fitted model in notebooks, below scikit-learn's diagram."""

import html
import math
from typing import Any

import numpy as np

from isa_nrsfm.analysis._diagnostics import camera_meaning


def summary_html(model: Any) -> str:
    """Return the key figures of a fitted model as an HTML table."""
    rows = "".join(
        f'<tr><th scope="row" style="text-align: left">{html.escape(name)}</th>'
        f'<td style="text-align: left">{html.escape(value)}</td></tr>'
        for name, value in _lines(model).items()
    )
    return f'<table class="isa-nrsfm-summary"><tbody>{rows}</tbody></table>'


def _lines(model: Any) -> dict[str, str]:
    """Return the names and values of the key figures."""
    n_components, n_points, _ = model.basis_.shape
    lines = {"Shapes": f"{n_components} basis shapes of {n_points} points"}
    if hasattr(model, "motion_"):
        fitted = np.isfinite(model._frame_sizes)
        without = f", {(~fitted).sum()} rows without points" * (not fitted.all())
        lines["Frames"] = f"{fitted.sum()}{without}"
    camera = model.camera_.replace("_", " ")
    ratio = getattr(model, "camera_noise_ratio_", None)
    meaning = "" if ratio is None else f"; {camera_meaning(ratio)}"
    lines["Cameras"] = f"{camera}{meaning}"
    floor = _percent(model.rank_floor_)
    lines["Inverse SNR"] = f"{_percent(model.inverse_snr_)}, rank floor {floor}"
    if hasattr(model, "noise_variance_"):
        noise = math.sqrt(model.noise_variance_)
        lines["Noise"] = (
            f"{_percent(noise)} of a frame's size"
            if model.frames_scaled_
            else f"{noise:.3g} in the units of the table"
        )
    shares = [_percent(share) for share in model.energy_share_]
    more = ["..."] * (len(shares) > 12)
    lines["Energy of each"] = ", ".join(shares[:12] + more)
    if "Noise" in lines and "Frames" in lines:
        messages = model.diagnostics().messages
        lines["Diagnostics"] = "; ".join(messages) or "no warning"
    return lines


def _percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100 * share:.3g} %"
