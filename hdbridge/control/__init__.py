"""Timed control loop: bus cycle, clock and priority, compensation, and the bench for procedures."""
