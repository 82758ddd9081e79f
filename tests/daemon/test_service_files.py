"""The systemd unit files: content, and acceptance by systemd."""

import configparser
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.command import run_here

from hdbridge.daemon.machine import Machine
from hdbridge.daemon.systemd import MARKER, ServiceFile, service_files
from hdbridge.errors import InputError
from hdbridge.files.profile import bundled_profile


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A machine of one axis on SocketCAN, in a folder with a name that systemd must not misread."""
    folder = tmp_path / "my cell 100%"
    folder.mkdir()
    text = (bundled_profile("article") / "axis.yaml").read_text(encoding="utf-8")
    text = text.replace("interface: virtual ", "interface: socketcan ").replace(
        "channel: hdbridge ", "channel: can3 "
    )
    (folder / "axis.yaml").write_text(text.replace("name: article", "name: turntable"), encoding="utf-8")
    (folder / "machine.yaml").write_text(
        "schema: hdbridge.machine/1\nname: cell\naxes: [{profile: .}]\n"
        "bus: {interface: socketcan, channel: can3, bitrate_bps: 500000}\nrealtime: {priority: 70}\n",
        encoding="utf-8",
    )
    return folder


def options(file: ServiceFile) -> dict[str, dict[str, str]]:
    """Section, key and last value of a unit."""
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(file.text)
    return {name: dict(parser[name]) for name in parser.sections()}


def test_the_unit_of_the_system(folder: Path) -> None:
    unit, network = service_files(Machine.load(folder), account="daemon")
    assert unit.path == Path("/etc/systemd/system/hdbridge-cell.service")
    service = options(unit)["Service"]
    assert service["ExecStart"].endswith(f'-P -m hdbridge run "{folder}/machine.yaml"'.replace("%", "%%"))
    assert (service["Type"], service["NotifyAccess"]) == ("notify", "main")
    assert service["KillMode"] == "control-group"
    assert (service["User"], service["LimitRTPRIO"], service["LimitMEMLOCK"]) == ("daemon", "70", "infinity")
    assert service["RestrictAddressFamilies"] == "AF_UNIX AF_CAN"
    assert service["ReadWritePaths"] == f'"{folder}"'.replace("%", "%%")
    assert "CPUSchedulingPolicy" not in service
    assert network.path == Path("/etc/systemd/network/80-hdbridge-can3.network")
    assert options(network)["Match"]["Name"] == "can3"
    assert options(network)["CAN"] == {"BitRate": "500000", "RestartSec": "100ms"}


def test_the_service_account(folder: Path) -> None:
    machine = Machine.load(folder)
    (folder / "machine.yaml").chmod(0o644)
    unit = service_files(machine)[0]
    owner = machine.path.owner()
    assert options(unit)["Service"].get("User") == (None if owner == "root" else owner)
    assert ("DynamicUser=yes" in unit.text) == (owner == "root")
    with pytest.raises(InputError, match="needs no rights of root"):
        service_files(machine, account="root")
    with pytest.raises(InputError, match="no such user"):
        service_files(machine, account="nobody-of-this-name")


def test_the_unit_of_a_user(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (unit,) = service_files(Machine.load(folder), user=True)
    assert unit.path == tmp_path / "config/systemd/user/hdbridge-cell.service"
    assert "User" not in options(unit)["Service"]
    assert options(unit)["Install"]["WantedBy"] == "default.target"


def test_a_tcp_port_and_a_serial_adapter_are_let_through(folder: Path) -> None:
    token = folder / "token"
    token.write_text("0123456789abcdef", encoding="ascii")
    token.chmod(0o600)
    path = folder / "machine.yaml"
    text = path.read_text(encoding="utf-8").replace(
        "socketcan, channel: can3", "slcan, channel: /dev/ttyACM0"
    )
    path.write_text(text + "api: {tcp: {token_file: token}, group: operators}\n", encoding="utf-8")
    (unit,) = service_files(Machine.load(folder), account="daemon")
    service = options(unit)["Service"]
    assert service["RestrictAddressFamilies"] == "AF_UNIX AF_INET AF_INET6"
    assert (service["PrivateDevices"], service["SupplementaryGroups"]) == ("no", "dialout")
    assert service["Group"] == "operators"


@pytest.mark.parametrize("user", [False, True])
def test_systemd_accepts_the_unit(folder: Path, tmp_path: Path, user: bool) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    unit = service_files(Machine.load(folder), user=user, account=None if user else "daemon")[0]
    path = tmp_path / unit.path.name
    path.write_text(unit.text, encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_the_unit_is_shown_written_and_removed(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    unit = tmp_path / "config/systemd/user/hdbridge-cell.service"

    shown = run_here(tmp_path, "install-service", folder, "--user")
    assert not unit.exists()
    assert str(unit) in shown.stdout
    assert f'run "{folder}/machine.yaml"'.replace("%", "%%") in shown.stdout

    written = run_here(tmp_path, "install-service", folder, "--user", "--yes")
    assert "systemctl --user enable --now hdbridge-cell.service" in written.stdout
    assert unit.read_text(encoding="utf-8").startswith(MARKER + "\n[Unit]")
    assert sys.executable in unit.read_text(encoding="utf-8")

    run_here(tmp_path, "install-service", folder, "--user", "--remove")
    assert not unit.exists()
    assert "is not there" in run_here(tmp_path, "install-service", folder, "--user", "--remove").stdout

    unit.write_text("[Service]\n", encoding="utf-8")
    for option in ("--yes", "--remove"):
        refused = run_here(tmp_path, "install-service", folder, "--user", option, status=2)
        assert "was not written by this program" in refused.stderr
    assert unit.read_text(encoding="utf-8") == "[Service]\n"


def test_a_virtual_bus_gets_no_service(tmp_path: Path) -> None:
    refused = run_here(tmp_path, "install-service", "article", status=2)
    assert "the bus 'virtual' reaches no drive" in refused.stderr
