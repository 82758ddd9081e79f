"""A measurement of a bench is passed directly to a file, a fit and a diagnosis, which check it."""

import numpy as np
import pytest

from hdbridge import (
    AxisConfig,
    Bench,
    Compensation,
    InputError,
    Record,
    Recording,
    TransmissionModel,
    diagnose,
    fit,
    simulated,
)
from hdbridge.control.compensation import CompensationLimits
from hdbridge.control.switchover import Correction
from hdbridge.sim.truth import Truth
from hdbridge.twin.misfit import prepare


@pytest.fixture(scope="module")
def fitted(run):
    return fit(run)


def changed(record, **columns):
    return Record({**record.columns, **columns})


def spoilt_at(record, sample, **values):
    columns = {name: record.columns[name].copy() for name in values}
    for name, value in values.items():
        columns[name][sample] = value
    return changed(record, **columns)


def test_a_run_is_a_recording_with_its_legs(run, axis, tmp_path):
    run.save(tmp_path / "kept")
    kept = Recording.load(tmp_path / "kept")
    assert kept.record == run.record
    assert kept.segments == run.segments
    assert {each.kind for each in kept.segments} == {"move", "sweep", "sine"}
    assert (kept.axis, kept.ratio) == (axis.name, axis.gear.ratio)
    assert kept.drive.vendor_id == axis.drive.identity.vendor_id
    assert "hdbridge" in kept.versions


def test_a_fit_of_a_run_is_the_model_and_the_document_of_the_command(fitted, run):
    document = fitted.as_dict()
    assert document["schema"] == "hdbridge.calibration/1"
    assert document["axis"] == run.axis
    assert {each.name for each in fitted.model.effects} == {"synchronous", "hysteresis"}


def test_a_diagnosis_of_a_run_is_the_document_of_the_command(run, fitted):
    document = diagnose(run, fitted.model).as_dict()
    assert document["schema"] == "hdbridge.diagnosis/1"
    assert "motor angle" in document["seen_over"]


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda record: changed(record, time_s=np.zeros(len(record))), "expected increasing times"),
        (lambda record: changed(record, load_position_deg=np.radians(record.load_position_deg)), "radians"),
        (lambda record: changed(record, motor_position_deg=np.zeros(len(record))), "never moves"),
        (
            lambda record: changed(record, load_position_deg=(record.load_position_deg - 5) % 360),
            "multi-turn",
        ),
        (lambda record: spoilt_at(record, 7, time_s=-1.0), "sample 7: time_s: .* do not decrease"),
        *(
            (
                lambda record, name=name, value=value: spoilt_at(record, 7, **{name: value}),
                f"sample 7: {name}",
            )
            for name in ("motor_position_deg", "load_position_deg", "motor_target_deg")
            for value in (np.nan, -np.inf, 1e300)
        ),
    ],
)
def test_impossible_records_are_refused_by_both(run, model, axis, spoil, complaint):
    spoilt = spoil(run.record)
    with pytest.raises(InputError, match=complaint):
        fit(spoilt, axis=axis)
    with pytest.raises(InputError, match=complaint):
        diagnose(spoilt if "never" in complaint or "sample" in complaint else [run, spoilt], model)


def test_another_gear_is_refused(run):
    with pytest.raises(InputError, match="ratio: a ratio of 100, but recording 1 has 50"):
        fit(run, ratio=100)
    with pytest.raises(InputError, match="the model: a ratio of 100, but recording 1 has 50"):
        diagnose(run, TransmissionModel(100.0))


def test_a_file_of_another_gear_is_named(run, axis, tmp_path):
    """By every function that takes a ratio from a file: a model, or an axis file."""
    wrong = tmp_path / "old gear.yaml"
    TransmissionModel(100.0).save(wrong)
    model = TransmissionModel.load(wrong)
    text = axis.path.read_text().replace("ratio: 50", "ratio: 100")
    (tmp_path / "axis.yaml").write_text("\n".join(each for each in text.splitlines() if "teeth:" not in each))
    bare, other = Recording(run.record), AxisConfig.load(tmp_path)
    with pytest.raises(InputError, match=r"expected a ratio of 100, stated by .*old gear\.yaml"):
        diagnose(bare, model)
    with pytest.raises(InputError, match=r"old gear\.yaml: a ratio of 100, but recording 1 has 50"):
        diagnose(run, model)
    with pytest.raises(InputError, match=r"expected a ratio of 100, stated by .*axis\.yaml"):
        fit(bare, axis=other)
    with pytest.raises(InputError, match=r"expected a ratio of 100, stated by .*axis\.yaml"):
        prepare(bare, other, Truth.load(axis.path.parent / "truth.yaml"))
    limits = CompensationLimits(300.0, 1000.0)
    in_use = Correction(Compensation(TransmissionModel(50.0), limits, axis.drive.cycle_s))
    with pytest.raises(InputError, match=r"old gear\.yaml: "):
        in_use.change(Compensation(model, limits, axis.drive.cycle_s))
    with simulated(axis) as drive, pytest.raises(InputError, match=r"old gear\.yaml: "):
        Bench(drive, model)


@pytest.mark.parametrize("ratio", [0.0, -50.0, np.nan, np.inf])
def test_an_impossible_ratio_is_refused(run, ratio):
    with pytest.raises(InputError, match=r"ratio: a ratio of .*; expected a number above 0"):
        fit(run.record, ratio=ratio)


def test_a_bare_record_needs_a_ratio(run):
    with pytest.raises(InputError, match="the ratio of the gear is unknown"):
        fit(run.record)


def test_no_recording_is_refused(model):
    with pytest.raises(InputError, match="no recording"):
        diagnose([], model)


def test_a_simulated_axis_without_a_truth_is_refused(axis, tmp_path):
    (tmp_path / "axis.yaml").write_text(axis.path.read_text())
    with pytest.raises(InputError, match=r"truth\.yaml"), simulated(AxisConfig.load(tmp_path)):
        pass


def test_a_recording_that_is_given_twice_is_refused(run, model):
    with pytest.raises(InputError, match="holds the same samples as recording 1"):
        diagnose([run, run], model)
    with pytest.raises(InputError, match="holds the same samples as recording 1"):
        fit([run, run.record], ratio=50)


@pytest.mark.parametrize("given", ["one.csv", ["one.csv"], [np.zeros(3)]])
def test_other_objects_are_refused_with_advice(given):
    with pytest.raises(InputError, match=r"is not a recording; expected .* Recording.load\(path\)"):
        fit(given)
