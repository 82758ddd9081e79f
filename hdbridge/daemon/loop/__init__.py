"""The control process: one thread, one bus, and one iteration of the loop per cycle."""
