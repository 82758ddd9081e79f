"""Every client call works, whichever optional key of axis and machine file is left out."""

from __future__ import annotations

import asyncio
import copy
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.daemon import stepped_daemon
from support.service import Service, article_profiles, play
from support.two_channels import CHANNELS

from hdbridge import Client
from hdbridge.axis import AxisConfig
from hdbridge.client.axis import Axis
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.policy import Policy
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import unix_socket
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.serve import follow
from hdbridge.errors import DaemonError, HdbridgeError, InputError
from hdbridge.files.yamlfile import document_from_text

MACHINE = """
schema: hdbridge.machine/1
name: cell
axes:
  - profile: axis1
    compensation: both
    adapt: observe
    load_loop: {gain_1_s: 1, maximum_arcsec: 20, slew_arcsec_s: 9}
  - {profile: axis2}
bus: {interface: virtual, channel: test, bitrate_bps: 500000, options: {}}
api: {socket: cell.sock}
lease_s: 3600
limits: {restarts_per_minute: 2}
recorder: {folder: flights, size_mb: 10}
adaptation: {mode: "off", folder: learnt, parameters: [hysteresis.offset_arcsec]}
realtime: {priority: 0, cpus: []}
"""
MORE = "realtime: {priority: 0, cpus: []}\n"

OF_THE_MACHINE = {
    "state": lambda c: c.state(),
    "axes": lambda c: c.axes,
    "axis": lambda c: c.axis("axis1"),
    "events": lambda c: c.events(),
    "mark": lambda c: c.mark("tea"),
    "lease_state": lambda c: c.lease_state(),
    "lease": lambda c: c.lease().__enter__(),
    "holds_lease": lambda c: c.holds_lease,
    "live": lambda c: next(iter(c.live(every=2, axes=["axis1"]))),
    "connected": lambda c: c.connected("/live").__enter__(),
    "coordinated": lambda c: c.coordinated({"axis1": 0.02}),
    "do": lambda c: c.state(),
    "stop": lambda c: c.stop(),
    "quick_stop": lambda c: c.quick_stop(),
    "lend_bus": lambda c: c.lend_bus(),
    "close": lambda c: None,
}
OF_AN_AXIS = {
    "state": lambda a: a.state(),
    "enable": lambda a: a.enable(),
    "compensate": lambda a: a.compensate("synchronous"),
    "activate_model": lambda a: a.activate_model("active"),
    "load_loop": lambda a: a.load_loop(True),
    "adapt": lambda a: a.adapt("observe"),
    "adaptation_back": lambda a: a.adaptation_back(),
    "move": lambda a: a.move(0.01),
    "jog": lambda a: a.jog(0.1),
    "queue": lambda a: a.queue([0.0, 0.01]),
    "clear_queue": lambda a: a.clear_queue(),
    "rest": lambda a: a.rest(),
    "stream": lambda a: a.stream().__enter__(),
    "stop": lambda a: a.stop(),
    "disable": lambda a: a.disable(),
    "read": lambda a: a.read("6064h"),
    "write": lambda a: a.write("6065h", 20000),
    "home": lambda a: a.home(99),
    "quick_stop": lambda a: a.quick_stop(),
    "reset": lambda a: a.reset(),
}


def test_these_are_all_calls_that_there_are() -> None:
    for kind, calls in ((Client, OF_THE_MACHINE), (Axis, OF_AN_AXIS)):
        assert set(calls) == {name for name in vars(kind) if not name.startswith("_")}


def files(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """An axis file and a machine file with every optional key."""
    profile = article_profiles(folder, 2)[0]
    path = profile.axis
    text = path.read_text() + CHANNELS + MORE
    axis = AxisConfig.from_text(text, path).model_dump(mode="json", by_alias=True, exclude_none=True)
    axis["bus"]["bitrate_bps"] = 500_000
    return axis, document_from_text(MACHINE, "machine.yaml").data


def keys(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The place of every key of a file."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in inside:
        if isinstance(key, str):
            yield (*at, key)
        yield from keys(value, (*at, key))


def without(data: Any, place: tuple[Any, ...]) -> Any:
    """The same file with this key left out."""
    left = at = copy.deepcopy(data)
    for each in place[:-1]:
        at = at[each]
    del at[place[-1]]
    return left


def machine_of(folder: Path, axis: dict[str, Any], machine: dict[str, Any]) -> Machine:
    """Read from files; InputError if a key that was left out is required."""
    (folder / "axis1" / "axis.yaml").write_text(yaml.safe_dump(axis))
    (folder / "machine.yaml").write_text(yaml.safe_dump(machine))
    return Machine.load(folder)


def content(machine: Machine) -> str:
    """Returns the content of the files, defaults included."""
    axes = [
        (each.config.model_dump_json(), each.compensation, each.adaptation, each.load_loop)
        for each in machine.axes
    ]
    return str((axes, machine.bus, machine.realtime, machine.api, machine.lease_s, machine.recorder))


def call_everything(machine: Machine, folder: Path) -> list[str]:
    """Every call of a client against the real service; complaints about answers that it cannot read."""
    complaints: list[str] = []

    def tried(name: str, call: Any, on: Any) -> None:
        try:
            call(on)
        except Exception as problem:
            # What the daemon refuses is an answer as well.
            if not isinstance(problem, HdbridgeError) or type(problem) is DaemonError:
                complaints.append(f"{name}: {problem!r}")

    def program(path: Path) -> None:
        with Client(path, name="test", timeout_s=60.0) as client:
            for name, call in OF_AN_AXIS.items():
                tried(name, call, client.axis("axis1"))
            for name, call in OF_THE_MACHINE.items():
                tried(name, call, client)

    async def story(service: Service) -> None:
        path = folder / "cell.sock"
        async with AsyncExitStack() as stack:
            bridge = await stack.enter_async_context(service.ready(simulated=True))
            for each in follow(machine, bridge, None, stack):
                bridge.core.observer.add(each)
            metrics = Metrics()
            bridge.core.observer.add(metrics)
            server = ApiServer(bridge, [Listener(unix_socket(path), Policy())], metrics)
            serving = asyncio.ensure_future(server.run())
            try:
                await asyncio.to_thread(program, path)
            finally:
                server.stop()
                await serving

    configs = [each.config for each in machine.axes]
    with stepped_daemon(configs, bitrate_bps=machine.bus.bitrate_bps) as daemon:
        play(story(Service(daemon, machine, folder)))
    return complaints


def test_every_optional_key_may_be_left_out(tmp_path: Path) -> None:
    axis, machine = files(tmp_path)
    complete = machine_of(tmp_path, axis, machine)
    tried = {content(complete)}
    complaints = {"nothing": call_everything(complete, tmp_path)}
    for number, file in enumerate((axis, machine)):
        for place in keys(file):
            left = [axis, machine]
            left[number] = without(file, place)
            try:
                one = machine_of(tmp_path, *left)
            except InputError:
                continue  # a required key
            if content(one) in tried:
                continue  # the same machine: the key was at its default
            tried.add(content(one))
            complaints[".".join(map(str, place))] = call_everything(one, tmp_path)
    assert {name: said for name, said in complaints.items() if said} == {}
    assert len(complaints) > 12


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_object_that_is_no_number_is_read(value: float) -> None:
    from hdbridge.client.messages import SdoValue

    told = SdoValue(index=0x2000, subindex=0, name="x", type="real32", value=value).model_dump_json()
    assert SdoValue.model_validate_json(told).value is None
