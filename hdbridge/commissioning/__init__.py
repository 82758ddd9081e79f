"""Workflows of an engineer: bring-up, calibration, improvement, and evaluation of tests."""
