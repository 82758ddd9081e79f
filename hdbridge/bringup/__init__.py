"""Bring-up of an axis: what answers on the bus, and whether it is and does what the axis file says."""
