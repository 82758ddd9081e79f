"""Parameters that wear and temperature move, followed by the load encoder."""

from hdbridge.daemon.adaptation.settings import AdaptationSettings, Excitation, Mode, Standing

__all__ = ["AdaptationSettings", "Excitation", "Mode", "Standing"]
