"""A study that runs on this machine: its platform, its web server, and the lines that its researcher reads."""

from __future__ import annotations

import secrets
from collections.abc import Collection
from pathlib import Path

from rich.text import Text

from hippodrome.control.config import Config
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed, next_step, send_start_server_message, send_stop_server_message
from hippodrome.local import own_cells, own_places
from hippodrome.local.activity.log import ActivityLog
from hippodrome.local.backend.authority import Authority
from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.backend.processes import end_everything
from hippodrome.local.stand_in import StandIn
from hippodrome.local.watch import Watch
from hippodrome.local.web.access import TLS_NAMES
from hippodrome.local.web.app import App
from hippodrome.local.web.names import PORT as NAMES_PORT
from hippodrome.local.web.names import Names
from hippodrome.local.web.server import HOST, WebServer, listen

OTHERS = 0o077  # the permissions of all users but the owner

FUNCTIONS = {
    "next_step": next_step.handler,
    "send_start_server_message": send_start_server_message.handler,
    "send_stop_server_message": send_stop_server_message.handler,
}


class Study:
    """A study that runs on this machine."""

    def __init__(
        self,
        folder: Path,
        data: Path,
        state: Path,
        port: int,
        activity_log: ActivityLog,
        *,
        origins: Collection[str] = (),
        tls: bool = False,
        names: str | None = None,
        fake_model: bool = False,
    ) -> None:
        """Publish the project in `folder` and take a port. Raises `NotPublished`, `NoPort`, and OSError.

        With `tls`, pages are served by https, and servers have names below localhost. `names` ("hash" or "userId") says
        how servers are named; None: as the project says. With `fake_model`, a stand-in answers in the place of the
        study's language model also if there is a key.
        """
        self._data = data
        self._state = state
        self._port = port
        self._activity_log = activity_log
        activity_log.named = tls
        self._authority = Authority(state.parent / "tls") if tls else None
        names_listener = listen(NAMES_PORT) if tls else None
        named_port: int | None = names_listener.getsockname()[1] if names_listener else None
        _end_servers_of_other_addresses(state, named_port)
        self._platform = LocalPlatform(
            data,
            state,
            project_folder=folder,
            written=activity_log.wrote,
            named_port=named_port,
            subdomain=names,
            say=activity_log.warn,
        )
        installed.use(self._platform)
        self._config = self._platform.publish()
        self._stand_in = StandIn(always=fake_model)
        self._stand_in.use(self._config, activity_log.warn)
        next_step_at = own_cells.OwnCells(self._platform, FUNCTIONS["next_step"]).handler
        app = App({**FUNCTIONS, "next_step": next_step_at}, activity_log.warn, origins)
        site = self._authority.context("localhost", HOST, *sorted(TLS_NAMES)) if self._authority else None
        self.server = WebServer(app, listen(port), self._platform.retry.report, site)
        self._names: Names | None = None
        if self._authority is not None and names_listener is not None:
            self._names = Names(names_listener, self._authority, self._platform.port_of)
        self._watch = Watch(folder, self._config, self._platform.publish, self._published, activity_log.say)

    def start(self) -> None:
        """Start the servers' threads and the web server, print the link, and watch the project's files."""
        self._activity_log.set_steps(step.key for step in self._config.steps)
        self._platform.start()
        self.server.start()
        if self._names is not None:
            self._names.start()
        self._banner()
        playing_on = sum(bool(task.folder) for task in self._platform.tasks.playing())
        if playing_on:
            self._activity_log.say(f"{playing_on} server(s) of the last run play on")
        self._watch.start()
        self._activity_log.follow(self._platform.tasks, self._platform.documents.folder)

    def close(self) -> None:
        """End the servers and the web server. The data stay, and the next run goes on with them."""
        running = len(self._platform.tasks.playing())
        self._activity_log.show("", f"Ending{f', and {running} server(s) with it' if running else ''} …")
        self._watch.close()
        self.server.close()
        if self._names is not None:
            self._names.close()
        self._platform.close()
        self._stand_in.close()
        self._activity_log.close()
        self._activity_log.show(f"Ended. The data are in {self._data}.")

    def _published(self, changed: Config) -> None:
        self._activity_log.set_steps(step.key for step in changed.steps)
        installed.use(self._platform)  # the functions forget the pages that they have cached
        self._stand_in.use(changed, self._activity_log.warn)
        if not changed.project.live:
            self._activity_log.warn(_NOT_LIVE)

    def _banner(self) -> None:
        project, url = self._config.project, self.server.url
        link = f"{url}/next?projectId={project.id}"
        own = link + self._signed(_new_id()) if project.signed_links else link
        lines = [
            Text(""),
            Text.assemble("  ", (project.name or project.id, "bold")),
            Text(f"  {self._config.summary()}"),
            Text(""),
            Text.assemble("  Link   ", (own, "bold green")),
            Text(f"  Data   {self._data}"),
            Text(f"  Logs   {from_here(self._state / 'logs')}"),
            *self._how_to_trust(),
            *self._how_to_play_together(link),
            *self._how_to_try_cells(link),
            Text(""),
            Text(f"  {_FOR_ONE if project.signed_links else _FOR_ALL} Ctrl-C ends everything."),
        ]
        if self._port and not url.endswith(f":{self._port}"):
            lines.append(Text(f"  Port {self._port} is in use, so it is another one.", "yellow"))
        if not project.live:
            lines.append(Text(f"  {_NOT_LIVE}.", "yellow"))
        if self._data.stat().st_mode & OTHERS:
            lines.append(Text(f"  {_OPEN.format(data=self._data)}", "yellow"))
        if project.use_aws:
            lines.append(Text("  useAWS is true, but on this machine servers are processes.", "yellow"))
        self._activity_log.show(*lines, Text(""))

    def _how_to_trust(self) -> list[Text]:
        """With TLS: at which port servers have names, and which certificate the browser must trust."""
        if self._names is None or self._authority is None:
            return []
        shown = _TLS.format(port=self._names.port, file=from_here(self._authority.certificate))
        lines = [Text(line) for line in shown.splitlines()]
        if self._names.port != NAMES_PORT:
            text = f"  Port {NAMES_PORT} is in use; HIPPO's front end looks for servers there and nowhere else."
            lines.append(Text(text, "yellow"))
        return lines

    def _how_to_play_together(self, link: str) -> list[Text]:
        """With `players`: a link for each place, so that one researcher can play in all of them."""
        project = self._config.project
        if not project.has_sessions:
            return []
        run = secrets.token_hex(2)
        user_ids = own_places.user_ids(
            project.id,
            project.players,
            project.matching,
            self._config.groups,
            lambda number: _new_id() if project.signed_links else f"try-{run}-{number}",
        )
        queries = [self._signed(each) if project.signed_links else f"&userId={each}" for each in user_ids]
        text = _TOGETHER.format(
            places="both" if project.players == 2 else f"all {project.players}", patience=f"{project.patience:g}"
        )
        advice = own_places.advice(project.matching)
        return [
            Text(""),
            *(Text(line) for line in text.splitlines()),
            *([Text(f"  {advice}")] if advice else []),
            *(Text(f"    {link}{each}", "green") for each in queries),
        ]

    def _how_to_try_cells(self, link: str) -> list[Text]:
        """With `conditions`: a link for each of the first cells."""
        project = self._published_project()
        names = own_cells.cell_names(project) if project and not project.has_sessions else []
        if not names or project is None:
            return []
        first, more = names[: own_cells.SHOWN], len(names) - own_cells.SHOWN
        width = max(map(len, first))
        return [
            Text(""),
            Text(f"  {_CELLS.format(factors=', '.join(factor.name for factor in project.conditions))}"),
            *(
                Text.assemble(
                    f"    {name:{width}}  ",
                    (f"{link}{self._signed(_new_id()) if project.signed_links else ''}&cell={name}", "green"),
                )
                for name in first
            ),
            *([Text(f"    … and {more} more, such as &cell={names[-1]}")] if more > 0 else []),
        ]

    def _published_project(self) -> Project | None:
        cache = ProjectCache(self._platform, SecretCache(self._platform.documents))
        return cache.project(self._config.project.id)

    def _signed(self, user_id: str) -> str:
        """What is appended to the study's link to make this participant's signed link."""
        project_id = self._config.project.id
        project = self._published_project()
        signature = ids.link_signature(project.secret if project else "", project_id, user_id)
        return f"&userId={user_id}&signature={signature}"


_TLS = """\
  Names  Servers have names below localhost, at port {port}
  Trust  {file}

  Let your browser trust this certificate, which vouches for names of this machine alone. In Chrome: Settings, Privacy
  and security, Security, Manage certificates. In Firefox: Settings, Privacy & Security, View Certificates, Authorities.
  On macOS: open it, and choose Always Trust."""
_TOGETHER = """\
  To play in {places} places yourself, open these links in windows side by side: a page that is hidden counts as away.
  Come to the game in each within {patience} seconds of the others (`patience`):"""
_CELLS = "To try a cell yourself ({factors}), open its link; it counts on this machine only, and AWS draws the cells:"
_FOR_ALL = "Whoever opens the link gets an id of their own; add &userId=… to choose it."
_FOR_ONE = "signedLinks is true: this link is for one participant; each start prints another."
_OPEN = "Other users of this machine can read the folder {data}. To change that: chmod -R go-rwx {data}"
_NOT_LIVE = "config.yml says `live: false`: participants get a 404 until it says true"


def _new_id() -> str:
    """A new participant's id."""
    return secrets.token_hex(12)


def from_here(path: Path) -> Path:
    """Return the path relative to the working directory, if it lies below that; otherwise the path itself."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _end_servers_of_other_addresses(state: Path, named_port: int | None) -> None:
    """End the servers of an earlier run if their addresses have another port than `named_port`. Raises OSError.

    Browsers could not reach them. A file in `state` keeps the port for the next run.
    """
    file, now = state / "named-port", str(named_port or "")
    state.mkdir(parents=True, exist_ok=True)
    before = file.read_text() if file.exists() else ""
    if before != now:
        end_everything(state)
        file.write_text(now)
