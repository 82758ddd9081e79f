"""From records to what they say: a model with its uncertainty, or how a model differs and why.

`identify.fit` identifies a model from a measurement. `diagnosis.diagnose` compares a model with records and
names what it lacks. Both take one prepared record (`prepared`), in which cuts, angles, reversals, noise and
channels are worked out once. Pure: no files, no clock.
"""
