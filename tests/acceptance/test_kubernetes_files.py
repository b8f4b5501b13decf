"""Files in `deploy/kubernetes`: valid for all supported versions, and in agreement with images and settings."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from docs.generate import ROOT
from tests.support.cluster.admission import VERSIONS, validate
from tests.support.named_commands import unknown_options
from tests.support.present import present

from marey_server.launchers.kubernetes.launcher import make_kubernetes_launcher
from marey_server.launchers.kubernetes.manifests import TOKEN_FILE, USER
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.pools import find_launcher
from marey_server.process.settings import Settings

FOLDER = ROOT / "deploy" / "kubernetes"
BASE = FOLDER / "base"
OVERLAYS = sorted(path.name for path in (FOLDER / "overlays").iterdir())
MANIFESTS = sorted(file for file in BASE.glob("*.yaml") if file.name != "kustomization.yaml")
CONTAINERFILE = (ROOT / "deploy" / "containers" / "Containerfile").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "how-to" / "run-on-kubernetes.md").read_text(encoding="utf-8")


def documents(name: str) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((BASE / name).read_text(encoding="utf-8")))


EVERY = {file.name: documents(file.name) for file in MANIFESTS}
(SERVER,) = EVERY["server.yaml"]
(WORKERS,) = EVERY["workers.yaml"]


@pytest.mark.parametrize("name", EVERY)
def test_each_manifest_is_valid_for_all_supported_versions(name: str) -> None:
    for document in EVERY[name]:
        validate(document)


def test_every_manifest_is_part_of_the_base() -> None:
    listed = yaml.safe_load((BASE / "kustomization.yaml").read_text(encoding="utf-8"))["resources"]
    assert sorted(listed) == [file.name for file in MANIFESTS]


@pytest.mark.kubectl
@pytest.mark.parametrize("overlay", OVERLAYS)
def test_kubectl_renders_an_overlay(overlay: str) -> None:
    command = ["kubectl", "kustomize", str(FOLDER / "overlays" / overlay)]
    rendered = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = list(yaml.safe_load_all(rendered))
    assert len(found) == sum(map(len, EVERY.values()))
    for document in found:
        validate(document)
        if document["kind"] not in ("Namespace",):
            assert document["metadata"]["namespace"] == "marey"
    images = re.findall(r"image: (\S+)", rendered)
    assert sorted(images) == [f"registry.example.org/marey-{name}@sha256:{'0' * 64}" for name in ("server", "worker")]


def test_overlays_use_settings_that_exist() -> None:
    for file in FOLDER.rglob("*.yaml"):
        names = set(re.findall(r"\bMAREY_[A-Z_]+", file.read_text(encoding="utf-8")))
        assert names <= {f"MAREY_{name.upper()}" for name in Settings.model_fields}


def test_no_variable_of_a_service_is_taken_for_a_setting() -> None:
    (service,) = EVERY["service.yaml"]
    assert service["metadata"]["name"] == "marey", "Kubernetes would add MAREY_PORT to the variables of each pod"
    assert [pod["enableServiceLinks"] for pod in pods()] == [False, False]


def pods() -> list[dict[str, Any]]:
    return [owner["spec"]["template"]["spec"] for owner in (SERVER, WORKERS)]


def test_pods_run_as_the_user_of_the_images_without_rights() -> None:
    assert f"USER {USER}\n" in CONTAINERFILE
    for pod in pods():
        of_pod = pod["securityContext"]
        assert (of_pod["runAsUser"], of_pod["fsGroup"], of_pod["runAsNonRoot"]) == (USER, USER, True)
        (container,) = pod["containers"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]},
        }  # fmt: skip
    assert [pod["automountServiceAccountToken"] for pod in pods()] == [True, False]


def test_containers_can_write_where_the_images_write() -> None:
    written = set(present(re.search(r"^VOLUME \[(.*)\]", CONTAINERFILE, re.MULTILINE))[1].replace('"', "").split(", "))
    for pod, unneeded in zip(pods(), ({"/run/marey-token"}, set()), strict=True):
        mounted = {mount["mountPath"] for mount in pod["containers"][0]["volumeMounts"]}
        assert mounted == written - unneeded
    (settings,) = EVERY["settings.yaml"]
    assert settings["data"]["MAREY_DATA"] == "/var/lib/marey/data", "the server closes its data folder to others"


def test_services_and_policies_select_the_pods() -> None:
    of_server, of_workers = (
        SERVER["spec"]["template"]["metadata"]["labels"],
        WORKERS["spec"]["template"]["metadata"]["labels"],
    )
    (service,) = EVERY["service.yaml"]
    assert service["spec"]["selector"].items() <= of_server.items()
    assert not service["spec"]["selector"].items() <= of_workers.items()
    for policy in EVERY["networkpolicies.yaml"]:
        selected = policy["spec"]["podSelector"]["matchLabels"].items()
        assert [selected <= labels.items() for labels in (of_server, of_workers)].count(True) == 1


def test_the_role_gives_no_rights_outside_the_namespace() -> None:
    (role,), (binding,) = EVERY["role.yaml"], EVERY["rolebinding.yaml"]
    assert (role["kind"], binding["kind"]) == ("Role", "RoleBinding")
    assert binding["subjects"] == [
        {"kind": "ServiceAccount", "name": SERVER["spec"]["template"]["spec"]["serviceAccountName"]}
    ]
    words = [word for rule in role["rules"] for word in (*rule["verbs"], *rule["resources"])]
    assert "*" not in words
    assert "ClusterRole" not in str(EVERY)


def test_a_stopping_server_can_end_its_requests() -> None:
    drain_s = Settings.model_fields["drain_s"].default
    assert min(pod["terminationGracePeriodSeconds"] for pod in pods()) > drain_s


def test_the_settings_of_the_page_are_valid(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    settings = yaml.safe_load(present(re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL))[1])["data"]
    for name, text in settings.items():
        monkeypatch.setenv(name, text)
    found = Settings()
    (pool,) = found.pools
    assert find_launcher(found.launcher) is make_kubernetes_launcher
    assert ClusterOptions(**{**found.launcher_options, **pool.options}).node_selector == {"accelerator": "a100"}


def test_the_page_names_secrets_files_and_commands_that_exist() -> None:
    (volume,) = [volume for volume in pods()[1]["volumes"] if "secret" in volume]
    assert f"create secret generic {volume['secret']['secretName']} --from-file={TOKEN_FILE}" in PAGE
    for path in re.findall(r"deploy/kubernetes/[\w./-]+", PAGE):
        assert (ROOT / path).exists(), path
    commands = re.findall(r"exec (?:-it )?marey-server-0 -- marey (.*)$", PAGE, re.MULTILINE)
    assert commands
    for command in commands:
        assert unknown_options(command.split()) == set()
    assert {f"1.{minor}" for minor in re.findall(r"\b1\.(3\d)\b", PAGE)} >= set(VERSIONS)
