"""Tests with hidden physical causes: the diagnosis names them, and the extended model compensates them.

There is one bench for each cause of the catalogue, for pairs, for no cause, for a different hysteresis law,
and for causes outside the catalogue. Sizes are 5 arcsec at the load (2 for the subdivisional error) with
readings that have 0.3 arcsec of noise. Each plan is one that an engineer who suspects the cause would choose.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from support.hidden import CAUSES
from support.hidden import UNKNOWN as UNKNOWN_CAUSES
from support.hidden_bench import (
    ACCELERATION_DEG_S2,
    CYCLE_MS,
    FAST_MS,
    MORE_MS,
    REACH_DEG,
    SPEED_DEG_S,
    STEPPING,
    Cell,
    Still,
    bare_truth,
    hidden_bench,
)
from support.keys import changed
from typer.testing import CliRunner

from hdbridge.axis.effects import CATALOGUE
from hdbridge.axis.model import TransmissionModel
from hdbridge.cli import app
from hdbridge.commissioning.improvement.extension import extension_of
from hdbridge.motion.procedures.moves import Procedure, Settle
from hdbridge.motion.procedures.reversals import Reversals
from hdbridge.motion.procedures.sine import Sines
from hdbridge.motion.procedures.standstill import Precondition
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.motion.procedures.sweep import Sweep
from hdbridge.records.recording import Recording
from hdbridge.sim.lockstep import nameplate_of
from hdbridge.sim.truth import Truth

SEEDS = [int(each) for each in os.environ.get("HIDDEN_SEEDS", "1").split()]
"""Seeds with which each cause is hidden; HIDDEN_SEEDS="1 2 3" sets more than one."""
MOST_OF_FLOOR = 1.3
Parts = tuple[Procedure[Any], ...]
LOOP: Parts = (
    Precondition(0.0, 2.0),
    Still(3.0),
    Sweep(-10.0, 12.0, 2.0),
    Sines(0.0, (180.0, 45.0, 5.0), 0.1, 1.0),
    Reversals(depths_deg=(2.0, 5.0, 9.0, 16.0), reach_deg=40.0, velocity_deg_s=0.5, beyond=True),
)
"""Motion that shows the hysteresis loop and the motor orders; every bench begins with it."""
FAST: Parts = (Sweep(-15.0, 65.0, SPEED_DEG_S),)
"""Sweep at another speed over part of a load turn, which shows the same motor orders."""
TURN: Parts = (Sweep(*REACH_DEG, SPEED_DEG_S),)
"""Sweep over all load angles in both directions: shows dependence on the angle or on the torque of a mass."""
AGAIN: Parts = (Still(6.0), Sweep(-10.0, 12.0, 4.0)) * 4
"""Repeated visits to one pose: show changes with time, temperature or wear."""
SPEEDS: Parts = (*FAST, Sweep(-10.0, 30.0, 12.0), Sweep(-4.0, 6.0, 0.7))
RESTS: Parts = (*FAST, Still(12.0), Sweep(-30.0, 60.0, SPEED_DEG_S), Still(12.0))
SWINGS: Parts = (Sweep(-15.0, 40.0, 3.0), Sines(0.0, (100.0,), 0.7, 8.0))
"""Motion with smooth accelerations of up to 39 deg/s^2: shows wind-up without ringing of a soft gear."""
TWICE: Parts = (Sweep(*REACH_DEG, SPEED_DEG_S, laps=2),)
"""Four passes over every load angle."""
TORQUES: Parts = (*TURN, Sweep(80.0, 102.0, 2.0), Sweep(170.0, 192.0, 2.0))
"""Sweeps of equal motor angles under several torques of an eccentric mass."""
SLOW: Parts = (*SPEEDS, Sweep(-1.0, 1.0, 0.1))
"""Sweeps down to a speed at which a speed-dependent loop equals the loop at rest."""
AT_REST = replace(STEPPING, settle=Settle(minimum_s=1.0))
"""Stepping test with a longer rest, for a hysteresis loop that depends on past speeds."""


def lagging() -> Truth:
    """Returns an axis whose gear temperature follows the temperature sensor with a lag of one minute."""
    return changed(bare_truth(), temperature__zero_time_constant_s=60.0)


def greased() -> Truth:
    """Returns an axis whose servo compensates the viscous drag of its grease by feed-forward.

    Otherwise the integral term compensates it, every stop overshoots by three motor counts (2.4 arcsec), and
    the error at rest is 7.4 times the floor, whatever the model.
    """
    return changed(bare_truth(), servo__viscous_feedforward_nm_s_per_rad=0.004)


def obeying(law: str, **shape: float) -> Truth:
    """Returns an axis with a loop of about the size of the model's, but of a law outside the catalogue."""
    data = bare_truth().model_dump(by_alias=True)
    data["gear"]["hysteresis"] = {
        "law": law,
        "offset_arcsec": 31.5,
        "yield_deg": 4.0,
        "exponent": 1.2,
        **shape,
    }
    return Truth.model_validate(data)


@dataclass(frozen=True)
class Bench:
    """Hidden causes, and the motion and test conditions in which they must be found."""

    parts: Parts
    causes: tuple[str, ...]
    highest_deg_s2: float = ACCELERATION_DEG_S2
    truth: Truth | None = None
    stepping: Stepping = STEPPING
    cycle_ms: int = CYCLE_MS

    @contextmanager
    def run(self, folder: Path, seed: int) -> Iterator[Cell]:
        """Provides the axis with its hidden causes, already measured."""
        sizes = [(each, 2.0 if each == "subdivisional_error" else 5.0) for each in self.causes]
        parts = (*LOOP, *self.parts)
        with hidden_bench(folder, sizes, seed, parts, self.highest_deg_s2, self.truth, self.cycle_ms) as cell:
            cell.stepping = self.stepping
            yield cell


def single(cause: str, parts: Parts, **more: Any) -> tuple[str, Bench]:
    return cause, Bench(parts, (cause,), **more)


def pair(first: str, second: str, parts: Parts) -> tuple[str, Bench]:
    return f"{first} and {second}", Bench(parts, (first, second), cycle_ms=FAST_MS)


SINGLE = dict(
    (
        single("motor_order", FAST),
        single("motor_encoder_eccentricity", FAST),
        single("load_order", TURN),
        single("flexspline_order", TURN),
        single("direction_phase", FAST),
        single("torque_modulation", TORQUES, cycle_ms=MORE_MS),
        single("compliance", TURN),
        single("inertial_windup", SWINGS, highest_deg_s2=39.0, stepping=AT_REST, cycle_ms=FAST_MS),
        single("velocity_windup", SPEEDS, truth=greased(), cycle_ms=FAST_MS),
        single("channel_skew", SPEEDS),
        single("backlash", FAST, cycle_ms=FAST_MS),
        single("hysteresis_memory", FAST),
        single("hysteresis_parameters", FAST),
        single("rate_dependence", SLOW, stepping=AT_REST),
        single("subdivisional_error", FAST),
        single("zero_drift", AGAIN),
        single("amplitude_drift", AGAIN),
        single("wear", AGAIN, cycle_ms=MORE_MS),
        single("creep", RESTS, cycle_ms=MORE_MS),
        single("ratio_error", TURN),
        single("count_loss", FAST),
        single("vibration", FAST),
        single("local_defect", TWICE),
    )
)
PAIRS = dict(
    (
        pair("motor_order", "channel_skew", SPEEDS),
        pair("load_order", "vibration", TURN),
        pair("flexspline_order", "hysteresis_parameters", TURN),
        pair("torque_modulation", "amplitude_drift", (*TORQUES, *AGAIN)),
    )
)
UNKNOWN = {each: Bench(TURN, (each,), cycle_ms=MORE_MS) for each in UNKNOWN_CAUSES}
OTHER_LAW = {
    "Bouc-Wen": Bench(FAST, (), truth=obeying("bouc_wen", beta=0.6)),
    "Dahl": Bench(FAST, (), truth=obeying("dahl")),
}
LAGGING = {"zero_drift behind its sensor": Bench(AGAIN, ("zero_drift",), truth=lagging())}
NONE = {"nothing": Bench((*FAST, *TURN), ())}
QUICK = {*SINGLE, *LAGGING, *NONE, "motor_order and channel_skew", "unexplained:roller", "Bouc-Wen"}
"""Benches of every run; `make test-slow` has all of them."""


def of(benches: dict[str, Bench]) -> list[Any]:
    """Returns pytest parameters: each bench with each seed."""
    return [
        pytest.param(
            (bench, seed),
            id=name if len(SEEDS) == 1 else f"{name}-{seed}",
            marks=[] if seed == SEEDS[0] and name in QUICK else [pytest.mark.slow],
        )
        for name, bench in benches.items()
        for seed in SEEDS
    ]


@pytest.fixture(scope="module")
def cell(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """Provides the measured bench of a case; its diagnosis is made only once, on request."""
    bench, seed = request.param
    with bench.run(tmp_path_factory.mktemp("hidden"), seed) as cell:
        yield cell


def described(cell: Cell) -> str:
    """Returns the hidden causes and the findings as text, for the message of a failed assertion."""
    hidden = "; ".join(each.text for each in cell.hidden) or "nothing"
    findings = cell.diagnosis.findings
    found = "; ".join(f"{each.cause} {each.probability:.2f} or {each.aliases}" for each in findings)
    return f"hidden: {hidden}; found: {found or 'nothing'} ({cell.recording}, {cell.model})"


def test_every_cause_of_the_catalogue_has_its_bench() -> None:
    assert set(SINGLE) == set(CAUSES)


@pytest.mark.parametrize("cell", of(SINGLE | PAIRS), indirect=True)
def test_only_hidden_causes_are_named(cell: Cell) -> None:
    hidden = {each.cause for each in cell.hidden}
    there = hidden.union(*(each.brings for each in cell.hidden))
    named = [{each.cause, *each.aliases} for each in cell.diagnosis.findings]
    for cause in hidden:
        assert any(cause in each for each in named), described(cell)
    for finding in named:
        assert finding & there, described(cell)
    assert len(named) <= len(there), described(cell)


@pytest.mark.parametrize("cell", of(SINGLE | PAIRS), indirect=True)
def test_the_extended_model_restores_accuracy_or_explains(cell: Cell) -> None:
    extension = extension_of(cell.diagnosis, TransmissionModel.load(cell.model))
    left = {each.cause for each in cell.hidden if not CATALOGUE[each.cause].compensable.possible}
    for cause in left:
        reason = f"{cause} is not compensated: {CATALOGUE[cause].compensable.why}"
        assert reason in extension.left, described(cell)
    if left:
        return
    residual, floor = cell.step(extension.model), cell.floor_arcsec
    assert residual < MOST_OF_FLOOR * floor, f"{residual:.2f} over a floor of {floor:.2f}; {described(cell)}"


@pytest.mark.parametrize("cell", of(LAGGING), indirect=True)
def test_a_zero_that_follows_its_sensor_slowly_is_named_with_its_lag(cell: Cell) -> None:
    assert [each.cause for each in cell.diagnosis.findings] == ["zero_drift"], described(cell)
    lag = cell.diagnosis.findings[0].parameters["tau_s"]
    assert lag.low < 60.0 < lag.high


@pytest.mark.parametrize("cell", of({"count_loss": SINGLE["count_loss"]}), indirect=True)
def test_the_command_gives_the_same_result_for_the_recording_folder(cell: Cell, tmp_path: Path) -> None:
    out, extended = tmp_path / "diagnosis.json", tmp_path / "extended.yaml"
    command = ["diagnose", str(cell.recording), "--model", str(cell.model), "--json", str(out)]
    done = CliRunner().invoke(app, [*command, "--extend", str(extended)], catch_exceptions=False)
    assert done.exit_code == 0
    assert json.loads(out.read_text())["findings"] == cell.diagnosis.as_dict()["findings"]
    assert TransmissionModel.load(extended) == cell.diagnosis.model


@pytest.mark.parametrize("cell", of(NONE), indirect=True)
def test_nothing_is_found_if_nothing_is_hidden(cell: Cell) -> None:
    assert not cell.diagnosis.findings, described(cell)
    extension = extension_of(cell.diagnosis, TransmissionModel.load(cell.model))
    assert cell.step(extension.model) < MOST_OF_FLOOR * cell.floor_arcsec


@pytest.mark.parametrize("cell", of(OTHER_LAW), indirect=True)
def test_another_law_of_the_loop_is_named_as_such_and_nothing_else(cell: Cell) -> None:
    named = {each.cause for each in cell.diagnosis.findings}
    assert named & {"hysteresis_parameters", "hysteresis_memory", "unexplained"}, described(cell)
    assert not named - {"hysteresis_parameters", "hysteresis_memory", "unexplained"}, described(cell)


@pytest.mark.parametrize("cell", of(UNKNOWN), indirect=True)
def test_unknown_causes_are_unexplained_with_their_coordinate(cell: Cell) -> None:
    findings = cell.diagnosis.findings
    assert [each.cause for each in findings] == ["unexplained"], described(cell)
    assert findings[0].lives_in


def test_the_same_seed_gives_the_same_record_bit_for_bit(tmp_path: Path) -> None:
    def record(folder: str, seed: int) -> bytes:
        parts = (Precondition(0.0, 2.0), Reversals(depths_deg=(5.0,)))
        with hidden_bench(tmp_path / folder, [("vibration", 5.0), ("creep", 5.0)], seed, parts) as cell:
            columns = Recording.load(cell.recording).record.columns
            return b"".join(columns[name].tobytes() for name in sorted(columns))

    once = record("once", 1)
    assert record("again", 1) == once
    assert record("another", 2) != once


def test_a_drive_reports_the_nominal_ratio() -> None:
    nameplate = nameplate_of(changed(bare_truth(), gear__ratio=49.99981))
    assert (nameplate.gear_motor_turns, nameplate.gear_load_turns) == (50, 1)
