"""Simulated axis: plant, encoders, and the bench with a CiA-402 drive (`hdbridge.device`) in front."""
