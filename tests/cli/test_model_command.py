"""`hdbridge model`: show, compare, commit, roll back; state after a kill."""

import json

import pytest

from hdbridge.axis.model import TransmissionModel

PENDING = """\
schema: hdbridge.model/1
ratio: 50
effects:
  - effect: hysteresis
    parameters: {{offset_arcsec: {offset}, width_deg: 20, exponent: 1.6}}
    uncertainty: {{offset_arcsec: 0.1}}
provenance:
  axis: article
  drive: {{vendor_id: 0x4844, product_code: 0x402}}
  gear: {{ratio: 50}}
  date: "2026-01-02T03:04:05Z"
  reason: offset {offset}
"""


@pytest.fixture
def propose(profile):
    """Returns a function that writes a pending model with the given offset to the profile."""
    (profile.folder / "model.yaml").unlink()

    def propose(offset: float):
        (profile.folder / "pending.yaml").write_text(PENDING.format(offset=offset))
        return profile.folder

    return propose


def offset(folder) -> float:
    (effect,) = TransmissionModel.load(folder / "model.yaml").effects
    return effect.parameters()["offset_arcsec"]


def test_models_are_committed_activated_rolled_back_and_logged(hdbridge, propose, tmp_path):
    for each in (41.0, 42.0):
        folder = propose(each)
        hdbridge("model", "commit", folder)
        assert offset(folder) == each
    assert not (folder / "pending.yaml").exists()
    hdbridge("model", "activate", folder, 1, "--reason", "the first was better")
    assert offset(folder) == 41.0
    for expected in (42.0, 41.0):
        hdbridge("model", "rollback", folder, "--reason", "no")
        assert offset(folder) == expected
    done = hdbridge("model", "rollback", folder, status=2)
    assert "nothing to roll back to" in done.stderr

    done = hdbridge("model", "log", folder, "--json", "log.json")
    assert "the first was better" in done.stdout
    log = json.loads((tmp_path / "log.json").read_text())
    assert log["schema"] == "hdbridge.model-log/1"
    assert [each["number"] for each in log["models"]] == [2, 1]
    assert [each["active"] for each in log["models"]] == [False, True]
    assert log["models"][1]["reason"] == "offset 41.0"


def test_diff_compares_active_and_pending_or_any_two(hdbridge, propose, tmp_path):
    folder = propose(41.0)
    done = hdbridge("model", "diff", folder)
    assert "no model → pending" in done.stdout
    hdbridge("model", "commit", folder)
    propose(42.5)
    done = hdbridge("model", "diff", folder, "--json", "diff.json")
    assert "+1.50 " in done.stdout
    rows = json.loads((tmp_path / "diff.json").read_text())["parameters"]
    changed = [each for each in rows if each["changed"]]
    assert [(each["parameter"], each["before"], each["after"]) for each in changed] == [
        ("offset_arcsec", 41.0, 42.5)
    ]
    hdbridge("model", "commit", folder)
    assert "-1.5" in hdbridge("model", "diff", folder, 2, 1).stdout
    done = hdbridge("model", "diff", folder, 2, 7, status=2)
    assert "there is no model '7'" in done.stderr


@pytest.mark.parametrize(
    "asked",
    [
        ("step", "profile", "--simulate"),
        ("motion", "profile", "--simulate", "--model", "profile/model.yaml"),
        ("improve", "profile", "--simulate"),
        ("check", "profile", "--model", "profile/model.yaml"),
        ("diagnose", "record.csv", "--model", "profile"),
        ("diagnose", "record.csv", "--model", "profile/model.yaml"),
    ],
)
def test_every_command_without_a_model_advises_the_next_step(hdbridge, propose, asked):
    folder = propose(41.0)
    done = hdbridge(*asked, status=2)
    assert "profile/model.yaml: there is no active model; commit the pending one: " in done.stderr
    assert done.stderr.rstrip().count("hdbridge model commit ") == 1
    hdbridge("model", "discard", folder)
    assert "calibrate first: hdbridge calibrate profile" in hdbridge(*asked, status=2).stderr
