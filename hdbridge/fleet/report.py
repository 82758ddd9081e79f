"""Pages of a fleet and of its single joints."""

import hashlib
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final
from urllib.parse import quote

from hdbridge import __version__
from hdbridge.errors import InputError, command
from hdbridge.files.atomic import make_folder, write_atomically
from hdbridge.fleet.diagnosing import local_model, read
from hdbridge.fleet.sources import Source
from hdbridge.fleet.statistics import Interval
from hdbridge.fleet.summary import Candidate, Row, Summary, counted, own_recordings
from hdbridge.report.page import Cell, Command, Heading, Link, Page, Section, Status, Table, sentence

ROWS: Final = 200
"""Maximum number of rows of a table, so that the page of ten thousand joints opens quickly."""
NOT_KNOWN: Final = "not known yet"
NO_PAGES: Final[Mapping[str, str]] = MappingProxyType({})
Joint = Callable[[str], Cell]
"""Function that returns a joint's name, as a link to its page if the page exists."""
_FAILURES: Final = 40
"""Number of characters of a failure reason by which failures are grouped."""
_KINDS: Final = {"swapped": "another joint", "turned": "another encoder or zero", "changed": "changed orders"}


def hours_words(remaining: Interval | None) -> str:
    """Formats the hours until a limit is reached, with their interval, or states that they are unknown."""
    if remaining is None:
        return NOT_KNOWN
    if remaining.high == 0.0:
        return "reached"
    return f"{_two(remaining.value)} ({_two(remaining.low)} to {_two(remaining.high)})"


def fleet_page(summary: Summary, folder: Path, pages: Mapping[str, str] = NO_PAGES) -> Page:
    """Returns the page of a summary.

    ``folder`` contains the data set, ``pages`` the addresses of the existing joint pages.
    """

    def joint(name: str) -> Cell:
        return Link(name, pages[name]) if name in pages else name or "?"

    without = next((each.joint for each in summary.first if each.joint not in pages), None)
    commands = []
    if without is not None:
        line = command("fleet", "report", folder, "--joint", without)
        about = f"writes the page of {without}; with --pages, those of all listed joints"
        commands.append(Command(line, about))
    return Page(
        title=f"Fleet of {summary.joints:,} joints",
        verdict=_verdict(summary),
        sections=[*_sections(summary, joint)],
        footer=f"hdbridge {__version__}. Data set: {folder}. Hours and shares are given with 90 % intervals.",
        status=Status.FOUND if summary.first else Status.NOTHING_FOUND,
        commands=commands,
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
    elif summary.recordings > len(summary.failed):
        text = f"None of {summary.joints:,} joints has a cause that repeats and is not common to all."
    else:
        text = "No joint can be judged."
    if wrong := len(summary.failed):
        have = "have" if wrong > 1 else "has"
        text += f" {wrong:,} of {summary.recordings:,} recordings {have} no diagnosis."
    return text


def _sections(summary: Summary, joint: Joint) -> Iterator[Section]:
    """Yields the sections that have rows, and always the list of joints."""
    text = (
        "Joints with a cause that appeared after the first recording and repeats, or that grows, more often "
        "than the fleet's rate of false findings explains. No more than 1 in 100 of these lines is expected "
        f"to be wrong. Limit: a peak of {summary.limit_arcsec:g} arcsec."
    )
    yield from _table(
        "Inspect first",
        text,
        ["joint", "cause", Heading("to the limit", "h"), Heading("peak"),
         Heading("growth", "arcsec per 1000 h"), Heading("probability", ""), "named in", "data",
         "also changed"],
        [_candidate(each, joint) for each in summary.first],
    ) if summary.first else [Section("Inspect first", f"{text}\n\nNone.")]  # fmt: skip
    for attribute, causes in summary.prevalence.items():
        yield from _table(
            f"Causes by {attribute}",
            "Joints in which the cause was named at least twice and is more likely there than not. The share "
            "is partially pooled: a small group is drawn towards the others.",
            [f"cause and {attribute}", "joints", *(Heading(each, "") for each in ("share", "from", "to"))],
            [
                [f"{_words(cause)}: {group}", f"{cases} of {joints}",
                 *(f"{100.0 * each:.0f} %" for each in (share.value, share.low, share.high))]
                for cause, groups in sorted(
                    causes.items(), key=lambda each: -sum(cases for cases, _, _ in each[1].values())
                )
                for group, (cases, joints, share) in groups.items()
            ],
        )  # fmt: skip
    mistaken = sorted(summary.mistaken, key=lambda each: ([*_KINDS].index(each.kind), each.joint, each.path))
    yield from _table(
        "Exchanged joints, other encoders, duplicates",
        "Recordings that do not match their joint. Recordings of another joint or encoder, and duplicates, "
        "are excluded from the rest of this page.",
        ["joint", "what", "why", "recording"],
        [
            *([joint(each.joint), _KINDS[each.kind], each.text, each.path] for each in mistaken),
            *([joint(name), "duplicate", f"the same samples as {first}", path]
              for name, path, first in summary.duplicates),
        ],
    )  # fmt: skip
    yield from _table(
        "Unlike their gear type",
        "The median over a joint's recordings is outside what 95 % of the joints of its type have, with a "
        "false discovery rate of 5 %. That alone is not a fault: a joint may be so from the start.",
        ["joint", "gear", "figure", *(Heading(each, "") for each in ("value", "normal from", "to"))],
        [
            [joint(each.joint), each.gear, _words(each.figure), each.value, each.normal.low, each.normal.high]
            for each in summary.odd
        ],
    )
    yield from _table(
        "Silent joints",
        "Joints without current information.",
        ["joint", "why"],
        [[joint(name), why] for name, why in summary.silent],
    )
    kinds = Counter(_kind(path, reason) for _, path, reason in summary.failed)
    yield from _table(
        "What failed",
        "; ".join(f"{count}: {kind}" for kind, count in kinds.most_common(8)) + ".",
        ["joint", "recording", "why"],
        [[joint(name), path, reason] for name, path, reason in summary.failed],
    )
    rates = sorted(summary.rates.items(), key=lambda each: -each[1][0])
    yield from _table(
        "Findings by cause",
        "Estimated from the fleet: the fraction of joints with the cause, and the rates of findings in "
        "recordings of joints with and without it. A finding that is as frequent without the cause is not "
        "informative.",
        ["cause", Heading("share", "of joints"), Heading("named with it", "of recordings"),
         Heading("without", "of recordings")],
        [[_words(cause), *(f"{100.0 * each:.1f} %" for each in own)] for cause, own in rates],
    )  # fmt: skip


def _table(
    title: str, text: str, header: Sequence[str | Heading], rows: Sequence[Sequence[Cell]]
) -> Iterator[Section]:
    """Yields a section with the first rows, if any."""
    more = f"the first {ROWS} of {len(rows):,}; fleet report --json has all" if len(rows) > ROWS else ""
    if rows:
        yield Section(title, text, [Table(header, rows[:ROWS], more)])


def _candidate(each: Candidate, joint: Joint) -> list[Cell]:
    aliases = f" (or {', '.join(map(_words, each.aliases))})" if each.aliases else ""
    if each.growth is None:
        growth = "no hours"
    elif each.growing:
        growth = f"{each.growth.value:+.2f} ({each.growth.low:.2f} to {each.growth.high:.2f})"
    else:
        growth = "not sure"
    remarks = len(each.remarks)
    return [
        joint(each.joint),
        _words(each.cause) + aliases,
        hours_words(each.remaining),
        each.peak_arcsec,
        growth,
        f"{each.probability:.2f}" if each.probability < 0.995 else "above 0.99",
        f"{each.named} of {each.recordings}",
        f"{remarks} remark{'s' * (remarks != 1)}" if remarks else "good",
        "; ".join(map(_words, each.what_changed)),
    ]


def _kind(path: str, reason: str) -> str:
    bare = reason.removeprefix(path).lstrip(":0123456789 ")
    return bare if len(bare) <= _FAILURES else bare[:_FAILURES].rpartition(" ")[0] + " ..."


def _words(name: str) -> str:
    """Formats the name of a cause or a quantity: `hysteresis.width_deg` is "hysteresis width, deg"."""
    with_unit = re.sub(r"_(deg|arcsec)\b", r", \1", name)
    return re.sub(r"(?<=[a-z])\.|\.(?=[a-z])|_", " ", with_unit)


def _two(value: float) -> str:
    """Formats a value to two significant digits, without an exponent."""
    return f"{float(f'{value:.2g}'):,.0f}"


PAGES = "pages"
KEY_DIGITS = 12


def shown(rows: Sequence[Row]) -> dict[str, Row]:
    """Returns the recording shown on each joint's page: the last one made of the joint itself.

    Its key ``mistaken`` lists the joint's recordings of another joint or encoder, or with different orders.
    """
    own, mistaken = own_recordings(rows)
    return {
        joint: {**each[-1], "mistaken": [one for one in mistaken if one.joint == joint]}
        for joint, each in own.items()
    }


def links(folder: Path, latest: Mapping[str, Row]) -> dict[str, str]:
    """Returns the relative address of each existing, up-to-date joint page.

    ``latest`` is from `shown`.
    """
    there = {each.name for each in (folder / PAGES).glob("*.html")}
    names = {joint: _name(row) for joint, row in latest.items()}
    return {joint: f"{PAGES}/{quote(name)}" for joint, name in names.items() if name in there}


def write_page(folder: Path, row: Row) -> None:
    """Diagnoses the recording again and writes its joint's page; removes the joint's older pages.

    InputError if recording or model no longer exist.
    """
    from hdbridge.analysis.diagnosis import diagnose
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.report.diagnosis import diagnosis_page
    from hdbridge.report.page import Section, Table, render

    given = {each.name: row[each.name] for each in fields(Source) if row.get(each.name)}
    source = Source(**{name: each for name, each in given.items() if name != "model"})
    where = str(folder / row["model"]) if row["model"].startswith("models/") else row["model"]
    model = local_model(where)
    if model.reason:
        raise InputError(model.reason)
    recording = replace(read(source), ratio=row["ratio"])
    result = diagnose(recording, TransmissionModel.from_text(model.text, where))
    known = {"joint": source.joint, "recording": source.path, "recorded": row["date"], "model": where}
    known |= {name: row[name] for name in ("gear", "batch", "cell", "lubricant")}
    known |= {"hours": None if row["hours"] is None else f"{row['hours']:,.0f}"}
    said = [("--model", where), ("--axis", source.axis if source.is_flight else None)]
    said += [(f"--{name}", row[name]) for name in ("columns", "units", "unwrap")]
    options = [word for name, value in said if value for word in (name, value)]
    page = diagnosis_page(
        result,
        title=f"Diagnosis of joint {source.joint}",
        provenance=[(name, value) for name, value in known.items() if value],
        command=command("diagnose", source.path, *options),
    )
    if row["mistaken"]:
        about = f"This is {Path(source.path).name}, the last recording of {source.joint} itself."
        table = Table(["recording", "why"], [[each.path, each.text] for each in row["mistaken"]])
        text = "File a recording under its own joint; after an exchange of the encoder, fit a new model."
        page = replace(
            page,
            verdict=f"{about} {sentence('; '.join(counted(row['mistaken'])))} {page.verdict}",
            sections=[Section("Recordings that do not fit this joint", text, [table]), *page.sections],
        )
    pages = make_folder(folder / PAGES)
    older = [
        each for each in pages.glob("*.html") if each.name[: -KEY_DIGITS - 5] == _name(row)[: -KEY_DIGITS - 5]
    ]
    write_atomically(pages / _name(row), render(page))
    for each in older:
        if each.name != _name(row):
            each.unlink(missing_ok=True)


def _name(row: Row) -> str:
    content = "\n".join([row["key"], *(each.path + each.text for each in row["mistaken"])])
    digits = hashlib.sha256(content.encode()).hexdigest()[:KEY_DIGITS]
    return f"{quote(row['joint'], safe='')}-{digits}.html"
