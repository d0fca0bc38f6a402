"""An installation on moto in which things happen by themselves, with real trial servers and a real site on loopback.

A thread does what AWS does between the functions: it hands messages to them, tells ECS's events, and runs each task as a
process of `python -m hippodrome.trial` with the environment that RunTask was given, on a port of its own, with a certificate of a test
authority. Another serves the participants' site over TLS. `where` leads a study's addresses to those on loopback.

Gaps of moto that are bridged here, beside those of `MotoWorld`: Lambda runs nothing (Invoke runs the real handler), the
scheduler fires nothing (a timer that is due within two minutes fires at once), CloudWatch's alarms tell nobody, and ECS
does not say when a task was made and ended.
"""

from __future__ import annotations

import base64
import contextlib
import gzip
import http.server
import json
import re
import signal
import ssl
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Self

import botocore.handlers
import pytest
from botocore.awsrequest import AWSResponse
from moto.ecs.models import EC2ContainerServiceBackend

from hippodrome.bots.addresses import OneSite
from hippodrome.bots.bot import Bot
from hippodrome.control.certificates.rules import location
from hippodrome.control.config import read_project
from hippodrome.control.storage.secret import SecretCache
from hippodrome.deployment.operate.doctor import play as rehearsal_with_bots
from hippodrome.deployment.operate.doctor.play import Play
from hippodrome.functions import (
    installed,
    next_step,
    sign_requests,
    start_server,
    stop_server,
    sweep,
    task_changed,
    update_project_master_list,
)
from testing import aws_events, processes
from testing.certificates import authority
from tests.deployment.installation import KEYS, ROOT, Installed
from tests.deployment.registering import _stream

Process = subprocess.Popen[str]
FUNCTIONS = {"start": start_server, "stop": stop_server, "task": task_changed}
NEAR = timedelta(minutes=2)
UNTIL_KILLED = 100.0  # seconds
NOBODY = 1  # a port on which nobody listens


class RunningInstallation(Installed):
    """`Installed`, in which things happen by themselves. `agent` is the folder of the agent that every server plays."""

    def __init__(self, agent: Path) -> None:
        super().__init__()
        self._agent = agent
        self._working = threading.RLock()  # one function at a time: handlers share one module's platform
        self._over = threading.Event()
        self._processes: dict[str, Process] = {}  # by task
        self._servers: dict[str, tuple[str, int]] = {}  # public address, and port on loopback, by running task
        self._ended: set[str] = set()
        self._served: dict[str, str] = {}
        self.stopped: list[str] = []  # the reasons that StopTask was given
        self.alarmed: list[str] = []  # the states that alarms were set to
        self.broken: dict[str, str] = {}  # functions that fail when they are invoked, and how
        self.without_alarms = False  # whether the topic of the alarms is told nothing
        self.without_timers = False  # whether timers do not fire
        self.visited = ""  # the query of a page that somebody looks at all the time
        self.secrets: set[str] = set()  # what servers were told that nobody else may see
        self.troubles: list[str] = []

    def __enter__(self) -> Self:
        super().__enter__()
        try:
            self._stop_slowly()
            self._begin()
        except BaseException:
            self.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        for thread in getattr(self, "_threads", ()):
            thread.join()
        for process in self._processes.values():
            process.kill()
            process.wait()
        super().__exit__(*error)
        assert error[0] or not self.troubles, self.troubles

    def _begin(self) -> None:
        self._temporary = self._stack.enter_context(tempfile.TemporaryDirectory())
        self._served = self._stack.enter_context(self.served())
        ours: tuple[str, Any] = ("before-call", self._before_call)
        botocore.handlers.BUILTIN_HANDLERS.append(ours)
        self._stack.callback(botocore.handlers.BUILTIN_HANDLERS.remove, ours)
        installed.use(self.platform)
        self._stack.callback(installed.use, None)
        made = authority()
        self.authority = made.certificate
        certificate, key = made.issue(f"*.{self.root_domain}", f"*.servers.{self.root_domain}")
        SecretCache(self.platform.documents).get_or_create()  # there is one once a server has started
        files = location(self.platform.settings.servers_domain)
        self.put(files.fullchain, certificate)
        self.put(files.privkey, key)
        self._site = _site(self, Path(self._temporary), certificate + key)
        self._signer = _signer(self)
        for server in (self._site, self._signer):
            server.daemon_threads = False  # so that `server_close` waits for what is being answered
            self._stack.callback(server.server_close)
            self._stack.callback(server.shutdown)
        threading.Thread(target=self._signer.serve_forever, daemon=True).start()
        self._threads = [threading.Thread(target=self._go, daemon=True)]
        threading.Thread(target=self._site.serve_forever, daemon=True).start()
        self._threads[0].start()

    # -- where bots go

    def where(self, project_id: str) -> OneSite:
        """Return the installation's addresses, which lead to loopback, and whom to believe there."""

        def connect(host: str, port: int) -> tuple[str, int]:
            if host == f"study.{self.root_domain}":
                return "127.0.0.1", int(self._site.server_address[1])
            ports = dict(list(self._servers.values()))
            return "127.0.0.1", ports.get(self.records().get(host, ""), NOBODY)

        servers = self.platform.settings.game_sources.split()
        tls = ssl.create_default_context(cadata=self.authority.decode())
        return OneSite(f"https://study.{self.root_domain}", servers, project_id, tls=tls, connect=connect)

    def answer_page(self, event: dict[str, Any]) -> dict[str, Any]:
        with self._working:
            return dict(next_step.handler(event, None))

    def answer_server(self, event: dict[str, Any]) -> dict[str, Any]:
        """Presigned requests for a server, which lead to the account's HTTP server; moto takes any signature."""
        with self._working:
            answer = dict(sign_requests.handler(event, None))
        bucket, here = self.env["BUCKET"], self._served["AWS_ENDPOINT_URL"]
        answer["body"] = answer["body"].replace(f"https://{bucket}.s3.amazonaws.com/", f"{here}/{bucket}/")
        return answer

    # -- what AWS does

    def _go(self) -> None:
        while not self._over.is_set():
            try:
                self._turn()
            except Exception as error:  # noqa: BLE001 - the test is told at its end
                self.troubles.append(f"{type(error).__name__}: {error}")
            self._over.wait(0.1)

    def _turn(self) -> None:
        self.skip_delays()
        for queue, function in FUNCTIONS.items():
            event = self.receive(queue)
            if event["Records"]:
                with self._working:
                    failed = function.handler(event, None)["batchItemFailures"]
                again = {one["itemIdentifier"] for one in failed}
                for record in event["Records"]:
                    if record["messageId"] in again:
                        url = self.ids[f"{queue}_queue"]
                        self.client("sqs").send_message(QueueUrl=url, MessageBody=record["body"])
        if self.visited:
            self.answer_page({**aws_events.load("http_get"), "rawPath": "/next", "rawQueryString": self.visited})
        self._fire()
        for arn in self.task_arns():
            self._look_after(arn)

    def _fire(self) -> None:
        if not self.without_timers:
            for name, (at, _) in self.timers().items():
                if at < datetime.now(UTC) + NEAR:
                    with contextlib.suppress(KeyError):  # cancelled at this moment
                        self.fire_timer(name)

    def _look_after(self, arn: str) -> None:
        task, process = self.task(arn), self._processes.get(arn)
        if process is None and arn not in self._ended:
            if task.desired_status == "STOPPED":
                self._tell_end(arn, exit_code=None)
                return
            task.created_at = datetime.now(UTC)
            self._processes[arn] = process = self._run(task)
            port = json.loads(process.stdout.readline())["port"] if process.stdout else 0
            self._servers[arn] = self.public_ip(arn), port
            task.started_at = datetime.now(UTC)
            self._tell(arn, "RUNNING")
        if process is not None and arn not in self._ended:
            if task.desired_status == "STOPPED" and process.poll() is None and not getattr(task, "told", False):
                task.told = True
                process.send_signal(signal.SIGTERM)
            if process.poll() is not None:
                self._tell_end(arn, exit_code=process.returncode)

    def _run(self, task: Any) -> Process:
        (container,) = task.overrides["containerOverrides"]
        told = {one["name"]: one["value"] for one in container["environment"]}
        plays = told["SESSION"] if "SESSION" in told else told["USER_ID"]
        self.secrets |= {told["TOKEN"], told["CREDENTIAL"], plays, told["SERVER"], told["PROJECT_ID"]}
        inherited = {name: value for name, value in self._served.items() if not name.startswith(("AWS_", "PYTHONUTF8"))}
        sign = f"http://127.0.0.1:{self._signer.server_address[1]}/sign"
        env = {**inherited, **told, "STORE": sign, "HOST": "127.0.0.1", "PORT": "0", "AGENT_DIR": str(self._agent)}
        spool = Path(self._temporary) / aws_events.last(task.task_arn)
        spool.mkdir()
        with (spool / "log").open("w") as log:
            return processes.start(
                "hippodrome.trial",
                cwd=ROOT,
                env={**env, "SPOOL": str(spool), "LINGER_SECONDS": "0.2"},
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )

    def _tell_end(self, arn: str, exit_code: int | None) -> None:
        """As ECS does: of a task that somebody has stopped, with the reason that was given."""
        self._ended.add(arn)
        self._servers.pop(arn, None)
        task = self.task(arn)
        task.last_status = "STOPPED"
        task.execution_stopped_at = task.stopped_at = datetime.now(UTC)
        reason = task.stopped_reason
        code = "UserInitiated" if reason else "EssentialContainerExited"
        for status in ("DEPROVISIONING", "STOPPED"):
            self._tell(arn, status, stop_code=code, reason=reason or None, exit_code=exit_code, desired="STOPPED")

    def _tell(self, arn: str, status: str, **more: Any) -> None:
        body = json.dumps(self.task_event(arn, status, **more))
        self.client("sqs").send_message(QueueUrl=self.ids["task_queue"], MessageBody=body)

    # -- what moto lacks

    def _stop_slowly(self) -> None:
        """Gap: a task of moto is STOPPED at once; on AWS it is stopping, and may store data, until its process has ended.

        https://docs.aws.amazon.com/AmazonECS/latest/developerguide/task-lifecycle-explanation.html
        """
        stop_task = EC2ContainerServiceBackend.stop_task

        def stop(backend: Any, *args: Any, **more: Any) -> Any:
            task = stop_task(backend, *args, **more)
            if task.task_arn in self._processes and task.task_arn not in self._ended:
                task.last_status = "STOPPING"
            return task

        self._patch(EC2ContainerServiceBackend, "stop_task", stop)

    def _before_call(self, model: Any, params: Any, context: dict[str, Any], **_: Any) -> Any:
        action = f"{model.service_model.service_name}:{model.name}"
        told = context.get("hippodrome_params", {})
        if action == "ecs:StopTask":
            self.stopped.append(told.get("reason", ""))
        if action == "cloudwatch:SetAlarmState":
            self.alarmed.append(told["StateValue"])
        answer: dict[str, Callable[[], dict[str, Any]]] = {
            "lambda:Invoke": lambda: self._invoke(re.findall("/functions/([^/]+)/", params["url"])[0], params["body"]),
            "cloudwatch:DescribeAlarmHistory": self._history,
        }
        if action not in answer:
            return None
        return AWSResponse(params["url"], 200, {}, None), {
            **answer[action](),
            "ResponseMetadata": {"HTTPStatusCode": 200},
        }

    def _invoke(self, name: str, body: bytes) -> dict[str, Any]:
        functions = {"hippodrome-update_project_master_list": update_project_master_list, "hippodrome-sweep": sweep}
        if name in self.broken:
            return {"StatusCode": 200, "FunctionError": "Unhandled", "Payload": _stream(self.broken[name].encode())}
        with self._working:
            reply = functions[name].handler(json.loads(body), None)
        return {"StatusCode": 200, "Payload": _stream(json.dumps(reply).encode())}

    def _history(self) -> dict[str, Any]:
        summary = f"Successfully executed action {self.alarm_topic}"
        told = [] if self.without_alarms or "ALARM" not in self.alarmed else [{"HistorySummary": summary}]
        return {"AlarmHistoryItems": told}


def _signer(world: RunningInstallation) -> http.server.ThreadingHTTPServer:
    """Return the site's `/sign`, as API Gateway hands it to `sign_requests`; without TLS, for servers alone."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            event = aws_events.load("http_post_json")
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            event |= {
                "rawPath": "/sign",
                "rawQueryString": "",
                "headers": {},
                "body": body.decode(),
                "isBase64Encoded": False,
            }
            answer = world.answer_server(event)
            self.send_response(answer["statusCode"])
            self.send_header("Content-Length", str(len(answer["body"].encode())))
            self.end_headers()
            self.wfile.write(answer["body"].encode())

        def log_message(self, *_: Any) -> None:
            pass

    return http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)


def _site(world: RunningInstallation, folder: Path, pem: bytes) -> http.server.ThreadingHTTPServer:
    """Return the participants' site over TLS, as API Gateway hands it to `next_step`."""

    class Handler(http.server.BaseHTTPRequestHandler):
        timeout = 60  # seconds; a client that stops in the midst of its handshake keeps nothing from ending

        def do_GET(self) -> None:
            self._answer("http_get")

        def do_POST(self) -> None:
            self._answer("http_post_form")

        def _answer(self, payload: str) -> None:
            event = aws_events.load(payload)
            event["rawPath"], _, event["rawQueryString"] = self.path.partition("?")
            event["headers"] = {name.lower(): value for name, value in self.headers.items()}
            event["headers"] |= {"x-forwarded-proto": "https"}
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            if body:
                event |= {"body": base64.b64encode(body).decode(), "isBase64Encoded": True}
            answer = world.answer_page(event)
            packed = base64.b64decode(answer["body"]) if answer["isBase64Encoded"] else answer["body"].encode()
            headers = {**answer["headers"]}
            if headers.pop("Content-Encoding", "") == "gzip":
                packed = gzip.decompress(packed)
            self.send_response(answer["statusCode"])
            for name, value in {**headers, "Content-Length": str(len(packed))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(packed)

        def log_message(self, *_: Any) -> None:
            pass

    (folder / "site.pem").write_bytes(pem)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(folder / "site.pem")
    made = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    # Each client's handshake takes place in the thread of its request, not in the one that accepts all.
    made.socket = context.wrap_socket(made.socket, server_side=True, do_handshake_on_connect=False)
    return made


@contextlib.contextmanager
def held(
    folder: Path, patch: pytest.MonkeyPatch, *, play: float, email: str, together: bool = False
) -> Iterator[RunningInstallation]:
    """An installation that lives, with the study of this folder, as `make deploy` leaves it; its rehearsals are short.

    `play` is the longest game of a bot in seconds; but those on the server that is killed play until it is, however
    long that takes here: the victim, and who plays `together` with it. `email` gets the alarms.
    """
    for name, value in KEYS.items():
        patch.setenv(name, value)
    patch.setattr(rehearsal_with_bots, "PAUSE", 0.2)
    kill = Play._kill

    def killed(walked: Play, victim: Bot) -> None:
        kill(walked, victim)
        for bot in walked.bots:
            bot.play = play  # on the next server

    patch.setattr(Play, "_kill", killed)
    patch.setattr(rehearsal_with_bots, "PLAY", UNTIL_KILLED if together else play)
    patch.setattr(rehearsal_with_bots, "VICTIM_PLAYS", UNTIL_KILLED)
    patch.setattr(rehearsal_with_bots, "STRUCK", 1.0)
    patch.setattr(rehearsal_with_bots, "ARRIVALS", 0.1)
    with RunningInstallation(folder) as world:
        patch.setattr(rehearsal_with_bots, "site", lambda context, project_id: world.where(project_id))
        registration = read_project(folder).registration()
        for page in (folder / "steps").iterdir():
            world.put(f"{registration['id']}/steps/{page.name}", page.read_bytes())
        definition = world.client("ecs").describe_task_definition(taskDefinition="hippodrome")["taskDefinition"]
        task = {"taskDefinition": definition["taskDefinitionArn"], "serverPort": 443}
        answer = update_project_master_list.handler({"project": {**registration, **task}}, None)
        assert answer.get("registered") == registration["id"], answer
        world.client("sns").subscribe(TopicArn=world.alarm_topic, Protocol="email", Endpoint=email)
        yield world
