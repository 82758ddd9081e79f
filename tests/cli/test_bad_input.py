"""Bad input gives one clear line and a documented exit status, and nothing is written."""

import pytest

from tests.cli.conftest import refused

COMPLIANCE = """\
  - effect: compliance
    parameters: {c1_arcsec_per_nm: 16, c2_arcsec_per_nm: 12, c3_arcsec_per_nm: 9, torque1_nm: 7,
                 torque2_nm: 25}

"""


def test_a_model_needing_unavailable_channels_is_refused_for_compensation(hdbridge, profile):
    folder = profile("# Made from printed tables", COMPLIANCE + "# Made from printed tables", "model.yaml")
    refused(hdbridge("check", folder, status=2), "'compliance' needs load_torque_nm", "add 'load_torque' to")
    refused(
        hdbridge("step", folder, "--simulate", status=2), "'compliance' needs load_torque_nm", "axis.yaml"
    )


def test_truth_without_simulation(hdbridge, profile):
    refused(hdbridge("step", "article", "--truth", profile.folder / "truth.yaml", status=2), "--simulate")


def test_a_scheme_not_in_the_model_is_refused(hdbridge):
    refused(hdbridge("step", "article", "--simulate", "--scheme", "extended", status=2), "extended")


@pytest.mark.parametrize("command", ["step", "measure", "calibrate", "improve", "scan", "doctor"])
def test_a_simulated_drive_has_no_bus_to_choose(hdbridge, command):
    done = hdbridge(command, "article", "--simulate", "--interface", "socketcan", status=2)
    assert "leave out --interface and --channel" in done.stderr


@pytest.mark.parametrize("command", ["step", "measure", "calibrate", "scan"])
def test_the_virtual_bus_without_a_drive_is_refused_at_once(hdbridge, command):
    done = hdbridge(command, "article", status=2)
    assert "bus.interface: found virtual, which reaches nothing outside this process" in done.stderr
    assert "--simulate" in done.stderr


def test_a_model_of_another_axis_is_refused_before_anything_is_connected(hdbridge, profile):
    folder = profile("name: article", "name: elbow")
    for command in (("check", folder), ("step", folder, "--simulate")):
        done = hdbridge(*command, status=2)
        refused(done, "provenance.axis: this model was made for 'article', but the axis here is 'elbow'")
        assert "booted" not in done.stderr


def test_a_cap_that_limits_the_model_is_reported_by_check_and_before_steps(hdbridge, profile):
    folder = profile("maximum_arcsec: ", "maximum_arcsec: 40 # not ")
    for command in (("check", folder), ("step", folder, "--simulate", "--count", 2, "--scheme", "both")):
        done = hdbridge(*command)
        assert "40 arcsec cut the correction of this model, which reaches" in done.stderr
