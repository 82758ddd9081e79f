"""Calibration with the motion test: the response is measured, stored and carried over."""

from hdbridge.axis.model import TransmissionModel


def test_response_is_measured_stored_reported_and_carried_over(cell):
    short = (cell.folder / "short.yaml").read_text()
    (cell.folder / "moving.yaml").write_text(short.replace("validation: {", "validation: {motion: true, "))
    done = cell.calibrate("--plan", "moving.yaml", "--out", "rec", "--json", "result.json")
    assert "deg/s" in done.stdout
    result = cell.json("result.json")
    assert result["offered"], result["reason"]
    assert "ripple at 19 deg/s" in result["reason"]
    for each in result["motion"]["speeds"]:
        assert each["filtered_arcsec"] < 1.05 * each["none_arcsec"]
    assert result["motion"]["speeds"][-1]["removed_percent"] > 70.0
    measured = TransmissionModel.load(cell.axis / "pending.yaml").response
    assert measured is not None
    assert measured.model_dump(mode="json") == result["motion"]["response"]

    cell.run("report", "rec", "--json", "again.json")
    assert cell.json("again.json")["motion"] == result["motion"]

    cell.run("model", "commit", "axis")
    cell.calibrate("--plan", "short.yaml", "--out", "rec2", "--json", "next.json")
    assert cell.json("next.json")["motion"] is None
    assert TransmissionModel.load(cell.folder / "rec2" / "model.yaml").response == measured
