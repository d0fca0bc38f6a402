"""The services and caches that the handlers of participants' requests share."""

from __future__ import annotations

from hippodrome.control.participants.answers import Answers
from hippodrome.control.participants.waiting import ServerStates
from hippodrome.control.ports import Platform
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache


class Services:
    """The services and caches of one running function."""

    def __init__(self, platform: Platform) -> None:
        self.platform = platform
        self.secrets = SecretCache(platform.documents)
        self.project_cache = ProjectCache(platform, self.secrets)
        self.repository = Repository(platform.documents)
        self.answers = Answers(platform.documents)
        self.states = ServerStates(platform, self.secrets)
