"""Transmission model (a gear ratio and a sum of effects), its file, history and comparison."""

from hdbridge.axis.model.transmission import TransmissionModel

__all__ = ["TransmissionModel"]
