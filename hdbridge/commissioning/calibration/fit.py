"""Fits a model to recordings alone, made by hdbridge or by others."""

from hdbridge.analysis.checks import check_once, check_records
from hdbridge.axis import AxisConfig
from hdbridge.axis.model import TransmissionModel
from hdbridge.commissioning.calibration.pipeline import conclude
from hdbridge.commissioning.calibration.result import Calibration
from hdbridge.records.given import Given, agreed_ratio, by_name


def fit(
    recording: Given,
    *,
    ratio: float | None = None,
    axis: AxisConfig | None = None,
    active: TransmissionModel | None = None,
    independent_zeros: bool = False,
) -> Calibration:
    """Fits a model to one or several recordings; ``.model`` is the model, ``.as_dict()`` the document.

    ``ratio`` (motor turns per load turn) is needed if neither the recordings nor ``axis`` state it; with
    ``axis`` the model is bound to it. ``active`` is the model to compare with and to fall back on.
    ``independent_zeros`` means that the encoders lost their zeros between the recordings.

    InputError if a recording cannot be used, belongs to another gear, or does not come from an axis.
    Quantities that the data do not determine are listed in ``.fit.warnings``.
    """
    recordings = by_name(recording)
    said = [("ratio", ratio), (str(axis.path), axis.gear.ratio) if axis else ("axis", None)]
    known = agreed_ratio(recordings, said)
    check_once(list(recordings), [each.record for each in recordings.values()])
    check_records({name: each.record for name, each in recordings.items()}, known)
    if active and axis:
        active.check_ratio(axis)
    return conclude(recordings, known, active, axis=axis, independent_zeros=independent_zeros)
