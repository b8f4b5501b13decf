"""Workflow of a webhook: the commands and the Python of the how-to page, on a real server, with a real receiver."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.server_process import ServerProcess
from tests.support.webhook_receiver import Open

from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.event_kinds import DEFAULT_WEBHOOK_KINDS
from marey_schemas.webhooks import KEY_PREFIX

pytestmark = pytest.mark.timeout(300)

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "webhooks.md"
TEXT = PAGE.read_text(encoding="utf-8")
LOOPBACK = '["127.0.0.0/8"]'


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server that may send to this machine."""
    process = ServerProcess(tmp_path_factory.mktemp("server"), MAREY_WEBHOOK_NETWORKS=LOOPBACK).start()
    yield process
    assert process.stop() == 0, process.log.read_text()[-3000:]


@pytest.fixture
def run(server: ServerProcess, tmp_path: Path) -> CommandLine:
    return CommandLine(server, tmp_path)


@pytest.fixture
def project(server: ServerProcess) -> Iterator[ProjectHandle]:
    with server.client() as marey:
        project = marey.create_project(ProjectCreate(name="lab"))
        yield project
        project.delete()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def words(line: str, **values: str) -> list[str]:
    """Return the arguments of a command of the page; `values` replaces words of the page by other values."""
    return [values.get(word, word) for word in shlex.split(line, comments=True)[1:]]


def test_the_commands_of_the_page_work_in_their_order(
    run: CommandLine, project: ProjectHandle, open_receiver: Open
) -> None:
    receiver = open_receiver(status=500)
    made, tested, failed, paused, rotated = (block.splitlines() for block in blocks("sh"))
    created = run(*words(made[0].replace("https://ci.example.org/marey", receiver.url)))
    found = dict(line.split() for line in created.stdout.splitlines())
    hook, secret = found["webhook"], found["secret"]
    assert secret.startswith(KEY_PREFIX)
    listed = run(*words(made[1])).stdout
    assert hook in listed
    assert secret not in listed

    refused = run(*words(tested[0], ID=hook), status=1)
    assert "the answer has the status 500" in refused.stderr
    assert receiver.url in run(*words(tested[1], ID=hook)).stdout
    assert "webhook.test" in run(*words(failed[0], ID=hook)).stdout
    receiver.status = 200
    assert "delivered with the status 200" in run(*words(failed[1], ID=hook)).stderr
    assert "delivered with the status 200" in run(*words(tested[0], ID=hook)).stderr

    for line in paused:
        run(*words(line, ID=hook))
    assert json.loads(run("webhook", "show", "lab", hook, "--json").stdout)["paused"]
    project.collections.create("raw")
    assert "is active" in run("webhook", "change", "lab", hook, "--resume").stderr
    received = receiver.wait_for(lambda found: found[-1].message["kind"] == "collection.created")

    namespace: dict[str, Any] = {}
    exec(blocks("python")[0], namespace)
    is_genuine = namespace["is_genuine"]
    assert all(is_genuine(one.headers, one.body, secret) for one in received)
    assert not is_genuine(received[0].headers, received[0].body + b" ", secret)
    assert not is_genuine({**received[0].headers, "webhook-timestamp": "1"}, received[0].body, secret)

    renewed = dict(line.split() for line in run(*words(rotated[0], ID=hook)).stdout.splitlines())["secret"]
    run(*words(tested[0], ID=hook))
    last = receiver.received[-1]
    assert is_genuine(last.headers, last.body, renewed)
    assert is_genuine(last.headers, last.body, secret)
    assert run("webhook", "rm", "lab", hook).stderr == f"{hook} is deleted\n"
    assert "no webhook" in run("webhook", "show", "lab", hook, status=1).stderr


def test_the_python_of_the_page_works(project: ProjectHandle, open_receiver: Open) -> None:
    receiver = open_receiver()
    code = blocks("python")[1].replace("https://ci.example.org/marey", receiver.url)

    class Marey:
        def project(self, _name: str) -> ProjectHandle:
            return project

    exec(code, {"marey": Marey()})
    assert receiver.kinds == ["webhook.test"]
    [made] = project.webhooks.list()
    assert (made.kinds, made.description, made.paused) == (("job.failed",), "Alerts", True)


def test_the_page_names_the_kinds_that_are_sent_by_default() -> None:
    (table,) = re.findall(r"\| events \| kinds \|\n\|---\|---\|\n(.*?)\n\n", TEXT, re.DOTALL)
    assert tuple(re.findall(r"`([a-z_]+\.[a-z_]+)`", table)) == DEFAULT_WEBHOOK_KINDS


def test_wrong_arguments_are_refused_with_what_to_write_instead(run: CommandLine, project: ProjectHandle) -> None:
    assert "the kinds are" in run("webhook", "create", "lab", "https://a.example", "--kind", "nap", status=2).stderr
    assert "--all" in run("webhook", "redeliver", "lab", "webhook_x", status=2).stderr
    assert "--resume" in run("webhook", "change", "lab", "webhook_x", status=2).stderr
    assert "retrying" in run("webhook", "deliveries", "lab", "webhook_x", "--state", "lost", status=2).stderr
    assert "user name" in run("webhook", "create", "lab", "https://ada:pw@a.example/", status=2).stderr
    assert "not a public address" in run("webhook", "create", "lab", "http://10.0.0.1/", status=1).stderr
