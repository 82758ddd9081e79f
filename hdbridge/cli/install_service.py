"""``hdbridge install-service``: the systemd files for the daemon."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import MachineArgument, say
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.systemd import ServiceFile


def command(
    machine: MachineArgument,
    yes: Annotated[bool, typer.Option("--yes", help="Write the files; else they are only shown.")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the files.")] = False,
    user: Annotated[bool, typer.Option("--user", help="For your own service manager, without root.")] = False,
    account: Annotated[
        str | None,
        typer.Option(
            "--account", metavar="NAME", help="User of the service; else the owner of the machine file."
        ),
    ] = None,
) -> None:
    """Show, write or remove the systemd files that run a machine's daemon from the start of the computer.

    Nothing is started; the commands for that are printed.
    """
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.systemd import service_files

    if user and account is not None:
        raise InputError("--account does not apply to your own service manager: leave it out")
    held = Machine.find(machine)
    if held.bus.interface == "virtual":
        raise InputError(
            f"{held.path}: the bus 'virtual' reaches no drive; expected the interface of the bus (socketcan)"
        )
    files = service_files(held, user=user, account=account)
    foreign = [each.path for each in files if not each.ours]
    if foreign and (yes or remove):
        raise InputError(f"{foreign[0]}: is not of this program, or cannot be read; move it away first")
    if remove:
        _remove(files)
    elif yes:
        _write(files)
        _tell_what_next(held, files, user=user)
    else:
        for file in files:
            say(f"# {file.path}")
            say(file.text)
        say("nothing was written: --yes writes this")


def _write(files: list[ServiceFile]) -> None:
    from hdbridge.files.atomic import write_atomically

    for file in files:
        try:
            file.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        write_atomically(file.path, file.text)
        file.path.chmod(0o644)
        say(f"wrote {file.path}")


def _remove(files: list[ServiceFile]) -> None:
    for file in files:
        if not file.path.exists():
            say(f"{file.path} is not there")
            continue
        try:
            file.path.unlink()
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        say(f"removed {file.path}")


def _refused(file: ServiceFile, problem: OSError) -> str:
    return f"{file.path}: {problem.strerror}; expected the rights of root (sudo), or --user"


def _tell_what_next(machine: Machine, files: list[ServiceFile], *, user: bool) -> None:
    control = "systemctl --user" if user else "systemctl"
    unit = files[0].path.name
    say("next:")
    if len(files) > 1:
        say("  networkctl reload")
    say(f"  {control} daemon-reload")
    say(f"  {control} enable --now {unit}")
    if user and machine.bus.interface == "socketcan":
        say("the CAN interface is set up by root: see docs/daemon.md")
