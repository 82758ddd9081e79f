"""The page of a fleet: joints to inspect first, causes by batch, mistaken and failed recordings, and the
rates at which causes are named.
"""

from __future__ import annotations

import posixpath
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final

from hdbridge import __version__
from hdbridge.fleet.statistics import Interval
from hdbridge.fleet.summary import Candidate, Mistaken, Summary
from hdbridge.report.page import Cell, Command, Heading, Link, Page, Section, Status, Table

ROWS: Final = 200
"""Maximum number of rows of a table, so that the page of ten thousand joints opens quickly."""
NOT_KNOWN: Final = "not known yet"
NO_PAGES: Final[Mapping[str, str]] = MappingProxyType({})
Joint = Callable[[str], Cell]
"""Returns the name of a joint, with a link to its page if there is one."""
_FAILURES: Final = 40
"""Length of the prefix by which failure reasons are grouped; characters."""


def hours_words(remaining: Interval | None) -> str:
    """Formats the hours to a limit with their interval, or reports that they are not known yet."""
    if remaining is None:
        return NOT_KNOWN
    if remaining.high == 0.0:
        return "reached"
    return f"{_two(remaining.value)} ({_two(remaining.low)} to {_two(remaining.high)})"


def fleet_page(summary: Summary, folder: Path, pages: Mapping[str, str] = NO_PAGES) -> Page:
    """Returns the page of a summary.

    ``folder`` holds the data set, ``pages`` the addresses of the joints' pages that exist.
    """

    def joint(name: str) -> Cell:
        return Link(name, pages[name]) if name in pages else name

    sections = [
        _first(summary, joint),
        *_prevalence(summary),
        *_mistaken(summary, joint),
        *_odd(summary, joint),
        *_silent(summary, joint),
        *_failed(summary, joint),
        _rates(summary),
    ]
    without = next((each.joint for each in summary.first if each.joint not in pages), None)
    command = None
    if without is not None:
        line = shlex.join(["hdbridge", "fleet", "report", str(folder), "--joint", without])
        command = Command(
            line, f"writes the page of {without}; with --pages, those of all joints of the list"
        )
    return Page(
        title=f"Fleet of {summary.joints:,} joints",
        verdict=_verdict(summary),
        sections=sections,
        footer=f"hdbridge {__version__}. Data set: {folder}. Hours and shares are given with 90 % intervals.",
        status=Status.FOUND if summary.first else Status.NOTHING_FOUND,
        commands=(command,) if command else (),
    )


def _verdict(summary: Summary) -> str:
    count = len(summary.first)
    if count:
        soonest = summary.first[0]
        text = f"{count:,} of {summary.joints:,} joints {'need' if count > 1 else 'needs'} a look; first "
        text += f"{soonest.joint}: {_words(soonest.cause)}, {soonest.peak_arcsec:.1f} arcsec"
        if soonest.remaining is not None and soonest.remaining.high > 0.0:
            text += f", {summary.limit_arcsec:g} arcsec in {hours_words(soonest.remaining)} h"
        text += "."
    else:
        text = f"No joint of {summary.joints:,} stands out by a cause that repeats and is not common to all."
    if wrong := len(summary.failed):
        text += (
            f" {wrong:,} of {summary.recordings:,} recordings {'have' if wrong > 1 else 'has'} no diagnosis."
        )
    return text


def _first(summary: Summary, joint: Joint) -> Section:
    text = (
        "Joints with a cause that appeared after the first recording and repeats, or that grows: more "
        "often than "
        "the fleet's rate of wrong names explains. No more than 1 in 100 of these lines is expected to be "
        "wrong. "
        f"Limit: a peak of {summary.limit_arcsec:g} arcsec."
    )
    if not summary.first:
        return Section("Look at first", f"{text}\n\nThere is none.")
    rows: list[list[Cell]] = []
    for each in summary.first[:ROWS]:
        rows.append(
            [
                joint(each.joint),
                _words(each.cause)
                + (f" (or {', '.join(map(_words, each.aliases))})" if each.aliases else ""),
                hours_words(each.remaining),
                each.peak_arcsec,
                _growth(each),
                _sure(each.probability),
                f"{each.named} of {each.recordings}",
                "; ".join(map(_words, each.what_changed)),
                f"{len(each.remarks)} remark{'s' * (len(each.remarks) != 1)}" if each.remarks else "good",
                posixpath.basename(each.path),
            ]
        )
    header: list[str | Heading] = [
        "joint",
        "cause",
        Heading("to the limit", "h"),
        Heading("peak"),
        Heading("growth", "arcsec per 1000 h"),
        Heading("probability", ""),
        "named in",
        "what else changed",
        "data",
        "last recording",
    ]
    return Section("Look at first", text, [Table(header, rows, _more(len(summary.first)))])


def _growth(each: Candidate) -> str:
    if each.growth is None:
        return "no hours"
    if not each.growing:
        return "not sure"
    return f"{each.growth.value:+.2f} ({each.growth.low:.2f} to {each.growth.high:.2f})"


def _prevalence(summary: Summary) -> Iterator[Section]:
    for attribute, causes in summary.prevalence.items():
        rows: list[list[Cell]] = []
        ranked = sorted(causes.items(), key=lambda each: -sum(cases for cases, _, _ in each[1].values()))
        for cause, groups in ranked:
            for group, (cases, joints, share) in groups.items():
                rows.append(
                    [
                        f"{_words(cause)}: {group}",
                        f"{cases} of {joints}",
                        f"{100.0 * share.value:.0f} %",
                        f"{100.0 * share.low:.0f} %",
                        f"{100.0 * share.high:.0f} %",
                    ]
                )
        if rows:
            yield Section(
                f"Causes by {attribute}",
                "Joints in which the cause was named at least twice and is more likely there than not. "
                "The share is "
                "partially pooled: a small group is drawn to the others.",
                [
                    Table(
                        [
                            f"cause and {attribute}",
                            "joints",
                            Heading("share", ""),
                            Heading("from", ""),
                            Heading("to", ""),
                        ],
                        rows[:ROWS],
                        _more(len(rows)),
                    )
                ],
            )


def _mistaken(summary: Summary, joint: Joint) -> Iterator[Section]:
    rows: list[list[Cell]] = [
        [joint(each.joint), _KINDS[each.kind], each.text, each.path]
        for each in sorted(summary.mistaken, key=_gravity)
    ]
    rows += [
        [joint(name), "there twice", f"the same samples as {first}", path]
        for name, path, first in summary.duplicates
    ]
    if rows:
        yield Section(
            "Exchanged, turned, twice",
            "Recordings that are not of their joint as it was. Those of another joint, of another "
            "encoder, and second "
            "copies count nowhere else on this page.",
            [Table(["joint", "what", "why", "recording"], rows[:ROWS], _more(len(rows)))],
        )


_KINDS: Final = {"swapped": "another joint", "turned": "another encoder or zero", "changed": "changed orders"}


def _gravity(each: Mistaken) -> tuple[int, str, str]:
    return (list(_KINDS).index(each.kind), each.joint, each.path)


def _odd(summary: Summary, joint: Joint) -> Iterator[Section]:
    if not summary.odd:
        return
    rows: list[list[Cell]] = [
        [joint(each.joint), each.gear, _words(each.figure), each.value, each.normal.low, each.normal.high]
        for each in summary.odd[:ROWS]
    ]
    yield Section(
        "Unlike their gear type",
        "The median over a joint's recordings is outside what 95 % of the joints of its type have, with a "
        "false "
        "discovery rate of 5 %. That alone is no fault: a joint may be so from the beginning.",
        [
            Table(
                [
                    "joint",
                    "gear",
                    "figure",
                    Heading("value", ""),
                    Heading("normal from", ""),
                    Heading("to", ""),
                ],
                rows,
                _more(len(summary.odd)),
            )
        ],
    )


def _silent(summary: Summary, joint: Joint) -> Iterator[Section]:
    if summary.silent:
        rows: list[list[Cell]] = [[joint(name), why] for name, why in summary.silent[:ROWS]]
        yield Section(
            "Silent joints",
            "Joints of which nothing is known now.",
            [Table(["joint", "why"], rows, _more(len(summary.silent)))],
        )


def _failed(summary: Summary, joint: Joint) -> Iterator[Section]:
    if not summary.failed:
        return
    kinds = Counter(_kind(path, reason) for _, path, reason in summary.failed)
    rows: list[list[Cell]] = [
        [joint(name) if name else "?", path, reason] for name, path, reason in summary.failed[:ROWS]
    ]
    yield Section(
        "What failed",
        "; ".join(f"{count}: {kind}" for kind, count in kinds.most_common(8)) + ".",
        [Table(["joint", "recording", "why"], rows, _more(len(summary.failed)))],
    )


def _kind(path: str, reason: str) -> str:
    bare = reason.removeprefix(path).lstrip(":0123456789 ")
    return bare if len(bare) <= _FAILURES else bare[:_FAILURES].rpartition(" ")[0] + " ..."


def _rates(summary: Summary) -> Section:
    ranked = sorted(summary.rates.items(), key=lambda each: -each[1][0])
    rows: list[list[Cell]] = [
        [_words(cause), *(f"{100.0 * each:.1f} %" for each in rates)] for cause, rates in ranked
    ]
    return Section(
        "How often which cause is named",
        "Estimated from the fleet: the share of joints with the cause, and how often a recording names it "
        "in a joint "
        "with it and in one without. What is named as often without it is not worth a line.",
        [
            Table(
                [
                    "cause",
                    Heading("share", "of joints"),
                    Heading("named with it", "of recordings"),
                    Heading("without", "of recordings"),
                ],
                rows,
            )
        ],
    )


def _more(count: int) -> str:
    return f"the first {ROWS} of {count:,}; the data set has all" if count > ROWS else ""


def _words(cause: str) -> str:
    return cause.replace("_", " ")


def _sure(probability: float) -> str:
    return f"{probability:.2f}" if probability < 0.995 else "above 0.99"


def _two(value: float) -> str:
    """Formats a value with two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.0f}"
