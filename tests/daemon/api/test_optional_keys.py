"""Every client call works, whichever optional key of axis and machine file is left out."""

import asyncio
import copy
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from itertools import combinations
from math import comb
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.daemon import stepped_daemon
from support.service import Service, article_profiles, play
from support.two_channels import CHANNELS

from hdbridge import Client
from hdbridge.axis import AxisConfig
from hdbridge.client.sync import Axis
from hdbridge.daemon.api.guard import Policy
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.server import ApiServer, Listener
from hdbridge.daemon.api.sockets import unix_socket
from hdbridge.daemon.machine import Machine
from hdbridge.daemon.serve import follow
from hdbridge.daemon.service.bridge import ServiceBridge
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
    "coordinated": lambda c: c.coordinated({"axis1": 0.02}),
    "name": lambda c: c.name,
    "address": lambda c: c.address,
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
    "revert_adaptation": lambda a: a.revert_adaptation(),
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


def test_every_client_call_is_listed() -> None:
    for kind, calls in ((Client, OF_THE_MACHINE), (Axis, OF_AN_AXIS)):
        assert set(calls) == {name for name in vars(kind) if not name.startswith("_")}


def files(folder: Path) -> tuple[Any, Any]:
    """An axis file and a machine file with every optional key."""
    profile = article_profiles(folder, 2)[0]
    path = profile.axis
    text = path.read_text() + CHANNELS + MORE
    axis = AxisConfig.from_text(text, path).model_dump(mode="json", by_alias=True, exclude_none=True)
    axis["bus"]["bitrate_bps"] = 500_000
    return axis, document_from_text(MACHINE, "machine.yaml").data


def keys(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Returns the path of every key of a file."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in inside:
        if isinstance(key, str):
            yield (*at, key)
        yield from keys(value, (*at, key))


def without(data: Any, places: Iterable[tuple[Any, ...]]) -> Any:
    """Returns the file without these keys; a section precedes its keys."""
    left = copy.deepcopy(data)
    for place in places:
        at: Any = left
        for each in place[:-1]:
            at = at.get(each, {}) if isinstance(at, dict) else at[each]
        at.pop(place[-1], None)
    return left


def machine_of(folder: Path, axis: dict[str, Any], machine: dict[str, Any]) -> Machine:
    """Reads the machine from files; InputError if a required key is missing."""
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


@asynccontextmanager
async def served(bridge: ServiceBridge, path: Path) -> AsyncIterator[None]:
    """Serves a real service at a Unix socket, in its own event loop, until the end of the block."""
    metrics = Metrics(bridge)
    bridge.core.add_sink(metrics)
    server = ApiServer(bridge, [Listener(unix_socket(path), Policy())], metrics)
    serving = asyncio.ensure_future(server.run())
    try:
        yield
    finally:
        server.stop()
        await serving


def call_everything(machine: Machine, folder: Path) -> list[str]:
    """Makes every client call to the real service; returns complaints about unreadable answers."""
    complaints: list[str] = []

    def tried(name: str, call: Any, on: Any) -> None:
        try:
            call(on)
        except Exception as problem:
            # A refusal is an answer as well.
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
            follow(bridge, stack)
            await stack.enter_async_context(served(bridge, path))
            await asyncio.to_thread(program, path)

    configs = [each.config for each in machine.axes]
    with stepped_daemon(configs, bitrate_bps=machine.bus.bitrate_bps) as daemon:
        play(story(Service(daemon, machine, folder)))
    return complaints


def test_every_call_works_without_optional_keys(tmp_path: Path) -> None:
    """For each pair of optional keys, either is left out at least once while the other is present."""
    whole = files(tmp_path)
    tried = {content(machine_of(tmp_path, *whole))}
    optional = []
    for number, file in enumerate(whole):
        for place in keys(file):
            left = [*whole]
            left[number] = without(file, [place])
            with suppress(InputError):  # the key is required
                one = content(machine_of(tmp_path, *left))
                if one not in tried:  # otherwise the file states the default
                    tried.add(one)
                    optional.append((number, place))
    assert len(optional) > 12
    runs = next(count for count in range(99) if comb(count, count // 2) >= len(optional))
    missing: list[list[tuple[int, tuple[Any, ...]]]] = [[] for _ in range(runs)]
    for key, chosen in zip(optional, combinations(missing, runs // 2), strict=False):
        for each in chosen:
            each.append(key)
    complaints = {}
    for each in ([], *missing):
        left = [without(file, [p for n, p in each if n == number]) for number, file in enumerate(whole)]
        complaints[str(each)] = call_everything(machine_of(tmp_path, *left), tmp_path)
    assert {without: said for without, said in complaints.items() if said} == {}
    assert len(complaints) == 1 + runs


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_non_numeric_objects_are_read(value: float) -> None:
    from hdbridge.client.messages import SdoValue

    text = SdoValue(index=0x2000, subindex=0, name="x", type="real32", value=value).model_dump_json()
    assert SdoValue.model_validate_json(text).value is None
