"""Jobs: they have the axis to themselves, can be cancelled, and what they measured is kept."""

import json
from pathlib import Path

import pytest
from support.service import Service, play, stepped_service, until

from hdbridge.axis.model import TransmissionModel, store
from hdbridge.client.messages import Job, JobKind
from hdbridge.daemon.service.bridge import ServiceBridge
from hdbridge.daemon.service.jobs import in_own_process
from hdbridge.errors import InputError, LeaseError, RefusedError
from hdbridge.records.recording import Recording

SHORT = """\
schema: hdbridge.plan/1
name: short
reference_s: 0.5
procedures:
  - {procedure: standstill, duration_s: 0.5}
  - {procedure: sweep, motor_turns: 3, motor_turns_per_s: 1.5}
  - {procedure: reversals, depths_deg: [20], reach_deg: 50, motor_deg_per_s: 40}
validation: {count: 4, cycles: 2, travel_deg: 5}
"""


@pytest.fixture
def service(tmp_path: Path):
    with stepped_service(tmp_path) as made:
        yield made


def of_id(bridge: ServiceBridge, job: Job) -> Job:
    return next(each for each in bridge.jobs() if each.id == job.id)


async def ended(bridge: ServiceBridge, job: Job) -> Job:
    await until(bridge, lambda: of_id(bridge, job).state != "running", 1000.0)
    return of_id(bridge, job)


def test_a_stepping_test_runs_and_is_kept(service: Service) -> None:
    async def story() -> None:
        async with service.enabled() as (bridge, token):
            axis = bridge.axes["axis1"]
            job = await axis.job(token, JobKind.STEP, {"count": 6, "scheme": ["none", "both"]})
            assert job.state == "running"
            assert axis.state().job is not None
            words = rf"job {job.id} runs on axis 'axis1' \(\d+ % done, begun by 'test'\)"
            ended_by = f"'hdbridge ctl cancel {job.id}' ends it"
            with pytest.raises(RefusedError, match=f"{words}; {ended_by}, or wait for its end"):
                await axis.move(token, 1.0)
            with pytest.raises(RefusedError, match=words):
                await axis.job(token, JobKind.STEP)
            with pytest.raises(LeaseError, match=f"'test' holds the right to move; .*{words}.*--force"):
                bridge.lease.take("another")
            done = await ended(bridge, job)
            assert done.state == "done", done.problem
            assert done.share == 1.0
            assert done.result["both"]["pooled"]["three_sigma_arcsec"] < 6.0
            assert done.result["none"]["pooled"]["three_sigma_arcsec"] > 10.0
            folder = Path(done.folder)
            assert folder.parent == service.machine.axes[0].profile.folder / "recordings"
            assert json.loads((folder / "result.json").read_text()) == done.result
            assert (folder / "stepping-none.csv.gz").exists()
            state = axis.state()
            assert state.state == "disabled"
            assert state.job is None
            assert state.scheme == "extended"
            await axis.enable(token)
            await axis.move(token, 1.0)
            assert axis.state().compensating

    play(story())


def test_what_a_process_refuses_is_the_jobs_problem(service: Service) -> None:
    async def story() -> None:
        async with service.ready(runner=in_own_process) as bridge:
            axis = bridge.axes["axis1"]
            token = bridge.lease.take("test")
            job = await axis.job(token, JobKind.STEP, {"count": 4, "model": 99})
            done = await ended(bridge, job)
            assert done.state == "failed"
            assert "no model '99'" in done.problem.detail
            assert axis.state().state == "disabled"

    play(story())


def test_a_cancelled_job_stops_the_axis_and_keeps_what_it_measured(service: Service) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            axis = bridge.axes["axis1"]
            token = bridge.lease.take("test")
            service.daemon.bus.spy = cancel_after(bridge, 3000)
            job = await axis.job(token, JobKind.STEP, {"count": 40, "scheme": "none"})
            done = await ended(bridge, job)
            assert done.state == "cancelled"
            assert 0.0 < done.share < 1.0
            assert (Path(done.folder) / "stepping-none-stopped.csv.gz").exists()
            assert axis.state().state == "disabled"
            with pytest.raises(InputError, match="no job 'step-9'"):
                await bridge.cancel_job(token, "step-9")

    play(story())


def cancel_after(bridge: ServiceBridge, frames: int):
    """A spy on the bus that cancels the job in its middle: nothing else runs in this thread meanwhile."""
    seen = 0

    def spy(can_id: int, data: bytes) -> None:
        nonlocal seen
        seen += 1
        if seen == frames:
            for job in bridge.jobs():
                bridge.book.cancel(job.id)

    return spy


def test_a_fault_ends_a_job_with_the_loops_words(service: Service) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            axis = bridge.axes["axis1"]
            token = bridge.lease.take("test")
            sent = 0

            def spoil(can_id: int, data: bytes) -> None:
                nonlocal sent
                sent += 1
                if sent == 3000:
                    service.daemon.nodes[0].faults.raise_error(0x3210)

            service.daemon.bus.spy = spoil
            job = await axis.job(token, JobKind.STEP, {"count": 40, "scheme": "none"})
            done = await ended(bridge, job)
            assert done.state == "failed"
            assert "the drive reports a fault" in done.problem.detail
            assert axis.state().state == "quick-stopped"
            assert (Path(done.folder) / "stepping-none-stopped.csv.gz").exists()
            await axis.reset(token)
            await axis.enable(token)
            await axis.move(token, axis.state().load_target_deg + 1.0)

    play(story())


@pytest.mark.parametrize(
    ("kind", "options", "words"),
    [
        (JobKind.STEP, {"counts": 3}, "counts"),
        (JobKind.STEP, {"count": 1}, "count"),
        (JobKind.STEP, {"scheme": "other"}, "scheme"),
        (JobKind.CALIBRATE, {"plan": "../../etc/passwd"}, "plan"),
        (JobKind.CALIBRATE, {"resume": "a/b"}, "resume"),
    ],
)
def test_options_that_a_job_does_not_have_are_refused_at_once(
    service: Service, kind: JobKind, options: dict[str, object], words: str
) -> None:
    async def story() -> None:
        async with service.ready() as bridge:
            token = bridge.lease.take("test")
            with pytest.raises(InputError, match=words):
                await bridge.axes["axis1"].job(token, kind, options)
            assert bridge.jobs() == []

    play(story())


def test_calibrates_to_a_pending_model(tmp_path: Path) -> None:
    async def story(service: Service) -> None:
        profile = service.machine.axes[0].profile
        profile.model.unlink()
        (profile.folder / "short.yaml").write_text(SHORT)
        async with service.ready() as bridge:
            axis = bridge.axes["axis1"]
            token = bridge.lease.take("test")
            job = await axis.job(token, JobKind.CALIBRATE, {"plan": "short"})
            done = await ended(bridge, job)
            assert done.state == "done", done.problem
            assert done.result["offered"], done.result["reason"]
            recording = Recording.load(Path(done.folder))
            assert recording.axis == "axis1"
            assert (Path(done.folder) / "report.html").exists()
            assert axis.state().model is None  # pending is not in use
            await axis.activate_model(bridge.lease.take("again"), "pending")
            assert "calibration" in axis.state().model.reason
            assert store.find(profile.folder, "active").number == 1

    with stepped_service(tmp_path, model=TransmissionModel(50.0)) as service:
        play(story(service))
