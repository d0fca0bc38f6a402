"""Runs a rehearsal: makes the copy, runs the parts one after the other, and removes the copy.

If a part fails, the transcript gets a line with advice, and the next part runs. In any case, also after Ctrl-C, the
copy is removed with all documents and servers of the bots.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from hippodrome.bots.addresses import OneSite
from hippodrome.console.problem import Problem
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
from hippodrome.control.storage.project_cache import FRESH
from hippodrome.deployment.core import explain
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.operate.doctor import addresses
from hippodrome.deployment.operate.doctor.check_context import CheckContext, CheckFailed
from hippodrome.deployment.operate.doctor.play import upkeep
from hippodrome.deployment.operate.doctor.play.copy import Copy, left_behind, remove
from hippodrome.deployment.operate.doctor.play.scene import RehearsalContext
from hippodrome.deployment.operate.doctor.play.transcript import LINES, Transcript
from hippodrome.deployment.operate.doctor.play.walk import Walk, each_once

DEBUG = "Run it again with HIPPODROME_DEBUG=1 and send us what it prints."


def site(context: CheckContext, project_id: str) -> OneSite:
    """Return the addresses that bots may open: the addresses of the installation's site and of its servers."""
    servers = context.platform.settings.game_sources.split()
    return OneSite(context.installation["Site"], servers, project_id, tls=addresses.authorities())


class Play:
    """One rehearsal. `progress` gets a text on each thing that happens; `transcript` has the results."""

    def __init__(
        self,
        context: CheckContext,
        project: Project,
        bots: int,
        progress: Callable[[str], None],
        minutes: float,
    ) -> None:
        self._context, self._project, self._bots, self._progress = context, project, bots, progress
        self._copy = Copy(context.account, context.installation, context.platform)
        self.transcript = Transcript()
        installation = context.installation
        self.transcript.hide(
            context.account.id,
            self._copy.id,
            installation["Bucket"],
            installation["HostedZoneId"],
            installation["RootDomain"],
        )
        self._scene = RehearsalContext(
            context,
            self._copy,
            site(context, self._copy.id),
            self.transcript,
            progress,
            until=time.monotonic() + minutes * 60,
        )

    def run(self) -> Transcript:
        """Run all parts, then remove everything. After Ctrl-C, remove everything and raise KeyboardInterrupt."""
        self._part("erased", self._remove_old_copies)
        try:
            if self._part("study", self._make):
                self._parts()
        finally:
            self._part("cost", lambda: upkeep.cost(self._scene, self._records()))
            self._part("erased", self._remove)
        for key, what in LINES.items():
            if not self.transcript.has(key):
                self.transcript.say(key, Mark.LOOK, f"Not tried: {what}.", "See what failed before it.")
        return self.transcript

    def _parts(self) -> None:
        timer = upkeep.Timer(self._scene)
        began = self._part("timer", timer.begin)
        walk = Walk(self._scene, self._bots)
        for key, part in (
            ("site", walk.site),
            ("links", walk.links),
            ("pages", walk.run),
            ("pages", walk.pages),
            ("servers", walk.servers),
            ("game", walk.games),
            ("killed", walk.killed),
            ("end", walk.end),
            ("data", walk.data),
        ):
            self._part(key, part)
        if began:
            self._part("timer", timer.end)
        self._part("sweep", lambda: upkeep.sweep(self._scene, timer.record))
        self._part("alarm", lambda: upkeep.alarm(self._scene))
        self._part("times", lambda: upkeep.times(self._scene, self._records()))

    def _part(self, key: str, part: Callable[[], None]) -> bool:
        """Run one part, and return whether it succeeded. If it has not, add a line that says why, and what to do."""
        try:
            part()
        except CheckFailed as failed:
            self.transcript.bad(key, str(failed), failed.advice)
        except Exception as error:  # noqa: BLE001 - the other parts go on
            problem = explain.problem_from(error) or Problem(f"{type(error).__name__}: {error}", DEBUG)
            self.transcript.bad(key, " ".join([str(problem), *problem.details]), problem.advice)
        else:
            return True
        return False

    def _records(self) -> list[Server]:
        """Return the present records of all servers of the rehearsal, each once."""
        return each_once(record for user in self._copy.users if (record := self._scene.server(user)))

    def _make(self) -> None:
        self._progress("registering a copy of the study")
        pages = self._copy.make(self._project)
        self.transcript.hide(self._copy.project.salt)
        self._progress("waiting until every function knows the copy")
        time.sleep((FRESH + timedelta(seconds=1)).total_seconds())
        self.transcript.good("study", f"A copy of a registered study, with {pages} pages of its own, was registered.")

    def _remove_old_copies(self) -> None:
        """Remove the copies that earlier rehearsals left behind because they were killed."""
        context = self._context
        for project_id in left_behind(context.platform.documents, datetime.now(UTC)):
            self._progress("removing what an earlier rehearsal has left")
            remove(context.account, context.installation, context.platform, project_id, progress=self._progress)

    def _remove(self) -> None:
        deleted = self._copy.remove(self._progress)
        self.transcript.good("erased", f"The copy and the bots' data are gone, {deleted} versions of documents in all.")
