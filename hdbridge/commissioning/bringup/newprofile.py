"""New profile folder: a copy of a bundled profile, or the data of a drive on the bus."""

import re
from pathlib import Path

from hdbridge.axis import BusConfig
from hdbridge.commissioning.bringup.scan import Node, axis_sections
from hdbridge.errors import InputError
from hdbridge.files.atomic import write_folder
from hdbridge.files.profile import bundled_profile

FILES = ("axis.yaml", "model.yaml", "truth.yaml")
_TO_FILL_IN = {
    "drive": {"rated_torque_nm": "0         # fill in: rated torque of the motor, Nm"},
    "motor_encoder": {"counts_per_turn": "0         # fill in: counts per motor turn"},
    "load_encoder": {
        "counts_per_turn": "0         # fill in: counts per load turn",
        "source": "{index: 0x60E4, subindex: 1, type: int32}   # fill in: where its reading comes from",
    },
    "gear": {"ratio": "0         # fill in: motor turns per load turn"},
}
"""Required keys of an axis file that the drive may not provide; `hdbridge check` stops at missing values."""
_TAIL = """
# Limits at the load. Begin with small ones; `hdbridge doctor` moves within them.
limits:
  position_min_deg: -5
  position_max_deg: 5
  velocity_deg_s: 5
  acceleration_deg_s2: 50
  jerk_deg_s3: 1000
  torque_percent: 30
"""


def copy_bundled(source: str, folder: Path) -> list[Path]:
    """Copies a bundled profile to a new folder and names the axis after it; returns the written files."""
    name = _axis_name(folder)
    origin = bundled_profile(source)
    # A model is bound to the axis by its name, so the copied model gets the new name.
    own = {"axis.yaml": (rb"(?m)^name: .*$", "name: "), "model.yaml": (rb"(?m)^  axis: .*$", "  axis: ")}
    files = {each: (origin / each).read_bytes() for each in FILES if (origin / each).is_file()}
    for each, (line, key) in own.items():
        if each in files:
            files[each] = re.sub(line, f"{key}{name}".encode(), files[each], count=1)
    return write_folder(folder, files)


def write_scanned(folder: Path, bus: BusConfig, node: Node, eds: Path | None) -> list[Path]:
    """Writes an axis file from the drive's own data and copies its EDS; returns the written files."""
    text = axis_text(_axis_name(folder), bus, node, eds.name if eds else "FILE.eds")
    if eds is not None and not eds.is_file():
        raise InputError(f"{eds}: there is no such file; expected the EDS file of the drive")
    files = {"axis.yaml": text.encode()}
    if eds is not None:
        files[eds.name] = eds.read_bytes()
    return write_folder(folder, files)


def axis_text(name: str, bus: BusConfig, node: Node, eds_name: str) -> str:
    """Returns the text of an axis file; values that only the user knows are marked ``fill in``."""
    said = axis_sections(node)
    for section, keys in _TO_FILL_IN.items():
        lines = said.setdefault(section, [])
        there = {each.split(":")[0].strip() for each in lines}
        lines += [f"  {key}: {value}" for key, value in keys.items() if key not in there]
    said["drive"] = [
        re.sub(r"FILE\.eds\b.*", f"{eds_name}", each) if "eds:" in each else each for each in said["drive"]
    ]
    said["drive"] += ["  cycle_ms: 4", "  following_error_deg: 5.0      # of the motor"]
    bitrate = [f"  bitrate_bps: {bus.bitrate_bps}"] if bus.bitrate_bps else []
    head = [
        "# Made by `hdbridge new --from scan` from the drive's own data. From now on this file is yours:",
        "# hdbridge reads it and never changes it. docs/files.md describes every key; `hdbridge check` says",
        "# what is missing or wrong.",
        "schema: hdbridge.axis/1",
        f"name: {name}",
        "",
        "bus:",
        f"  interface: {bus.interface}",
        f"  channel: {bus.channel}",
        *bitrate,
    ]
    order = ("drive", "motor_encoder", "load_encoder", "gear")
    body = [line for section in order for line in ("", f"{section}:", *said[section])]
    return "\n".join([*head, *body]) + "\n" + _TAIL


def _axis_name(folder: Path) -> str:
    name = folder.resolve().name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
        raise InputError(
            f"{folder}: {name!r} is not a valid name of an axis; expected letters, digits, '.', '_', '-'"
        )
    return name
