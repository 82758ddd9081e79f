"""Look-alikes are so in both directions."""

from hdbridge.axis.effects import CATALOGUE, aliases_of


def test_look_alikes_are_symmetric():
    for name in CATALOGUE:
        assert name not in aliases_of(name)
        for other in aliases_of(name):
            assert name in aliases_of(other)


def test_the_classic_pairs_are_listed():
    for one, other in [
        ("load_order", "compliance"), ("velocity_windup", "channel_skew"), ("ratio_error", "wear"),
        ("motor_order", "motor_encoder_eccentricity"), ("zero_drift", "count_loss"),
        ("backlash", "hysteresis"),
        ("load_order", "ratio_error"), ("torque_modulation", "amplitude_drift"),
    ]:  # fmt: skip
        assert other in aliases_of(one)
