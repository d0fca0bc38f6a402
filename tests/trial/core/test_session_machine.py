"""Members come, go, press keys and read pages at any time: what must hold of a session's trial, whatever happens.

The model knows who is connected, which key each holds, and how long each has been missed. How long the others wait is
what they are told when the absence begins; test_session_flapping.py says how much that is.
"""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from hippodrome.trial.core.effects import AskPolicy, StepCall
from testing.exploration import examples
from tests.trial.session_driver import SessionDriver

ABSENT, COUNTDOWN, NEARLY = 30.0, 3.0, 1e-6
TIMES = st.sampled_from([0.05, 0.35, 1.0, 2.0, COUNTDOWN, 10.0, 29.95, ABSENT])
NUMBERS = st.integers(0, 3)


class Machine(RuleBasedStateMachine):
    @initialize(
        count=st.integers(2, 4),
        after=st.sampled_from(["end", "policy"]),
        vacant=st.booleans(),
        instructions=st.booleans(),
        between=st.sampled_from([0, 5, "between.html"]),
    )
    def begins(self, count: int, after: str, vacant: bool, instructions: bool, between: object) -> None:
        section = {
            "afterAbsent": after,
            "betweenEpisodes": between,
            "maxEpisodes": 3,
            "absent": ABSENT,
            "gather": ABSENT,
        }
        section |= {"countdown": COUNTDOWN}
        section |= {"substitute": "random"} if after == "policy" or vacant else {}
        section |= {"instructions": "rules.html"} if instructions else {}
        empty = SessionDriver.NAMES[count - 1 : count] if vacant else ()
        self.driver = SessionDriver(count, vacant=empty, **section)
        self.after = after
        self.members = len(self.driver.places)
        self.here: set[int] = set()
        self.hidden: set[int] = set()
        """Connected, and looking at another page."""
        self.keys: dict[int, str] = {}
        self.missed = dict.fromkeys(range(self.members), 0.0)
        self.allowed = dict.fromkeys(self.missed, ABSENT)
        self.replaced: set[int] = set()
        self.seen = 0
        self.on_break = False

    def player(self, number: int) -> str:
        return self.driver.places[f"P{number}"]

    @property
    def over(self) -> bool:
        return self.driver.trial.progress.over

    def missing(self) -> list[int]:
        """Return the members for whom the others wait now."""
        if self.over or not self.here:
            return []
        return [number for number in self.missed if number not in self.here and number not in self.replaced]

    def let_time_pass(self, seconds: float) -> None:
        """Let time pass, from one event to the next, and check the effects of each."""
        driver, until = self.driver, self.driver.now + seconds
        self.check_effects()
        driver.take()
        self.check_effects()
        for _ in range(1000):
            missing = self.missing()
            waits = [self.allowed[number] - self.missed[number] for number in missing]
            wake = driver.trial.wake_at
            step = max(0.0, min([until - driver.now, *waits, *([] if wake is None else [wake - driver.now])]))
            for number in missing:
                self.missed[number] += step
            driver.now += step
            driver.event("advance", driver.now)
            driver.answer_calls()
            self.check_effects()
            self.check_who_is_replaced()
            driver.take()
            self.check_effects()
            if driver.now >= until - NEARLY:
                return
        raise AssertionError("it wakes for nothing")

    def check_effects(self) -> None:
        """Check the effects since the last call."""
        for number in self.missing():
            if self.missed[number] >= self.allowed[number] - NEARLY and self.after == "policy":
                self.replaced.add(number)
        for effect in self.driver.all[self.seen :]:
            if isinstance(effect, StepCall):
                self.check_step(effect)
            elif isinstance(effect, AskPolicy):
                asked = {self.player(number) for number in self.here}
                assert effect.player not in asked, "no policy plays for who is here"
        self.seen = len(self.driver.all)
        on_break = self.driver.trial.progress.on_break
        if on_break and not self.on_break:
            self.keys.clear()  # these keys were held in the episode that is over
        self.on_break = on_break

    def check_who_is_replaced(self) -> None:
        for number in self.here if not self.over else ():
            people = self.driver.state_seen_by(number)["people"]
            found = {each for each in self.missed if people[self.player(each)] == "policy"}
            assert found == self.replaced - self.here, "a policy plays as soon as the time is over, and no sooner"

    def check_step(self, call: StepCall) -> None:
        assert self.here, "no step for nobody"
        assert not self.missing(), "no step while the others wait"
        for number in self.here:
            action, held = call.actions[self.player(number)], self.keys.get(number)
            assert (action.name, action.by) == ((held, "human") if held else ("noop", "none")), "their own key alone"
        for player in call.actions.keys() - {self.player(number) for number in self.here}:
            assert call.actions[player].by in ("policy", "late", "none"), "no human plays for who is not here"

    # ---- what happens

    @rule(number=NUMBERS)
    def comes(self, number: int) -> None:
        number %= self.members
        self.is_back(number)
        self.driver.come(number)
        assert self.over or self.driver.state_seen_by(number)["you"] == self.player(number)

    def is_back(self, number: int) -> None:
        self.check_effects()
        self.here.add(number)
        self.hidden.discard(number)
        self.keys.pop(number, None)
        self.replaced.discard(number)
        self.missed[number] = 0.0 if not self.over else self.missed[number]

    @rule(number=NUMBERS)
    def goes(self, number: int) -> None:
        self.is_away(number % self.members, self.driver.go)

    @rule(number=NUMBERS)
    def looks_at_another_page(self, number: int) -> None:
        number %= self.members
        if number in self.here:
            self.is_away(number, lambda number: self.driver.say(number, hidden=True))
            self.hidden.add(number)

    @rule(number=NUMBERS)
    def looks_at_the_game_again(self, number: int) -> None:
        number %= self.members
        if number in self.hidden:
            self.is_back(number)
            self.driver.say(number, hidden=False)

    def is_away(self, number: int, how: Callable[[int], object]) -> None:
        self.check_effects()
        left = number in self.here
        self.here.discard(number)
        self.hidden.discard(number)
        self.keys.pop(number, None)
        how(number)
        if left:
            self.allowed[number] = self.driver.trial._participants.presence.time_left(self.player(number))
            assert 0 <= self.allowed[number] <= ABSENT

    @rule(number=NUMBERS, key=st.sampled_from(["up", "right"]))
    def holds_a_key(self, number: int, key: str) -> None:
        number %= self.members
        if number in self.here and number not in self.keys and not self.over:
            self.check_effects()
            self.keys[number] = key
            self.driver.say(number, action=key, held=True)

    @rule(number=NUMBERS, command=st.sampled_from(["start", "pause", "reset"]))
    def says(self, number: int, command: str) -> None:
        number %= self.members
        if number in self.here and not self.over:
            self.check_effects()
            self.driver.say(number, command=command)

    @rule()
    def an_episode_ends(self) -> None:
        self.check_effects()
        self.driver.take(terminated=True)

    @rule(seconds=TIMES)
    def time_passes(self, seconds: float) -> None:
        self.let_time_pass(seconds)

    @rule()
    def all_are_here_and_go_on(self) -> None:
        for number in range(self.members):
            if number not in self.here:
                self.comes(number)
        self.let_time_pass(0.2)
        for number in range(self.members):
            self.says(number, "start")
        before = sum(isinstance(effect, StepCall) for effect in self.driver.all)
        self.let_time_pass(COUNTDOWN + 0.3)
        now = sum(isinstance(effect, StepCall) for effect in self.driver.all)
        assert self.over or now > before, "the game goes on when nobody is waited for"

    @invariant()
    def no_member_is_waited_for_too_long(self) -> None:
        if hasattr(self, "driver"):
            self.check_effects()
            late = [number for number in self.missing() if self.missed[number] > self.allowed[number] + NEARLY]
            assert not late

    @invariant()
    def no_game_ends_before_the_time_is_over(self) -> None:
        if hasattr(self, "driver") and self.driver.trial.progress.outcome == "partnerLeft":
            assert any(self.missed[each] >= self.allowed[each] - NEARLY for each in self.missed)

    @invariant()
    def an_ended_trial_has_one_answer_for_each(self) -> None:
        if hasattr(self, "driver"):
            expected = sorted(self.driver.places) if self.driver.trial.finished else []
            assert sorted(human for human, _ in self.driver.answers) == expected

    def teardown(self) -> None:
        if hasattr(self, "driver"):
            self.all_are_here_and_go_on()
            if not self.over:
                self.driver.say(0, command="stop").take()
            self.driver.answer_calls()
            assert self.driver.trial.finished
            self.an_ended_trial_has_one_answer_for_each()
            for number in self.here:
                assert self.driver.done(number).outcome == self.driver.outcomes[f"P{number}"]


def test_whatever_members_do_a_session_keeps_its_rules() -> None:
    run_state_machine_as_test(Machine, settings=settings(max_examples=examples(30), stateful_step_count=30))
