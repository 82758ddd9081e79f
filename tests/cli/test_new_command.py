"""`hdbridge new` for installations from a wheel."""

import pytest

from hdbridge.axis import AxisConfig, BusConfig
from hdbridge.commissioning.bringup.newprofile import axis_text
from hdbridge.commissioning.bringup.scan import scan_bus
from hdbridge.drive import Link
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_profile
from hdbridge.sim.lockstep import simulated_bench


@pytest.fixture(scope="module")
def node():
    """Result of a scan of a simulated drive."""
    axis = AxisConfig.load(bundled_profile("article"))
    truth = axis.path.parent / "truth.yaml"
    with simulated_bench(truth, axis.eds_path, axis.drive.node_id) as (bus, clock, _):
        (found,) = scan_bus(Link(bus, clock)).nodes
    return found


@pytest.mark.parametrize("source", ["demo", "article"])
def test_copies_a_bundled_profile_under_a_new_name(hdbridge, tmp_path, source):
    done = hdbridge("new", "cells/my-axis", "--from", source)
    assert "next: hdbridge check cells/my-axis" in done.stdout
    axis = AxisConfig.load(tmp_path / "cells" / "my-axis")
    assert axis.name == "my-axis"
    assert (tmp_path / "cells" / "my-axis" / "model.yaml").exists() is (source == "article")
    hdbridge("check", "cells/my-axis")
    again = hdbridge("new", "cells/my-axis", status=2)
    assert "already exists" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("a b",), "is not a valid name of an axis"),
        (("mine", "--from", "scan"), "give --interface and --channel"),
        (("mine", "--interface", "socketcan"), "give --from scan with it"),
    ],
)
def test_an_impossible_profile_is_refused_and_nothing_written(hdbridge, tmp_path, arguments, complaint):
    done = hdbridge("new", *arguments, status=2)
    assert complaint in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_writes_an_axis_file_from_the_drives_objects(node):
    text = axis_text("found", BusConfig(interface="socketcan", channel="can0"), node, "hdbridge-402.eds")
    axis = AxisConfig.from_text(text)
    assert (axis.bus.interface, axis.bus.channel, axis.drive.node_id) == ("socketcan", "can0", 1)
    assert (axis.gear.ratio, axis.motor_encoder.counts_per_turn) == (50, 8000)
    assert axis.drive.identity.vendor_id == 0x4844


def test_values_unknown_to_the_drive_are_marked_to_be_filled_in(node):
    from dataclasses import replace

    silent = replace(node, values={})
    text = axis_text("found", BusConfig(interface="socketcan", channel="can0"), silent, "hdbridge-402.eds")
    assert text.count("fill in") >= 4
    with pytest.raises(InputError, match=r"axis.yaml:\d+:\d+: drive.rated_torque_nm"):
        AxisConfig.from_text(text)


def test_a_drive_with_interpolated_position_only_gets_that_mode(node):
    from dataclasses import replace

    bus = BusConfig(interface="socketcan", channel="can0")
    for modes, mode in ((0x43, "ip"), (0xE1, "csp"), (0xA1, "csp"), (None, "csp")):
        found = replace(node, modes=modes)
        assert found.usable
        assert AxisConfig.from_text(axis_text("found", bus, found, "hdbridge-402.eds")).drive.mode == mode
    assert not replace(node, modes=0x03).usable
