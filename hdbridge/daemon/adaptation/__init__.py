"""Parameters that wear and temperature move, followed by the load encoder.

`settings` is what a machine file may say; `adaptation` the whole of one axis, made of `measuring` (samples to
observations), `regressors` (the linear problem), `prior` (the calibration's covariance), `estimator` and
`plausibility`; `sink` ties the axes of a machine to the service, and `keeping` writes what survives it.
"""

from hdbridge.daemon.adaptation.settings import AdaptationSettings, Excitation, Mode, Standing

__all__ = ["AdaptationSettings", "Excitation", "Mode", "Standing"]
