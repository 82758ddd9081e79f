"""Calibration: measures an axis, fits a model, tests it, and offers it for commit.

    measure      runs a plan on a bench, without compensation, into a growing recording folder (`Journal`)
    identify     fits a model to this or any other recording (`FitResult`)
    validate     runs the stepping test with the old model and with the new one
    propose      makes the model the profile's pending one if it is better on unseen data

`calibrate` does all four. Bench and drive are passed in, real or simulated.
"""

from hdbridge.commissioning.calibration.identification import identify, measured_of
from hdbridge.commissioning.calibration.journal import Journal
from hdbridge.commissioning.calibration.measure import Callbacks, measure
from hdbridge.commissioning.calibration.pipeline import Calibration, Offer, calibrate, concluded, fit
from hdbridge.commissioning.calibration.validation import Validation, validate

__all__ = [
    "Calibration",
    "Callbacks",
    "Journal",
    "Offer",
    "Validation",
    "calibrate",
    "concluded",
    "fit",
    "identify",
    "measure",
    "measured_of",
    "validate",
]
