"""Set-points of one axis in each control period: moves, jogs, streams and stops within the limits. Pure."""

from hdbridge.motion.coordinated import CoordinatedPlan, coordinated
from hdbridge.motion.modes import MotionMode
from hdbridge.motion.setpoint import SetPoint

__all__ = ["CoordinatedPlan", "MotionMode", "SetPoint", "coordinated"]
