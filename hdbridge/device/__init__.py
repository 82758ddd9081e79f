"""A CiA-402 drive on a CAN bus, seen from the drive: CANopen node, firmware, modes, without a plant."""
