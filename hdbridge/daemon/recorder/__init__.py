"""Flight recorder: a ring of MCAP files on disk."""
