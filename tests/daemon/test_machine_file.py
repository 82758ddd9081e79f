"""The machine file: its meaning, and one exact line for every error."""

# ruff: noqa: E501  (the table of complaints shows each on one line)

import pickle
from pathlib import Path

import pytest

from hdbridge.daemon.machine import Machine, machine_file
from hdbridge.enums import Scheme
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_folder, bundled_profile

GOOD = """\
schema: hdbridge.machine/1
name: test
axes:
  - profile: one
  - profile: two
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two compatible axes: nodes 1 and 2."""
    for name, node in (("one", 1), ("two", 2)):
        axis(tmp_path, name, node)
    return tmp_path


def axis(folder: Path, name: str, node: int, **changes: str) -> None:
    text = (bundled_profile("article") / "axis.yaml").read_text(encoding="utf-8")
    changes = {"name: article": f"name: {name}", "node_id: 1": f"node_id: {node}", **changes}
    for wanted, given in changes.items():
        assert text.count(f"  {wanted}\n") + text.count(f"\n{wanted}\n") == 1, wanted
        text = text.replace(wanted, given, 1)
    (folder / name).mkdir(exist_ok=True)
    (folder / name / "axis.yaml").write_text(text, encoding="utf-8")


def load(folder: Path, text: str = GOOD) -> Machine:
    (folder / "machine.yaml").write_text(text, encoding="utf-8")
    return Machine.load(folder)


def refused(folder: Path, text: str = GOOD) -> str:
    with pytest.raises(InputError) as caught:
        load(folder, text)
    return str(caught.value)


def test_a_good_file_gives_its_axes_with_defaults(folder: Path) -> None:
    machine = load(folder)
    assert [each.name for each in machine.axes] == ["one", "two"]
    assert [each.config.drive.node_id for each in machine.axes] == [1, 2]
    assert (machine.name, machine.cycle_s, machine.lease_s) == ("test", 0.004, 10.0)
    assert (machine.api.socket, machine.api.tcp) == (None, None)
    one = machine.axis("one")
    assert (one.compensation, one.adaptation.mode, one.load_loop) == (Scheme.EXTENDED, "off", None)
    assert one.profile.folder == folder / "one"
    assert one.model().effects == ()
    with pytest.raises(InputError, match="no axis 'three'; expected one of: one, two"):
        machine.axis("three")


def test_keys_of_an_axis_and_of_the_whole_machine(folder: Path) -> None:
    machine = load(
        folder,
        GOOD.replace(
            "profile: one", "{profile: one, compensation: none, adapt: on, load_loop: {gain_1_s: 2}}"
        )
        + "bus: {interface: socketcan, channel: can7, bitrate_bps: 500000}\n"
        + "adaptation: {mode: observe, interval_s: 30}\n"
        + "realtime: {priority: 80, cpus: [1]}\nlease_s: 2.5\n",
    )
    one, two = machine.axes
    assert (one.compensation, one.adaptation.mode, two.adaptation.mode) == (Scheme.NONE, "on", "observe")
    assert one.adaptation.interval_s == 30
    assert one.load_loop is not None
    assert one.load_loop.gain_1_s == 2
    assert one.config.bus == two.config.bus == machine.bus
    assert (machine.bus.channel, one.config.realtime.priority, machine.lease_s) == ("can7", 80, 2.5)
    assert machine.on_bus(channel="vcan0").axes[1].config.bus.channel == "vcan0"


def test_machine_can_be_pickled(folder: Path) -> None:
    machine = load(folder)
    again = pickle.loads(pickle.dumps(machine))
    assert again == machine
    assert again.axes[1].config.where("drive.node_id") == machine.axes[1].config.where("drive.node_id")


@pytest.mark.parametrize(
    ("wanted", "given", "expected"),
    [
        ("name: test", "name: a b", "machine.yaml:2:7: name: "),
        ("axes:", "axis: []\naxes:", "machine.yaml:3:1: axis: unknown key; did you mean 'axes'?"),
        (
            "profile: two",
            "profile: tow",
            "machine.yaml:5:14: axes[1].profile: tow: no such file or folder, nor a bundled profile",
        ),
        ("profile: two", "profil: two", "machine.yaml:5:5: axes[1].profil: unknown key; did you mean 'profile'?"),
        (
            "profile: two",
            "profile: one",
            "machine.yaml:5:14: axes[1].profile: axis name 'one' is already used in line 4; expected another name",
        ),
        ("name: test", "name: test\nlease_s: 0", "machine.yaml:3:10: lease_s: found 0; expected a number from 0.5"),
        (
            "name: test",
            "name: test\napi: {tcp: {token_file: token}}",
            "machine.yaml:3:25: api.tcp.token_file: ",
        ),
        (
            "name: test",
            "name: test\napi: {tcp: {token_file: token, key: key.pem}}",
            "machine.yaml:3:32: api.tcp.key: unknown key; expected port, names, token_file",
        ),
    ],
)  # fmt: skip
def test_errors_state_their_location(folder: Path, wanted: str, given: str, expected: str) -> None:
    assert expected in refused(folder, GOOD.replace(wanted, given, 1))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"node_id: 1": "node_id: 1"}, "drive.node_id of 'one' already; expected another node id"),
        ({"cycle_ms: 4": "cycle_ms: 2"}, "drive.cycle_ms: found 2; expected 4, as of 'one'"),
        ({"master_node_id: 127": "master_node_id: 126"}, "drive.master_node_id: found 126; expected 127"),
        ({"channel: hdbridge": "channel: other"}, "bus: differs from that of 'one'"),
    ],
)
def test_incompatible_axes_are_refused(folder: Path, changes: dict[str, str], expected: str) -> None:
    text = (folder / "two" / "axis.yaml").read_text(encoding="utf-8")
    for wanted, given in changes.items():
        text = (
            text.replace("node_id: 2", "node_id: 1", 1) if wanted == given else text.replace(wanted, given, 1)
        )
    (folder / "two" / "axis.yaml").write_text(text, encoding="utf-8")
    complaint = refused(folder)
    assert expected in complaint
    assert "machine.yaml:5:14: axes[1].profile: " in complaint
    assert str(folder / "two" / "axis.yaml") + ":" in complaint


def test_an_overloaded_bus_is_refused(folder: Path) -> None:
    text = GOOD + "bus: {interface: socketcan, channel: can0, bitrate_bps: 125000}\n"
    assert "axes: the cycle of one and two takes" in refused(folder, text)
    assert load(folder, text.replace("125000", "1000000")).bus.bitrate_bps == 1_000_000


def test_a_model_of_another_axis(folder: Path) -> None:
    model = (bundled_profile("article") / "model.yaml").read_text(encoding="utf-8")
    (folder / "two" / "model.yaml").write_text(model, encoding="utf-8")
    assert "'article'" in refused(folder)
    (folder / "two" / "model.yaml").write_text(model.replace("axis: article", "axis: two"), encoding="utf-8")
    assert [each.name for each in load(folder).axis("two").model().effects] == ["synchronous", "hysteresis"]


def test_the_token_file_must_be_private(folder: Path) -> None:
    text = GOOD + "api: {tcp: {token_file: token}}\n"
    token = folder / "token"
    token.write_text("0123456789abcdef\n", encoding="ascii")
    token.chmod(0o644)
    assert f"{token} can be read by others (mode 644); expected mode 600" in refused(folder, text)
    token.chmod(0o600)
    tcp = load(folder, text).api.tcp
    assert tcp is not None
    assert tcp.port == 8402
    for content in ("", "short", "with spaces in the middle", "x" * 201, "line\nbreak-long-enough"):
        token.write_text(content, encoding="ascii")
        assert "expected a token of 16 to 200" in refused(folder, text)


def test_a_machine_is_found_by_folder_file_or_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load(folder)
    monkeypatch.chdir(folder)
    for text in (".", "machine.yaml", str(folder)):
        assert Machine.find(text).name == "test"
    assert Machine.find("one").path == folder / "one" / "axis.yaml"
    assert Machine.find("one/axis.yaml").name == "one"
    assert Machine.find("article").axes[0].profile.folder == bundled_profile("article")
    with pytest.raises(InputError, match="no such file or folder, nor a bundled profile"):
        Machine.find("nowhere")


def test_the_bundled_machine_is_valid() -> None:
    machine = Machine.find("cell")
    assert machine.path == bundled_folder("profiles") / "cell" / "machine.yaml"
    assert all(axis.profile.truth.is_file() for axis in machine.axes)
    assert machine_file("cell") == machine.path
    assert machine_file("article") is None
