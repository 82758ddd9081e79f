"""API messages: validation of requests, enumerations, errors in both directions."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from hdbridge import errors
from hdbridge.client import messages
from hdbridge.client.messages import STATUS, Request

REQUESTS = Request.__subclasses__()
RAISED = [
    each
    for each in vars(errors).values()
    if isinstance(each, type) and issubclass(each, errors.HdbridgeError)
]
EXAMPLES = {
    messages.Move: {"target_deg": 30.0},
    messages.Coordinated: {"targets_deg": {"a": 1.0}},
    messages.Jog: {"velocity_deg_s": 1.0},
    messages.QueueItem: {"target_deg": 1.0},
    messages.StreamPoint: {"time_s": 0.0, "position_deg": 1.0, "velocity_deg_s": 0.0},
    messages.Home: {"method": 37},
}


@pytest.mark.parametrize("request_", EXAMPLES, ids=lambda each: each.__name__)
@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e300, "30", True, None, [1.0]])
def test_request_numbers_are_finite_and_bounded(request_, wrong):
    right = EXAMPLES[request_]
    assert request_.model_validate(right)
    name = next(iter(right))
    value = {"a": wrong} if isinstance(right[name], dict) else wrong
    with pytest.raises(ValidationError) as refused:
        request_.model_validate({**right, name: value})
    assert name in str(refused.value)


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda each: each.__name__)
def test_requests_refuse_unknown_keys(request_):
    with pytest.raises(ValidationError, match="taget_deg"):
        request_.model_validate({**EXAMPLES.get(request_, {}), "taget_deg": 1.0})


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda each: each.__name__)
def test_every_variable_size_field_is_bounded(request_):
    """A list, a text or a mapping without an upper limit would let one request fill the memory."""

    def unbounded(schema, path):
        kind = schema.get("type")
        if kind == "string" and not {"maxLength", "enum", "pattern", "const"} & schema.keys():
            yield path
        if kind == "array":
            if "maxItems" not in schema:
                yield path
            yield from unbounded(schema["items"], path + "[]")
        if kind == "object" and "properties" not in schema and "maxProperties" not in schema:
            yield path
        if kind in {"number", "integer"}:
            low, high = {"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"}
            if not (low & schema.keys() and high & schema.keys()) and "options" not in path:
                yield path
        for name, below in schema.get("properties", {}).items():
            yield from unbounded(below, f"{path}.{name}")
        for below in [*schema.get("anyOf", []), *schema.get("$defs", {}).values()]:
            yield from unbounded(below, path)

    assert [*unbounded(request_.model_json_schema(), request_.__name__)] == []


@pytest.mark.parametrize("wrong", ["a\nb", "\x1b[2J", "\x9b2J", "\u202egnitirw", "\u2028", "x" * 401, 3])
def test_client_texts_are_one_line_without_control_characters(wrong):
    """The text is shown to other clients and logged."""
    with pytest.raises(ValidationError, match="client"):
        messages.LeaseRequest(client=wrong)
    assert messages.LeaseRequest(client="Zelle 3, Prüfstand \u2192 Süd").client


def test_reports_ignore_unknown_keys():
    state = messages.LeaseState.model_validate({"held": False, "timeout_s": 5.0, "colour": "red"})
    assert not state.held


@pytest.mark.parametrize("kind", RAISED, ids=lambda each: each.__name__)
def test_errors_survive_the_round_trip(kind):
    problem = messages.Problem.of(kind("node 3: no answer; check its power"), axis="joint-3")
    assert problem.hint == "check its power"
    assert problem.axis == "joint-3"
    back = messages.Problem.model_validate_json(problem.model_dump_json()).error()
    assert type(back) is kind
    assert str(back) == "node 3: no answer; check its power"
    assert back.exit_status == kind.exit_status


def test_a_subclass_of_an_error_arrives_as_its_public_base_class():
    class AbortError(errors.SdoError):
        pass

    back = messages.Problem.of(AbortError("node 3: refused")).error()
    assert type(back) is errors.SdoError
    assert back.exit_status == 4


def test_subclasses_precede_their_base_classes_in_the_table():
    """A kind listed after its base class would never be reported."""
    kinds = list(STATUS)
    assert [
        (early, late)
        for place, early in enumerate(kinds)
        for late in kinds[place + 1 :]
        if issubclass(late, early)
    ] == []


@given(st.text(max_size=60), st.text(max_size=60))
def test_problems_of_other_servers_become_hdbridge_errors(kind, detail):
    back = messages.Problem(type=kind, title="?", status=418, detail=detail).error()
    assert isinstance(back, errors.HdbridgeError)
