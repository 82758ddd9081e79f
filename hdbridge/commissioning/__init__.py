"""The paths an engineer takes: bring-up, calibration, improvement, and the figures of a test."""
