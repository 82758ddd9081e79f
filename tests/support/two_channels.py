"""Load torque and temperature channels: lines for an axis file; functions that stop and resume the TPDO."""

CHANNELS = """
load_torque:
  source: {index: 0x2101, type: int32}
  newton_metres_per_count: 0.001
  maximum_nm: 100
temperature:
  source: {index: 0x2100, type: int16}
  celsius_per_count: 0.1
"""
TPDO3 = 0x381
OFF = 0x8000_0000


def stops(node):
    """Stops the TPDO that carries both channels."""
    node.dictionary[0x1802, 1].put(TPDO3 | OFF)


def resumes(node):
    """Resumes the TPDO that carries both channels."""
    node.dictionary[0x1802, 1].put(TPDO3)
