"""A trial as it happens: steps the game in time, shows it to the player, records it, and reports when it is over."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
import time
import traceback
import uuid
from collections.abc import Awaitable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from trial import messages, recording
from trial.agent import Outcome, Player
from trial.connection import Link
from trial.frames import Frame
from trial.game import Break, Choice, Episode, Game, Pacer, Refused, State
from trial.recording import Recording
from trial.resume import Past, Unfinished, recall
from trial.settings import Settings
from trial.spool import Spool, insist, store_file
from trial.store import Store, brief
from trial.tracebacks import report
from trial.worker import Stuck, Worker

log = logging.getLogger("trial")

FLUSH_SECONDS = 0.5
"""So much play may be lost if the process is killed outright."""
_LAST_STEP_SECONDS = 2.0  # a step under way when the server must end may take so long
_MESSAGES_KEPT = 5000  # between two steps; only somebody hostile says more

_SORRY_EPISODE = "Something went wrong in the game, so this round has ended. The next round begins."
_SORRY_ANEW = "This round could not go on where it was, so it begins again. The rounds before it are kept."
_SORRY_TRIAL = "Something went wrong in the game and it cannot go on. What you have played is kept; please continue."


class Diverged(Exception):
    """An episode that is played again is not what it was."""


@dataclass(frozen=True, slots=True)
class Turn:
    """What the worker brings back from one step."""

    outcome: Outcome
    frame: Frame
    line: bytes


class Trial:
    """One game step of one participant, from the first picture to the stored answer.

    `run` plays; `attach` and `detach` are told who watches; `handle` what they say. All on the event loop.
    A trial that fails before there is anything to see is `broken`: it has no answer, and nobody is attached to it.
    """

    def __init__(
        self, settings: Settings, step: str, *, worker: Worker, player: Player, store: Store, spool: Spool
    ) -> None:
        self.settings = settings
        self.config = settings.trial
        self.step = step
        self.id = uuid.uuid4().hex
        self.ready = asyncio.Event()
        """The first picture is there, or the trial is over."""
        self.finished = asyncio.Event()
        """Everything is stored and the answer is written."""
        self.broken = False
        """It could not even begin. Certain once it is `ready`."""
        self.game = Game(self.config, player.action_space or ("noop",))
        self._worker = worker
        self._player = player
        self._store = store
        self._spool = spool
        self._pacer = Pacer()
        self._wake = asyncio.Event()
        self._asked: list[str] = []  # reset and stop, done between two steps
        self._said: list[dict[str, Any]] = []  # since the last line of the recording that holds messages
        self._heard = 0  # so many of them the agent has been told, as far as they are for it
        self._dropped = 0
        self._link: Link | None = None
        self._frame: Frame | None = None
        self._frame_id = 0
        self._recording: Recording | None = None
        self._flush_timer: asyncio.TimerHandle | None = None
        self._flushing: asyncio.Task[None] | None = None
        self._uploads: set[asyncio.Task[None]] = set()
        self._closing = False
        self._saving = False
        self._played_seconds = 0.0
        self._stepped_at: float | None = None
        self._break_since: float | None = None  # in the loop's time
        self._last_words: str | None = None
        self._anew: int | None = None  # the episode that an earlier server had begun and this one begins again
        self._reports: set[str] = set()
        self._task: asyncio.Task[None] | None = None
        self._earlier: dict[str, Any] | None = None
        self._unfinished: Unfinished | None = None

    # ---- the player

    @property
    def link(self) -> Link | None:
        return self._link

    def attach(self, link: Link) -> None:
        """Show the trial to this client and take its orders; the one before it must be closed by the caller."""
        self.detach(self._link)
        self._link = link
        self._happened("connected")
        if self.finished.is_set():
            self._say_done()
            return
        link.say(self.controls())
        link.told = self._standing()
        link.rate = self.game.frame_rate
        if self._last_words is not None:
            link.say(messages.error(self._last_words))
        elif self._anew == self.game.episode and not self.game.steps:
            link.say(messages.error(_SORRY_ANEW))
        if self._frame is not None:
            link.offer(self._frame, self._frame_id)

    def detach(self, link: Link | None) -> None:
        """This client has gone. The game is held until somebody starts it again."""
        if link is not None and link is self._link:
            self._link = None
            self._happened("disconnected")
            self.game.leave()
            self._wake.set()

    def _happened(self, event: str) -> None:
        """Remember, for the next line of the recording, something that no message said."""
        if len(self._said) < _MESSAGES_KEPT:
            self._said.append({"ns": time.monotonic_ns(), "event": event})

    def controls(self) -> str:
        config, game = self.config, self.game
        return messages.controls(
            ui=config.ui,
            frame_rate=game.frame_rate,
            min_frame_rate=config.min_frame_rate,
            max_frame_rate=config.max_frame_rate,
            frame_rate_step_size=config.frame_rate_step_size,
            allow_frame_rate_change=config.allow_frame_rate_change,
            action_space=game.action_space,
            state=game.state.value,
            episode=game.episode,
            max_episodes=config.max_episodes,
            score=game.score,
            episode_score=game.episode_score,
            next_in=self._break_left(),
        )

    def handle(self, message: messages.Message, link: Link) -> None:
        """Do what the client says. Raises Refused with words for it."""
        command = message.command
        if message.frame_rate is not None and not self.config.allow_frame_rate_change:
            raise Refused("the frame rate of this game is fixed")
        missing = messages.not_offered(message, self.config.ui)
        if missing is not None:
            raise Refused(f"{missing} is not offered in this game")
        if command in messages.FEEDBACK and self.game.over:
            raise Refused("the game is over, and nobody hears that any more")
        said = message.record()
        if said:
            if len(self._said) < _MESSAGES_KEPT:
                self._said.append({"ns": time.monotonic_ns(), **said})
            else:
                self._dropped += 1
        if command is not None:
            self._command(command, link)
        if message.frame_rate is not None:
            self.game.change_frame_rate(message.frame_rate)
        if message.action is not None:
            self.game.act(message.action, message.held)
        self._tell()

    def _command(self, command: str, link: Link) -> None:
        game = self.game
        if command == "start":
            game.start()
        elif command == "pause":
            game.pause()
        elif command == "requestUI":
            link.say(self.controls())
        elif command in ("reset", "stop") and command not in self._asked:
            self._asked.append(command)
        self._wake.set()

    def _standing(self) -> tuple[State, int, float, int]:
        game = self.game
        return game.state, game.episode, game.score, game.frame_rate

    def _tell(self) -> None:
        link, standing = self._link, self._standing()
        if link is not None and link.told != standing:
            link.told = standing
            link.rate = self.game.frame_rate
            left = self._break_left()
            link.state(
                messages.state(standing[0].value, *standing[1:], episode_score=self.game.episode_score, next_in=left)
            )

    def _break_left(self) -> float | None:
        """Seconds until the next episode; None if this is no break. The first look at a break begins its time."""
        if not self.game.on_break:
            self._break_since = None
            return None
        now = asyncio.get_running_loop().time()
        if self._break_since is None:
            self._break_since = now
        return max(0.0, self._break_since + self.config.between_episodes - now)

    def _say_done(self) -> None:
        link = self._link
        if link is not None:
            episodes, score = self.game.episodes_played, self.game.score
            if self._earlier is not None:
                episodes, score = self._earlier.get("episodes", 0), self._earlier.get("score", 0)
            link.end(1000, messages.done(episodes, score) if link.binary else "done")

    # ---- playing

    async def run(self, agent_ready: Awaitable[bool]) -> None:
        """Play until the trial is over and everything is stored, or `shut` is called."""
        self._earlier = await self._earlier_answer()
        if self._earlier is None:
            await self._play(agent_ready)
            self.broken = self.game.outcome == "failed" and self._frame is None
            self.ready.set()
            await self._save()
            if not self.game.over or self.broken:
                return
        self.finished.set()
        self.ready.set()
        self._say_done()

    async def _play(self, agent_ready: Awaitable[bool]) -> None:
        if not await agent_ready:
            self.game.failed(fatal=True)
            return
        # The names of the actions are known only now.
        self.game = Game(self.config, self._player.action_space)
        past = await self._recall()
        if past is not None:
            self.game.resume(past.ended)
            self._unfinished = past.unfinished
            self._played_seconds = past.seconds
        loop = asyncio.get_running_loop()
        while not self.game.over and not self._closing:
            self._obey()
            await self._end_episodes()
            if self.game.over:
                break
            left = self._break_left()
            if left is not None:
                self._pacer.rest()
                self._stepped_at = None
                if left > 0.0:
                    await self._wait(loop.time() + left)
                else:
                    self.game.go_on()
            elif self.game.needs_reset:
                await self._begin_episode()
            elif not self.game.playing:
                self._pacer.rest()
                self._stepped_at = None
                await self._wait(None)
            else:
                due = self._pacer.next(loop.time(), self.game.frame_rate)
                while self.game.playing and not self._asked and not self._closing and loop.time() < due:
                    await self._wait(due)
                if self.game.playing and not self._asked and not self._closing:
                    await self._take_step()
            self._tell()

    def _obey(self) -> None:
        asked, self._asked = self._asked, []
        for command in asked:
            if command == "stop":
                self.game.stop()
            else:
                self.game.reset()

    async def _wait(self, until: float | None) -> None:
        """Until something is said or (in the loop's time) `until`."""
        timer = None if until is None else asyncio.get_running_loop().call_at(until, self._wake.set)
        await self._wake.wait()
        self._wake.clear()
        if timer is not None:
            timer.cancel()

    async def _begin_episode(self) -> None:
        unfinished, self._unfinished = self._unfinished, None
        seed = secrets.randbelow(2**31) if unfinished is None or unfinished.seed is None else unfinished.seed
        try:
            current = self._recording
            if current is None:
                current = self._recording = self._open(seed)
        except OSError as error:
            log.error("a recording cannot be opened (%s)", brief(error))
            self.game.failed(fatal=True)
            self._sorry(_SORRY_TRIAL)
            return
        episode = self.game.episode
        if unfinished is not None and unfinished.steps:
            if await self._resume(unfinished):
                self._say_again(unfinished)
                return
        elif unfinished is not None:
            self._say_again(unfinished)
        try:
            line, frame = await self._worker.call(self._reset, episode, seed, limit=self.settings.step_seconds)
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
            self._fail(error)
            return
        self._record(line)
        self.game.began()
        self._show(frame)
        self.ready.set()

    async def _resume(self, unfinished: Unfinished) -> bool:
        """Play again what an earlier server recorded of this episode; whether the game stands there now."""
        steps = len(unfinished.steps)
        try:
            frame = await self._worker.call(self._replay, unfinished, limit=self.settings.start_seconds)
        except Stuck as error:
            self._fail(error)
            return True
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything; the episode begins anew
            log.warning("the episode cannot go on where it was and begins again (%s)", type(error).__name__)
            self._anew = self.game.episode
            return False
        self._record(recording.line("resume", **self._stamp(), episode=unfinished.number, steps=steps))
        self.game.replayed(steps, unfinished.score)
        self._show(frame)
        self.ready.set()
        log.info("the game goes on after %d steps of an earlier server", steps)
        return True

    def _say_again(self, unfinished: Unfinished) -> None:
        """Take up the feedback that an earlier server's agent did not hear any more."""
        now = time.monotonic_ns()
        self._said = [{"ns": now, "command": word, "again": True} for word in unfinished.unheard] + self._said

    async def _take_step(self) -> None:
        loop = asyncio.get_running_loop()
        link = self._link
        if link is not None and link.window.stalled(loop.time()):
            log.info("the player's page has stopped answering: paused")
            self._happened("stopped answering")
            self.game.leave()
            return
        game = self.game
        choice = game.choose()
        said = self._said.copy()
        facts: dict[str, Any] = {"episode": game.episode, "step": game.steps + 1, "frame": self._frame_id + 1}
        if said:
            facts["messages"] = said
        if self._dropped:
            facts["messagesDropped"] = self._dropped
            self._dropped = 0
        try:
            turn = await self._worker.call(self._turn, choice, facts, said, limit=self.settings.step_seconds)
        except Exception as error:  # noqa: BLE001 - as above
            self._fail(error)  # what was said stays, for the line that ends the episode
            return
        self._record(turn.line)
        self._recorded(len(said))
        now = loop.time()
        self._played_seconds += 1.0 / game.frame_rate if self._stepped_at is None else now - self._stepped_at
        self._stepped_at = now
        game.stepped(turn.outcome.reward, turn.outcome.terminated, turn.outcome.truncated)
        self._show(turn.frame)

    def _show(self, frame: Frame) -> None:
        self._frame = frame
        self._frame_id = (self._frame_id + 1) & 0xFFFFFFFF
        if self._link is not None:
            self._link.offer(frame, self._frame_id)

    def _fail(self, error: Exception) -> None:
        self._complain(error, self.game.episode)
        self.game.failed(fatal=isinstance(error, Stuck))
        self._sorry(_SORRY_TRIAL if self.game.over else _SORRY_EPISODE)

    def _complain(self, error: Exception, episode: int) -> None:
        """Write an error of the researcher's code into the log and the recording."""
        told = report(error, self.settings.agent_dir, self.settings.user_id)
        if told in self._reports:
            log.warning("the agent failed again, in the same way")
        else:
            self._reports.add(told)
            log.error("the agent failed\n%s", told)
        words = "".join(traceback.format_exception_only(error)).strip()
        self._record(
            recording.line("error", **self._stamp(), episode=episode, step=self.game.steps, error=words[:2000])
        )

    def _sorry(self, words: str) -> None:
        if self.game.over:
            self._last_words = words
        if self._link is not None:
            self._link.say(messages.error(words))
        self._tell()

    # ---- on the worker's thread

    def _replay(self, unfinished: Unfinished) -> Frame:
        """Play an episode again up to where it was cut off. Raises Diverged if it is not the same any more."""
        _, _, seeded = self._player.reset(unfinished.seed or 0)
        if not seeded or unfinished.seed is None:
            raise Diverged("the environment takes no seed")
        for step in unfinished.steps:
            for word in step.feedback:
                self._player.feedback(word)
            choice = self.game.controls.default if step.human is None else step.human
            outcome = self._player.step(choice)
            taken = choice if outcome.action is None else outcome.action
            if outcome.terminated or outcome.truncated or (taken, outcome.reward) != (step.action, step.reward):
                raise Diverged("it plays differently now")
        return self._player.render()

    def _reset(self, episode: int, seed: int) -> tuple[bytes, Frame]:
        first, info, seeded = self._player.reset(seed)
        frame = self._player.render()
        facts: dict[str, Any] = {"episode": episode, "seed": seed if seeded else None, "info": recording.plain(info)}
        if self.config.record_observations:
            facts["observation"] = recording.observation(first)
        return recording.line("reset", **self._stamp(), **facts), frame

    def _hear(self, said: list[dict[str, Any]]) -> None:
        """Tell the agent the feedback among what was said, unless it has heard it."""
        for message in said[self._heard :]:
            self._heard += 1
            if message.get("command") in messages.FEEDBACK:
                self._player.feedback(message["command"])

    def _turn(self, choice: Choice, facts: dict[str, Any], said: list[dict[str, Any]]) -> Turn:
        stamp = self._stamp()
        self._hear(said)
        outcome = self._player.step(choice.index)
        frame = self._player.render()
        index, name, by = choice.index, choice.name, "human" if choice.human else "none"
        if outcome.action is not None:
            names = self._player.action_space
            index, by = outcome.action, "agent"
            name = names[index] if 0 <= index < len(names) else str(index)
        line = recording.line(
            "step",
            **stamp,
            **facts,
            human=choice.index if choice.human else None,
            action=index,
            actionName=name,
            by=by,
            reward=outcome.reward,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            info=outcome.info,
            **({"observation": recording.observation(outcome.observation)} if self.config.record_observations else {}),
        )
        return Turn(outcome, frame, line)

    # ---- recording

    def _stamp(self) -> dict[str, Any]:
        return {
            "v": recording.SCHEMA,
            "session": self.settings.server,
            "trial": self.id,
            "time": now_text(),
            "ns": time.monotonic_ns(),
        }

    @property
    def _folder(self) -> str:
        settings = self.settings
        return f"{settings.project_id}/users/{settings.user_id}/trials/{settings.server}"

    def _open(self, seed: int) -> Recording:
        name = "trial" if self.config.data_file == "trial" else f"episode-{self.game.episode:04d}"
        opened = self._spool.open(f"{self._folder}/{self.step}-{name}.jsonl.gz")
        opened.add(
            recording.line(
                "header",
                **self._stamp(),
                project=self.settings.project_id,
                user=self.settings.user_id,
                server=self.settings.server,
                step=self.step,
                game=self.config.game,
                actionSpace=list(self.game.action_space),
                frameRate=self.game.frame_rate,
                actionBufferLifespan=self.config.action_buffer_lifespan,
                episode=self.game.episode,
                seed=seed,
                versions=recording.versions(),
            )
        )
        return opened

    def _record(self, line: bytes) -> None:
        if self._recording is None:
            return
        self._recording.add(line)
        if self._flush_timer is None:
            self._flush_timer = asyncio.get_running_loop().call_later(FLUSH_SECONDS, self._flush_soon)

    def _flush_soon(self) -> None:
        self._flush_timer = None
        current = self._recording
        if current is not None and current.dirty:
            self._flushing = asyncio.create_task(self._flush(current))

    async def _flush(self, current: Recording) -> None:
        try:
            await asyncio.to_thread(current.flush)
        except OSError as error:
            log.warning("a recording cannot be written (%s); trying again", brief(error))
            if self._flush_timer is None:
                self._flush_timer = asyncio.get_running_loop().call_later(FLUSH_SECONDS, self._flush_soon)

    async def _end_episodes(self) -> None:
        """Write down the episodes that are over; files that are complete go to the store meanwhile."""
        while self.game.ended:
            over = self.game.ended[0]
            await self._write_end(over)
            self.game.ended.pop(0)
            # The break after an episode belongs to its file.
            goes_on = isinstance(self.game.ended[0], Break) if self.game.ended else self.game.on_break
            if self.config.data_file == "episode" and not goes_on:
                self._close_recording()

    async def _write_end(self, over: Episode | Break) -> None:
        """Write down that an episode or a break is over, and what was said in it; the agent hears that first."""
        said = self._said.copy()
        if isinstance(over, Break):
            kind, number, facts = "break", over.after, {}
        else:
            kind, number = "end", over.number
            facts = {"steps": over.steps, "score": messages.tidy(over.score)}
        await self._tell_agent(said, number)
        self._record(recording.line(kind, **self._stamp(), episode=number, **facts, why=over.why, messages=said))
        self._recorded(len(said))

    async def _tell_agent(self, said: list[dict[str, Any]], episode: int) -> None:
        """Tell the agent the feedback that came after the last step of an episode, while it is still that episode."""
        if self._worker.busy or not any(message.get("command") in messages.FEEDBACK for message in said[self._heard :]):
            return  # an agent that is busy now is stuck
        limit = _LAST_STEP_SECONDS if self._closing else self.settings.step_seconds
        try:
            await self._worker.call(self._hear, said, limit=limit)
        except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything; the episode was played
            self._complain(error, episode)
            if isinstance(error, Stuck):
                self.game.failed(fatal=True)
                self._sorry(_SORRY_TRIAL)

    def _recorded(self, count: int) -> None:
        """So many of the messages stand in the recording now."""
        del self._said[:count]
        self._heard = max(0, self._heard - count)

    def _close_recording(self) -> None:
        current, self._recording = self._recording, None
        if current is not None:
            self._uploads.add(asyncio.create_task(self._put_away(current)))

    async def _put_away(self, current: Recording) -> None:
        """Close a recording and store it; tries until it is done."""
        await insist("close a recording", lambda: asyncio.to_thread(current.close))
        if self._spool.keep:
            current.path.replace(current.path.with_suffix(""))
            return
        await store_file(self._store, current.key, current.path)

    # ---- the end

    @property
    def _answer_key(self) -> str:
        return f"{self.settings.project_id}/users/{self.settings.user_id}/answers/{self.step}.json"

    async def _recall(self) -> Past | None:
        """What servers before this one recorded of the step."""
        folder, _, server = self._folder.rpartition("/")
        try:
            return await asyncio.to_thread(recall, self._store, folder, server, self.step)
        except Exception as error:  # noqa: BLE001 - whatever the store or an old recording raises: it is played anew
            log.warning("cannot look for earlier recordings (%s)", brief(error))
            return None

    async def _earlier_answer(self) -> dict[str, Any] | None:
        """What an earlier server reported for this step, if the participant has already played it."""
        try:
            found = await asyncio.to_thread(self._store.get, self._answer_key)
        except Exception as error:  # noqa: BLE001 - whatever the store raises; the answer is not overwritten anyway
            log.warning("cannot look for an earlier answer (%s)", brief(error))
            return None
        if found is None:
            return None
        with contextlib.suppress(ValueError, AttributeError):
            answers = json.loads(found).get("answers")
            return answers if isinstance(answers, dict) else {}
        return {}

    async def _save(self) -> None:
        """Store recordings, then write the answer, if there is one: whoever sees it may rely on them."""
        self._saving = True
        await self._end_episodes()
        if self._closing and self.game.on_break:
            await self._write_end(Break(self.game.episode, "shutdown"))
        elif self._closing and not self.game.over:
            said, self._said = self._said, []
            self._record(
                recording.line(
                    "end",
                    **self._stamp(),
                    episode=self.game.episode,
                    steps=self.game.steps,
                    why="shutdown",
                    score=messages.tidy(self.game.episode_score),
                    messages=said,
                )
            )
        self._tell()
        self._close_recording()
        if self._uploads:
            await asyncio.wait(self._uploads)
        if not self.game.over or self.broken:
            return
        game = self.game
        answer = {
            "schema": 1,
            "step": self.step,
            "page": "game",
            "group": self.settings.group,
            "answered": now_text(),
            "answers": {
                "episodes": game.episodes_played,
                "score": messages.tidy(game.score),
                "frames": game.total_steps,
                "seconds": round(self._played_seconds, 3),
                "trial": self.id,
                "outcome": game.outcome,
            },
        }
        data = json.dumps(answer).encode()
        await insist("write the answer", lambda: asyncio.to_thread(self._store.create, self._answer_key, data))
        log.info("trial over: %s after %d episodes", game.outcome, game.episodes_played)

    async def shut(self, seconds: float) -> None:
        """End playing where it stands and store what was recorded; no answer is written unless the trial was over.

        Gives up after `seconds`, even if the researcher's code or the store never answers.
        """
        self._closing = True
        self._wake.set()
        task = self._task
        if task is None:
            return
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                if not self._saving:
                    await asyncio.wait({task}, timeout=_LAST_STEP_SECONDS)
                if not self._saving and self._earlier is None:  # stuck in the researcher's code, or broken
                    task.cancel()
                    await asyncio.wait({task})
                    await self._save()
                await asyncio.wait({task})

    def begin(self, agent_ready: Awaitable[bool]) -> asyncio.Task[None]:
        """Start `run`."""
        self._task = asyncio.create_task(self.run(agent_ready))
        return self._task


def now_text() -> str:
    """The time as in all of the study's records: `2026-11-21T14:46:40.123456Z`."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
