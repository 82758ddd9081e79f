"""Adaptation: model parameters that drift with wear and temperature follow the load encoder.

`settings` defines the keys of a machine file. `adaptation` is the complete adaptation of one axis, built from
`measuring` (samples to observations), `regressors` (the linear problem), `prior` (the calibration's
covariance), `estimator` and `plausibility`. `sink` connects the axes of a machine to the service, and
`keeping` stores the state.
"""

from hdbridge.daemon.adaptation.settings import AdaptationSettings, Excitation, Mode, Standing

__all__ = ["AdaptationSettings", "Excitation", "Mode", "Standing"]
