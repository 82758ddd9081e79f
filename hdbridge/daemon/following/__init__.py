"""Following: is the model of an axis still valid, and what has drifted? One pass over the loop's samples.

`follower` is the pass: `health` of the load encoder, `measuring` (samples to observations and their linear
problem), then `judging` (verdicts for clients) and `adaptation` (by `estimator`). `statefile` has the files
of an adaptation.
"""
