"""Manifests of the launcher `kubernetes`: compared with files, and valid for all supported versions."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.support.cluster.admission import admit
from tests.support.cluster.objects import Refused

from marey_server.launchers.kubernetes.manifests import Manifest, Pool, pool_deployment, token_secret, worker_job
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.kubernetes.own_pod_jobs import Dispatch, own_pod_job
from marey_server.launchers.launcher import LauncherUnusable, WorkerRequest, read_options

FILES = Path(__file__).parent / "manifests"
IMAGE = f"registry.example.org/marey-worker@sha256:{'0' * 64}"
PLAIN = ClusterOptions(image=IMAGE)
UID = "7d2f1c80-0000-4000-8000-000000000000"
RICH = ClusterOptions(
    image=IMAGE,
    namespace="lab",
    instance="prod",
    queue="motion",
    node_selector={"node.kubernetes.io/instance-type": "a100"},
    tolerations=({"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"},),
    pull_secrets=("registry",),
)
GPU = WorkerRequest(
    {"gpu": "a100, 80 GB"}, ("model", "retarget"), slots=2, cpus=8, memory_bytes=64 << 30, gpus=1, deadline_s=7200
)

MANIFESTS: dict[str, Manifest] = {
    "job": worker_job(Pool("cpu", "http://marey:8460", PLAIN), "marey-cpu-k1-0"),
    "job-with-gpu": worker_job(Pool("gpu", "https://marey.example.org", RICH, GPU), "prod-gpu-k1-0"),
    "indexed-job": worker_job(Pool("gpu", "https://marey.example.org", RICH, GPU), "prod-gpu-k1", count=3),
}
OWN = Pool("OWN-PODS", "http://marey:8460", RICH, WorkerRequest({"marey/own-pod": "yes"}, ("model",), gpus=1))
MANIFESTS["own-pod"] = own_pod_job(
    OWN, Dispatch("job_01m8h", 3, 2, project="p"), time_limit_s=3600, environment={"A": "b"}
)
MANIFESTS["own-pods-of-tasks"] = own_pod_job(OWN, Dispatch("job_01m8h", 1, 0, 9, 4, "p"), time_limit_s=3600)
OWNER = {**MANIFESTS["job"], "metadata": {**MANIFESTS["job"]["metadata"], "uid": UID}}
MANIFESTS["secret"] = token_secret(OWNER, "marey_secret")


@pytest.mark.parametrize("name", MANIFESTS)
def test_a_manifest_equals_its_file(name: str) -> None:
    expected = yaml.safe_load((FILES / f"{name}.yaml").read_text(encoding="utf-8"))
    assert MANIFESTS[name] == expected


@pytest.mark.parametrize("name", MANIFESTS)
def test_a_manifest_is_admitted_by_the_oldest_and_the_newest_version(name: str) -> None:
    admit(MANIFESTS[name])


def test_the_token_is_only_in_the_secret() -> None:
    assert "marey_secret" not in str([manifest for name, manifest in MANIFESTS.items() if name != "secret"])
    (owner,) = MANIFESTS["secret"]["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["name"], owner["uid"]) == ("Job", "marey-cpu-k1-0", UID)


def test_the_pods_of_a_deployment_are_those_of_a_job() -> None:
    pool = Pool("cpu", "http://marey:8460", PLAIN)
    of_job = worker_job(pool, "marey-cpu-k1-0")["spec"]["template"]["spec"]
    of_deployment = pool_deployment(pool, replicas=3, secret="marey-cpu-k1-0")["spec"]["template"]["spec"]
    assert of_job.pop("restartPolicy") == "Never"
    (container,) = of_deployment["containers"]
    container["args"] = ["marey-cpu-k1-0" if word == "$(POD_NAME)" else word for word in container["args"]]
    assert container["env"].pop()["name"] == "POD_NAME"
    assert of_deployment == of_job


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "image: this field is missing"),
        ({"image": "marey-worker:latest"}, "image: the image must be named by its digest"),
        ({"image": IMAGE, "colour": "red"}, "colour: there is no field of this name"),
        ({"image": IMAGE, "namespace": "Lab"}, "namespace: the text must have only lower-case letters"),
        ({"image": IMAGE, "relist_s": 0, "cpus": 0}, "cpus: .*; relist_s: "),
    ],
)
def test_invalid_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(LauncherUnusable, match=message):
        read_options(ClusterOptions, options, "kubernetes")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"template": None}, "strict decoding error|Required value"),
        ({"template": {"spec": {"containers": []}}}, "Required value"),
        ({"backoffLimitPerIndex": 0}, "requires indexed completion mode"),
        ({"completionMode": "Indexed", "completions": None}, "spec.completions: Required value|strict decoding"),
        ({"backofflimit": 0}, "strict decoding error"),
        ({"podReplacementPolicy": "TerminatingOrFailed"}, "only Failed is supported"),
    ],
)
def test_the_stub_refuses_what_a_cluster_refuses(change: dict[str, Any], message: str) -> None:
    job = MANIFESTS["job"]
    with pytest.raises(Refused, match=message):
        admit({**job, "spec": {**job["spec"], **change}})


def test_the_stub_refuses_restarts_with_a_failure_policy_and_pods_with_rights() -> None:
    job = MANIFESTS["job"]
    template = job["spec"]["template"]
    restarting = {**template, "spec": {**template["spec"], "restartPolicy": "OnFailure"}}
    with pytest.raises(Refused, match='only "Never" is supported'):
        admit({**job, "spec": {**job["spec"], "template": restarting}})
    as_root = {**template, "spec": {**template["spec"], "securityContext": {}}}
    with pytest.raises(Refused, match="violates PodSecurity"):
        admit({**job, "spec": {**job["spec"], "template": as_root}})
