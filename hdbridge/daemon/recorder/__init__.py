"""The flight recorder: MCAP files in a ring on disk."""
