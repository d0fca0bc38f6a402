"""`RemoteEnv`: an environment that runs on a server, with Gymnasium's interface (docs/gym.md)."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import ssl
import weakref
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.sync.client import ClientConnection, connect

from hippodrome.trial.gym import spaces, values
from hippodrome.trial.gym.forms import SUBPROTOCOL
from hippodrome.trial.gym.spaces import CodecError

TIMEOUT = 90.0
"""The seconds in which an answer must come: more than a server's default limit, so that its sentence comes first."""

_CLOSE_SECONDS = 2.0  # seconds in which the server must answer a close
_MAX_REPLY = 2**30  # the most bytes of a reply


class RemoteError(RuntimeError):
    """The server could not carry out a request. The text is the server's sentence, and the connection remains."""


class ConnectionLost(RemoteError):
    """The connection has ended, and its environments are closed. The text says why."""


class GymClient:
    """A connection to a server of environments.

    `url` begins with `ws://` or `wss://`; without a path it gets `/gym`. `timeout` is in seconds, for connecting and
    for each answer. `ca` is a file of certificates in PEM that are trusted beside the system's. Raises ConnectionLost
    if there is no server, or if it does not speak this subprotocol.
    """

    def __init__(self, url: str, *, ca: str | None = None, timeout: float = TIMEOUT) -> None:
        parts = urlsplit(url)
        address = urlunsplit(parts._replace(path="/gym")) if parts.path in ("", "/") else url
        # Messages show the address without its password and query, which may be secrets.
        self.url = urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))
        self._timeout = timeout
        self._process = os.getpid()
        self._over: str | None = None
        try:
            self._connection: ClientConnection = connect(
                address,
                ssl=_trusting(ca) if ca is not None else None,
                subprotocols=[SUBPROTOCOL],
                compression=None,
                max_size=_MAX_REPLY,
                open_timeout=timeout,
                close_timeout=_CLOSE_SECONDS,
                proxy=None if _is_this_machine(parts.hostname or "") else True,
                ping_interval=None,  # no pings: a step may take longer than their answers may
            ).__enter__()
        except (OSError, InvalidHandshake, InvalidURI, TimeoutError, ValueError) as error:
            # `from None`, since the error may show the query.
            raise ConnectionLost(f"There is no connection to {self.url}: {_reason(error)}.") from None
        if self._connection.subprotocol != SUBPROTOCOL:
            self._end(f"it does not speak {SUBPROTOCOL}")
            raise ConnectionLost(
                f"The server at {self.url} does not speak {SUBPROTOCOL}. Servers of `hippodrome gym` do."
            )

    def call(self, method: str, **params: Any) -> Any:
        """Send a request. Return its result. Raises RemoteError, and ConnectionLost."""
        answer = self._exchange(values.to_bytes({"method": method, "params": params}))
        try:
            result = values.from_bytes(answer if isinstance(answer, bytes) else answer.encode())
        except CodecError as error:
            self.unfit(error)
        if isinstance(result, dict) and isinstance(result.get("error"), dict):
            raise RemoteError(str(result["error"].get("message")))
        return result

    def unfit(self, error: Exception) -> None:
        """End the connection, and raise ConnectionLost: the server's answer does not fit the request."""
        self._end(str(error))
        raise ConnectionLost(
            f"The answer of {self.url} cannot be read: {str(error).rstrip('.')}. If it is a server of another version "
            "of Hippodrome, use the same version on both sides."
        ) from error

    def close(self) -> None:
        """Close the connection. The server then closes its environments. May be called again."""
        self._end("it was closed")

    def _exchange(self, message: bytes) -> str | bytes:
        if os.getpid() != self._process:
            raise ConnectionLost(f"The connection to {self.url} is that of another process; make one in this process.")
        if self._over is not None:
            raise ConnectionLost(f"There is no connection to {self.url} any more: {self._over}.")
        try:
            self._connection.send(message)
            return self._connection.recv(self._timeout)
        except TimeoutError:
            self._end(f"there was no answer within {self._timeout:g} s")
        except ConnectionClosed as error:
            self._end(_reason(error))
        except BaseException:
            self._end("a request was interrupted")  # otherwise the next request would get its answer
            raise
        raise ConnectionLost(f"The connection to {self.url} is lost: {self._over}.")

    def _end(self, why: str) -> None:
        if self._over is None:
            self._over = why.rstrip(".")
            with contextlib.suppress(OSError):
                if os.getpid() == self._process:
                    self._connection.close()
                else:
                    self._connection.socket.close()  # the descriptor of this forked process; nothing is sent


def _is_this_machine(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def _trusting(ca: str) -> ssl.SSLContext:
    context = ssl.create_default_context()
    try:
        context.load_verify_locations(ca)
    except OSError as error:
        raise ValueError(f"{ca} cannot be read as certificates: {error.strerror}") from error
    return context


def _reason(error: BaseException) -> str:
    """Return why there is no connection, for the end of a sentence."""
    if isinstance(error, ConnectionClosed):
        if error.rcvd is None:
            return "the server has ended"
        return error.rcvd.reason or f"the server closed it with code {error.rcvd.code}"
    if isinstance(error, InvalidStatus):
        words = error.response.body.decode("utf-8", "replace").strip() if error.response.body else ""
        return f"it answered {error.response.status_code} {words[:200]}".rstrip(". ")
    if isinstance(error, InvalidURI):
        return "the address must begin with ws:// or wss://"
    if isinstance(error, TimeoutError):
        return "it took too long"
    if isinstance(error, ConnectionRefusedError):
        return "no server listens there (`hippodrome gym` starts one)"
    return str(error).rstrip(".") or type(error).__name__


Columns = tuple[Any, Any, Any, Any, list[dict[str, Any]]]


class RemoteEnv(gymnasium.Env[Any, Any]):
    """An environment that runs on a server: `RemoteEnv("ws://127.0.0.1:5000/", "CartPole-v1")`.

    It has a connection of its own, which ends with `close`, with a `with` block, or when the object is no longer used.
    `render_mode` and `options` are those of `gymnasium.make`. `timeout` is in seconds, for connecting and for each
    answer. `ca` is a file of certificates to trust (PEM), for `wss://`. `np_random` is a generator of the client: the
    environment draws its random numbers on the server, by the seed of `reset`.

    Its methods raise RemoteError with the server's sentence. They raise ConnectionLost, a RemoteError, if the
    connection has ended: then the environment is closed, and a new RemoteEnv makes a new one.
    """

    # `gymnasium.make` reads the modes of the class, which are the usual ones. An instance has its environment's modes.
    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "ansi"]}  # noqa: RUF012

    def __init__(
        self,
        url: str,
        env_id: str,
        *,
        render_mode: str | None = None,
        ca: str | None = None,
        timeout: float = TIMEOUT,
        **options: Any,
    ) -> None:
        if render_mode == "human":
            raise ValueError(
                'A server has no window; use render_mode="rgb_array", and gymnasium.wrappers.HumanRendering around it.'
            )
        params = options if render_mode is None else options | {"render_mode": render_mode}
        self._client = client = GymClient(url, ca=ca, timeout=timeout)
        self._closer = weakref.finalize(self, client.close)
        try:
            facts = client.call("make", env_id=env_id, **params)
            try:
                self._id = facts["instance_id"]
                self.observation_space = spaces.build(facts["observation_space"])
                self.action_space = spaces.build(facts["action_space"])
                self.render_mode = facts["render_mode"]
                # The mode human would open a window on the server.
                modes = [mode for mode in facts["metadata"].get("render_modes") or [] if mode != "human"]
                self.metadata = {**facts["metadata"], "render_modes": modes}
                kwargs = {"url": url, "env_id": env_id, "ca": ca, "timeout": timeout, **params}
                self.spec = EnvSpec(env_id, entry_point="hippodrome.gym:RemoteEnv", kwargs=kwargs, **facts["spec"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                client.unfit(error)
        except BaseException:
            self._closer()
            raise

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode. Return its first observation and info."""
        super().reset(seed=seed)
        observation, info = self._call("reset", seed=seed if seed is None else int(seed), options=options)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step. Raises CodecError if `action` does not have the shape and kind of the action space."""
        observation, reward, terminated, truncated, info = self._call(
            "step", action=values.read(self.action_space, action)
        )
        return observation, reward, terminated, truncated, info

    def step_many(self, actions: Any) -> Columns:
        """Take a step for each action, with one message. Return observations, rewards, terminated, truncated, infos.

        `actions` is a list of actions, or an array of them. The observations are one batch, in the form of Gymnasium's
        vector environments, and the infos a list. After an episode the next one begins, as in Gymnasium's vector
        environments. By default (`autoreset_mode="NextStep"`) the step after the end does not use its action: it resets
        the environment, and its reward is 0. With `"SameStep"`, the last step of an episode has the next episode's
        first observation, and `final_obs` and `final_info` in its info. With `"Disabled"`, no further step is taken, so
        there are fewer results than actions. `autoreset_mode` is an option of the constructor.
        """
        space = self.action_space
        if not (isinstance(actions, np.ndarray) and actions.dtype == space.dtype and actions.shape[1:] == space.shape):
            actions = [values.read(space, action) for action in actions]
        return tuple(self._call("step_many", actions=actions))

    def render(self) -> Any:
        """Return what the environment's `render` returns. Pictures come without loss."""
        return self._call("render")

    def close(self) -> None:
        """Close the environment and the connection. May be called again."""
        if hasattr(self, "_closer"):
            self._closer()

    def _call(self, method: str, **params: Any) -> Any:
        return self._client.call(method, instance_id=self._id, **params)
