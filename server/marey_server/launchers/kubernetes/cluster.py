"""Requests to the API of a Kubernetes cluster, about the Jobs, pods and Secrets of one namespace.

All documents are dictionaries in the form of the API.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

import aiohttp
from kubernetes.aio import client, config
from kubernetes.aio.config.config_exception import ConfigException

from marey_server.launchers.kubernetes.manifests import Manifest
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.launcher import EngineError

Kind = Literal["jobs", "pods"]

PAGE = 500
"""Number of objects in one answer to a list."""
LOG_LINES = 5
_ALREADY_EXISTS, _NOT_FOUND, _GONE = 409, 404, 410
_OF_OBJECT = frozenset({400, 403, 413, 422})
"""Statuses of answers to invalid objects, and to objects that policies or quotas of the cluster do not admit."""


class VersionGone(EngineError):
    """Error of a watch whose start version the cluster no longer has; list the objects again, and watch from there."""


class ObjectRefused(EngineError):
    """Error of a request whose object the cluster has refused; requests with other objects may succeed."""


class NoSuchObject(EngineError):
    """Error of a request about an object that does not exist in the cluster."""


class ObjectExists(EngineError):
    """Error of a request to create an object whose name another object has already."""


@dataclass(frozen=True)
class Listed:
    """Objects of a namespace, and the version of the cluster at which they were listed."""

    objects: dict[str, Manifest]
    version: str


@dataclass(frozen=True)
class Change:
    """Change of an object that a watch reports; `deleted` says whether the object no longer exists."""

    document: Manifest
    deleted: bool


class Cluster:
    """Connection to the API of a cluster.

    Each method raises `EngineError` if the cluster refuses a request, or does not answer within `timeout_s` seconds.
    """

    def __init__(self, options: ClusterOptions) -> None:
        self._options = options
        self._namespace = options.namespace
        self._timeout_s = options.timeout_s
        self._api: client.ApiClient | None = None
        self._connecting = asyncio.Lock()

    async def close(self) -> None:
        """Close all connections."""
        if self._api is not None:
            await self._api.close()

    async def create_job(self, job: Manifest) -> Manifest:
        """Create a Job. Raises `ObjectExists` if a Job has this name already."""
        body = client.V1Job.model_validate(job)
        return await self._answer(lambda api: _batch(api).create_namespaced_job_without_preload_content(
            self._namespace, body, field_validation="Strict", _request_timeout=self._timeout_s
        ))  # fmt: skip

    async def read_job(self, name: str) -> Manifest:
        """Return a Job by its name. Raises `NoSuchObject` if there is no such Job."""
        return await self._answer(lambda api: _batch(api).read_namespaced_job_without_preload_content(
            name, self._namespace, _request_timeout=self._timeout_s
        ))  # fmt: skip

    async def delete_job(self, name: str) -> None:
        """Delete a Job; the cluster then deletes its pods and its Secret.

        Raises `NoSuchObject` if there is no such Job.
        """
        await self._answer(lambda api: _batch(api).delete_namespaced_job_without_preload_content(
            name, self._namespace, propagation_policy="Background", _request_timeout=self._timeout_s
        ))  # fmt: skip

    async def delete_pod(self, name: str) -> None:
        """Delete a pod, whose processes get SIGTERM first. Raises `NoSuchObject` if there is no such pod."""
        await self._answer(lambda api: _core(api).delete_namespaced_pod_without_preload_content(
            name, self._namespace, _request_timeout=self._timeout_s
        ))  # fmt: skip

    async def create_secret(self, secret: Manifest) -> None:
        """Create a Secret. Raises `ObjectExists` if a Secret has this name already."""
        body = client.V1Secret.model_validate(secret)
        await self._answer(lambda api: _core(api).create_namespaced_secret_without_preload_content(
            self._namespace, body, field_validation="Strict", _request_timeout=self._timeout_s
        ))  # fmt: skip

    async def read_log(self, pod: str) -> str:
        """Return the last lines of a pod's log. Raises `NoSuchObject` if there is no such pod."""
        async with self._response(lambda api: _core(api).read_namespaced_pod_log_without_preload_content(
            pod, self._namespace, tail_lines=LOG_LINES, limit_bytes=8192, _request_timeout=self._timeout_s
        )) as response:  # fmt: skip
            return await response.text(errors="replace")

    async def list(self, kind: Kind, selector: str) -> Listed:
        """Return all objects of a kind that have the labels in `selector`, and the version of this list."""
        objects: dict[str, Manifest] = {}
        token: str | None = None
        while True:
            page = await self._answer(partial(self._page, kind, selector, token))
            objects |= {one["metadata"]["name"]: one for one in page["items"]}
            token = page["metadata"].get("continue") or None
            if token is None:
                return Listed(objects, page["metadata"]["resourceVersion"])

    def _page(
        self, kind: Kind, selector: str, token: str | None, api: client.ApiClient
    ) -> Awaitable[aiohttp.ClientResponse]:
        return _lister(api, kind)(
            self._namespace, label_selector=selector, limit=PAGE, _continue=token, _request_timeout=self._timeout_s
        )

    async def watch(self, kind: Kind, selector: str, version: str, seconds: int) -> AsyncIterator[Change]:
        """Yield the changes after `version`, for a number of seconds or until the connection ends.

        Raises `VersionGone` if the cluster no longer has this version; then list the objects again.
        """
        async with self._response(lambda api: _lister(api, kind)(
            self._namespace, label_selector=selector, resource_version=version, watch=True, timeout_seconds=seconds,
            _request_timeout=seconds + self._timeout_s,
        )) as response:  # fmt: skip
            while line := await response.content.readline():
                event = json.loads(line)
                if event["type"] == "ERROR":
                    raise _error(event["object"].get("code", 500), event["object"])
                if event["type"] != "BOOKMARK":
                    yield Change(event["object"], deleted=event["type"] == "DELETED")

    async def _answer(self, send: Callable[[client.ApiClient], Awaitable[aiohttp.ClientResponse]]) -> Manifest:
        async with self._response(send) as response:
            answer: Manifest = await response.json()
            return answer

    @asynccontextmanager
    async def _response(
        self, send: Callable[[client.ApiClient], Awaitable[aiohttp.ClientResponse]]
    ) -> AsyncIterator[aiohttp.ClientResponse]:
        """Send a request and yield the successful answer. Raises `EngineError`, also while the answer is read."""
        try:
            response = await send(await self._connected())
            async with response:
                if response.status >= 400:
                    raise _error(response.status, await _problem(response))
                yield response
        except TimeoutError:
            raise EngineError("the Kubernetes cluster does not answer in time") from None
        except (aiohttp.ClientError, ConfigException, OSError, ValueError) as error:
            raise EngineError(f"no valid answer from the cluster: {type(error).__name__}: {error}") from error

    async def _connected(self) -> client.ApiClient:
        async with self._connecting:
            if self._api is None:
                self._api = client.ApiClient(await _configuration(self._options))
            return self._api


async def _configuration(options: ClusterOptions) -> client.Configuration:
    configuration = client.Configuration()
    try:
        if options.kubeconfig is None:
            config.load_incluster_config(client_configuration=configuration)
        else:
            await config.load_kube_config(
                str(options.kubeconfig),
                context=options.context,
                client_configuration=configuration,
                persist_config=False,
            )
    except (ConfigException, OSError) as error:
        raise EngineError(
            f"the access to the cluster is not configured: {error}; check the launcher option `kubeconfig`"
        ) from error
    return configuration


def _batch(api: client.ApiClient) -> client.BatchV1Api:
    return client.BatchV1Api(api)


def _core(api: client.ApiClient) -> client.CoreV1Api:
    return client.CoreV1Api(api)


def _lister(api: client.ApiClient, kind: Kind) -> Callable[..., Awaitable[aiohttp.ClientResponse]]:
    if kind == "jobs":
        return _batch(api).list_namespaced_job_without_preload_content
    return _core(api).list_namespaced_pod_without_preload_content


async def _problem(response: aiohttp.ClientResponse) -> Manifest:
    """Return the JSON document in the cluster's answer to a failed request, or else one with the answer's text."""
    text = await response.text(errors="replace")
    try:
        found = json.loads(text)
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {"message": text[:200]}


def _error(status: int, problem: Manifest) -> EngineError:
    message = f"the cluster answers {status}: {problem.get('message') or problem.get('reason') or 'no reason given'}"
    if status == _NOT_FOUND:
        return NoSuchObject(message)
    if status == _GONE:
        return VersionGone(message)
    if status == _ALREADY_EXISTS and problem.get("reason") == "AlreadyExists":
        return ObjectExists(message)
    return ObjectRefused(message) if status in _OF_OBJECT else EngineError(message)
