"""Twins of a profile: pending, committed, rolled back, and used by the simulated axis."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.command import run_here
from support.keys import changed

from hdbridge.axis import AxisConfig, Identity
from hdbridge.axis.model import store
from hdbridge.errors import InputError
from hdbridge.files.profile import Profile
from hdbridge.sim.truth import Truth
from hdbridge.simulated import simulated
from hdbridge.twin.twin import TWINS, TwinFile, diff

DATE = datetime(2026, 3, 1, 12, tzinfo=UTC)
SERIAL = Identity(vendor_id=0x4844, product_code=0x402, serial=17)


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    source = Path(__file__).parents[2] / "profiles" / "demo"
    folder = tmp_path / "demo"
    shutil.copytree(source, folder)
    return folder


def twin_of(profile: Path, coulomb_nm: float = 0.05) -> TwinFile:
    intervals = {"motor.coulomb_nm": (0.9 * coulomb_nm, 1.1 * coulomb_nm)}
    return TwinFile(changed(Truth.load(profile), motor__coulomb_nm=coulomb_nm, intervals=intervals))


def test_a_twin_is_pending_until_it_is_committed_and_activations_are_undone(profile: Path) -> None:
    before = Profile.find(str(profile)).simulated
    assert before.name == "truth.yaml"
    TWINS.propose(profile, twin_of(profile, 0.05), "made of a recording", DATE, SERIAL)
    assert Profile.find(str(profile)).simulated == before
    assert [each.name for each in TWINS.log(profile)] == ["pending"]
    assert TWINS.commit(profile, DATE, SERIAL) == 1
    assert Profile.find(str(profile)).simulated == profile / "twin.yaml"
    TWINS.propose(profile, twin_of(profile, 0.06), "after a repair", DATE, SERIAL)
    assert TWINS.commit(profile, DATE, SERIAL) == 2
    assert TWINS.rollback(profile, "no better", DATE, SERIAL) == 1
    assert TwinFile.load(profile / "twin.yaml").truth.motor.coulomb_nm == 0.05
    # The history of the models in the same profile is unaffected.
    assert store.log(profile) == []


def test_twins_read_back_exactly(profile: Path) -> None:
    """In the file, each confidence interval is on one line."""
    fit = {"parameters": ["Coulomb friction", "load inertia"], "noise": {"motor torque": 1e-05}}
    twin = twin_of(profile).with_provenance(fit=fit).bound_to(AxisConfig.load(profile), SERIAL)
    twin.save(profile / "pending-twin.yaml")
    assert TwinFile.load(profile / "pending-twin.yaml") == twin
    lines = [each.strip() for each in (profile / "pending-twin.yaml").read_text().splitlines()]
    assert "serial: 0x11" in lines
    assert sum(each.startswith("motor.coulomb_nm: [0.045") for each in lines) == 1


def test_the_older_twin_layout_is_read(profile: Path) -> None:
    text = TwinFile(Truth.load(profile)).dump()
    text += "intervals:\n  motor.coulomb_nm:\n    - 0.03\n    - 0.04\n"
    text += "provenance:\n  fit:\n    covariance:\n      -\n        - 0.1\n        - 0.2\n"
    (profile / "twin.yaml").write_text(text)
    kept = TwinFile.load(profile / "twin.yaml")
    assert kept.truth.intervals == {"motor.coulomb_nm": (0.03, 0.04)}
    assert kept.provenance["fit"]["covariance"] == [[0.1, 0.2]]


def test_a_twin_of_another_drive_or_gear_is_refused(profile: Path) -> None:
    TWINS.propose(profile, twin_of(profile), "", DATE, SERIAL)
    with pytest.raises(InputError, match="this twin was made for serial 0x11"):
        TWINS.commit(profile, DATE, Identity(vendor_id=0x4844, product_code=0x402, serial=18))
    other = twin_of(profile)
    gear = other.truth.gear.model_copy(update={"ratio": 80.0})
    with pytest.raises(InputError, match="this twin is of a gear with ratio 80"):
        TWINS.propose(profile, TwinFile(other.truth.model_copy(update={"gear": gear})), "", DATE)


def test_the_simulated_drive_uses_an_existing_twin(profile: Path) -> None:
    coarse = changed(Truth.load(profile), motor__encoder__counts_per_turn=4000)
    (profile / "twin.yaml").write_text(TwinFile(coarse).dump())
    axis = AxisConfig.load(profile)
    with simulated(axis) as drive, pytest.raises(Exception, match="4000"):
        drive.boot()
    with simulated(axis, profile / "truth.yaml") as drive:
        drive.boot()


def test_the_difference_of_two_twins_has_half_widths(profile: Path) -> None:
    rows = {f"{row.effect}.{row.parameter}": row for row in diff(Truth.load(profile), twin_of(profile).truth)}
    changed = rows["motor.coulomb_nm"]
    assert (changed.before, changed.after) == (0.034, 0.05)
    assert changed.half_width == pytest.approx(0.005)
    assert [name for name, row in rows.items() if row.changed] == ["motor.coulomb_nm"]
    assert "gear.motor_orders[2].amplitude_arcsec" in rows


def test_the_model_command_manages_twins(profile: Path) -> None:
    assert "no twin yet" in run_here(profile, "model", "log", profile, "--twin").stdout
    TWINS.propose(profile, twin_of(profile), "made of a recording", DATE)
    assert "coulomb_nm" in run_here(profile, "model", "diff", profile, "--twin").stdout
    assert "twin 1 is active" in run_here(profile, "model", "commit", profile, "--twin").stdout
    run_here(profile, "model", "log", profile, "--twin", "--json", "log.json")
    log = json.loads((profile / "log.json").read_text())
    assert log["schema"] == "hdbridge.twin-log/1"
    assert [each["reason"] for each in log["twins"]] == ["made of a recording"]
