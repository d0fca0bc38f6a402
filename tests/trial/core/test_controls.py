"""Held keys, combinations and presses: what the action of each step is."""

from hypothesis import given
from hypothesis import strategies as st

from trial.core.controls import Controls

SPACE = ("noop", "up", "right", "left", "down", "upright", "upleft")


def test_held_keys_combine_and_the_newest_wins():
    controls = Controls(SPACE, 1)
    controls.hold("up")
    assert controls.take() == (1, True)
    controls.hold("right")
    assert controls.take() == (5, True)
    controls.hold("left")
    assert controls.take() == (6, True), "left is newer than right"
    controls.release("left")
    assert controls.take() == (5, True)
    controls.hold("down")
    assert controls.take() == (4, True), "nothing goes with down"
    for key in ("up", "right", "down"):
        controls.release(key)
    assert controls.take() == (0, False)


def test_a_press_lasts_its_steps_or_until_another_action():
    controls = Controls(SPACE, 3)
    controls.press("left")
    assert [controls.take() for _ in range(4)] == [(3, True)] * 3 + [(0, False)]
    controls.press("left")
    controls.press("up")
    assert controls.take() == (1, True)
    controls.hold("down")
    assert controls.take() == (4, True)
    controls.press("left")
    assert [controls.take()[0] for _ in range(4)] == [3, 3, 3, 4]


def test_a_tap_between_two_steps_is_not_lost():
    controls = Controls(SPACE, 1)
    controls.hold("right")
    controls.take()
    controls.hold("up")
    controls.release("up")
    assert controls.take() == (5, True)
    assert controls.take() == (2, True)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["press", "hold", "release", "take", "clear"]), st.sampled_from([*SPACE, "fire", "jump"])
        ),
        max_size=60,
    ),
    st.integers(1, 5),
)
def test_controls_always_have_an_action(events, lifespan):
    controls = Controls(SPACE, lifespan)
    held = set()
    for what, name in events:
        if what in ("press", "hold", "release"):
            getattr(controls, what)(name)
            held = held | {name} if what == "hold" else held - {name} if what == "release" else held
        elif what == "clear":
            controls.clear()
            held = set()
        else:
            index, _ = controls.take()
            assert 0 <= index < len(SPACE)
        assert set(controls.held) == held
    for name in held:
        controls.release(name)
    for _ in range(lifespan + 1):
        controls.take()
    assert controls.take() == (0, False), "everything ends once nothing is held"
