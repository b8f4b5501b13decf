"""Files in `deploy/` and the compose file: the settings, options and commands that they name exist."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml
from docs.generate import ROOT
from tests.support.named_commands import unknown_options
from tests.support.s3_servers import seaweedfs

from marey_schemas.address import SERVER_VARIABLES
from marey_server.process.settings import Settings
from marey_server.store.object_storage.client import Bucket

UNITS = sorted((ROOT / "deploy" / "systemd").iterdir())
CONTAINERFILE = ROOT / "deploy" / "containers" / "Containerfile"
COMPOSE = ROOT / "docker-compose.yml"
PAGE = ROOT / "docs" / "how-to" / "deploy.md"
UPGRADE_PAGE = ROOT / "docs" / "how-to" / "upgrade.md"
FILES = [COMPOSE, PAGE, UPGRADE_PAGE, *sorted(file for file in (ROOT / "deploy").rglob("*") if file.is_file())]
OF_CLIENTS = set(SERVER_VARIABLES)
"""Variables that clients and workers read."""


def directives(file: Path, name: str) -> list[str]:
    """Return the values of a directive of a unit, including those that are in a comment."""
    return re.findall(rf"^#?{name}=(.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)


def services() -> dict[str, Any]:
    return yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]


def started_commands() -> list[list[str]]:
    """Return the words after `marey` of each command that a unit, an image or a page of the documentation runs."""
    lines = [shlex.split(line) for unit in UNITS for line in directives(unit, "ExecStart")]
    assert all(words.pop(0) == "/opt/marey/bin/marey" for words in lines)
    started = re.findall(r"CMD (\[.*\])", CONTAINERFILE.read_text(encoding="utf-8"))
    page = PAGE.read_text(encoding="utf-8")
    page += UPGRADE_PAGE.read_text(encoding="utf-8")
    told = re.findall(r"^(?:sudo /opt/marey/bin/|docker compose exec server )marey (.*)$", page, re.MULTILINE)
    assert told
    lines += map(shlex.split, told)
    return lines + [[word for word in json.loads(words) if word != "marey"] for words in started]


@pytest.mark.parametrize("words", started_commands(), ids=" ".join)
def test_the_started_commands_exist_with_these_options(words: list[str]) -> None:
    assert unknown_options(words) == set()


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_the_named_settings_and_variables_exist(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    variables = {f"MAREY_{name.upper()}" for name in Settings.model_fields} | OF_CLIENTS
    assert set(re.findall(r"\bMAREY_[A-Z0-9_]+", text)) <= variables
    settings = re.findall(r"(?:^|`)([a-z0-9_]+) = ", text, re.MULTILINE)
    assert set(settings) <= set(Settings.model_fields)


def test_each_started_image_is_a_target_of_the_container_file() -> None:
    targets = re.findall(r"^FROM .* AS (\w+)$", CONTAINERFILE.read_text(encoding="utf-8"), re.MULTILINE)
    built = {service["build"]["target"] for service in services().values() if "build" in service}
    assert built == {"server", "worker"} <= set(targets)


def test_the_files_that_an_image_needs_are_sent_to_its_build() -> None:
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line[0] == "!"}
    copied = re.findall(
        r"^COPY (?!--from)(?:--\S+ )*(.*) \S+$", CONTAINERFILE.read_text(encoding="utf-8"), re.MULTILINE
    )
    for source in " ".join(copied).split():
        assert (ROOT / source).exists()
        assert any(source == name or source.startswith(f"{name}/") for name in sent), source


def test_no_secret_is_in_a_file_an_argument_or_a_variable() -> None:
    for service in services().values():
        assert service["restart"] == "unless-stopped"
        for name, text in service.get("environment", {}).items():
            assert name.endswith("_FILE") or not re.search("PASSWORD|TOKEN|SECRET", name), name
            assert not re.search(r"//[^/]*:[^/]*@", str(text)), name
    for unit in UNITS:
        for variable in directives(unit, "Environment"):
            assert not re.search("PASSWORD=|TOKEN|SECRET", variable), variable


def test_the_storage_of_the_compose_file_stores_blobs(tmp_path: Path) -> None:
    """The command of the service and the access keys of the page are used as they are, with other folders and ports."""
    added = yaml.safe_load((ROOT / "deploy" / "containers" / "object-storage.yml").read_text(encoding="utf-8"))
    (identities,) = re.findall(r"<<END\n(.*?)END\n", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "s3-identities").write_text(identities.replace("$(cat secrets/s3-secret-key)", "of-the-test"))
    (tmp_path / "data").mkdir()
    command = [
        word.replace("/run/secrets", str(tmp_path)).replace("=/data", f"={tmp_path / 'data'}")
        for word in added["services"]["storage"]["command"]
    ]
    variables = added["services"]["server"]["environment"]
    server = seaweedfs(tmp_path, command)
    bucket = Bucket(
        variables["MAREY_S3_BUCKET"],
        endpoint=server.endpoint,
        key_id=variables["MAREY_S3_KEY_ID"],
        secret_key="of-the-test",
    )
    server.start(bucket)
    server.stop()


def test_services_have_time_to_end_their_requests() -> None:
    drain_s = Settings.model_fields["drain_s"].default
    units = [int(text) for unit in UNITS for text in directives(unit, "TimeoutStopSec")]
    containers = [int(one["stop_grace_period"].rstrip("s")) for one in services().values() if "build" in one]
    assert len(units) == len(UNITS)
    assert min(units + containers) > drain_s


@pytest.mark.parametrize("unit", UNITS, ids=lambda file: file.name)
def test_units_leave_what_workers_and_servers_need(unit: Path) -> None:
    assert directives(unit, "MemoryDenyWriteExecute") == [], "numba could not load"
    assert directives(unit, "ProcSubset") == [], "psutil could not read /proc/stat, and every job would fail"
