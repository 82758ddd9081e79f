"""Calibration: from a bare axis to a model that can be trusted, reviewed and undone.

    measure      a plan is run on a bench, without compensation, into a folder that grows (`Journal`)
    identify     the recording, or anybody's, becomes a `FitResult`
    validate     the stepping test with the model before and with the new one
    propose      the model becomes the profile's pending one, if it is better on data that it has not seen

`calibrate` does all four. Bench and drive come in; nothing here knows whether they are simulated.
"""

from hdbridge.calibration.fit import fit
from hdbridge.calibration.identification import identify, measured_of
from hdbridge.calibration.journal import Journal
from hdbridge.calibration.measure import measure, start_journal
from hdbridge.calibration.pipeline import calibrate, conclude, concluded
from hdbridge.calibration.result import Calibration, Offer, Stepped
from hdbridge.calibration.validation import Validation, validate

__all__ = [
    "Calibration",
    "Journal",
    "Offer",
    "Stepped",
    "Validation",
    "calibrate",
    "conclude",
    "concluded",
    "fit",
    "identify",
    "measure",
    "measured_of",
    "start_journal",
    "validate",
]
