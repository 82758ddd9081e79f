"""The control process: one thread, one bus, one turn per cycle."""
