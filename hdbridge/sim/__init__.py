"""The simulated drive: plant, firmware, CANopen node."""
