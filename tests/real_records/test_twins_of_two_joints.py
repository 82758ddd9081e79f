"""Agreement of a simulated drive with two published robot joints.

The records are looked for as in `test_measured_records.py`; without them these tests are skipped.
"""

import pytest
import real_records

from hdbridge.records.recording import Recording
from hdbridge.twin.translate import translate


def recordings_of(joint: int) -> list[Recording]:
    found = real_records.joint_recordings(real_records.FOLDER, joint)
    if not found:
        pytest.skip(f"no cobot-command/joint{joint}-*.csv in the folder HDBRIDGE_REAL_RECORDS")
    return found


@pytest.mark.parametrize("joint", [4, 5])
def test_typical_values_do_not_match_a_robot_joint(joint: int) -> None:
    """Its drive lags the command by 8 ms; a typical one follows within two or three."""
    truth = translate(real_records.joint_axis()).truth
    for recording in recordings_of(joint):
        row = real_records.held_against(recording, truth).row("following_error")
        assert row is not None
        assert row.measured > 5.0, "motor degrees"
        assert row.simulated < 0.4 * row.measured


@pytest.mark.slow
def test_a_twin_of_three_recordings_predicts_the_fourth() -> None:
    twin, compared = real_records.twin_of_others(recordings_of(4), 0)
    assert twin.findings == (), "its following error remains, so no value is that of the axis"
    for signal, share in (("load_error", 0.5), ("following_error", 0.5), ("motor_torque", 0.3)):
        usual, now = compared["usual values"].row(signal), compared["twin"].row(signal)
        assert usual is not None
        assert now is not None
        assert now.difference < share * usual.difference
