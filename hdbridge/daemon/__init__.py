"""The daemon: holds the drives of one bus, day and night. See docs/architecture.md."""
