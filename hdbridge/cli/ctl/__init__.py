"""``hdbridge ctl``: control of a running daemon: look, move, stop, compensate.

common.py        address of the daemon; the lease; Ctrl-C stops the axis
look.py          read-only commands
motion.py        power and motion
model.py         compensation, models, adaptation
objects.py       objects of the drive
"""

from __future__ import annotations

from collections.abc import Callable

import typer

from hdbridge.cli.ctl import look, model, motion, objects

_SIGNED = {"ignore_unknown_options": True}
"""Settings of commands with a number that may be negative and would be taken for an option."""


def register(app: typer.Typer) -> None:
    """Adds the commands."""
    group = typer.Typer(
        help="Control a running daemon: look, move, stop, compensate.",
        no_args_is_help=True,
        rich_markup_mode="markdown",
    )
    plain: list[Callable[..., None]] = [
        *(look.status, look.watch, look.events, look.lease, look.mark),
        *(motion.enable, motion.disable, motion.reset, motion.home, motion.stop, motion.quick_stop),
        *(model.compensate, model.model, model.adapt, model.load_loop),
        objects.get,
    ]
    for each in plain:
        group.command(each.__name__.replace("_", "-"))(each)
    signed: list[Callable[..., None]] = [motion.move, motion.jog, motion.queue]
    for each in signed:
        group.command(context_settings=_SIGNED)(each)
    group.command("set", context_settings=_SIGNED)(objects.put)
    app.add_typer(group, name="ctl")
