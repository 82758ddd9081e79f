"""Analysis of records: identification of a model, and diagnosis of a model against records.

`identify.fit` identifies a model from a measurement. `diagnosis.diagnose` compares a model with records and
names the causes of the difference. Both use one prepared record (`prepared`), in which cuts, angles,
reversals, noise and channels are determined once. Pure: no files, no clock.
"""
