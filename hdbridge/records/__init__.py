"""Measured time series of one axis: records, recordings with their segments, records of other benches."""
