"""``hdbridge reset``: resets a fault of the drive."""

from hdbridge.cli.options import JsonOption, say, write_json
from hdbridge.cli.session import Session, on_axis


@on_axis
def command(
    session: Session,
    json_file: JsonOption = None,
) -> None:
    """Reset a fault of the drive when its cause is gone; power stays off.

    Boots the drive, prints the error code and the last emergency, and resets the fault. Nothing moves. Exit
    status 4 if the fault returns at once. With a daemon use `hdbridge ctl reset`.
    """
    from hdbridge.drive.states import State

    axis = session.axis
    with (
        session.drive() as drive,
    ):
        drive.boot()
        faulty = drive.state() is State.FAULT
        fault = drive.fault_reset() if faulty else None
        state = drive.state()
    write_json(
        json_file,
        {"schema": "hdbridge.reset/1", "axis": axis.name, "fault": fault, "state": state.value},
    )
    done = f"the fault is reset ({fault})" if faulty else "there is no fault to reset"
    say(f"{done}: the drive is in '{state.value}'")
