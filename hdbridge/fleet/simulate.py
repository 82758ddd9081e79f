"""Simulated fleet: random joints that age over a year, and recordings with typical file faults.

Each joint is the bundled demo axis with a gear of its own. Its recordings come from the simulated axis
(`hdbridge.sim`), which shares no code with the diagnosis. `answers.json` contains the hidden causes and
faults.
"""

import gzip
import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random
from typing import Any, Final

from hdbridge.errors import InputError
from hdbridge.files.atomic import make_folder, write_atomically
from hdbridge.files.profile import Profile
from hdbridge.records.record import Record
from hdbridge.sim.exercise import Exercise
from hdbridge.sim.machine import Machine
from hdbridge.sim.truth import Truth

YEAR_HOURS: Final = 8000.0
BEGIN: Final = datetime(2026, 1, 5, 6, 0, tzinfo=UTC)
LUBRICANTS: Final = ("grease A", "grease B")
CELLS: Final = ("cell 1", "cell 2", "cell 3")
BATCHES: Final = ("2025-07", "2025-08", "2025-09")
SICK: Final = 0.2
"""Fraction of joints with a growing cause; three times as large in the last batch."""
ODD: Final = 0.1
"""Fraction of joints with unusually large motor orders from the beginning."""
EVERYDAY: Final = 0.015
"""Relative standard deviation of order amplitudes and hysteresis offset between recordings of one joint."""
FRICTION_NM: Final = 0.3
"""Load friction of a joint with backlash."""
STIFFNESS_NM_PER_RAD: Final = 45_000.0


@dataclass
class Joint:
    """A simulated joint: its properties, its ageing and the faults of its recordings."""

    name: str
    batch: str
    cell: str
    lubricant: str
    orders: list[dict[str, float]]
    offset_arcsec: float
    cause: str | None = None
    arcsec_per_1000_hours: float = 0.0
    """Growth rate of the cause's peak, which is zero at 0 operating hours."""
    odd: bool = False
    swapped_with: str | None = None
    """Joint under whose name the recordings of this joint are filed, from number ``swapped_at`` on."""
    swapped_at: int | None = None
    turned_at: int | None = None
    """Number of the first recording after an exchange of the motor encoder."""
    turned_deg: float = 0.0
    hours: list[float] = field(default_factory=list)


def _load_order(data: dict[str, Any], size: float) -> None:
    radius_mm = 30.0
    shift_um = size / 206264.8 * radius_mm * 1e3
    data["load"]["encoder"]["disc"] = {
        "radius_mm": radius_mm,
        "eccentricity_um": shift_um,
        "eccentric_at_deg": 40.0,
    }


def _backlash(data: dict[str, Any], size: float) -> None:
    data["gear"]["backlash_arcsec"] = 2.0 * size
    data["load"]["coulomb_nm"] = FRICTION_NM  # without friction the load follows through the gap


def _flexspline(data: dict[str, Any], size: float) -> None:
    data["gear"]["flexspline_orders"] = [{"order": 2, "amplitude_arcsec": size, "phase_deg": 70.0}]


def _motor_order(data: dict[str, Any], size: float) -> None:
    data["gear"]["motor_orders"].append({"order": 5, "amplitude_arcsec": size, "phase_deg": 25.0})


def _loop(data: dict[str, Any], size: float) -> None:
    data["gear"]["hysteresis"]["offset_arcsec"] += size


CAUSES: Final[Mapping[str, Callable[[dict[str, Any], float], None]]] = {
    "load_order": _load_order,
    "backlash": _backlash,
    "flexspline_order": _flexspline,
    "motor_order": _motor_order,
    "hysteresis_parameters": _loop,
}
"""Causes of ageing, as functions that add a cause with a given peak, in arcsec, to the data of a truth."""


def simulate(
    folder: Path, joints: int, recordings: int, seed: int, progress: Callable[[float], None] = lambda _: None
) -> None:
    """Writes recordings, `manifest.csv` and `answers.json` to a new folder.

    One file in a hundred is damaged, and one in fifty is duplicated. In a hundred joints, two are exchanged
    for each other, and one has its motor encoder replaced. Each fault occurs at least once. InputError for
    fewer than 4 joints or 3 recordings, and for a folder that is not empty.
    """
    if joints < 4 or recordings < 3:
        raise InputError(
            f"found {joints} joints with {recordings} recordings; expected at least 4 with at least 3"
        )
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: is not empty; expected a new folder")
    make_folder(folder)
    rng = Random(seed)
    base = Truth.load(Profile.find("demo").truth).model_dump(by_alias=True, mode="json")
    fleet = [_drawn(number, recordings, base, rng) for number in range(1, joints + 1)]
    healthy = [each for each in fleet if each.cause is None]
    for each in fleet if len(healthy) < 3 else ():
        each.cause, each.arcsec_per_1000_hours = None, 0.0
    healthy = [each for each in fleet if each.cause is None]
    chosen = rng.sample(healthy, 3 * min(max(1, joints // 100), len(healthy) // 3))
    for one, other, turned in zip(chosen[::3], chosen[1::3], chosen[2::3], strict=True):
        one.swapped_with, other.swapped_with = other.name, one.name
        one.swapped_at = other.swapped_at = rng.randrange(1, recordings)
        turned.turned_at, turned.turned_deg = rng.randrange(1, recordings), rng.uniform(30.0, 330.0)
        one.hours = other.hours = [max(each) for each in zip(one.hours, other.hours, strict=True)]
    named = {each.name: each for each in fleet}
    rows, paths = [], []
    for done, each in enumerate(fleet):
        for number in range(recordings):
            swapped = each.swapped_at is not None and number >= each.swapped_at
            filed = named[each.swapped_with] if swapped and each.swapped_with else each
            path = folder / filed.name / f"{round(each.hours[number]):06d}.csv.gz"
            make_folder(path.parent)
            _recorded(each, number, base, rng).write_csv(path)
            paths.append(path)
            rows.append(_row(path.relative_to(folder), filed, each.hours[number]))
        progress((done + 1) / joints)
    content = {
        "schema": "hdbridge.fleet-answers/1",
        "seed": seed,
        **_spoiled(folder, paths, rows, rng),
        "joints": [asdict(each) for each in fleet],
    }
    write_atomically(folder / "answers.json", json.dumps(content, indent=2) + "\n")
    lines = [
        ",".join(rows[0]),
        *(",".join(each.values()) for each in sorted(rows, key=lambda each: each["path"])),
    ]
    write_atomically(folder / "manifest.csv", "\n".join(lines) + "\n")


def _drawn(number: int, recordings: int, base: Mapping[str, Any], rng: Random) -> Joint:
    batch = rng.choice(BATCHES)
    joint = Joint(f"J{number:04d}", batch, rng.choice(CELLS), rng.choice(LUBRICANTS), [], 0.0)
    joint.odd = rng.random() < ODD
    scale = rng.uniform(2.0, 2.5) if joint.odd else 1.0
    joint.orders = [
        {
            "order": each["order"],
            "amplitude_arcsec": scale * each["amplitude_arcsec"] * rng.uniform(0.7, 1.3),
            "phase_deg": rng.uniform(-180.0, 180.0),
        }
        for each in base["gear"]["motor_orders"]
    ]
    joint.offset_arcsec = base["gear"]["hysteresis"]["offset_arcsec"] * rng.uniform(0.9, 1.1)
    if rng.random() < SICK * (3.0 if batch == BATCHES[-1] else 1.0) and not joint.odd:
        joint.cause = rng.choice(list(CAUSES))
        joint.arcsec_per_1000_hours = rng.uniform(0.6, 2.0)
    step = YEAR_HOURS / recordings
    joint.hours = [round((k + rng.uniform(0.0, 0.6)) * step + 20.0, 1) for k in range(recordings)]
    return joint


def _truth(joint: Joint, number: int, base: Mapping[str, Any], rng: Random) -> Truth:
    """Returns the parameters of the axis during one of its recordings."""
    data = json.loads(json.dumps(base))
    data["substep_ms"] = 1.0
    data["motor"]["encoder"].update(counts_per_turn=65536, interpolation=16)
    data["gear"].update(stiffness_nm_per_rad=STIFFNESS_NM_PER_RAD, damping_nm_s_per_rad=40.0)
    data["servo"]["load_feedforward"]["frequency_hz"] = 65.0
    turned = joint.turned_at is not None and number >= joint.turned_at
    data["gear"]["motor_orders"] = [
        {
            **each,
            "amplitude_arcsec": each["amplitude_arcsec"] * rng.gauss(1.0, EVERYDAY),
            "phase_deg": (each["phase_deg"] + turned * each["order"] * joint.turned_deg) % 360.0,
        }
        for each in joint.orders
    ]
    data["gear"]["hysteresis"]["start_arcsec"] = 0.0
    data["gear"]["hysteresis"]["offset_arcsec"] = joint.offset_arcsec * rng.gauss(1.0, EVERYDAY)
    if joint.cause is not None:
        CAUSES[joint.cause](data, joint.arcsec_per_1000_hours * joint.hours[number] / 1000.0)
    return Truth.model_validate(data)


def _recorded(joint: Joint, number: int, base: Mapping[str, Any], rng: Random) -> Record:
    """Records a minute of motion: a load turn in each direction, and sine motions of several amplitudes."""
    exercise = Exercise(
        Machine(_truth(joint, number, base, rng), rng.randrange(2**31), may_compile=True), cycles_per_sample=4
    )
    exercise.hold(0.5)
    exercise.move(-720.0, 600.0, 2000.0)
    exercise.move(18_000.0 + 720.0, 720.0, 2000.0)
    exercise.hold(0.5)
    exercise.move(-18_000.0, 720.0, 2000.0)
    for amplitude_deg in (90.0, 30.0, 8.0):
        exercise.sine(amplitude_deg, 0.25, 1.0)
    exercise.hold(0.5)
    found = exercise.readings()
    return Record(
        {
            "time_s": found.time_s,
            "motor_position_deg": found.motor_deg,
            "load_position_deg": found.load_deg,
            "motor_target_deg": found.target_deg,
        }
    )


def _row(path: Path, joint: Joint, hours: float) -> dict[str, str]:
    date = BEGIN + timedelta(hours=hours)
    return {
        "path": path.as_posix(),
        "joint": joint.name,
        "ratio": "50",
        "batch": joint.batch,
        "cell": joint.cell,
        "lubricant": joint.lubricant,
        "hours": f"{hours:g}",
        "date": date.isoformat(timespec="seconds"),
    }


def _spoiled(folder: Path, paths: list[Path], rows: list[dict[str, str]], rng: Random) -> dict[str, Any]:
    """Damages some files, duplicates others and returns their paths."""
    bad = rng.sample(range(len(paths)), max(1, len(paths) // 100))
    twice = rng.sample([each for each in range(len(paths)) if each not in bad], max(1, len(paths) // 50))
    for place in bad:
        path = paths[place]
        how = rng.randrange(3)
        if how == 0:  # an interrupted transfer
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        elif how == 1:
            path.write_bytes(b"")
        else:
            path.write_bytes(gzip.compress(b"<html>404 Not Found</html>\n", mtime=0))
    copies = []
    for place in twice:
        path = paths[place]
        copy = path.with_name(path.name.replace(".csv.gz", "-copy.csv.gz"))
        shutil.copyfile(path, copy)
        rows.append({**rows[place], "path": copy.relative_to(folder).as_posix()})
        copies.append(rows[-1]["path"])
    return {"damaged": [rows[each]["path"] for each in bad], "copies": copies}
