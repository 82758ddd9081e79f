"""Pages of single joints, next to the page of the fleet: `OUT/pages/JOINT-KEY.html`.

The name contains the start of the key of the recording that is shown, so a page is out of date as soon as
the joint has a newer recording, model or version.
"""

import shlex
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from urllib.parse import quote

from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, write_atomically
from hdbridge.fleet.diagnosing import local_model, read
from hdbridge.fleet.sources import Source
from hdbridge.fleet.summary import Row

PAGES = "pages"
KEY_DIGITS = 12


def links(folder: Path, latest: Mapping[str, Row]) -> dict[str, str]:
    """Returns the relative address of each joint's page that is there and up to date.

    ``latest`` holds the recording to show for each joint.
    """
    there = {each.name for each in (folder / PAGES).glob("*.html")}
    names = {joint: _name(row) for joint, row in latest.items()}
    return {joint: f"{PAGES}/{quote(name)}" for joint, name in names.items() if name in there}


def write_page(folder: Path, row: Row) -> None:
    """Diagnoses a recording of the data set again and writes the page; removes the joint's older pages.

    InputError if recording or model are not there any more.
    """
    from hdbridge.analysis.diagnosis import diagnose
    from hdbridge.axis.model import TransmissionModel
    from hdbridge.report.diagnosis import diagnosis_page
    from hdbridge.report.page import render

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
        command=shlex.join(["hdbridge", "diagnose", source.path, *options]),
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
    return f"{quote(row['joint'], safe='')}-{row['key'][:KEY_DIGITS]}.html"
