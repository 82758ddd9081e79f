"""Set-points of one axis, period by period: moves, jogs, streams and stops within the limits. Pure."""
