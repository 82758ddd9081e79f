"""Published measurements: causes are named and hold on held-out data.

The records are not part of the project (licences; docs/how-well.md names the sources). They are read from the
folder HDBRIDGE_REAL_RECORDS; without it these tests are skipped.
"""

from pathlib import Path

import numpy as np
import pytest
import real_records
from typer.testing import CliRunner

from hdbridge.analysis.diagnosis import diagnose
from hdbridge.analysis.findings import Diagnosis
from hdbridge.analysis.scales import Scales
from hdbridge.axis.effects import Hysteresis
from hdbridge.axis.model import TransmissionModel
from hdbridge.cli import app
from hdbridge.errors import InputError
from hdbridge.records.record import Record, concatenate

NOTHING = TransmissionModel(100.0, ())
"""A ratio without an error, the only prior knowledge of the robot."""
UNLIKELY = {
    "local_defect",
    "count_loss",
    "vibration",
    "backlash",
    "load_order",
    "wear",
    "creep",
    "zero_drift",
}


def measured(name: str) -> list[Path]:
    found = sorted(real_records.FOLDER.glob(name))
    if not found:
        pytest.skip(f"no {name} in the folder HDBRIDGE_REAL_RECORDS")
    return found


@pytest.fixture(scope="module")
def joints() -> dict[int, list[Record]]:
    return {
        joint: [Record.read_csv(each) for each in measured(f"cobot/joint{joint}-*.csv")] for joint in (4, 5)
    }


def names(found: Diagnosis) -> dict[str, tuple[str, ...]]:
    return {each.cause: each.aliases for each in found.findings}


@pytest.mark.parametrize("joint", [4, 5])
def test_a_robot_joint_is_named_and_the_names_predict_the_recording_left_out(joints, joint):
    out, *others = joints[joint]
    found = diagnose(concatenate(others), NOTHING, independent_zeros=True)
    named = names(found)
    assert "motor_encoder_eccentricity" in named["motor_order"]
    orders = next(each for each in found.model.effects if each.name == "motor_order").orders
    if joint == 4:
        assert max(orders, key=lambda each: each.amplitude_arcsec).order == 2
        # A drag that is linear in speed is reported as a delay.
        assert "velocity_windup" in named["channel_skew"]
    else:
        assert "compliance" in named
    assert not set(named) & UNLIKELY
    likely = [each.probability for each in found.findings if each.cause != "unexplained"]
    # Each recording is predicted from the others, so the limit is not that of a single one-way record.
    assert Scales().one_way < max(likely) <= Scales().one_way_repeated
    assert any("reversal" in each for each in found.remarks)
    before, after = (diagnose(out, model).baseline.rms_arcsec for model in (NOTHING, found.model))
    assert after < 0.4 * before


@pytest.mark.parametrize(("joint", "most"), [(4, 1.1), (5, 1.2)])
def test_findings_predict_a_held_out_recording_like_a_regression(joints, joint, most):
    """The goal is a ratio of 1.1 for both joints; joint 5 exceeds it, because its speed term is not accepted
    in four recordings of a second each.
    """
    records = joints[joint]
    after, regression = real_records.left_out(records), real_records.regressed(records)
    assert np.sqrt(np.mean(np.square(after))) < most * np.sqrt(np.mean(np.square(regression)))


@pytest.mark.parametrize("folder", ["cobot", "cobot-command"])
@pytest.mark.parametrize(
    ("joint", "cause", "least_arcsec"), [(4, "channel_skew", 14.0), (5, "compliance", 10.0)]
)
def test_half_the_samples_with_or_without_the_command_name_the_same(folder, joint, cause, least_arcsec):
    whole = [Record.read_csv(each) for each in measured(f"{folder}/joint{joint}-*.csv")]
    halves = [
        Record({name: values[::2] for name, values in each.columns.items()}, each.source) for each in whole
    ]
    found = diagnose(concatenate(halves), NOTHING, independent_zeros=True)
    sizes = {each.cause: each.peak_arcsec for each in found.findings}
    assert "motor_order" in sizes
    assert sizes[cause] > least_arcsec
    assert not set(sizes) & UNLIKELY
    assert found.extended.rms_arcsec < 0.45 * found.baseline.rms_arcsec


def test_different_zeros_are_reported_without_a_cause(joints, tmp_path):
    NOTHING.save(tmp_path / "model.yaml")
    records = [each.source for each in joints[4]]
    command = ["diagnose", *records, "--model", str(tmp_path / "model.yaml")]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert "--independent-zeros" in result.stderr
    found = diagnose(concatenate(joints[4]), NOTHING)
    assert set(names(found)) == {"unexplained"}


def test_a_fit_of_one_fast_move_is_refused(joints: dict[int, list[Record]]) -> None:
    result = CliRunner().invoke(app, ["fit", *(each.source for each in joints[4]), "--ratio", "100"])
    assert isinstance(result.exception, InputError)
    assert "slow sweeps" in str(result.exception)


def test_return_point_memory_predicts_the_dampers_other_motion() -> None:
    (path,) = measured("damper/earthquake.csv")
    predicted = {name: row[1] for name, row in real_records.laws(path.parents[1]).items()}
    assert predicted["hysteresis_memory"] < 0.9 * predicted["hysteresis"]
    force = real_records.damper(path.parents[1], "earthquake")[2]
    assert predicted["hysteresis_memory"] < 0.5 * float(np.std(force))


@pytest.mark.parametrize("name", ["sine", "earthquake"])
def test_return_point_memory_of_the_damper_is_reported_if_visible(name: str) -> None:
    """A sine reverses at varying angles without nested loops, so both laws leave the same residual."""
    (path,) = measured(f"damper/{name}.csv")
    record = real_records.damper_record(path.parents[1], name, 2.0)
    law = Hysteresis(offset_arcsec=95.0, width_deg=32.0, exponent=2.2)
    diagnosis = diagnose(record, TransmissionModel(50.0, (law,)))
    found = names(diagnosis)
    assert "unexplained" in found
    if name == "earthquake":  # a damper obeys neither law, and the residual may outweigh the memory
        considered = {each.split(":")[0] for each in diagnosis.considered}
        assert set(found) <= {"hysteresis_memory", "unexplained"}
        assert "hysteresis_memory" in considered.union(found)
    else:
        assert set(found) <= {"hysteresis_parameters", "unexplained"}
        assert "hysteresis_memory" in found.get("hysteresis_parameters", ("hysteresis_memory",))


@pytest.mark.parametrize("joint", [4, 5])
def test_command_worsens_no_record(joints: dict[int, list[Record]], joint: int) -> None:
    """The recordings end in motion, with the command some degrees ahead of the motor."""
    commanded = [Record.read_csv(each) for each in measured(f"cobot-command/joint{joint}-*.csv")]
    without, with_command = (
        diagnose(concatenate(each), NOTHING, independent_zeros=True) for each in (joints[joint], commanded)
    )
    assert set(names(with_command)) == set(names(without))
    assert with_command.extended.rms_arcsec < 1.02 * without.extended.rms_arcsec
