"""Requests generated from the API's own description: never a 5xx, and no motion without the lease.

FUZZ_EXAMPLES=200 sets the number of requests per operation and tests every value at the bounds of the schema;
HYPOTHESIS_PROFILE=random uses different requests in every run.
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

BRIDGE = FakeBridge()
LIMIT_DEG = 180.0
schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", create_app(BRIDGE, Metrics(BRIDGE)))
schema.config.phases.coverage.enabled = "FUZZ_EXAMPLES" in os.environ
checks = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
# A bounded number of examples of each operation, the same in every run.
most = int(os.environ.get("FUZZ_EXAMPLES", "3"))
few = settings(max_examples=most, phases=[Phase.explicit, Phase.generate])
fewer = settings(max_examples=most, phases=[Phase.generate])


def machine(case) -> str:
    """Enables all axes and directs the request to an axis that exists; returns the token of the lease."""
    BRIDGE.__init__()
    token = BRIDGE.lease.take("the holder")
    for each in BRIDGE.axes.values():
        each.at = messages.ControlState.ENABLED
    if "axis" in case.path_parameters:
        case.path_parameters["axis"] = "joint-1"
    return token


@schema.include(method="GET").parametrize()
@few
def test_read_requests_move_nothing_and_never_fail(case):
    case.call_and_validate(headers={"X-Lease": machine(case)}, checks=checks)
    assert BRIDGE.moved == BRIDGE.stopped == []


@schema.exclude(method="GET").parametrize()
@fewer
def test_requests_without_the_lease_move_nothing_and_never_fail(case):
    machine(case)
    case.headers.pop("X-Lease", None)
    case.call_and_validate(checks=checks)
    assert BRIDGE.moved == []


@schema.exclude(method="GET").parametrize()
@few
def test_requests_with_the_lease_never_fail_nor_leave_the_limits(case):
    answer = case.call_and_validate(headers={"X-Lease": machine(case)}, checks=checks)
    if answer.status_code >= 400:
        assert BRIDGE.moved == []
    if case.operation.path.endswith("/move"):
        assert len(BRIDGE.moved) == (answer.status_code < 300)
    assert all(abs(given[0]) <= LIMIT_DEG for _, what, *given in BRIDGE.moved if what == "move")
