"""The estimation core of `identify` and `diagnose`: samples, columns, nuisances, noise, least squares."""
