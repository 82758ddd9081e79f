"""The daemon, which controls the drives of one bus permanently. See docs/architecture.md."""
