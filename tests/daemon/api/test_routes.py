"""Request of each route to the machine, and its answer."""

import json
import re

import pytest

from hdbridge.client import messages


@pytest.mark.parametrize(
    ("method", "path", "body", "asked"),
    [
        ("POST", "disable", None, ("disable",)),
        ("POST", "reset", None, ("reset",)),
        ("POST", "home", {"method": 37}, ("home", 37)),
        ("POST", "jog", {"velocity_deg_s": -5, "timeout_s": 1}, ("jog", -5.0, 1.0)),
        ("POST", "queue", {"points": [{"target_deg": 1}, {"target_deg": 2}]}, ("queue", 2)),
        ("DELETE", "queue", None, ("clear queue",)),
        ("POST", "compensate", {"scheme": "both"}, ("compensate", "both")),
        ("POST", "model", {"version": 4}, ("model", 4)),
        ("POST", "model", {"version": "pending"}, ("model", "pending")),
        ("POST", "load-loop", {"on": True}, ("load loop", True)),
        ("POST", "adaptation", {"mode": "observe"}, ("adapt", "observe")),
        ("DELETE", "adaptation", None, ("adaptation back",)),
        ("PUT", "objects/6041h", {"value": "1"}, ("write", "6041h", "1")),
    ],
)
def test_motion_requests_need_the_lease(api, leased, method, path, body, asked):
    """The same request is executed once with the lease, and never without it or with a wrong token."""
    url = f"/axes/joint-1/{path}"
    with api.over_socket() as stranger:
        refused = [
            stranger.request(method, url, json=body, headers=headers)
            for headers in ({}, {"X-Lease": "mZ3sWJx0b0lq"}, {"X-Lease": ""})
        ]
    assert [each.status_code for each in refused] == [423, 423, 423]
    assert "the tests" in refused[0].json()["detail"]
    assert api.bridge.moved == []
    done = leased.request(method, url, json=body)
    assert done.status_code in {200, 201}, done.text
    assert api.bridge.moved == [("joint-1", *asked)]


def test_a_coordinated_move_starts_every_axis_or_none(api, leased):
    targets = {"joint-1": 10.0, "joint-2": 20.0}
    refused = leased.post("/coordinated", json={"targets_deg": targets})
    assert refused.status_code == 409
    assert "joint-2" in refused.json()["detail"]
    assert api.bridge.moved == []
    leased.post("/axes/joint-2/enable")
    assert leased.post("/coordinated", json={"targets_deg": targets, "speed": 0.5}).status_code == 200
    assert [each.target_deg for each in api.bridge.axes.values()] == [10.0, 20.0]


def test_the_lease_is_taken_renewed_and_given_back(api):
    bridge = api.bridge
    bridge.now_s = 0.0
    with api.over_socket() as client, api.over_socket() as other:
        grant = messages.LeaseGrant.model_validate_json(
            client.post("/lease", json={"client": "cell controller"}).content
        )
        mine = {"X-Lease": grant.token}
        held = other.post("/lease", json={"client": "another"})
        assert held.status_code == 423
        assert "cell controller" in held.json()["detail"]
        bridge.now_s = 9.0
        assert client.put("/lease", headers=mine).json()["held"]
        bridge.now_s = 18.0
        assert client.post("/axes/joint-1/enable", headers=mine).status_code == 200, "using it renews it"
        bridge.now_s = 27.0
        assert client.delete("/lease", headers=mine).json()["held"] is False
        assert other.post("/lease", json={"client": "another"}).status_code == 201
        taken = client.post("/lease", json={"client": "cell controller", "force": True})
        assert taken.status_code == 201
        assert taken.json()["token"] != grant.token


def test_a_lease_without_a_name_gets_the_peer_process(api):
    with api.over_socket() as client:
        assert "process" in client.post("/lease", json={}).json()["client"]


def test_waiting_for_a_move_renews_the_lease(api):
    """The lease would otherwise expire before the axis arrives."""
    bridge = api.bridge
    bridge.lease = type(bridge.lease)(1.5, bridge.lease._now)
    token = bridge.lease.take("patience")
    bridge.axes["joint-1"].moving_s = 2.5
    with api.over_socket(**{"X-Lease": token}) as client:
        client.post("/axes/joint-1/enable").raise_for_status()
        assert client.post("/axes/joint-1/move", json={"target_deg": 5}).status_code == 200
        assert bridge.lease.holds(token)


def test_an_unknown_axis_lists_the_known_ones(leased):
    answer = leased.get("/axes/joint-9")
    assert answer.status_code == 404
    assert "joint-1, joint-2" in answer.json()["detail"]
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("content", "status", "words"),
    [
        (b"{", 400, "JSON"),
        (b"", 422, "the body: is missing"),
        (b'{"target_deg": NaN}', 422, "target_deg"),
        (b'{"target_deg": 1e999}', 422, "target_deg"),
        (b'{"target_deg": -Infinity}', 422, "target_deg"),
        (b'{"target_deg": "30"}', 422, "target_deg"),
        (b'{"target_deg": 30, "taget_deg": 3}', 422, "taget_deg: unknown key"),
        (b"{}", 422, "target_deg: is missing"),
        (b'{"target_deg": 30, "\\ud800": 3}', 422, "unicode"),
        (b'{"target_deg": 30, "wait": 1}', 422, "wait"),
        (b'{"target_deg": 181}', 422, "180"),
        (b"[" * 100 + b"]" * 100, 422, "dictionary"),
        (b"[" * 100_000 + b"]" * 100_000, 400, "parsing"),
        (b'{"target_deg": 1' + b"0" * 5000 + b"}", 400, ""),
        (b'{"target_deg": 30}' + b" " * (256 << 10), 413, "KiB"),
    ],
)
def test_an_invalid_body_moves_nothing_and_is_explained(api, leased, content, status, words):
    answer = leased.post("/axes/joint-1/move", content=content, headers={"Content-Type": "application/json"})
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = messages.Problem.model_validate_json(answer.content)
    assert words in " ".join([problem.detail, *problem.errors])
    assert api.bridge.moved == []


def test_internal_errors_reveal_no_internals(api, leased, monkeypatch):
    def broken() -> None:
        raise ZeroDivisionError("secret")

    monkeypatch.setattr(api.bridge, "state", broken)
    answer = leased.get("/state")
    assert answer.status_code == 500
    assert "secret" not in answer.text
    assert answer.headers["content-type"] == "application/problem+json"


def test_health_reflects_the_loop(api):
    with api.over_tcp(token=None) as client:
        url = str(client.base_url).replace("api/v1/", "healthz")
        assert client.get(url).status_code == 200
        api.bridge.alive = False
        assert client.get(url).status_code == 503


def test_every_operation_is_described(leased):
    schema = leased.get("/openapi.json").json()
    assert all(each["description"] for methods in schema["paths"].values() for each in methods.values())


def test_every_operation_documents_its_problems(leased):
    schema = leased.get("/openapi.json").json()
    kinds = {
        kind
        for methods in schema["paths"].values()
        for operation in methods.values()
        for status, response in operation["responses"].items()
        if status >= "400"
        for kind in response["content"]
    }
    assert kinds == {"application/problem+json"}
    assert "HTTPValidationError" not in json.dumps(schema)


def test_the_live_page_is_served_with_its_own_policy(leased):
    page = leased.get("http://hdbridge/")
    assert page.headers["content-type"].startswith("text/html")
    assert "script-src 'self'" in page.headers["content-security-policy"]
    main = leased.get("http://hdbridge/page/main.js")
    named = re.findall(r'"/page/([^"]+)"', page.text) + re.findall(r'"\./([^"]+)"', main.text)
    assert {"main.js", "uPlot.iife.min.js", "live.css", "icon.svg", "controls.js"} <= {*named}
    for name in named:
        answer = leased.get(f"http://hdbridge/page/{name}")
        assert answer.status_code == 200
        kind = {"js": "javascript", "css": "css", "svg": "svg"}[name.rpartition(".")[2]]
        assert kind in answer.headers["content-type"]
        assert answer.headers["content-security-policy"] == page.headers["content-security-policy"]
    assert leased.get("http://hdbridge/page/..%2f__init__.py").status_code == 404
