"""Random events in any order on both buses: no set-point outside the limits, and no unrequested motion."""

from hypothesis import given, settings
from hypothesis import strategies as st
from support.disorder import draw, play_story


@settings(max_examples=4)
@given(rng=st.randoms(), count=st.integers(5, 25))
def test_no_set_point_outside_the_limits_and_no_motion_without_a_request(tmp_path_factory, rng, count):
    play_story(tmp_path_factory.mktemp("disorder"), [draw(rng) for _ in range(count)])
