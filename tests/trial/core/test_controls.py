"""Held keys, combinations and presses: what the action of each step is."""

from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.core.controls import Controls

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


def test_of_several_taps_between_two_steps_the_newest_acts():
    controls = Controls(SPACE, 1)
    for key in ("up", "down"):
        controls.hold(key)
        controls.release(key)
    assert [controls.take(), controls.take()] == [(4, True), (0, False)]


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


# ---- an action that is kept


def test_an_action_of_hippos_page_acts_until_the_next():
    controls = Controls(("noop", "left", "right"), 1)
    controls.keep("left")
    assert [controls.take() for _ in range(3)] == [(1, True)] * 3
    controls.forget_taps()
    assert controls.take() == (1, True)
    controls.keep("right")
    assert [controls.take() for _ in range(2)] == [(2, True)] * 2
    controls.keep("noop")
    assert controls.take() == (0, False)
    controls.keep("left")
    controls.clear()
    assert controls.take() == (0, False)


def test_the_first_action_is_asked_for_where_no_action_is_called_noop():
    controls = Controls(("left", "right"), 1)
    controls.keep("left")
    assert controls.take() == (0, True)
    controls.keep("noop")
    assert controls.take() == (0, False)


def test_a_name_that_is_no_action_ends_the_action_that_is_kept():
    controls = Controls(SPACE, 1)
    controls.keep("left")
    controls.keep("jump")
    assert controls.take() == (0, False)


# ---- when an action was chosen


def chosen_at(controls, *, after):
    """Return the action of the next step and the time of the message that chose it; each event is (time, what, name)."""
    for time, what, name in after:
        controls.time = time
        getattr(controls, what)(name)
    index, _ = controls.take()
    return SPACE[index], controls.pressed_at


def test_an_action_has_the_time_of_the_press_or_of_the_key_that_chose_it():
    controls = Controls(SPACE, 2)
    assert chosen_at(controls, after=[(1, "press", "left")]) == ("left", 1)
    assert chosen_at(controls, after=[]) == ("left", 1)
    assert chosen_at(controls, after=[(2, "hold", "up"), (3, "hold", "up")]) == ("up", 2), "the keyboard repeats it"
    assert chosen_at(controls, after=[(4, "hold", "right")]) == ("upright", 4)
    assert chosen_at(controls, after=[(5, "release", "right")]) == ("up", 5), "from then on the other key chooses"
    assert chosen_at(controls, after=[(6, "release", "left")]) == ("up", 5), "it was not held"
    assert chosen_at(controls, after=[(7, "hold", "left"), (8, "release", "left")]) == ("upleft", 7), "a tap"


def test_with_single_presses_that_wait_are_forgotten_when_all_keys_are_let_go():
    controls = Controls(SPACE, 1, single=True)
    controls.press("left")
    controls.clear()
    assert controls.take() == (0, False)


def test_with_single_each_press_that_waits_keeps_its_own_time():
    controls = Controls(SPACE, 1, single=True)
    assert chosen_at(controls, after=[(1, "press", "left"), (2, "hold", "up")]) == ("left", 1)
    assert chosen_at(controls, after=[(3, "release", "up")]) == ("up", 2)


# ---- turn by turn


def test_a_choice_is_a_press_or_a_key_that_goes_down_alone_or_with_up_to_three_held_keys():
    controls = Controls(("noop", "up", "upright", "dcba", "edcba"), 1)
    assert controls.choice("up", None) == 1
    assert controls.choice("right", None) is None, "only together with others"
    assert controls.choice("up", True) == 1
    assert controls.choice("up", True) is None, "the keyboard repeats it"
    assert controls.choice("right", True) == 2
    assert controls.choice("up", False) is None
    assert controls.choice("up", True) == 2, "right is still held"
    controls.clear()
    assert [controls.choice(name, True) for name in "abcde"] == [None, None, None, 3, None]
