"""CiA-402 over CANopen: states, objects, PDOs, boot-up, supervision."""
