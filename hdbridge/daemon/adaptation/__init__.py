"""Parameters that wear and temperature move, followed by the load encoder."""
