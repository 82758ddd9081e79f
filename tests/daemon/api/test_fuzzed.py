"""Requests made from the API's own description: never a 5xx, and nothing moves without the lease.

FUZZ_EXAMPLES=200 makes so many of each operation, and HYPOTHESIS_PROFILE=random others in every run.
"""

import os

import schemathesis
from hypothesis import Phase, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from support.fake_bridge import FakeBridge

from hdbridge.client import messages
from hdbridge.daemon.api.app import create_app
from hdbridge.daemon.api.metrics import Metrics
from hdbridge.daemon.api.traffic import Traffic

BRIDGE = FakeBridge()
LIMIT_DEG = 180.0
seen: set[str] = set()
schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", create_app(BRIDGE, Metrics(), Traffic()))
checks = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]
few = settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "3")), phases=[Phase.explicit, Phase.generate]
)


def machine(case) -> str:
    """Both axes enabled, the lease with somebody, whose token it is; the request is for an axis there is."""
    BRIDGE.__init__()
    token = BRIDGE.lease.take("the holder")
    for each in BRIDGE.axes.values():
        each.at = messages.ControlState.ENABLED
    if "axis" in case.path_parameters:
        case.path_parameters["axis"] = "joint-1"
    return token


@schema.parametrize()
@few
def test_without_the_lease_nothing_moves_and_nothing_fails(case):
    machine(case)
    case.headers.pop("X-Lease", None)
    case.call_and_validate(checks=checks)
    assert BRIDGE.moved == []


@schema.include(method=["POST", "PUT"]).parametrize()
@few
def test_with_the_lease_nothing_fails_and_no_target_is_outside_the_limits(case):
    answer = case.call_and_validate(headers={"X-Lease": machine(case)}, checks=checks)
    if answer.status_code >= 400:
        assert BRIDGE.moved == []
    for _, what, *given in BRIDGE.moved:
        seen.add(what)
        if what == "move":
            assert abs(given[0]) <= LIMIT_DEG


def test_that_found_requests_which_move():
    """Else the test before would have shown nothing."""
    assert {"move", "jog", "queue", "compensate", "model"} <= seen
