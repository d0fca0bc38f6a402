"""A study that runs on this machine: its platform, its web server, and the lines that its researcher reads."""

from __future__ import annotations

import io
import os
import secrets
import ssl
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path

from rich.text import Text

from hippodrome.console.problem import Problem
from hippodrome.control.config import Config
from hippodrome.control.model import ids
from hippodrome.functions import installed, next_step, send_start_server_message, send_stop_server_message
from hippodrome.local import own_cells, own_places
from hippodrome.local.activity.log import ActivityLog
from hippodrome.local.backend.authority import Authority
from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.lab import Host, Lab, qr
from hippodrome.local.publish import NotPublished
from hippodrome.local.stand_in import StandIn
from hippodrome.local.watch import Watch
from hippodrome.local.web.access import TLS_NAMES
from hippodrome.local.web.app import App
from hippodrome.local.web.names import PORT as NAMES_PORT
from hippodrome.local.web.names import names_server
from hippodrome.local.web.relay import by_path
from hippodrome.local.web.server import HOST, WebServer, address_of, listen

OTHERS = 0o077  # the permissions of all users but the owner

FUNCTIONS = {
    "next_step": next_step.handler,
    "send_start_server_message": send_start_server_message.handler,
    "send_stop_server_message": send_stop_server_message.handler,
}


class Study:
    """A study that runs on this machine; in a lab several of them, under one address."""

    def __init__(
        self,
        folders: Sequence[Path],
        data: Path,
        state: Path,
        port: int,
        activity_log: ActivityLog,
        *,
        origins: Collection[str] = (),
        tls: bool = False,
        names: str | None = None,
        fake_model: bool = False,
        host: Host | None = None,
        certificate: tuple[Path, Path] | None = None,
    ) -> None:
        """Publish the projects in `folders` and take a port. Raises `NotPublished`, `NoPort`, `Problem`, and OSError.

        With `tls`, pages are served by https, and servers have names below localhost. `names` ("hash" or "userId") says
        how servers are named; None: as the project says. With `host`, other machines reach pages and servers there;
        then `certificate` names the files of a certificate's chain and its key, instead of one that is made here. With
        `fake_model`, a stand-in answers in the place of a study's language model also if there is a key.
        """
        self._data = data
        self._state = state
        self._port = port
        self._tls = tls
        self._activity_log = activity_log
        activity_log.named, activity_log.one_port = tls and host is None, host is not None
        self._authority = _authority(state.parent, tls, host, certificate)
        names_listener = listen(NAMES_PORT) if tls and host is None else None
        named_port: int | None = names_listener.getsockname()[1] if names_listener else None
        listener = listen(port, host.bound) if host else listen(port)
        site = _site_context(self._authority, host, certificate)
        address = address_of(listener, site, host.shown if host else None)
        self._platform = LocalPlatform(
            data,
            state,
            project_folder=folders[0],
            written=activity_log.wrote,
            named_port=named_port,
            subdomain=names,
            more_folders=folders[1:],
            lab=address if host else None,
            say=activity_log.warn,
        )
        installed.use(self._platform)
        self._configs = {folder: self._platform.publish(folder) for folder in folders}
        if len(self._project_ids()) < len(folders):
            raise NotPublished(["Two studies have the same id; give each a project.id of its own."])
        self._stand_in = StandIn(always=fake_model)
        for config in self._configs.values():
            self._stand_in.use(config, activity_log.warn)
        self._lab = Lab(self._platform, address, self._project_ids) if host else None
        if self._lab is not None:
            functions = self._lab.functions(FUNCTIONS)
        else:  # in a lab cells are drawn, as on AWS
            own = own_cells.OwnCells(self._platform, FUNCTIONS["next_step"])
            functions = {**FUNCTIONS, "next_step": own.handler}
        app = App(functions, activity_log.warn, origins, any_name=host is not None)
        report = self._platform.retry.report
        route = by_path(self._platform.port_of_label) if host else None
        self.server = WebServer(app, listener, report, site, url=address, route=route)
        self._names: WebServer | None = None
        if self._authority is not None and names_listener is not None:
            self._names = names_server(names_listener, self._authority, self._platform.port_of, report)
        self._names_port = named_port
        self._watches = [self._watch(folder, config) for folder, config in self._configs.items()]

    def _watch(self, folder: Path, config: Config) -> Watch:
        publish, published = partial(self._platform.publish, folder), partial(self._published, folder)
        return Watch(folder, config, publish, published, self._activity_log.say)

    def _project_ids(self) -> list[str]:
        return list(dict.fromkeys(config.project.id for config in self._configs.values()))

    def start(self) -> None:
        """Start the servers' threads and the web server, print the link, and watch the project's files."""
        for config in self._configs.values():
            self._activity_log.set_steps(config.project.id, (step.key for step in config.steps))
        lost = self._platform.start()
        self.server.start()
        if self._names is not None:
            self._names.start()
        self._banner()
        if lost:
            self._activity_log.say(
                f"The last run was killed. Its {lost} server(s) were ended; each game goes on on another"
            )
        for watch in self._watches:
            watch.start()
        self._activity_log.follow(self._platform.tasks, self._platform.documents.folder)

    def close(self) -> None:
        """End the servers and the web server. The data stay, and the next run goes on with them."""
        running = len(self._platform.tasks.playing())
        self._activity_log.show("", f"Ending{f', and {running} server(s) with it' if running else ''} …")
        for watch in self._watches:
            watch.close()
        self.server.close()
        if self._names is not None:
            self._names.close()
        self._platform.close()
        self._stand_in.close()
        self._activity_log.close()
        self._activity_log.show(f"Ended. The data are in {self._data}.")

    def _published(self, folder: Path, changed: Config) -> None:
        self._configs[folder] = changed
        self._activity_log.set_steps(changed.project.id, (step.key for step in changed.steps))
        installed.use(self._platform)  # the functions forget the pages that they have cached
        self._stand_in.use(changed, self._activity_log.warn)
        if not changed.project.live:
            self._activity_log.warn(_NOT_LIVE)

    def _banner(self) -> None:
        lines = [Text("")]
        if self._lab is not None:
            lines += self._about_the_lab(self._lab)
        for config in self._configs.values():
            lines += self._about(config)
        lines += [
            Text(f"  Data   {self._data}"),
            Text(f"  Logs   {from_here(self._state / 'logs')}"),
            *self._how_to_trust(),
        ]
        if self._lab is None:
            (config,) = self._configs.values()
            lines += [*self._how_to_play_together(config), *self._how_to_try_cells(config)]
        lines += [Text(""), Text(f"  {self._who_takes_part()} Ctrl-C ends everything.")]
        if self._port and not self.server.url.endswith(f":{self._port}"):
            lines.append(Text(f"  Port {self._port} is in use, so it is another one.", "yellow"))
        if self._data.stat().st_mode & OTHERS:
            lines.append(Text(f"  {_OPEN.format(data=self._data)}", "yellow"))
        if any(config.project.use_aws for config in self._configs.values()):
            lines.append(Text("  useAWS is true, but on this machine servers are processes.", "yellow"))
        self._activity_log.show(*lines, Text(""))

    def _about(self, config: Config) -> list[Text]:
        """The study's name, its summary and its link; in a lab with a QR code, if there is no other study."""
        project = config.project
        link = self._lab.link(project.id) if self._lab else self._link(config)
        own = link + self._signed(config, _new_id()) if project.signed_links and self._lab is None else link
        lines = [
            Text.assemble("  ", (project.name or project.id, "bold")),
            Text(f"  {config.summary()}"),
            Text(""),
            Text.assemble("  Link   ", (own, "bold green")),
        ]
        if self._lab is not None:
            lines += _code(link) if len(self._configs) == 1 else [Text("")]
            if config.game_steps and project.max_servers is None:
                lines.append(Text(f"  {_NO_LIMIT.format(cores=os.cpu_count())}", "yellow"))
        if not project.live:
            lines.append(Text(f"  {_NOT_LIVE}.", "yellow"))
        return lines

    def _about_the_lab(self, lab: Lab) -> list[Text]:
        """Whom this server reaches, what others in the network can see, and where the list of studies is."""
        return [
            Text(f"  A lab's server: every machine that can reach {self.server.url} can open it."),
            Text(f"  {_ENCRYPTED if self._tls else _PLAIN}", "" if self._tls else "yellow"),
            Text.assemble("  List   ", (lab.list_link, "green")),
            Text(""),
        ]

    def _who_takes_part(self) -> str:
        if self._lab is not None:
            return _IN_LAB
        return _FOR_ONE if any(config.project.signed_links for config in self._configs.values()) else _FOR_ALL

    def _link(self, config: Config) -> str:
        return f"{self.server.url}/next?projectId={config.project.id}"

    def _how_to_trust(self) -> list[Text]:
        """With TLS: at which port servers have names, and which certificate the browser must trust."""
        if self._authority is None:
            return []
        if self._names is None:
            shown = _TRUST.format(file=from_here(self._authority.certificate))
            return [Text(line) for line in shown.splitlines()]
        shown = _TLS.format(port=self._names_port, file=from_here(self._authority.certificate))
        lines = [Text(line) for line in shown.splitlines()]
        if self._names_port != NAMES_PORT:
            text = f"  Port {NAMES_PORT} is in use; HIPPO's front end looks for servers there and nowhere else."
            lines.append(Text(text, "yellow"))
        return lines

    def _how_to_play_together(self, config: Config) -> list[Text]:
        """With `players`: a link for each place, so that one researcher can play in all of them."""
        project, link = config.project, self._link(config)
        if not project.has_sessions:
            return []
        text = _TOGETHER.format(
            places="both" if project.players == 2 else f"all {project.players}", patience=f"{project.patience:g}"
        )
        advice = own_places.advice(project.matching)
        return [
            Text(""),
            *(Text(line) for line in text.splitlines()),
            *([Text(f"  {advice}")] if advice else []),
            *(Text(f"    {link}{each}", "green") for each in self._place_queries(config)),
        ]

    def _place_queries(self, config: Config) -> list[str]:
        """What is appended to the study's link for each place of a new session."""
        project, run = config.project, secrets.token_hex(2)
        user_ids = own_places.user_ids(
            project.id,
            project.players,
            project.matching,
            config.groups,
            lambda number: _new_id() if project.signed_links else f"try-{run}-{number}",
        )
        return [self._signed(config, user_id) if project.signed_links else f"&userId={user_id}" for user_id in user_ids]

    def _how_to_try_cells(self, config: Config) -> list[Text]:
        """With `conditions`: a link for each of the first cells; with `players` one for each place."""
        project, link = self._platform.project(config.project.id), self._link(config)
        names = own_cells.cell_names(project) if project else []
        if not names or project is None:
            return []
        first, more = names[: own_cells.SHOWN], len(names) - own_cells.SHOWN
        width = max(map(len, first))
        text = _CELLS_TOGETHER if project.has_sessions else _CELLS
        return [
            Text(""),
            Text(f"  {text.format(factors=', '.join(factor.name for factor in project.conditions))}"),
            *(
                Text.assemble(f"    {name:{width}}  ", (f"{link}{query}&cell={name}", "green"))
                for name in first
                for query in self._cell_queries(config)
            ),
            *([Text(f"    … and {more} more, such as &cell={names[-1]}")] if more > 0 else []),
        ]

    def _cell_queries(self, config: Config) -> list[str]:
        """What is appended to the study's link for each new participant who tries a cell."""
        if config.project.has_sessions:
            return self._place_queries(config)
        return [self._signed(config, _new_id()) if config.project.signed_links else ""]

    def _signed(self, config: Config, user_id: str) -> str:
        """What is appended to the study's link to make this participant's signed link."""
        project_id = config.project.id
        project = self._platform.project(config.project.id)
        signature = ids.link_signature(project.secret if project else "", project_id, user_id)
        return f"&userId={user_id}&signature={signature}"


_TLS = """\
  Names  Servers have names below localhost, at port {port}
  Trust  {file}

  Let your browser trust this certificate, which vouches for names of this machine alone. In Chrome: Settings, Privacy
  and security, Security, Manage certificates. In Firefox: Settings, Privacy & Security, View Certificates, Authorities.
  On macOS: open it, and choose Always Trust."""
_TRUST = """\
  Trust  {file}

  Each computer of the lab must trust this authority, which vouches for this address and localhost alone: in the
  browser's settings, Security, Manage certificates. Otherwise participants see a warning."""
_PLAIN = (
    "Plain HTTP: whoever can read this network's traffic reads answers, and can play for others. With --tls it is "
    "encrypted."
)
_ENCRYPTED = "Pages and games are encrypted."
_IN_LAB = "Each browser that opens the link is a new participant, with a signed link of their own."
_NO_LIMIT = "Each game is a process here. Set maxServers in config.yml to what this machine's {cores} cores can run."
_TOGETHER = """\
  To play in {places} places yourself, open these links in windows side by side: a page that is hidden counts as away.
  Come to the game in each within {patience} seconds of the others (`patience`):"""
_CELLS = "To try a cell yourself ({factors}), open its link; it counts on this machine only, and AWS draws the cells:"
_CELLS_TOGETHER = (
    "To try a cell yourself ({factors}), open its links side by side; it counts on this machine only, and AWS draws "
    "the cells:"
)
_FOR_ALL = "Whoever opens the link gets an id of their own; add &userId=… to choose it."
_FOR_ONE = "signedLinks is true: this link is for one participant; each start prints another."
_OPEN = "Other users of this machine can read the folder {data}. To change that: chmod -R go-rwx {data}"
_NOT_LIVE = "config.yml says `live: false`: participants get a 404 until it says true"


def _code(link: str) -> list[Text]:
    """The link as a QR code, for a terminal."""
    drawn = io.StringIO()
    qr(link).terminal(out=drawn, compact=True)
    return [Text.from_ansi(line) for line in drawn.getvalue().splitlines()]


def _authority(root: Path, tls: bool, host: Host | None, certificate: tuple[Path, Path] | None) -> Authority | None:
    """The authority that makes certificates here; None without TLS, and if there is a certificate. Raises OSError."""
    if not tls or certificate is not None:
        return None
    return Authority(root / "tls") if host is None else Authority(root / f"tls-{host.shown}", host.shown)


def _site_context(
    authority: Authority | None, host: Host | None, certificate: tuple[Path, Path] | None
) -> ssl.SSLContext | None:
    """The TLS context of the pages; None without TLS. Raises `Problem` if the certificate cannot be used."""
    if certificate is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(*certificate)
        except (OSError, ValueError) as error:  # an SSLError is an OSError
            raise Problem(
                f"The certificate {certificate[0]} and the key {certificate[1]} cannot be used: {error}.",
                "Name two PEM files that belong together: the certificate with its chain, and its key.",
            ) from None
        return context
    if authority is None:
        return None
    return (
        authority.context(host.shown, "localhost", HOST)
        if host
        else authority.context("localhost", HOST, *sorted(TLS_NAMES))
    )


def _new_id() -> str:
    """A new participant's id."""
    return secrets.token_hex(12)


def from_here(path: Path) -> Path:
    """Return the path relative to the working directory, if it lies below that; otherwise the path itself."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path
