"""Rules for launchers, checked for Kubernetes with a stub cluster whose pods run the real worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from tests.support.cluster.stub import IMAGE, StubCluster, running_cluster
from tests.support.launcher_contract import LauncherContract

from marey_server.launchers.kubernetes.launcher import make_kubernetes_launcher
from marey_server.launchers.launcher import LaunchContext, Launcher
from marey_server.launchers.pools import find_launcher


@pytest.fixture(scope="class")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StubCluster]:
    """A stub cluster, which stores files of Secrets outside the folders that a test searches for tokens."""
    with running_cluster(tmp_path_factory.mktemp("contract") / "cluster") as stub:
        yield stub


def making(cluster: StubCluster, **options: bool) -> Callable[[LaunchContext], Launcher]:
    """Return a function that makes launchers for the stub cluster."""
    usual = {"image": IMAGE, "kubeconfig": cluster.kubeconfig, "timeout_s": 60.0}
    return lambda context: make_kubernetes_launcher(replace(context, options=usual | options))


class StubContract(LauncherContract):
    """Rules for launchers, checked with the stub cluster."""

    @pytest.fixture
    def new_processes(self, cluster: StubCluster) -> Iterator[None]:
        cluster.kubelet.new_processes = True
        yield
        cluster.kubelet.new_processes = False


class TestKubernetesLauncher(StubContract):
    @pytest.fixture
    def make_launcher(self, cluster: StubCluster) -> Callable[[LaunchContext], Launcher]:
        return making(cluster)


class TestIndexedJobs(StubContract):
    @pytest.fixture
    def make_launcher(self, cluster: StubCluster) -> Callable[[LaunchContext], Launcher]:
        return making(cluster, indexed=True)


def test_the_settings_can_name_the_launcher() -> None:
    assert find_launcher("kubernetes") is make_kubernetes_launcher
