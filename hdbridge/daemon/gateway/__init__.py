"""Gateway, in its own process: a CiA-402 drive on another bus whose position is that of the load."""
