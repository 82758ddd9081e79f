"""`hdbridge improve` at its edges: interrupted, refused, not better."""

import signal

import pytest
import yaml
from support.command import started
from support.patience import until

from hdbridge.commissioning.calibration.validation import Floor, Validation
from hdbridge.commissioning.evaluation.stepping import Stepped
from hdbridge.commissioning.improvement import Trial
from hdbridge.motion.procedures.stepping import Standing, SteppingOutcome
from hdbridge.report.stepping import stepping_sections


def refused(err, *texts):
    lines = [line for line in err.splitlines() if line.startswith("hdbridge: ")]
    assert len(lines) == 1, err
    for text in texts:
        assert text in lines[0]


def test_ctrl_c_keeps_the_record_and_resume_completes_it(cell):
    cell.hide("motor_order")
    # In two parts of half as many samples there is room for a drift of the zero between them.
    axis = cell.axis / "axis.yaml"
    axis.write_text(axis.read_text().replace("cycle_ms: 20", "cycle_ms: 10"))
    options = ("--simulate", "--plan", "narrow.yaml", "--out", "rec")
    process = started(cell.folder, "improve", "axis", *options)
    about = cell.folder / "rec" / "recording.yaml"
    until(lambda: process.poll() is not None or (about.exists() and "02-sweep" in about.read_text()))
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    assert process.returncode == 130, err
    assert "--resume rec" in err
    assert "Traceback" not in err
    tasks = yaml.safe_load(about.read_text())["notes"]["tasks"]
    assert {"01-standstill", "02-sweep"} <= {each["task"] for each in tasks if each["complete"]}
    assert not (cell.axis / "pending.yaml").exists()

    result, _, err = cell.improve("--simulate", "--resume", "rec", "--json", "result.json")
    assert "tasks are there already" in err
    assert [each["cause"] for each in result["diagnosis"]["findings"]] == ["motor_order"]
    assert result["offered"] is True


def test_without_an_active_model_there_is_nothing_to_improve(cell):
    (cell.axis / "model.yaml").unlink()
    _, _, err = cell.improve(status=2)
    refused(err, "model.yaml", "calibrate first")
    assert not (cell.folder / "rec").exists()


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (("--from", "nowhere"), ("nowhere",)),
        (("--from", "axis", "--resume", "rec", "--simulate"), ("--from", "--resume")),
        (("--plan", "quik"), ("quik", "did you mean 'quick'")),
    ],
    ids=["no recording", "from and resume", "no plan"],
)
def test_bad_options_are_refused_before_anything_moves(cell, options, texts):
    _, _, err = cell.improve(*options, status=2)
    refused(err, *texts)
    assert not (cell.folder / "rec").exists()


def test_a_recording_of_another_axis_is_refused(improved):
    path = improved.axis / "axis.yaml"
    path.write_text(path.read_text().replace("name: demo", "name: other"))
    _, _, err = improved.improve("--from", "rec", "--out", "again", status=2)
    refused(err, "rec", "demo", "other")


def stepped(*errors_arcsec):
    stands = tuple(Standing(float(place), error, 0.1) for place, error in enumerate(errors_arcsec))
    return Stepped.of("a model", SteppingOutcome(cw=stands[::2], ccw=stands[1::2]))


WIDE = stepped(*(9.0, -8.0, 7.5, -9.5) * 8)
NARROW = stepped(*(1.0, -1.2, 0.8, -0.9) * 8)
NEARLY_AS_NARROW = stepped(*(1.1, -1.0, 0.8, -1.0) * 8)


@pytest.mark.parametrize(
    ("big", "small", "better"),
    [
        ((WIDE, NARROW), (NARROW, NEARLY_AS_NARROW), True),
        ((NARROW, NEARLY_AS_NARROW), (WIDE, NARROW), True),
        ((NARROW, NARROW), (NARROW, NARROW), False),
        ((NARROW, NEARLY_AS_NARROW), (NEARLY_AS_NARROW, NARROW), False),
        ((WIDE, NARROW), (NARROW, WIDE), False),
    ],
    ids=["big steps", "small steps", "the same", "by chance", "one worse"],
)
def test_better_means_better_somewhere_and_worse_nowhere(big, small, better):
    assert Trial(Validation(*big, Floor(1.0, 0.5)), small).improves is better


def both_ways(cw, ccw):
    places = range(16)
    stands = [
        tuple(Standing(float(place), mean + size * (-1) ** place, 0.1) for place in places)
        for mean, size in (cw, ccw)
    ]
    return Stepped.of("a model", SteppingOutcome(cw=stands[0], ccw=stands[1]))


def test_worsening_in_one_direction_is_reported():
    """The two directions converge, so the total improves; the backward direction alone does not."""
    before, after = both_ways((20.0, 1.0), (-20.0, 1.0)), both_ways((0.0, 1.0), (0.0, 2.0))
    checked = Validation(before, after, Floor(1.0, 0.5))
    assert checked.improves
    assert checked.worse == ("worse CCW: 3 sigma 3.00 to 6.00 arcsec",)
    trial = Trial(checked, (after, after))
    assert trial.worse == checked.worse
    assert checked.as_dict()["worse"] == list(checked.worse)
    (section, *_) = stepping_sections(checked)
    assert ("stepping", checked.worse[0]) in section.blocks[1].rows
    assert Validation(after, before, Floor(1.0, 0.5)).worse == ()
