"""Requests of a client as data, shared by the synchronous and the asyncio client.

A ``moving`` call requires the lease. A call that ``waits`` is answered when a motion has ended, so it has no
time-out: the daemon's supervision bounds it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter, ValidationError

from hdbridge.client import messages
from hdbridge.client.messages.problem import CONTENT_TYPE, Problem
from hdbridge.errors import DaemonError, HdbridgeError, InputError

A = TypeVar("A")
M = TypeVar("M", bound=BaseModel)
PREFIX = "/api/v1"
POLL_S: Final = 0.1
JOG_S: Final = 0.5
"""Time-out of a jog after the last request of its client."""
RENEWALS: Final = 3
"""Renewals of a lease per time-out."""


@dataclass(frozen=True)
class Call(Generic[A]):
    """A request and the type of its answer."""

    method: str
    path: str
    answer: type[A] | Any
    body: BaseModel | None = None
    moving: bool = False
    waits: bool = False
    query: Mapping[str, int] | None = None

    @property
    def content(self) -> bytes | None:
        """Body as JSON."""
        return None if self.body is None else self.body.model_dump_json(exclude_none=True).encode()

    def read(self, status: int, kind: str, content: bytes) -> A:
        """Returns the parsed answer; raises the daemon's error if it refused the request."""
        if status >= 400:
            raise _refused(status, kind, content)
        try:
            found: A = TypeAdapter(self.answer).validate_json(content)
        except ValidationError as problem:
            first = problem.errors(include_input=False, include_url=False)[0]
            raise DaemonError(
                f"{self.method} {self.path}: the answer is not what this version of hdbridge expects "
                f"({'.'.join(map(str, first['loc']))}: {first['msg']}); use the same version at both ends"
            ) from None
        return found


def _refused(status: int, kind: str, content: bytes) -> HdbridgeError:
    if kind.startswith(CONTENT_TYPE):
        try:
            return Problem.model_validate_json(content).error()
        except ValidationError:
            pass
    return DaemonError(
        f"HTTP {status}, which is not an answer of hdbridge: is another server at this address?"
    )


def given(request: type[M], /, **values: Any) -> M:
    """Builds a request; raises InputError for an invalid value before anything is sent."""
    try:
        return request.model_validate(values)
    except ValidationError as problem:
        first = problem.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{where}: found {first['input']!r}; {first['msg']}") from None


class MachineCalls:
    """Requests that concern no single axis."""

    @staticmethod
    def state() -> Call[messages.MachineState]:
        return Call("GET", "/state", messages.MachineState)

    @staticmethod
    def events(since: int) -> Call[messages.Events]:
        return Call("GET", "/events", messages.Events, query={"since": since})

    @staticmethod
    def lend_bus() -> Call[messages.MachineState]:
        return Call("POST", "/bus/lend", messages.MachineState, moving=True, waits=True)

    @staticmethod
    def mark(text: str) -> Call[messages.Events]:
        return Call("POST", "/mark", messages.Events, given(messages.Mark, text=text))

    @staticmethod
    def lease() -> Call[messages.LeaseState]:
        return Call("GET", "/lease", messages.LeaseState)

    @staticmethod
    def take_lease(client: str, force: bool) -> Call[messages.LeaseGrant]:
        wanted = given(messages.LeaseRequest, client=client, force=force)
        return Call("POST", "/lease", messages.LeaseGrant, wanted)

    @staticmethod
    def renew_lease() -> Call[messages.LeaseState]:
        return Call("PUT", "/lease", messages.LeaseState)

    @staticmethod
    def release_lease() -> Call[messages.LeaseState]:
        return Call("DELETE", "/lease", messages.LeaseState)

    @staticmethod
    def stop_all() -> Call[messages.MachineState]:
        return Call("POST", "/stop", messages.MachineState)

    @staticmethod
    def quick_stop_all() -> Call[messages.MachineState]:
        return Call("POST", "/quick-stop", messages.MachineState)

    @staticmethod
    def coordinated(
        targets_deg: Mapping[str, float], speed: float, wait: bool
    ) -> Call[messages.MachineState]:
        body = given(messages.Coordinated, targets_deg=dict(targets_deg), speed=speed, wait=wait)
        return Call("POST", "/coordinated", messages.MachineState, body, moving=True, waits=True)


class AxisCalls:
    """Requests of one axis."""

    def __init__(self, name: str) -> None:
        self.path = f"/axes/{quote(name, safe='')}"

    def _post(
        self, what: str, body: BaseModel | None = None, *, waits: bool = False, moving: bool = True
    ) -> Call[messages.AxisState]:
        path = f"{self.path}/{what}"
        return Call("POST", path, messages.AxisState, body, moving=moving, waits=waits)

    def state(self) -> Call[messages.AxisState]:
        return Call("GET", self.path, messages.AxisState)

    def enable(self) -> Call[messages.AxisState]:
        return self._post("enable", waits=True)

    def disable(self) -> Call[messages.AxisState]:
        return self._post("disable", waits=True)

    def reset(self) -> Call[messages.AxisState]:
        return self._post("reset", waits=True)

    def stop(self) -> Call[messages.AxisState]:
        return self._post("stop", moving=False)

    def quick_stop(self) -> Call[messages.AxisState]:
        return self._post("quick-stop", moving=False)

    def home(self, method: int, **values: float | None) -> Call[messages.AxisState]:
        return self._post("home", given(messages.Home, method=method, **values), waits=True)

    def move(
        self,
        target_deg: float,
        velocity_deg_s: float | None,
        acceleration_deg_s2: float | None,
        wait: bool,
    ) -> Call[messages.AxisState]:
        body = given(
            messages.Move,
            target_deg=target_deg,
            velocity_deg_s=velocity_deg_s,
            acceleration_deg_s2=acceleration_deg_s2,
            wait=wait,
        )
        return self._post("move", body, waits=True)

    def jog(self, velocity_deg_s: float, timeout_s: float) -> Call[messages.AxisState]:
        return self._post("jog", given(messages.Jog, velocity_deg_s=velocity_deg_s, timeout_s=timeout_s))

    def queue(self, points: Sequence[messages.QueueItem | float]) -> Call[messages.AxisState]:
        items = [
            each.model_dump() if isinstance(each, messages.QueueItem) else {"target_deg": each}
            for each in points
        ]
        return self._post("queue", given(messages.Queue, points=items))

    def clear_queue(self) -> Call[messages.AxisState]:
        return Call("DELETE", f"{self.path}/queue", messages.AxisState, moving=True)

    def compensate(self, scheme: messages.Scheme | str) -> Call[messages.AxisState]:
        return self._post("compensate", given(messages.Compensate, scheme=scheme))

    def activate_model(self, version: int | str) -> Call[messages.AxisState]:
        return self._post("model", given(messages.ActivateModel, version=version), waits=True)

    def load_loop(self, on: bool) -> Call[messages.AxisState]:
        return self._post("load-loop", given(messages.SwitchLoadLoop, on=on))

    def adapt(self, mode: messages.AdaptationMode | str) -> Call[messages.AxisState]:
        return self._post("adaptation", given(messages.Adapt, mode=mode))

    def adaptation_back(self) -> Call[messages.AxisState]:
        return Call("DELETE", f"{self.path}/adaptation", messages.AxisState, moving=True)

    def read(self, name: str) -> Call[messages.SdoValue]:
        return Call("GET", f"{self.path}/objects/{quote(name, safe='')}", messages.SdoValue)

    def write(self, name: str, value: str) -> Call[messages.SdoValue]:
        path = f"{self.path}/objects/{quote(name, safe='')}"
        return Call("PUT", path, messages.SdoValue, given(messages.SdoWrite, value=value), moving=True)
