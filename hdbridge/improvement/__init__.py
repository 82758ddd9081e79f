"""Improvement: closing the loop on a drive.

    diagnose     a recording, measured by a plan or given, against the active model
    further      what is left open: the shortest experiment of the machine that distinguishes it
    extension    the extended model, without what cannot be told in advance
    trial        stepping with the active and with the extended model, in turns
    improve      all of it, to a pending model

Drive and dates come in; nothing here knows whether the drive is simulated.
"""

from hdbridge.improvement.extension import Extension, extension_of
from hdbridge.improvement.further import Choice, choose, untold
from hdbridge.improvement.improve import Source, improve
from hdbridge.improvement.result import Improvement, Round
from hdbridge.improvement.trial import Trial, try_out

__all__ = [
    "Choice",
    "Extension",
    "Improvement",
    "Round",
    "Source",
    "Trial",
    "choose",
    "extension_of",
    "improve",
    "try_out",
    "untold",
]
