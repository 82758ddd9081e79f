"""hdbridge: a CANopen CiA-402 master that makes a harmonic-drive axis point where it is told."""

__version__ = "0.1.0"
