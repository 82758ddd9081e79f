"""Prints the tables of docs/bring-up.md: answers of `hdbridge check` to a folder of dictionaries (EDS, DCF).

    python tools/dictionaries.py FOLDER

The folder holds OWNER/REPOSITORY/PATH for each file, so that a row states its public source. Each file gets a
profile as a user would make it: `hdbridge new --from article`, the file next to the axis file, and the keys
`drive.eds`, `drive.mode` and `load_encoder.source` edited. The load encoder is 60E4h:01 if the dictionary has
it, else a node of its own. The other values are the article's.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdbridge.files.edsfile import decode

OWN = "{index: 0x60E4, subindex: 1, type: int32, via: tpdo}"
"""Load encoder of the article."""
NODE = "{index: 0x6004, subindex: 0, type: uint32, node: 2}"
MODES = ("csp", "ip")
LEFT = re.compile(r"(\w{4}h:\w\w), (.*?): (.*?)(?: \([^()]*: [\w.]+\))?")
MASTER, TIMER, SUPPORTED = "1016h:01", "1400h:05", "6502h:00"
STOPPED_BY = {
    (False, False): "heartbeat, event timer",
    (False, True): "heartbeat",
    (True, False): "event timer",
    (True, True): "**nothing**",
}
"""Consequences, by whether 1016h:01 and 1400h:05 are left to the drive."""


@dataclass
class Checked:
    """Dictionary with the answers of `hdbridge check`."""

    source: Path
    text: str
    verdicts: dict[str, str] = field(default_factory=dict)
    load_encoder: str = ""
    left: dict[str, dict[str, tuple[str, str]]] = field(default_factory=dict)
    """Objects left to the drive, with reason and consequence, by mode."""
    remarks: list[str] = field(default_factory=list)

    def key(self, section: str, key: str) -> str:
        """Returns a value of the file, empty if it has none."""
        found = re.search(
            rf"^\[{section}\]\s*$(?:(?!^\[).)*?^{key}[ \t]*=([^\r\n]*)",
            self.text,
            re.IGNORECASE | re.DOTALL | re.MULTILINE,
        )
        return found[1].strip() if found else ""


def main() -> None:
    """Prints the tables of the folder named on the command line."""
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        sys.exit("expected one argument: a folder with EDS and DCF files in OWNER/REPOSITORY/PATH")
    folder = Path(sys.argv[1])
    files = sorted(each for each in folder.rglob("*") if each.suffix.lower() in (".eds", ".dcf"))
    if not files:
        sys.exit(f"{folder}: has no EDS or DCF file")
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(2) as pool:
        article = Path(scratch) / "article"
        hdbridge("new", str(article), "--from", "article")
        checked = list(pool.map(lambda each: check(folder, each, article), files))
    checked.sort(key=lambda each: (name(each).lower(), str(each.source)))
    print_drives(checked)
    print_left(checked)


def check(folder: Path, file: Path, article: Path) -> Checked:
    """Checks one dictionary in each mode, in a copy of the article's profile."""
    found = Checked(file.relative_to(folder), decode(file.read_bytes()))
    with tempfile.TemporaryDirectory() as scratch:
        profile = Path(shutil.copytree(article, Path(scratch) / "axis"))
        shutil.copy(file, profile)
        axis = (profile / "axis.yaml").read_text()
        for mode in MODES:
            for source in (OWN, NODE):
                edited = re.sub(r"eds: \S+", f"eds: {file.name!r}\n  mode: {mode}", axis, count=1)
                (profile / "axis.yaml").write_text(edited.replace(OWN, source))
                done = hdbridge("check", str(profile), "--json", f"{scratch}/{mode}.json")
                complaint = re.sub(r"^hdbridge: \S*?:\d+:\d+: ", "", done.stderr.strip())
                if not complaint.startswith("load_encoder.source"):
                    break
            if done.returncode == 0:
                found.load_encoder = "60E4h:01" if source == OWN else "a node of its own"
                add(found, mode, json.loads(Path(f"{scratch}/{mode}.json").read_text()))
            else:
                found.verdicts[mode] = "no: " + brief(complaint, file.name)
    return found


def hdbridge(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command line of this checkout."""
    command = [sys.executable, "-m", "hdbridge", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def brief(complaint: str, file: str) -> str:
    """Returns an error message without the key of the axis file and the advice."""
    text = re.sub(r"^[\w.]+: ", "", complaint.partition(";")[0])
    text = text.replace(f" among the modes of {file}", " among its modes").replace(file, "it")
    return text.replace(", which hdbridge cannot do without", "")


def add(found: Checked, mode: str, answer: dict[str, Any]) -> None:
    """Adds the report of `check` on a valid dictionary."""
    left: dict[str, tuple[str, str]] = {}
    for line in answer["left to the drive"]:
        match = LEFT.fullmatch(line)
        if match is None:
            sys.exit(f"{found.source}: cannot read the line {line!r} of `hdbridge check`")
        left[match[1]] = (short(match[2], found.source.name), match[3])
    found.left[mode] = left
    found.verdicts[mode] = "if the drive has it" if SUPPORTED in left else "yes"
    for key in ("fixed mapping", "sent along", "not read"):
        found.remarks += [
            f"{key}: {each.rpartition(found.source.name)[2].lstrip(':')}" for each in answer[key]
        ]


def short(reason: str, file: str) -> str:
    """Returns a short reason why an object is left to the drive; empty if the dictionary lacks it."""
    if reason == f"which {file} lacks":
        return ""
    return re.sub(rf"^(which is|which|for which) | (in|of) {re.escape(file)}.*?(?= can carry|$)", "", reason)


def name(found: Checked) -> str:
    """Returns vendor and product as stated in the file."""
    names = (found.key("DeviceInfo", "VendorName"), found.key("DeviceInfo", "ProductName"))
    return ", ".join(filter(None, names)) or "(not given)"


def print_drives(checked: list[Checked]) -> None:
    """Prints one row for each dictionary."""
    print(
        "| vendor, product | file (revision, date): source | csp | ip | load encoder | "
        "master dies: stopped by | left to the drive |"
    )
    print("|---|---|---|---|---|---|---|")
    for each in checked:
        revision = each.key("DeviceInfo", "RevisionNumber") or each.key("FileInfo", "FileRevision") or "-"
        date = each.key("FileInfo", "ModificationDate") or each.key("FileInfo", "CreationDate") or "-"
        owner, repository, *path = each.source.parts
        source = f"`{each.source.name}` ({revision}, {date}): {owner}/{repository}, {'/'.join(path[:-1])}"
        both = [each.left[mode] for mode in MODES if mode in each.left]
        watched = STOPPED_BY[MASTER in both[0], TIMER in both[0]] if both else "-"
        cells = [
            name(each),
            source,
            *(each.verdicts[mode] for mode in MODES),
            each.load_encoder or "-",
            watched,
        ]
        print("|", " | ".join([*cells, objects(each)]).replace("\n", " "), "|")
    print()


def objects(found: Checked) -> str:
    """Returns the objects that are left to the drive, in all modes that work."""
    texts = []
    every: dict[str, str] = {}
    for mode, left in found.left.items():
        for key, (reason, _) in left.items():
            text = key.removesuffix(":00") + (f" ({reason})" if reason else "")
            if key not in every and every:
                text += f" in {mode}"
            texts += [text] if key not in (*every, MASTER, TIMER, SUPPORTED) else []
        every |= dict.fromkeys(left, mode)
    return "; ".join([", ".join(texts), *dict.fromkeys(found.remarks)]).strip("; ") or "-"


def print_left(checked: list[Checked]) -> None:
    """Prints the consequence of each object left to the drive, and the number of dictionaries concerned."""
    usable = [each for each in checked if each.left]
    rows = {
        row
        for each in usable
        for left in each.left.values()
        for row in ((k, c) for k, (_, c) in left.items())
    }
    counts = Counter(key for each in usable for key in {key for left in each.left.values() for key in left})
    print(f"| object | what follows if it is left to the drive | of {len(usable)} |")
    print("|---|---|---|")
    for key in sorted(counts):
        consequences = "; or: ".join(sorted(consequence for other, consequence in rows if other == key))
        print(f"| {key.removesuffix(':00')} | {consequences} | {counts[key]} |")


if __name__ == "__main__":
    main()
