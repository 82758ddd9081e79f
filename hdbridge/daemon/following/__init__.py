"""Following: is the model of an axis still valid, and what has drifted? One pass over the loop's samples.

`follower` is the pass: `health` of the load encoder, `measuring` (samples to observations and their linear
problem), then `judging` (verdicts for clients) and `adaptation` (by `estimator`). `settings` defines the keys
of a machine file, `statefile` the files of an adaptation.
"""

from hdbridge.daemon.following.settings import AdaptationSettings, Excitation, Mode

__all__ = ["AdaptationSettings", "Excitation", "Mode"]
