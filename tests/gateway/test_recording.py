"""A flight recording of a gateway: requests and statuswords of the other master."""

import numpy as np
import pytest
from support.gateway import COUNTS_PER_DEG, swing

from hdbridge.daemon.machinefile import RecorderSettings
from hdbridge.daemon.recorder.export import exported
from hdbridge.daemon.recorder.flightfile import About, AxisAbout
from hdbridge.daemon.recorder.flightlog import Batch, FlightLog
from hdbridge.daemon.recorder.reading import flight_files, read


@pytest.mark.parametrize("bench", [{"period_s": 0.01}], indirect=True)
async def test_a_recording_has_the_targets_and_the_words_of_the_other_master(bench, tmp_path):
    plc, period_s = bench.plc, bench.daemon.period_s
    reader = bench.daemon.memory.reader()
    await bench.enable()
    await swing(bench)
    await bench.wait(1.0)
    outer = bench.bridge.axes["axis1"].state().outer
    # By design one cycle of the inner bus, and up to one more cycle until the next frame.
    assert period_s <= outer.latency_s <= outer.latency_99_s <= 2.01 * period_s
    plc.plan = lambda cycle: round(1000 * COUNTS_PER_DEG)  # beyond the limits of the axis
    await bench.wait(0.2)
    plc.cycling = False
    await bench.wait(1.0)
    assert bench.bridge.axes["axis1"].state().outer.latency_s is None
    sent, samples = plc.seen, reader.read()[0]
    about = About("cell", period_s, (AxisAbout.of(bench.daemon.axes[0].config),))
    log = FlightLog(tmp_path / "flights", RecorderSettings(), about)
    log.put(Batch(samples))
    log.close()
    flights = [read(each) for each in flight_files([tmp_path / "flights"])]
    axis = flights[0].axes["axis1"]
    time_s = 1e-9 * flights[0].machine["time_ns"]
    after = np.searchsorted(time_s, [at_s for at_s, *_ in sent]) + 1
    targets = [target / COUNTS_PER_DEG for *_, target in sent]
    inside = axis["outer_statusword"][after] & 0x6F == 0x27
    assert axis["outer_target_deg"][after][inside] == pytest.approx(np.array(targets)[inside], abs=1e-9)
    assert axis["outer_target_deg"].max() == pytest.approx(1000.0)
    assert axis["load_target_deg"].max() < 1000.0
    faulted = axis["outer_error_code"] == 0x8700
    assert set(axis["outer_statusword"][faulted] & 0x4F) == {0x0F, 0x08}
    assert set(axis["outer_controlword"]) == {0, 0x06, 0x07, 0x0F}
    assert set(axis["outer_nmt"]) == {5}
    assert set(axis["outer_mode"]) == {8}
    assert np.nanmedian(time_s - axis["outer_received_s"]) >= period_s
    record = exported(flights).record
    assert max(record.columns["outer_target_deg"]) == pytest.approx(1000.0)
    assert set(record.columns["outer_controlword"]) == {0x0F}
