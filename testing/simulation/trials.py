"""The simulated trial servers of sessions: they let the members in, play, and write their answers.

They behave like hippodrome/trial/server/ and hippodrome/trial/core/ with the defaults of config.yml. The game begins when all members are
connected, pauses while one is away, and ends for all when one was away for more than `ABSENT` seconds. A server that
replaces a lost one goes on where the recordings of the lost server end.
"""

from __future__ import annotations

import contextlib
import functools
import json
from collections import Counter, defaultdict
from collections.abc import Mapping

from hippodrome.control.ports import Conflict
from hippodrome.protocol import session as sessions
from hippodrome.protocol.keys import answer_key, session_key
from hippodrome.protocol.session import SessionDocument, assignment_key, member_token
from testing.simulation.ports import SimPlatform
from testing.simulation.tasks import TimedTask
from testing.tasks import Life

TICK = 1.0  # seconds after which a trial looks again which members are connected
COUNTDOWN, ABSENT = 3.0, 30.0  # seconds: `trial.countdown` and `trial.absent`
LINGER = 3.0  # seconds from a trial's stored answers to its end

_parsed = functools.lru_cache(maxsize=1000)(sessions.parse)  # trials read documents every second; few of them change


class SimTrial:
    """The trial of one task.

    `over` is empty while it goes on; then it is `done`, `lost` (with its server) or `idle`.
    """

    def __init__(self, trials: SimTrials, task: TimedTask, session_id: str, step: str, play: float) -> None:
        """`play`: the seconds that the game takes."""
        self.task, self.session_id = task, session_id
        self.over = ""
        self.began: float | None = None  # when the game began
        self._step, self._play = step, play
        self._here: Counter[str] = Counter()  # connections, by member
        self._away: defaultdict[str, float] = defaultdict(float)  # seconds of absence, by member
        self._countdown = COUNTDOWN
        self._trials, self._documents, self._clock = trials, trials.platform.documents, trials.platform.clock
        self._clock.spawn(self._run)

    @property
    def session(self) -> SessionDocument | None:
        """The session's document; None if there is none yet."""
        found = self._documents.kept.get(session_key(self._trials.project_id, self.session_id))
        return _parsed(found[0]) if found else None

    def connect(self, user: str, token: str) -> bool:
        """Let the participant in if they show the token of a member; return whether they were let in."""
        session = self.session
        if session is None or session.member(user) is None:
            return False
        if token != member_token(self.task.request.environment["TOKEN"], user):
            return False
        self.task.guests += 1
        self._here[user] += 1
        return True

    def disconnect(self, user: str) -> None:
        """Close one connection of the member."""
        self._here[user] -= 1

    def _run(self) -> None:
        """Play, one tick after the other, until the answers are stored, the server is lost, or no member has come."""
        alone = 0.0
        while not self.over:
            self._clock.sleep(TICK)
            if is_lost(self.task):
                self.over = "lost"
                return
            session = self.session
            here = {user for user, connections in self._here.items() if connections > 0}
            if session is None or not here:
                alone += TICK
                if alone > self._trials.idle:
                    self._end("idle")
                continue
            alone = 0.0
            self._go_on(session, here)

    def _go_on(self, session: SessionDocument, here: set[str]) -> None:
        """Play or pause for one tick, and end the game if it is over. At least one member is connected."""
        members = {member.user_id for member in session.members}
        if members <= here:
            self._all_here()
            if self._trials.played[self.session_id, self._step] >= self._play:
                self._store(session, dict.fromkeys(members, "finished"))
            return
        self._countdown = COUNTDOWN
        for user in members - here:
            self._away[user] += TICK
        absent = {user for user in members if self._away[user] > ABSENT}
        if absent:
            self._store(session, {user: "left" if user in absent else "partnerLeft" for user in members})

    def _all_here(self) -> None:
        self._away.clear()
        if self._countdown > 0:
            self._countdown -= TICK
            return
        if self.began is None:
            self.began = self._clock.seconds
        self._trials.played[self.session_id, self._step] += TICK  # the recording holds this tick

    def _store(self, session: SessionDocument, outcomes: Mapping[str, str]) -> None:
        """Store an answer for each member, unless an earlier server has stored one."""
        for member in session.members:
            answers = {"score": 10, "outcome": outcomes[member.user_id], "session": session.id}
            record = {"step": self._step, "page": "game", "answers": answers, "schema": 1}
            key = answer_key(self._trials.project_id, member.user_id, self._step)
            with contextlib.suppress(Conflict):
                self._documents.keep(key, json.dumps(record).encode())
        self.over = "done"
        if self._has_another_game(session):
            return
        self._clock.after(LINGER, lambda: self._end("done"))

    def _has_another_game(self, session: SessionDocument) -> bool:
        """Whether the server has a further game to run for its members."""
        found = self._documents.kept.get(assignment_key(self._trials.project_id, session.id))
        games = json.loads(found[0])["games"] if found else ()
        keys = (answer_key(self._trials.project_id, session.members[0].user_id, game) for game in games)
        return any(key not in self._documents.kept for key in keys)

    def _end(self, why: str) -> None:
        self.over = self.over or why
        self._trials.platform.tasks.end(self.task.arn, "EssentialContainerExited", "Essential container exited", 0)


def is_lost(task: TimedTask) -> bool:
    """Return whether the players have lost their server. After Spot's warning a server goes on until its container ends."""
    warned = task.stop_code == "SpotInterruption"
    return task.last is not Life.RUNNING or (task.desired is Life.STOPPED and not warned)


class SimTrials:
    """The trials of all tasks of a world."""

    def __init__(self, platform: SimPlatform, project_id: str, idle: float) -> None:
        """`idle`: the seconds after which a trial without members ends."""
        self.platform, self.project_id, self.idle = platform, project_id, idle
        self.played: defaultdict[tuple[str, str], float] = defaultdict(float)
        """Seconds of play in the recordings, by session and game step."""
        self._trials: dict[tuple[str, str], SimTrial] = {}  # the trials by their tasks and game steps

    def at(self, task: TimedTask, step: str, play: float) -> SimTrial | None:
        """Return the trial of a session's task; None if the task has no session, or if the session is not formed yet.

        The first call for a game step makes its trial, with `play` seconds of play.
        """
        session_id = self.platform.tasks.owner(task)
        if not sessions.is_session_id(session_id):
            return None
        if (task.arn, step) not in self._trials:
            self._trials[task.arn, step] = SimTrial(self, task, session_id, step, play)
        return self._trials[task.arn, step]
