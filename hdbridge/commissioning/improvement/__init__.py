"""Improvement: diagnosis, extension and trial of a model on a drive.

    diagnose     a recording, measured by a plan or given, against the active model
    further      the shortest experiment that separates the remaining alternative causes
    extension    the extended model, without unpredictable effects
    trial        stepping with the active and the extended model alternately
    improve      all steps, up to a pending model

Drive and dates are passed in; nothing here depends on whether the drive is simulated.
"""

from hdbridge.commissioning.improvement.extension import extension_of
from hdbridge.commissioning.improvement.further import Choice, choose, unseparated
from hdbridge.commissioning.improvement.improve import Improvement, Source, improve
from hdbridge.commissioning.improvement.trial import Trial

__all__ = ["Choice", "Improvement", "Source", "Trial", "choose", "extension_of", "improve", "unseparated"]
