"""Injects a hidden physical cause into the simulated axis, for a diagnosis to find."""

from support.hidden.hide import CAUSES, UNKNOWN, hide, hide_all
from support.hidden.site import Hidden, Run

__all__ = ["CAUSES", "UNKNOWN", "Hidden", "Run", "hide", "hide_all"]
