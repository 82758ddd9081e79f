"""Measured time series of one axis: records, recordings with what moved how, records of other benches."""
