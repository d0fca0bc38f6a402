"""The AWS calls that find and remove the leftovers of two servers: one that runs, and one that is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import msgspec
import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Reason
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.aws.account import find_installation
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.operate.aws_erasure import AwsErasure
from hippodrome.deployment.operate.stop import Stopper
from testing.studies import study
from tests.deployment.installation import Installed, account_here
from tests.deployment.operate.test_stop import start


def sweep(world: Installed) -> None:
    Sweep(world.platform).run()


def stop(world: Installed) -> None:
    assert not Stopper(world.platform, executor=Executor(lambda _: None)).run(60)


def erase(world: Installed) -> None:
    account = account_here()
    executor = Executor(lambda _: None)
    erasure = AwsErasure(account, find_installation(account), "maze", "alice", executor)
    assert not any(erasure.run().values())


@pytest.mark.parametrize(
    ("remove", "expected"),
    [
        (
            sweep,
            {"ListTasks": 1, "DescribeTasks": 1, "ListClusters": 2, "ListResourceRecordSets": 1}
            | {"ListSchedules": 1, "ListObjectsV2": 3, "GetObject": 5}
            | {"StopTask": 1, "ChangeResourceRecordSets": 1, "DeleteSchedule": 1},
        ),
        (
            stop,
            # Each look after the first describes what was stopped: ECS lists stopped tasks for an hour or longer.
            {"ListTasks": 4, "DescribeTasks": 2, "ListClusters": 4, "ListResourceRecordSets": 2}
            | {"ListSchedules": 2, "ListObjectsV2": 2, "GetObject": 7}
            | {"StopTask": 2, "ChangeResourceRecordSets": 2, "DeleteSchedule": 2, "PutObject": 1},
        ),
        (
            erase,
            {"ListTasks": 6, "DescribeTasks": 5, "ListClusters": 6, "ListResourceRecordSets": 3}
            | {"ListSchedules": 3, "GetObject": 10, "DescribeStacks": 1, "GetCallerIdentity": 1}
            | {"StopTask": 1, "ChangeResourceRecordSets": 2, "DeleteSchedule": 1}
            # what is theirs, and what they share with others: sessions, the lobby, cells and slots
            | {"ListObjectVersions": 29, "ListMultipartUploads": 2, "DeleteObjects": 1},
        ),
    ],
)
def test_finding_and_removing_leftovers_takes_these_calls(
    installed: Installed, remove: Callable[[Installed], None], expected: dict[str, int], access_keys: None
) -> None:
    installed.register(msgspec.structs.replace(study(), task_definition="hippodrome"))
    start(installed, "maze", "alice", "bob")
    repository = Repository(installed.platform.documents)
    # Its record is closed, and everything else still exists.
    stored = repository.server(ids.server_label("maze", "alice"))
    assert stored
    repository.save(server.close(stored.server, Reason.STOPPED, installed.platform.now()), stored.etag)
    with installed.recording() as calls:
        remove(installed)
    assert dict(Counter(call.operation for call in calls)) == expected
