"""Twin of an axis: fits the simulated drive to recordings of a real axis, and reports the differences.

This package imports the models and the simulated drive; neither of them imports this package.
"""
