"""Commands for compensation, models and adaptation of a daemon's axes."""

from typing import Annotated

import typer

from hdbridge.cli.ctl.common import AtOption, AxisArgument, TakeOption, moving, tell
from hdbridge.cli.options import JsonOption
from hdbridge.client.messages import AdaptationMode, Scheme
from hdbridge.errors import InputError


def compensate(
    axis: AxisArgument,
    scheme: Annotated[Scheme, typer.Argument(metavar="SCHEME", help="`none` switches it off.")],
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Select the part of the model that compensates: none, synchronous, hysteresis, both or extended.

    The change is ramped, also in motion.
    """
    with moving(at, axis, force=force) as moved:
        tell(moved.compensate(scheme.value), json_file)


def model(
    axis: AxisArgument,
    version: Annotated[
        str,
        typer.Argument(
            metavar="VERSION",
            help="Number in `hdbridge model log`; `pending` commits that one, `active` reads it again.",
        ),
    ],
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Make another model of an axis the active one; the change is ramped, also in motion."""
    if version not in {"pending", "active"} and not (version.isascii() and version.isdigit()):
        raise InputError(f"VERSION: found {version!r}; expected a number, pending or active")
    with moving(at, axis, force=force) as moved:
        tell(moved.activate_model(int(version) if version.isdigit() else version), json_file)


def adapt(
    axis: AxisArgument,
    mode: Annotated[
        AdaptationMode | None,
        typer.Argument(metavar="MODE", help="`off`, `observe` (report what would change) or `on`."),
    ] = None,
    back: Annotated[bool, typer.Option("--back", help="Return to the committed model.")] = False,
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Set the adaptation of model parameters to the load encoder."""
    if back == (mode is not None):
        raise InputError("expected either a mode or --back")
    with moving(at, axis, force=force) as moved:
        tell(moved.adaptation_back() if mode is None else moved.adapt(mode.value), json_file)


def load_loop(
    axis: AxisArgument,
    on: Annotated[bool, typer.Option("--on/--off", help="Switch it on or off.")],
    at: AtOption = None,
    force: TakeOption = False,
    json_file: JsonOption = None,
) -> None:
    """Switch the slow integral of the load error on or off, if the machine file has one."""
    with moving(at, axis, force=force) as moved:
        tell(moved.load_loop(on), json_file)
