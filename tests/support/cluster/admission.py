"""Rules by which the stub cluster admits objects, and rights by which it admits callers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kubernetes_validate
import yaml
from tests.support.cluster.objects import Document, Refused

VERSIONS = ("1.35", "1.37")
"""Oldest and newest minor version of Kubernetes that Marey supports."""
ROLE = Path(__file__).parents[3] / "deploy" / "kubernetes" / "base" / "role.yaml"
_NAME = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")


@dataclass(frozen=True)
class Rights:
    """Rights of a caller: rules of a role, or everything."""

    rules: tuple[Document, ...] = ()
    everything: bool = False

    def allows(self, verb: str, group: str, resource: str) -> bool:
        """Return whether a rule allows the verb for the resource."""
        return self.everything or any(
            verb in rule["verbs"] and group in rule["apiGroups"] and resource in rule["resources"]
            for rule in self.rules
        )


def shipped_rights() -> Rights:
    """Return the rights that the project gives its server."""
    role = yaml.safe_load(ROLE.read_text(encoding="utf-8"))
    assert role["kind"] == "Role", "the server needs no rights in the whole cluster"
    return Rights(tuple(role["rules"]))


def admit(document: Document) -> None:
    """Raise `Refused` for an object that a cluster would refuse."""
    validate(document)
    name = document["metadata"].get("name", "")
    if not (0 < len(name) <= 63 and _NAME.fullmatch(name)):
        raise _invalid(document, f"metadata.name: {name!r}")
    if document["kind"] == "Job":
        _admit_job(document)
    if document["kind"] in ("Job", "Deployment"):
        _admit_pod(document, document["spec"]["template"]["spec"])
    if document["kind"] == "Deployment":
        labels = document["spec"]["template"]["metadata"]["labels"]
        if not document["spec"]["selector"]["matchLabels"].items() <= labels.items():
            raise _invalid(document, "spec.selector: does not match the template")


def validate(document: Document) -> None:
    """Raise `Refused` if an object has a field that a supported version of Kubernetes does not know."""
    for version in VERSIONS:
        try:
            kubernetes_validate.validate(document, version, strict=True)
        except kubernetes_validate.ValidationError as error:
            raise Refused(400, "BadRequest", f"strict decoding error ({version}): {error.message}") from None


def _admit_job(job: Document) -> None:
    """Check rules about Jobs that the schema does not express."""
    spec = job["spec"]
    pod: dict[str, Any] = (spec.get("template") or {}).get("spec") or {}
    if not pod.get("containers"):
        raise _invalid(job, "spec.template.spec.containers: Required value")
    if pod.get("restartPolicy") not in ("Never", "OnFailure"):
        raise _invalid(job, 'spec.template.spec.restartPolicy: Required value: valid values: "OnFailure", "Never"')
    if "podFailurePolicy" in spec and pod["restartPolicy"] != "Never":
        raise _invalid(job, 'spec.template.spec.restartPolicy: only "Never" is supported when podFailurePolicy is set')
    indexed = spec.get("completionMode") == "Indexed"
    if "backoffLimitPerIndex" in spec and not indexed:
        raise _invalid(job, "spec.backoffLimitPerIndex: requires indexed completion mode")
    actions = {rule["action"] for rule in spec.get("podFailurePolicy", {}).get("rules", ())}
    if "FailIndex" in actions and "backoffLimitPerIndex" not in spec:
        raise _invalid(job, "spec.podFailurePolicy.rules: FailIndex requires backoffLimitPerIndex")
    if indexed and spec.get("completions") is None:
        raise _invalid(job, "spec.completions: Required value: when completion mode is Indexed")
    if spec.get("podReplacementPolicy") == "TerminatingOrFailed" and "podFailurePolicy" in spec:
        raise _invalid(job, "spec.podReplacementPolicy: only Failed is supported when podFailurePolicy is set")


def _admit_pod(document: Document, pod: Document) -> None:
    """Check the profile `restricted` of the Pod Security Standards, which the namespace enforces."""
    of_pod = pod.get("securityContext", {})
    if of_pod.get("seccompProfile", {}).get("type") != "RuntimeDefault" or not of_pod.get("runAsNonRoot"):
        raise _forbidden(document, "runAsNonRoot, seccompProfile")
    for container in pod["containers"]:
        own = container.get("securityContext", {})
        if own.get("allowPrivilegeEscalation") is not False or own.get("capabilities", {}).get("drop") != ["ALL"]:
            raise _forbidden(document, "allowPrivilegeEscalation, capabilities")


def _invalid(document: Document, message: str) -> Refused:
    return Refused(422, "Invalid", f'{document["kind"]} "{document["metadata"].get("name")}" is invalid: {message}')


def _forbidden(document: Document, fields: str) -> Refused:
    name = document["metadata"].get("name")
    return Refused(403, "Forbidden", f'"{name}" is forbidden: violates PodSecurity "restricted": {fields}')
