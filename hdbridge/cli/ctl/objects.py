"""Objects of a daemon's drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hdbridge.cli.ctl.common import (
    AtOption,
    AxisArgument,
    TakeOption,
    connected,
    document,
    moving,
)
from hdbridge.cli.options import JsonOption, ObjectArgument, ValueArgument, print_object, write_json

if TYPE_CHECKING:
    from hdbridge.client.messages import SdoValue


def get(
    axis: AxisArgument, object_: ObjectArgument, at: AtOption = None, json_file: JsonOption = None
) -> None:
    """Read an object of the drive by SDO, between the cycles."""
    with connected(at) as client:
        _print_object(client.axis(axis).read(object_), json_file)


def put(
    axis: AxisArgument,
    object_: ObjectArgument,
    value: ValueArgument,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Write an object of the drive by SDO, and read it back; refused while the axis is enabled."""
    with moving(at, axis, force=force) as moved:
        _print_object(moved.write(object_, value), json_file)


def _print_object(found: SdoValue, json_file: Path | None) -> None:
    write_json(json_file, document("ctl-object", found))
    print_object(f"{found.index:04X}h:{found.subindex:02X} '{found.name}'", found.value, found.type)
