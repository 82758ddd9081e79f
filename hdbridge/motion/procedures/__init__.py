"""Measurement procedures of a bench, as pure generators."""
