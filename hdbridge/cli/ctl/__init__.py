"""``hdbridge ctl``: control of a running daemon: look, move, stop, compensate.

common.py        address of the daemon; the lease; Ctrl-C stops the axis
look.py          read-only commands
motion.py        power and motion
model.py         compensation, models, adaptation
objects.py       objects of the drive
"""

from typing import Final

from hdbridge.cli.ctl import look, model, motion, objects

COMMANDS: Final = {
    "status": look.status,
    "watch": look.watch,
    "events": look.events,
    "lease": look.lease,
    "mark": look.mark,
    "enable": motion.enable,
    "disable": motion.disable,
    "reset": motion.reset,
    "home": motion.home,
    "stop": motion.stop,
    "quick-stop": motion.quick_stop,
    "compensate": model.compensate,
    "model": model.model,
    "adapt": model.adapt,
    "load-loop": model.load_loop,
    "get": objects.get,
    "move": motion.move,
    "jog": motion.jog,
    "queue": motion.queue,
    "set": objects.put,
}
