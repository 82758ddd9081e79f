"""The next experiment in words: what would separate what the data leave open.

As the causes have it, also what only a person can do (move a mass, re-clock an encoder). What the axis can do
by itself: `hdbridge.improvement.experiments`.
"""

from __future__ import annotations

from typing import Final

from hdbridge.effects import CATALOGUE

_UNEXPLAINED: Final = {
    "load angle": "two slow load turns both ways, then again with the load encoder re-clocked by 90 deg",
    "reversal": "nested reversals from 0.1 deg up, each beyond where the last one turned, slowly",
    "motor angle": "a slow sweep over ten motor turns both ways, at two places of the load",
    "speed": "the same way at three speeds and two accelerations, with rests of a minute between",
    "torque": "the same sweep with the load's mass at two places",
    "time": "an hour of returns to one reference pose, with the temperature recorded",
}
"""By what it depends on."""


def next_experiment(cause: str, aliases: tuple[str, ...]) -> str:
    """The shortest experiment that distinguishes the cause from its aliases; without aliases, the one that
    confirms it.
    """
    either = [pair for each in aliases for pair in ((cause, each), (each, cause))]
    known = [
        CATALOGUE[one].about.apart[other]
        for one, other in either
        if one in CATALOGUE and other in CATALOGUE[one].about.apart
    ]
    if known:
        return min(known).words
    return CATALOGUE[cause].about.experiment if cause in CATALOGUE else ""


def for_unexplained(lives_in: str) -> str:
    """How to look closer at something unexplained."""
    return _UNEXPLAINED[depends_on(lives_in)]


def depends_on(lives_in: str) -> str:
    """Which of load angle, motor angle, reversal, speed, torque and time a coordinate is one of."""
    if "load angle" in lives_in or "position" in lives_in:
        return "load angle"
    if "reversal" in lives_in or lives_in == "direction":
        return "reversal"
    if "motor angle" in lives_in or "wave generator" in lives_in:
        return "motor angle"
    if lives_in in {"speed", "acceleration"} or "stop" in lives_in:
        return "speed"
    return "torque" if "torque" in lives_in else "time"
