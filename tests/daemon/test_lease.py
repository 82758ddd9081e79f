"""One client at a time holds the lease, for any order of requests."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hdbridge.daemon.service.lease import Lease
from hdbridge.daemon.service.reports import lease_state
from hdbridge.errors import InputError, LeaseError

CLIENTS = ("page", "script", "pendant")


class Time:
    def __init__(self) -> None:
        self.s = 0.0

    def now(self) -> float:
        return self.s


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def lease(time: Time) -> Lease:
    return Lease(10.0, time.now)


def test_tokens_cannot_be_guessed(time: Time) -> None:
    lease = Lease(10.0, time.now)
    tokens = set()
    for _ in range(100):
        tokens.add(lease.take("page", force=True))
    assert len(tokens) == 100
    assert min(map(len, tokens)) >= 20


def test_a_second_client_learns_the_holder_and_the_remaining_time(lease: Lease, time: Time) -> None:
    lease.take("page")
    time.s = 4.0
    with pytest.raises(LeaseError, match=r"'page' holds the lease; it runs out in 6\.0 s"):
        lease.take("script")
    lease.doing = lambda: "axis 'a' is in motion (jog)"
    with pytest.raises(LeaseError, match=r"renewed; axis 'a' is in motion \(jog\); wait, or repeat"):
        lease.take("script")


def test_the_lease_of_the_gateway_lasts_until_it_is_taken_by_force(lease: Lease, time: Time) -> None:
    lease.take("gateway", lasts=True)
    time.s = 1e6
    assert lease_state(lease, time.s).remaining_s is None
    with pytest.raises(LeaseError, match=r"as long as the gateway runs; to stop .*repeat .* with --force$"):
        lease.take("script")
    lease.take("script", force=True)
    time.s += 10.0
    assert lease.holder is None


def test_a_lease_expires_unless_it_is_used(lease: Lease, time: Time) -> None:
    token = lease.take("page")
    time.s = 9.99
    lease.check(token)
    time.s = 19.98
    lease.check(token)
    time.s = 29.98
    assert lease.holder is None
    with pytest.raises(LeaseError, match="expired"):
        lease.check(token)


@pytest.mark.parametrize("client", ["", "  ", "x" * 401])
def test_a_client_has_a_name(lease: Lease, client: str) -> None:
    with pytest.raises(InputError, match="name"):
        lease.take(client)
    assert lease.holder is None


@pytest.mark.parametrize("token", ["", "x", "ü" * 22])
def test_a_wrong_token_changes_nothing(lease: Lease, time: Time, token: str) -> None:
    lease.take("page")
    before = lease.holder
    time.s = 5.0
    for ask in (lease.check, lease.release):
        with pytest.raises(LeaseError, match="'page'"):
            ask(token)
    assert lease.holder == before


class Disorder(RuleBasedStateMachine):
    """Compares the lease with a model that implements only the documented rules."""

    def __init__(self) -> None:
        super().__init__()
        self.time = Time()
        self.lease = Lease(10.0, self.time.now)
        self.tokens: list[str] = ["never given"]
        self.holds: tuple[str, str] | None = None
        self.heard_s = 0.0

    def present(self) -> tuple[str, str] | None:
        if self.holds and self.time.s >= self.heard_s + 10.0:
            self.holds = None
        return self.holds

    @rule(seconds=st.sampled_from([0.0, 0.1, 3.0, 9.9, 10.0, 50.0]))
    def wait(self, seconds: float) -> None:
        self.time.s += seconds

    @rule(client=st.sampled_from(CLIENTS), force=st.booleans())
    def take(self, client: str, force: bool) -> None:
        held = self.present()
        if held and not force:
            with pytest.raises(LeaseError):
                self.lease.take(client)
            return
        token = self.lease.take(client, force=force)
        assert token not in self.tokens
        self.tokens.append(token)
        self.holds, self.heard_s = (client, token), self.time.s

    @rule(data=st.data(), ask=st.sampled_from(["check", "release"]))
    def ask(self, data: st.DataObject, ask: str) -> None:
        token = data.draw(st.sampled_from(self.tokens))
        held = self.present()
        if held is None or held[1] != token:
            with pytest.raises(LeaseError):
                getattr(self.lease, ask)(token)
            return
        getattr(self.lease, ask)(token)
        if ask == "release":
            self.holds = None
        else:
            self.heard_s = self.time.s

    @invariant()
    def holder_is_the_models(self) -> None:
        held, holder = self.present(), self.lease.holder
        assert (holder.client if holder else None) == (held[0] if held else None)
        if holder:
            assert self.time.s < holder.expires_s <= self.time.s + 10.0


TestDisorder = Disorder.TestCase
TestDisorder.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
