"""Following: tests whether an axis's model is still valid, and estimates its drift, in one pass over the
samples.

`follower` runs the pass: `health` of the load encoder, `measuring` (samples to observations and their linear
problem), `zero` (motion of the encoders' zero), then `judging` (verdicts for clients) and `adaptation` (by
`estimator`). `statefile` has the files of an adaptation.
"""
