"""Blind case: its hidden cause, drawn by its name and the suite's seed, and its folder."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import math
import random
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from blind.axes import EVERYDAY_LAWS, OTHER_LAWS, BlindAxis, EverydayAxis, drawn_axis, everyday_axes
from blind.fullbench import Bench, drawn_plan, run_of
from blind.plant import Plant, PlantRig, calibrated
from blind.work import KINDS as WORK_KINDS
from blind.work import Burst, drawn_work
from support.hidden import CAUSES, UNKNOWN, Hidden, Run, hide_all
from support.hidden.site import ARCSEC_PER_RAD, ARCSEC_PER_TURN

from hdbridge import InputError
from hdbridge.commissioning.calibration.measure import remaining_plan
from hdbridge.control.bench import axis_view
from hdbridge.motion.procedures.moves import Dwell, MoveTo
from hdbridge.motion.procedures.plan import Plan
from hdbridge.records.record import Record, concatenate
from hdbridge.records.recording import Recording, Segment
from hdbridge.sim.exercise import Readings
from hdbridge.sim.truth import Truth

SCHEMA = "hdbridge.blind/2"
HELD_OUT_FROM = 1000
"""Suites with this seed and above choose between versions of the code; those below develop it."""
KINDS: Mapping[str, str] = MappingProxyType(
    {
        "single": "bench suite", "pair": "bench suite", "triple": "bench suite",
        "none": "bench suite", "other_law": "bench suite", "unknown": "bench suite",
        "healthy_bench": "everyday", "healthy_work": "everyday", "fault": "everyday", "law": "everyday",
        "outside": "everyday", "flicker": "everyday", "faults": "everyday", "repeats": "everyday",
    }
)  # fmt: skip
"""Kinds of cases, and the family that each belongs to."""
LOADED = ("compliance", "torque_modulation")
WARM = ("zero_drift", "amplitude_drift")
SLOW = (*WARM, "wear")
"""Causes that take minutes."""
SLOW_S = 300.0
NEED_ROLLING = ("hysteresis_memory", "hysteresis_parameters")
RECORDS_PER_AXIS = 4
LARGEST_ARCSEC = 40.0
LONGEST_PROGRAM_S = 120.0
BETWEEN_PROGRAMS_S = 5.0
"""Pause between two runs of a repeated program, in the recording's time."""
BETWEEN_TASKS_S = 1.0
"""Pause between two tasks of a plan, in the recording's time."""
MOST_BENCH_SAMPLES = 1_000_000

# Structural aliases: no measurement on an unmodified axis separates them. A diagnosis that names one of them
# and gives the other as an alias is right.
TWINS = (
    ("motor_order", "motor_encoder_eccentricity"),
    ("load_order", "compliance"),
    ("ratio_error", "wear"),
    ("channel_skew", "velocity_windup"),
)


@dataclass(frozen=True)
class Case:
    """A case to be made.

    A bench case is one long record of a bench plan. An everyday case is a record of ordinary work, or of a
    bench plan if `bench` is set, and has the model of a calibration of its axis.
    """

    name: str
    kind: str
    causes: tuple[str, ...] = ()
    axis: str = ""
    """Name of the axis and its calibration, in an everyday case; empty in a bench case."""
    law: str = "rolling_friction"
    bench: bool = False
    """True if an everyday case runs a bench plan instead of everyday work."""
    pair: str = ""
    """Cases with the same pair share their random draws."""

    def folder(self, suite: Path, seed: int) -> Path:
        """Folder of the case; the name of a folder of a held-out suite reveals nothing."""
        hashed = hashlib.sha256(f"{seed} {self.name}".encode()).hexdigest()[:10]
        return suite / (self.name if seed < HELD_OUT_FROM else hashed)


def cases(wanted: Mapping[str, int], seed: int) -> Iterator[Case]:
    """Returns the cases of a suite; ``wanted`` is a number by kind, for single per cause."""
    for kind, number in wanted.items():
        if kind not in KINDS:
            raise ValueError(f"--suite: found '{kind}'; expected kinds of {', '.join(KINDS)}")
        yield from (_everyday_cases if KINDS[kind] == "everyday" else _bench_cases)(kind, number, seed)


def _bench_cases(kind: str, number: int, seed: int) -> Iterator[Case]:
    rng = random.Random(f"cases {seed}")
    if kind == "single":
        for cause, index in itertools.product(CAUSES, range(number)):
            yield Case(f"{kind}-{cause}-{index}", kind, (cause,))
        return
    for index in range(number):
        causes: tuple[str, ...] = ()
        if kind in {"pair", "triple"}:
            causes = _together(rng, 2 if kind == "pair" else 3)
        elif kind == "unknown":
            causes = (sorted(UNKNOWN)[index % len(UNKNOWN)],)
        yield Case(f"{kind}-{index:03d}", kind, causes)


def _everyday_cases(kind: str, number: int, seed: int) -> Iterator[Case]:
    rng = random.Random(f"cases {seed} {kind}")
    known, unknown = (rng.sample(sorted(each), len(each)) for each in (CAUSES, UNKNOWN))
    for index in range(number):
        name = f"{kind}-{index:03d}"
        axis = f"{kind}-{index // RECORDS_PER_AXIS:03d}"
        cause = known[index % len(known)]
        if kind in {"healthy_bench", "healthy_work"}:
            yield Case(name, kind, axis=axis, bench=kind == "healthy_bench")
        elif kind == "fault":
            yield Case(name, kind, (cause,), axis=axis, bench=index % 4 == 0)
        elif kind == "faults":
            yield Case(name, kind, _together(rng, rng.choice((2, 2, 3))), axis=axis, bench=index % 4 == 0)
        elif kind == "repeats":
            beyond = tuple(unknown[index % len(unknown) :][: rng.choice((0, 1))])
            yield Case(name, kind, (*_together(rng, rng.choice((1, 2, 3))), *beyond), axis=axis)
        elif kind == "outside":
            yield Case(name, kind, (unknown[index % len(unknown)],), axis=axis, bench=index % 2 == 0)
        elif kind == "law":
            law = EVERYDAY_LAWS[index // 2 % len(EVERYDAY_LAWS)]
            yield Case(name, kind, axis=f"{kind}-{index // 2:03d}", law=law, bench=index % 2 == 0)
        else:
            causes = (cause,) if index % 2 else ()
            for encoder in ("fine", "coarse"):
                axis = f"{kind}-{index // 2:03d}-{encoder}"
                yield Case(f"{name}-{encoder}", kind, causes, axis=axis, bench=index % 4 > 1, pair=name)


def _together(rng: random.Random, number: int) -> tuple[str, ...]:
    """Draws causes that can be distinguished when they occur together."""
    while True:
        causes = tuple(rng.sample(sorted(CAUSES), number))
        apart = all(not set(twins) <= set(causes) for twins in TWINS)
        if apart and not set(NEED_ROLLING) <= set(causes):
            return causes


def make(case: Case, seed: int, suite: Path) -> Path:
    """Draws, runs and writes a case atomically; returns its folder.

    The folder holds the record (CSV files, or a recording in ``record``), ``model.yaml``, ``sealed.json``
    and, if there is a cause, ``fresh``: the same course again on the same plant, with other noise.
    """
    target = case.folder(suite, seed)
    draft = suite / f".{target.name}.part"
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    if KINDS[case.kind] == "everyday":
        secret = _everyday(case, seed, draft, suite / "axes")
    else:
        secret = _full_bench(case, seed, draft)
    secret = {"case": case.name, "kind": case.kind, "family": KINDS[case.kind], "pair": case.pair, **secret}
    seal(draft, seed, secret)
    shutil.rmtree(target, ignore_errors=True)
    draft.rename(target)
    return target


def seal(folder: Path, seed: int, secret: Mapping[str, Any]) -> None:
    """Writes the secret of a case in packed form, to prevent reading it by accident."""
    packed = base64.b64encode(zlib.compress(json.dumps(secret).encode())).decode()
    text = json.dumps({"schema": SCHEMA, "seed": seed, "sealed": packed})
    (folder / "sealed.json").write_text(text + "\n", encoding="utf-8")


def unsealed(folder: Path) -> dict[str, Any]:
    """Returns the sealed truth of a case."""
    packed = json.loads((folder / "sealed.json").read_text(encoding="utf-8"))["sealed"]
    return dict(json.loads(zlib.decompress(base64.b64decode(packed))))


def _full_bench(case: Case, seed: int, folder: Path) -> dict[str, Any]:
    """Makes a case of the bench suite: one long record that shows everything, and a model a few per cent
    wrong.
    """
    rng = random.Random(f"blind {seed} {case.name}")
    law = rng.choice(OTHER_LAWS) if case.kind == "other_law" else "rolling_friction"
    axis = drawn_axis(rng, f"blind-{case.name}", law)
    plan = drawn_plan(rng, axis.truth.gear.ratio)
    run = run_of(plan, axis.truth)
    sizes = [(cause, _size_arcsec(rng, cause, axis.noise_arcsec)) for cause in case.causes]
    truth, hidden = hide_all(axis.truth, sizes, rng, run)
    readings = Bench(truth, rng.randrange(2**31), plan).record()
    columns = _columns(readings, rng)
    write_csv(folder / "record.csv", columns)
    (folder / "model.yaml").write_text(axis.model_yaml, encoding="utf-8")
    return {
        "motion": "full bench",
        "rate_hz": 50.0,
        "counts_per_turn": axis.truth.motor.encoder.counts_per_turn,
        "law": axis.law,
        "noise_arcsec": round(axis.noise_arcsec, 4),
        "samples": len(readings.time_s),
        **_told(hidden, truth),
        # Present, but not hidden on purpose: to name them is neither right nor wrong.
        "also": [*_brought(hidden), *_always(truth, run, axis, hidden)],
    }


def _size_arcsec(rng: random.Random, cause: str, noise_arcsec: float) -> float:
    size = max(3.0, 3.0 * noise_arcsec) * math.exp(rng.uniform(0.0, math.log(2.0)))
    return size / 3.0 if cause == "subdivisional_error" else size


def _told(hidden: Sequence[Hidden], truth: Truth) -> dict[str, Any]:
    return {
        "hidden": [
            {
                "cause": each.cause,
                "size_arcsec": round(each.size_arcsec, 4),
                "size_is": each.size_is,
                "text": each.text,
                "parameters": {key: float(value) for key, value in each.parameters.items()},
            }
            for each in hidden
        ],
        "truth": truth.model_dump(mode="json", by_alias=True, exclude_defaults=True),
    }


def _brought(hidden: Sequence[Hidden]) -> list[str]:
    return sorted({cause for each in hidden for cause in each.brings} - {each.cause for each in hidden})


def _wind_up_arcsec(truth: Truth, acceleration_deg_s2: float) -> float:
    """Returns the wind-up of the load in acceleration, which every axis has."""
    spring = truth.gear.stiffness_nm_per_rad / truth.load_.whole_inertia_kg_m2
    return acceleration_deg_s2 * 3600.0 / spring


def _always(truth: Truth, run: Run, axis: BlindAxis, hidden: Sequence[Hidden]) -> list[str]:
    """Returns the causes that every axis has, if they are large enough to be seen."""
    wind_up = _wind_up_arcsec(truth, run.load_acceleration_deg_s2)
    causes = {"inertial_windup"} if wind_up > 0.2 * max(axis.noise_arcsec, 0.5) else set()
    if truth.load_.coulomb_nm:
        wind_up = truth.load_.coulomb_nm / truth.gear.stiffness_nm_per_rad * ARCSEC_PER_RAD
        if wind_up > 0.3 * max(axis.noise_arcsec, 0.5):
            causes |= {"velocity_windup", "backlash"}
    return sorted(causes - {each.cause for each in hidden})


def _columns(readings: Readings, rng: random.Random) -> dict[str, tuple[Any, str]]:
    """Returns the columns of the record with their formats; slow channels have their own noise and steps."""
    torque, warmth = _slow_channels(readings.load_torque_nm, readings.temperature_c, rng.randrange(2**31))
    return {
        "time_s": (readings.time_s, "%.3f"),
        "motor_position_deg": (readings.motor_deg, "%.6f"),
        "load_position_deg": (readings.load_deg, "%.8f"),
        "motor_target_deg": (readings.target_deg, "%.6f"),
        "load_torque_nm": (torque, "%.2f"),
        "motor_torque_nm": (readings.motor_torque_nm, "%.4f"),
        "temperature_c": (warmth, "%.4f"),
    }


def _slow_channels(torque_nm: Any, temperature_c: Any, seed: int) -> tuple[Any, Any]:
    noise = np.random.default_rng(seed)
    torque = np.round(torque_nm + noise.normal(0.0, 0.02, len(torque_nm)), 2)
    warmth = np.round((temperature_c + noise.normal(0.0, 0.03, len(temperature_c))) / 0.0625) * 0.0625
    return torque, warmth


def write_csv(path: Path, columns: dict[str, tuple[Any, str]]) -> None:
    """Writes a record as bare CSV."""
    table = np.column_stack([values for values, _ in columns.values()])
    formats = [each for _, each in columns.values()]
    np.savetxt(path, table, fmt=formats, delimiter=",", header=",".join(columns), comments="")


def axis_of(case: Case, seed: int) -> EverydayAxis:
    """Returns the axis of an everyday case; those of a flickering pair differ only in the motor encoder."""
    if not case.pair:
        return everyday_axes(random.Random(f"axis {seed} {case.axis}"), case.axis, case.law)[0]
    name, _, encoder = case.axis.rpartition("-")
    rng = random.Random(f"axis {seed} {name}")
    encoders = {"fine": (2**20, rng.uniform(0.1, 0.5)), "coarse": (2**16, 0.0)}
    return everyday_axes(rng, name, case.law, list(encoders.values()))[list(encoders).index(encoder)]


@dataclass
class Course:
    """Commands of an axis, and the part of them that was recorded."""

    rig: PlantRig
    motion: str
    parts: list[tuple[int, int]]
    """First cycle, and the one after the last, of each part of the record."""
    segments: list[Segment]
    pause_s: float = 0.0
    """Pause between two parts of the record, s."""

    def run(self, ratio: float) -> Run:
        """Returns the properties of the course that determine the sizes of causes."""
        period_s = self.rig.axis.drive.cycle_s
        ways = [np.array(self.rig.target_deg[first:end]) for first, end in self.parts]
        speeds = [np.diff(each) / period_s for each in ways]
        accelerations = [np.diff(each) / period_s for each in speeds]
        return Run(
            duration_s=period_s * (self.parts[-1][1] - self.parts[0][0]),
            load_speed_deg_s=max(float(np.max(np.abs(each))) for each in speeds),
            load_acceleration_deg_s2=max(float(np.max(np.abs(each))) for each in accelerations),
            motor_turns=ratio * sum(float(np.sum(np.abs(each))) * period_s for each in speeds) / 360.0,
            load_reach_deg=(min(map(np.min, ways)), max(map(np.max, ways))),
        )


def _everyday(case: Case, seed: int, folder: Path, axes: Path) -> dict[str, Any]:
    """Makes a case on its own axis, with the model of its calibration."""
    axis = axis_of(case, seed)
    model = calibrated(
        axis, axes / case.axis, random.Random(f"calibration {seed} {case.axis}").randrange(2**31)
    )
    model.save(folder / "model.yaml")
    rng = random.Random(f"blind {seed} {case.pair or case.name}")
    rig = PlantRig(axis, rng.randrange(2**31))
    slow = any(each in SLOW for each in case.causes)
    if case.bench:
        course = _bench_course(rig, rng)
    else:
        kind = rng.choice([each for each in WORK_KINDS if each != "steps" or not slow])
        compensated = rng.random() < (0.6 if kind == "daemon" else 0.2)
        bench = rig.compensated(model) if compensated else rig.bench()
        if case.kind == "repeats":
            course = _repeated_course(rig, bench, rng)
        else:
            course = _work_course(rig, bench, kind, rng, SLOW_S if slow else 10.0)
    run = course.run(axis.config.gear.ratio)
    truth, hidden, seen, healthy = _with_causes(case, axis, course, run, rng)
    # Drawn last, so that a case without the cause has the same draws.
    period_s = axis.config.drive.cycle_s
    as_recorded = (case.bench and rng.random() < 0.6) or (course.motion == "daemon" and rng.random() < 0.6)
    rate_hz = math.exp(rng.uniform(math.log(10.0), math.log(1000.0)))
    every = 1 if as_recorded else max(1, round(1.0 / rate_hz / period_s))
    begin_s = 0.0 if as_recorded else rng.choice((0.0, 0.0, round(rng.uniform(0.0, 1e5), 3), 1.7e9))
    names = _channels(case, rng)
    layout = _Layout(course, every, begin_s, names, as_recorded)
    samples = layout.write(folder, "record", seen, rng.randrange(2**31))
    if hidden:
        fresh = Plant(axis, truth, rng.randrange(2**31)).run(rig.counts)
        layout.write(folder, "fresh", fresh, rng.randrange(2**31))
    effect = layout.taken(seen["exact_arcsec"] - healthy["exact_arcsec"])
    effect = np.abs(effect - np.mean(effect))
    for each in hidden:
        if each.cause == "count_loss":
            each.parameters["time_s"] = layout.time_of(each.parameters["time_s"])
    wind_up = _wind_up_arcsec(truth, run.load_acceleration_deg_s2)
    return {
        "motion": course.motion,
        "rate_hz": 1.0 / (period_s * every),
        "counts_per_turn": axis.config.motor_encoder.counts_per_turn,
        "flicker_counts": axis.flicker_counts,
        "columns": names,
        "law": axis.law,
        "noise_arcsec": axis.noise_arcsec,
        "samples": samples,
        "effect": {"peak_arcsec": float(np.max(effect)), "rms_arcsec": float(np.sqrt(np.mean(effect**2)))},
        **_told(hidden, truth),
        "also": sorted({*_brought(hidden), *(["inertial_windup"] if wind_up > 0.5 else [])}),
    }


def _bench_course(rig: PlantRig, rng: random.Random) -> Course:
    view, period_s = axis_view(rig.axis), rig.axis.drive.cycle_s
    name = rng.choice(("quick", "quick", "full", "dynamics"))
    if remaining_plan(Plan.load(name), rig.axis).duration_s > MOST_BENCH_SAMPLES * period_s:
        name = "quick"
    course = Course(rig, f"plan {name}", [], [], BETWEEN_TASKS_S)
    bench = rig.bench()
    for number, task in enumerate(Plan.load(name).tasks(view).tasks):
        first = len(rig.counts)
        bench.run(task.procedure)
        course.parts.append((first, len(rig.counts)))
        shift_s = number * BETWEEN_TASKS_S
        course.segments += [
            Segment(kind=each.kind, start_s=each.start_s + shift_s, end_s=each.end_s + shift_s)
            for each in bench.legs
        ]
    return course


def _work_course(rig: PlantRig, bench: Any, kind: str, rng: random.Random, shortest_s: float) -> Course:
    course = Course(rig, kind, [], [])
    way, *bursts = drawn_work(rng, axis_view(rig.axis), kind, shortest_s)
    bench.run(way)
    for each in bursts:
        first = len(rig.counts)
        bench.run(each)
        course.parts.append((first, len(rig.counts)))
        if each.pause_s:
            bench.run(each.standing)
    first, end = course.parts[0]
    if kind != "daemon" and rng.random() < 0.3:  # the recorder was started in motion
        course.parts[0] = (first + round(rng.uniform(0.0, 0.1) * (end - first)), end)
    return course


def _repeated_course(rig: PlantRig, bench: Any, rng: random.Random) -> Course:
    """Runs one program several times, each time from the same place; the way back is not recorded."""
    kind = rng.choice(("moves", "pick and place", "stream"))
    course = Course(rig, f"{kind}, repeated", [], [], BETWEEN_PROGRAMS_S)
    way, program = drawn_work(rng, axis_view(rig.axis), kind, longest_s=LONGEST_PROGRAM_S)
    start = next(each for each in reversed(way.legs) if isinstance(each, MoveTo))
    for _ in range(rng.randint(3, 6)):
        bench.run(Burst((*(way.legs if not course.parts else ()), start, Dwell(0.5))))
        first = len(rig.counts)
        bench.run(program)
        course.parts.append((first, len(rig.counts)))
    return course


def _with_causes(
    case: Case, axis: EverydayAxis, course: Course, run: Run, rng: random.Random
) -> tuple[Truth, list[Hidden], dict[str, Any], dict[str, Any]]:
    """Returns the truth with the causes, and the readings with and without them.

    Sizes are drawn from barely visible to large, and halved if the motor cannot carry them.
    """
    seed, hiding = rng.randrange(2**31), rng.randrange(2**31)
    healthy = Plant(axis, axis.truth, seed).run(course.rig.counts)
    count = ARCSEC_PER_TURN / 2**16 / axis.truth.gear.ratio if case.pair else axis.count_arcsec
    smallest = max(0.5, 0.3 * count, 0.3 * axis.truth.load_.encoder.noise_arcsec)
    sizes = [
        math.exp(rng.uniform(math.log(smallest), math.log(LARGEST_ARCSEC))) for _ in case.causes or ("",)
    ]
    if not case.causes:
        return axis.truth, [], healthy, healthy
    most_nm = 0.95 * 3.0 * axis.truth.motor.rated_torque_nm
    first_s = course.parts[0][0] * course.rig.axis.drive.cycle_s
    # A subdivisional error of one arcsec is as visible as three of others; every axis has some wind-up.
    factor = {"subdivisional_error": 1.0 / 3.0}
    added = {"inertial_windup": _wind_up_arcsec(axis.truth, run.load_acceleration_deg_s2)}
    for halvings in range(12):
        wanted = [
            (each, size * 0.5**halvings * factor.get(each, 1.0) + added.get(each, 0.0))
            for each, size in zip(case.causes, sizes, strict=True)
        ]
        try:
            truth, hidden = hide_all(axis.truth, wanted, random.Random(hiding), run)
        except (ValueError, InputError):
            continue  # out of the plant's ranges
        truth = _later(truth, first_s)
        seen = Plant(axis, truth, seed).run(course.rig.counts)
        if np.max(np.abs(seen["motor_torque_nm"])) < most_nm:
            hidden = [replace(each, parameters=dict(each.parameters)) for each in hidden]
            for each in hidden:
                if each.cause == "count_loss":
                    each.parameters["time_s"] += first_s
            return truth, hidden, seen, healthy
    raise RuntimeError(f"{case.name}: {', '.join(case.causes)} cannot be put into this axis")


def _later(truth: Truth, seconds: float) -> Truth:
    """Moves the loss of counts behind the start of the record."""
    data = truth.model_dump(by_alias=True)
    for encoder in (data["motor"]["encoder"], data["load"]["encoder"]):
        for loss in encoder["losses"]:
            loss["time_s"] += seconds
    return Truth.model_validate(data)


def _channels(case: Case, rng: random.Random) -> list[str]:
    """Returns the optional columns of the record."""
    shares = {
        "motor_target_deg": 0.55,
        "motor_torque_nm": 0.4,
        "load_torque_nm": 0.75 if set(case.causes) & set(LOADED) else 0.25,
        "temperature_c": 0.75 if set(case.causes) & set(WARM) else 0.35,
    }
    return [name for name, share in shares.items() if rng.random() < share]


@dataclass(frozen=True)
class _Layout:
    """Conversion of a course to a record: cycles, times, columns and files."""

    course: Course
    every: int
    begin_s: float
    names: list[str]
    as_recorded: bool
    """True for a recording folder with command and torque; else CSV files."""

    def _places(self) -> list[Any]:
        return [np.arange(first, end, self.every) for first, end in self.course.parts]

    def taken(self, column: Any) -> Any:
        """Returns the samples of a column."""
        return column[np.concatenate(self._places())]

    def _times(self) -> list[Any]:
        """Returns the times of each part."""
        first = self.course.parts[0][0]
        period_s = self.course.rig.axis.drive.cycle_s
        return [
            self.begin_s + (each - first) * period_s + number * self.course.pause_s
            for number, each in enumerate(self._places())
        ]

    def time_of(self, switched_on_s: float) -> float:
        """Converts a time since the axis was switched on to the record's time."""
        cycles = (np.concatenate(self._places()) + 1) * self.course.rig.axis.drive.cycle_s  # read at its end
        return float(np.interp(switched_on_s, cycles, np.concatenate(self._times())))

    def write(self, folder: Path, name: str, seen: Mapping[str, Any], seed: int) -> int:
        """Writes the record; returns its number of samples."""
        torque, warmth = _slow_channels(seen["load_torque_nm"], seen["temperature_c"], seed)
        seen = {**seen, "load_torque_nm": torque, "temperature_c": warmth}
        names = ["motor_position_deg", "load_position_deg", *self.names]
        if self.as_recorded:
            names = list(dict.fromkeys([*names, "motor_target_deg", "motor_torque_nm"]))
        records = [
            Record({"time_s": time_s, **{each: seen[each][places] for each in names}})
            for time_s, places in zip(self._times(), self._places(), strict=True)
            if len(places) >= 2
        ]
        if self.as_recorded:
            axis, first_s = self.course.rig.axis, self._segment_shift_s()
            segments = tuple(
                Segment(kind=each.kind, start_s=each.start_s + first_s, end_s=each.end_s + first_s)
                for each in self.course.segments
            )
            Recording(concatenate(records), segments, axis.name, axis.gear.ratio, axis.drive.identity).save(
                folder / name
            )
        else:
            for number, each in enumerate(records, 1):
                each.write_csv(folder / f"{name}-{number:02d}.csv.gz")
        return sum(map(len, records))

    def _segment_shift_s(self) -> float:
        """Offset from the time since the axis was switched on to the record's time, s."""
        return self.begin_s - (self.course.parts[0][0] + 1) * self.course.rig.axis.drive.cycle_s


def record_of(folder: Path, name: str = "record") -> list[Path]:
    """Returns the files or the recording folder of a case's record; empty if the case lacks that record."""
    if (folder / name).is_dir():
        return [folder / name]
    return sorted([*folder.glob(f"{name}.csv"), *folder.glob(f"{name}-*.csv.gz")])
