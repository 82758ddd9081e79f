"""The gateway: a CiA-402 drive on another bus whose position is the load's, in a process of its own."""
