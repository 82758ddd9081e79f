"""The timed loop: one cycle, its clock and priority, the compensation, and the bench that runs procedures."""
