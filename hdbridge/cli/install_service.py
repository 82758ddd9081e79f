"""``hdbridge install-service``: the systemd files for the daemon."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from hdbridge.cli.options import MachineArgument, console
from hdbridge.errors import InputError

if TYPE_CHECKING:
    from hdbridge.daemon.machine import Machine
    from hdbridge.daemon.systemd import ServiceFile


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("install-service")(install_service)


def install_service(
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

    They are a unit and, for SocketCAN with a `bitrate_bps`, a file for systemd-networkd. Nothing is started;
    the commands for that are printed.
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
            console.print(f"# {file.path}", markup=False, soft_wrap=True)
            console.print(file.text, markup=False, soft_wrap=True)
        console.print("nothing was written: --yes writes this")


def _write(files: list[ServiceFile]) -> None:
    from hdbridge.files.atomic import write_atomically

    for file in files:
        try:
            file.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        write_atomically(file.path, file.text)
        file.path.chmod(0o644)
        console.print(f"wrote {file.path}", soft_wrap=True)


def _remove(files: list[ServiceFile]) -> None:
    for file in files:
        if not file.path.exists():
            console.print(f"{file.path} is not there", soft_wrap=True)
            continue
        try:
            file.path.unlink()
        except OSError as problem:
            raise InputError(_refused(file, problem)) from None
        console.print(f"removed {file.path}", soft_wrap=True)


def _refused(file: ServiceFile, problem: OSError) -> str:
    return f"{file.path}: {problem.strerror}; expected the rights of root (sudo), or --user"


def _tell_what_next(machine: Machine, files: list[ServiceFile], *, user: bool) -> None:
    control = "systemctl --user" if user else "systemctl"
    unit = files[0].path.name
    console.print("next:")
    if len(files) > 1:
        console.print("  networkctl reload")
    console.print(f"  {control} daemon-reload")
    console.print(f"  {control} enable --now {unit}")
    if user and machine.bus.interface == "socketcan":
        console.print("the CAN interface is set up by root: see docs/daemon.md")
