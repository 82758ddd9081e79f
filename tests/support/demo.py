"""The demo axis: its axis file and its truth."""

from pathlib import Path

from hdbridge.axis import AxisConfig
from hdbridge.sim.truth import Truth

DEMO = Path(__file__).parents[2] / "profiles" / "demo"
AXIS, TRUTH = AxisConfig.load(DEMO), Truth.load(DEMO)
