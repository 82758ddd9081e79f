"""The twin: fits the simulated drive to recordings of a real axis, and reports its differences from it.

It imports the models and the simulated drive; neither imports it.
"""
