"""Article's axis with raised limits, at which the servo attenuates the correction; measured response."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.axis.model.response import Response
from hdbridge.commissioning.calibration.motion import motion_test
from support.exercised import booted

ARTICLE = Path(__file__).resolve().parents[2] / "profiles" / "article"
RAISED = {
    "velocity_deg_s": "130",
    "acceleration_deg_s2": "300",
    "following_error_deg": "90.0",
    "position_min_deg": "-1500",
    "position_max_deg": "1500",
    "maximum_arcsec": "600",
    "slew_arcsec_s": "100000",
}
REMOVED = {
    "counts_per_turn: 2880000": "counts_per_turn: 400000",
    "{index: 0x60E4, subindex: 1": "{index: 0x6064, subindex: 0",
}
"""Edits of the axis file that make the motor encoder, at 50 motor turns per load turn, the load encoder."""


def raised_axis() -> str:
    """Returns the text of the article's axis file with raised limits."""
    text = (ARTICLE / "axis.yaml").read_text(encoding="utf-8")
    for key, value in RAISED.items():
        text, found = re.subn(rf"(?m)^(  {key}: )[-\d.]+", rf"\g<1>{value}", text)
        assert found == 1, key
    return text


def raised_profile(folder: Path) -> Path:
    """Copies the article's profile to a new folder, with raised limits."""
    shutil.copytree(ARTICLE, folder)
    (folder / "axis.yaml").write_text(raised_axis(), encoding="utf-8")
    return folder


def without_load_encoder(folder: Path) -> Path:
    """Removes the load encoder from a profile: the motor encoder replaces it."""
    text = (folder / "axis.yaml").read_text(encoding="utf-8")
    for old, new in REMOVED.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "axis.yaml").write_text(text, encoding="utf-8")
    return folder


_measured: dict[tuple[bytes, ...], Response] = {}
"""Cached responses by the content of their profiles, because measuring one takes 6 s of CPU time."""


def measured_response(profile: Path) -> Response:
    """Measures the response of the profile's axis by the motion test."""
    content = tuple((profile / name).read_bytes() for name in ("axis.yaml", "model.yaml", "truth.yaml"))
    if content not in _measured:
        _measured[content] = _measure(profile)
    return _measured[content]


def _measure(profile: Path) -> Response:
    axis = AxisConfig.load(profile)
    with booted(axis, profile / "truth.yaml") as (drive, _):
        response = motion_test(drive, TransmissionModel.load(profile / "model.yaml")).response
    assert response is not None
    return response


def measured_profile(folder: Path) -> Path:
    """Creates a profile with raised limits whose model contains the measured response."""
    profile = raised_profile(folder)
    model = TransmissionModel.load(profile / "model.yaml")
    replace(model, response=measured_response(profile)).save(profile / "model.yaml")
    return profile


def ripple_arcsec(samples: np.ndarray, speed_deg_s: float) -> float:
    """Returns the rms of the load error about a straight line while the target moves at this speed.

    ``samples`` are those of one axis from the daemon's ring.
    """
    even = np.flatnonzero(abs(samples["velocity_deg_s"] - speed_deg_s) < 1e-3 * abs(speed_deg_s))
    even = even[len(even) // 3 :]  # without the transient of the ramp
    assert len(even) > 100
    error = 3600.0 * (samples["load_position_deg"] - samples["load_target_deg"])[even]
    line = np.linspace(-1.0, 1.0, len(error))
    return float(np.std(error - np.polyval(np.polyfit(line, error, 1), line)))
