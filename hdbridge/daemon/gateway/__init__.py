"""Gateway: shows each axis on another bus as a CiA-402 drive whose position is the load's, in its own
process.
"""
