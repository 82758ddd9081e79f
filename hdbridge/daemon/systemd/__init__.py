"""Texts of the systemd files that run a machine's daemon and configure its CAN interface. Writes nothing."""

import os
import pwd
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from jinja2 import Environment, PackageLoader, StrictUndefined

from hdbridge.daemon.machine import Machine
from hdbridge.errors import InputError

MARKER: Final = "# Written by 'hdbridge install-service'; 'hdbridge install-service --remove' removes it."
"""First line of each file; a file without it was not written by this program."""
_SYSTEM_UNITS: Final = Path("/etc/systemd/system")
_NETWORKS: Final = Path("/etc/systemd/network")
_HOMES: Final = (Path("/home"), Path("/root"), Path("/run/user"))
_SERIAL: Final = frozenset({"slcan", "serial", "robotell", "seeedstudio"})
"""python-can interfaces that are serial ports."""


@dataclass(frozen=True, slots=True)
class ServiceFile:
    """A file to write."""

    path: Path
    text: str

    @property
    def ours(self) -> bool:
        """True if the path is free or contains a file of this program."""
        try:
            with self.path.open(encoding="utf-8") as file:
                return file.readline().rstrip("\n") == MARKER
        except FileNotFoundError:
            return True
        except (OSError, UnicodeDecodeError):
            return False


def service_files(machine: Machine, *, user: bool = False, account: str | None = None) -> list[ServiceFile]:
    """Returns the unit of a machine's daemon, and for SocketCAN with a bit rate the interface's network file.

    ``user`` selects the user's own service manager, which cannot configure interfaces. ``account`` is the
    user under which the system's manager runs the daemon, by default the machine file's owner, or a dynamic
    user if the owner is root.
    """
    unit = f"hdbridge-{machine.name}.service"
    about = _about(machine)
    if user:
        configuration = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        return [ServiceFile(configuration / "systemd" / "user" / unit, _render("user.service.j2", about))]
    account = _checked(account) if account is not None else _owner(machine.path)
    writable = _folders(machine) if account else []
    about |= {"account": account, "writable": [_quoted(each) for each in writable], "home": _home(machine)}
    files = [ServiceFile(_SYSTEM_UNITS / unit, _render("system.service.j2", about))]
    if about["can"] and machine.bus.bitrate_bps is not None:
        network: dict[str, object] = {"channel": machine.bus.channel, "bitrate": machine.bus.bitrate_bps}
        path = _NETWORKS / f"80-hdbridge-{machine.bus.channel}.network"
        files.append(ServiceFile(path, _render("can.network.j2", network)))
    return files


def _about(machine: Machine) -> dict[str, object]:
    can = machine.bus.interface == "socketcan"
    command = (sys.executable, "-P", "-m", "hdbridge", "run", str(machine.path))
    return {
        "name": machine.name,
        "axes": ", ".join(axis.name for axis in machine.axes),
        "command": " ".join(_quoted(each) for each in command),
        "group": machine.api.group,
        "priority": max(machine.realtime.priority, 1),
        "can": can,
        "device": f"sys-subsystem-net-devices-{machine.bus.channel}.device" if can else None,
        "serial": machine.bus.interface in _SERIAL,
        "network": machine.api.tcp is not None or machine.bus.interface == "udp_multicast",
    }


def _render(template: str, about: dict[str, object]) -> str:
    environment = Environment(
        loader=PackageLoader(__name__), undefined=StrictUndefined, keep_trailing_newline=True,
        trim_blocks=True, lstrip_blocks=True, autoescape=False,
    )  # fmt: skip
    return environment.get_template(template).render(marker=MARKER, **about)


def _quoted(word: Path | str) -> str:
    """Quotes a word for systemd, and escapes specifiers and variables."""
    text = str(word).replace("\\", "\\\\").replace("%", "%%").replace("$", "$$").replace('"', '\\"')
    return f'"{text}"' if any(each.isspace() or each in "\"';\\" for each in text) else text


def _folders(machine: Machine) -> list[Path]:
    """Returns the folders that must be writable: those of models, recordings, adaptation and the socket."""
    folders = {machine.folder, *(axis.profile.folder for axis in machine.axes)}
    if machine.api.socket is not None:
        folders.add(machine.resolve_path(machine.api.socket).parent)
    return sorted(each for each in folders if not any(other in each.parents for other in folders))


def _home(machine: Machine) -> str:
    """Returns the value of ProtectHome: ``read-only`` if files or interpreter are in home folders."""
    needed = [*_folders(machine), Path(sys.executable), Path(sys.prefix), Path(__file__)]
    inside = any(home in each.parents for each in needed for home in _HOMES)
    return "read-only" if inside else "yes"


def _owner(path: Path) -> str | None:
    number = path.stat().st_uid
    if number == 0:
        return None
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        raise InputError(f"{path}: belongs to user {number}, who has no name; give --account NAME") from None


def _checked(account: str) -> str:
    try:
        number = pwd.getpwnam(account).pw_uid
    except KeyError:
        raise InputError(
            f"--account {account}: no such user; create it: useradd --system {account}"
        ) from None
    if number == 0:
        raise InputError("--account root: the daemon needs no rights of root; give another user")
    return account
