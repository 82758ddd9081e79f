"""Transmission model: a gear ratio and a sum of effects; its file, its history, its differences."""

from hdbridge.axis.model.transmission import ModelTracker, TransmissionModel

__all__ = ["ModelTracker", "TransmissionModel"]
