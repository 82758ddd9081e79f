"""Daemon that permanently controls the drives of one bus. See docs/architecture.md."""
