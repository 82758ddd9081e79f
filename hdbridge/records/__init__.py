"""Measured time series of one axis: records, recordings with segments, and records of other programs."""
