"""Rules about pods of a job's own, checked with the stub cluster, and with a real cluster if one is named."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.cluster.contract import NamedCluster, OwnPodContract
from tests.support.cluster.dispatching import WAITS
from tests.support.cluster.stub import IMAGE, running_cluster
from tests.support.tiers import CLUSTER_IMAGE_VARIABLE, CLUSTER_VARIABLE


class TestStubCluster(OwnPodContract):
    @pytest.fixture
    def cluster(self, tmp_path: Path) -> Iterator[NamedCluster]:
        with running_cluster(tmp_path / "cluster") as stub:
            stub.kubelet.images[IMAGE] = WAITS
            named = NamedCluster(stub.kubeconfig_of("operator"), IMAGE)
            yield named
            named.close()


@pytest.mark.cluster
class TestClusterOfKubeconfig(OwnPodContract):
    @pytest.fixture
    def cluster(self) -> Iterator[NamedCluster]:
        named = NamedCluster(Path(os.environ[CLUSTER_VARIABLE]), os.environ[CLUSTER_IMAGE_VARIABLE])
        yield named
        named.close()
