"""`hdbridge move` and `hdbridge home`."""

import json
import os
import signal

import pytest

from hdbridge.motion.procedures.moves import Settle
from hdbridge.motion.procedures.waypoints import Hold


def stands(path):
    return [(each["target_deg"], each["error_arcsec"]) for each in json.loads(path.read_text())["stands"]]


def test_way_points_are_reached_compensated(hdbridge, tmp_path):
    done = hdbridge("move", "article", 10, -5.5, "--simulate", "--json", "out.json")
    found = stands(tmp_path / "out.json")
    assert [target for target, _ in found] == [10.0, -5.5]
    assert max(abs(error) for _, error in found) < 5.0
    assert "-5.5000" in done.stdout
    assert "model.yaml; power is off" in done.stdout


def test_relative_angles_start_from_the_present_position(hdbridge, tmp_path):
    hdbridge("move", "article", 1, 2, -0.5, "--relative", "--simulate", "--json", "out.json")
    assert [target for target, _ in stands(tmp_path / "out.json")] == pytest.approx([1.0, 3.0, 2.5])


def test_without_compensation_the_gear_error_is_visible(hdbridge, tmp_path):
    done = hdbridge("move", "article", -5, "--uncompensated", "--simulate", "--hold", 1, "--json", "out.json")
    assert "not compensated" in done.stdout
    assert abs(stands(tmp_path / "out.json")[0][1]) > 20.0
    assert json.loads((tmp_path / "out.json").read_text())["model"] is None


def test_a_profile_without_a_model_moves_uncompensated_with_a_notice(hdbridge):
    done = hdbridge("move", "demo", 1, "--simulate")
    assert "not compensated" in done.stdout
    assert "model.yaml does not exist" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((1000,), "would move the load to 1000 deg; the axis file allows -400 to 400"),
        ((300, 300, "--relative"), "would move the load to 600 deg"),
        (("up",), "ANGLE: found 'up'; expected a number"),
        ((), "ANGLE: is missing"),
        ((1, "--uncompensated", "--model", "model.yaml"), "leave out --model"),
        ((1, "--velocity", 0), "--velocity: found '0'; expected a number of at least 1e-06"),
    ],
)
def test_unreachable_targets_are_refused(hdbridge, arguments, complaint):
    done = hdbridge("move", "article", *arguments, "--simulate", status=2)
    assert complaint in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(("leg", "status"), [(Hold, 0), (Settle, 130)])
def test_ctrl_c_ends_holding_in_order_and_stops_a_move(hdbridge, monkeypatch, leg, status):
    ended = leg.ended

    def interrupted(self, samples, axis):
        if len(samples) == 30:
            os.kill(os.getpid(), signal.SIGINT)
        return ended(self, samples, axis) and len(samples) > 30

    monkeypatch.setattr(leg, "ended", interrupted)
    done = hdbridge(
        "-v", "move", "article", 1, "--simulate", "--hold", 1e9 if leg is Hold else 0, status=status
    )
    assert ("power is off" in done.stdout) is (status == 0)
    assert ("stopped on the way, at 0." in done.stderr) is (status == 130)
    assert "disabled  node=1" in done.stderr


def test_homing_reports_the_position(hdbridge, tmp_path):
    done = hdbridge("home", "article", "--method", 35, "--simulate", "--json", "out.json")
    assert "homed by method 35" in done.stdout
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["load_position_by_motor_deg"] == pytest.approx(0.0, abs=0.01)


def test_an_unsupported_homing_method_is_refused_by_the_drive(hdbridge):
    done = hdbridge("home", "article", "--method", 17, "--simulate", status=4)
    assert "6098h" in done.stderr
