"""A procedure through the daemon gives what the same one gives on a bench."""

from pathlib import Path

import numpy as np
import pytest
from support.daemon import PROFILE
from support.service import Service, play, stepped_service

from hdbridge import AxisConfig, Bench, TransmissionModel
from hdbridge.commissioning.evaluation.stepping import SchemeResult
from hdbridge.control.bench import compensation_for
from hdbridge.daemon.service.activity import Activity, Kind
from hdbridge.daemon.service.axis import ServiceAxis
from hdbridge.daemon.service.procedures import knots_of, streamed_view
from hdbridge.daemon.service.rigs import DaemonRig
from hdbridge.errors import InputError
from hdbridge.motion.generator import Bounds
from hdbridge.motion.procedures.moves import Dwell, MoveTo, Sine
from hdbridge.motion.procedures.stepping import Stepping
from hdbridge.motion.stream import Stream
from hdbridge.simulated import simulated

SMALL = Stepping(count=12, step_deg=43.56)


@pytest.fixture
def service(tmp_path: Path):
    with stepped_service(tmp_path) as made:
        yield made


def rig_of(axis: ServiceAxis) -> DaemonRig:
    activity = Activity(Kind.JOB, "a test")
    axis.occupy(activity)
    return DaemonRig(axis, activity)


@pytest.mark.parametrize("jerk_deg_s3", [400.0, 4000.0, 40_000.0, 4e6])
@pytest.mark.parametrize("distance_deg", [0.01, 0.8712, 33.3])
def test_the_knots_of_a_move_are_its_targets_and_within_the_limits(
    jerk_deg_s3: float, distance_deg: float
) -> None:
    axis = AxisConfig.load(PROFILE)
    own = axis.limits.model_copy(update={"jerk_deg_s3": jerk_deg_s3})
    limits = streamed_view(axis.model_copy(update={"limits": own})).limits
    path = MoveTo(1.0 + distance_deg).path(1.0, limits)
    stream = Stream(1.0, limits, Bounds(-400.0, 400.0), 0.004)
    for knot in knots_of(path, 1, 0.004, limits):
        stream.add(*knot[1:])  # refuses what is beyond the limits
    stream.begin()
    for cycle in range(round(path.duration_s / 0.004) + 2):
        target = stream.step().position_deg
        assert target == pytest.approx(path.at(min(cycle * 0.004, path.duration_s)), abs=1e-9)
    assert stream.waiting


def test_the_legs_are_followed_as_on_a_bench(service: Service) -> None:
    class Legs:
        def moves(self, axis):
            first = yield MoveTo(3.0)
            second = yield Dwell(0.5)
            third = yield Sine(2.5, 0.5, 0.5, 1.0)
            return first, second, third

    async def story() -> None:
        async with service.ready() as bridge:
            bench = rig_of(bridge.axes["axis1"]).bench()
            run = bench.run(Legs())
            move, dwell, sine = run.outcome
            axis = service.machine.axes[0].config
            path = MoveTo(3.0).path(move[0].load_target_deg, bench._view.limits)
            times = np.array([each.time_s for each in move]) - move[0].time_s
            targets = [path.at(min(each, path.duration_s)) for each in times]
            assert [each.load_target_deg for each in move] == pytest.approx(targets, abs=1e-9)
            assert dwell[-1].time_s - dwell[0].time_s == pytest.approx(0.5, abs=1e-9)
            assert {each.load_target_deg for each in dwell} == {3.0}
            assert sine[0].load_target_deg == pytest.approx(3.0)
            assert min(each.load_target_deg for each in sine) == pytest.approx(2.0, abs=1e-4)
            assert [each.kind for each in run.segments] == ["move", "standstill", "sine"]
            times = run.record.time_s
            assert np.allclose(np.diff(times), axis.drive.cycle_s)  # nothing is missing between two legs
            assert bridge.axes["axis1"].state().state == "disabled"

    play(story())


def test_stepping_gives_the_figures_of_a_bench(service: Service) -> None:
    async def story() -> tuple[SchemeResult, SchemeResult]:
        async with service.ready() as bridge:
            rig = rig_of(bridge.axes["axis1"])
            model = TransmissionModel.load(service.machine.axes[0].profile.model)
            with_model = rig.bench(compensation_for(rig.axis, model)).run(SMALL)
            without = rig.bench().run(SMALL)
            assert with_model.survived == ()
            return SchemeResult.of(with_model.outcome), SchemeResult.of(without.outcome)

    compensated, bare = play(story())
    axis = AxisConfig.load(PROFILE)
    with simulated(axis) as drive:
        drive.boot()
        model = TransmissionModel.load(PROFILE / "model.yaml")
        reference = SchemeResult.of(Bench(drive, model).run(SMALL).outcome)
        bare_reference = SchemeResult.of(Bench(drive).run(SMALL).outcome)
    for mine, theirs in ((compensated, reference), (bare, bare_reference)):
        for way in ("cw", "ccw"):
            assert getattr(mine, way).three_sigma_arcsec == pytest.approx(
                getattr(theirs, way).three_sigma_arcsec, rel=0.15, abs=0.3
            )
            assert getattr(mine, way).mean_arcsec == pytest.approx(getattr(theirs, way).mean_arcsec, abs=1.0)


def test_a_procedure_that_would_leave_the_limits_is_refused_before_power(service: Service) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            bench = rig_of(bridge.axes["axis1"]).bench()
            with pytest.raises(InputError, match="nothing was moved"):
                bench.run(Stepping(count=100_000, step_deg=360.0))
            assert bridge.axes["axis1"].link.state.name == "DISABLED"

    play(story())
