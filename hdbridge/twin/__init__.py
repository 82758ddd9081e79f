"""The twin: the simulated drive learns a real axis from recordings, and says what it gets wrong.

Above both sides: it knows the models and the simulated drive, and neither knows it.
"""
