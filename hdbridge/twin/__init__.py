"""Twin of an axis: fits the simulated drive to recordings of a real axis, and reports the differences.

It imports the models and the simulated drive; neither imports it.
"""
