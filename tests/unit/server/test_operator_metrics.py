"""Metrics about the queue, workers and stored data."""

from tests.support.queue_desk import Desk

from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import ClaimRequest
from marey_server.access.principal import SYSTEM
from marey_server.process.observe import Metrics
from marey_server.store.monitoring.figures import Figures, read_figures
from marey_server.store.monitoring.workers import WorkerMemory
from marey_server.store.tables import server_state


def figures(desk: Desk) -> Figures:
    memory = WorkerMemory()
    for name, version in (("a", "1.0"), ("b", "1.0"), ("c", "<script>")):
        memory.hear("usr", "tok", ClaimRequest(worker=name, kinds=("errand",), version=version))
    return desk.database.read(SYSTEM, read_figures, memory.heard(), "1.0")


def sample(metrics: Metrics, name: str, **labels: str) -> float | None:
    return metrics.registry.get_sample_value(name, labels)


def test_figures_count_queued_and_running_jobs_and_workers_and_never_name_what_a_client_chose(desk: Desk) -> None:
    labelled = JobCreate.model_validate({"kind": "errand", "labels": {"gpu": "secret"}})
    desk.submit_many(JobCreate(kind="errand"), JobCreate(kind="errand"), labelled)
    desk.claim_many(1)
    desk.clock.advance(30)
    shown = figures(desk)
    assert {key: one.count for key, one in shown.queued.items()} == {("errand", "none"): 1, ("errand", "some"): 1}
    assert 30 <= shown.queued["errand", "some"].oldest_age_s < 31
    assert shown.running == {"errand": 1}
    assert shown.workers == {"1.0": 2, "other": 1, "unknown": 1}  # the desk's own worker runs a job
    assert (shown.uploads, shown.stored_bytes) == (0, 0)


def test_the_size_of_the_database_grows_with_its_content(desk: Desk) -> None:
    before = figures(desk).database_bytes
    added = {"key": "large", "value": "".join(map(str, range(500_000)))}  # Postgres compresses what repeats itself
    desk.database.write(SYSTEM, lambda tx: tx.execute(tx.insert_or_ignore(server_state, added)).rowcount)
    assert figures(desk).database_bytes > before > 0


def test_counters_count_ends_retries_lost_leases_and_delays_of_claims(desk: Desk) -> None:
    metrics = Metrics()
    desk.database.observer = metrics.operator
    desk.submit()
    desk.clock.advance(7)
    desk.claim_many(1)
    desk.clock.advance(61)
    desk.reap()
    (lease,) = desk.claim_many(1)
    desk.complete(lease)
    assert sample(metrics, "marey_leases_lost_total") == 1
    assert sample(metrics, "marey_jobs_requeued_total", outcome="lost") == 1
    assert sample(metrics, "marey_jobs_ended_total", state="succeeded", reason="none") == 1
    assert sample(metrics, "marey_claim_delay_seconds_count") == 2
    assert sample(metrics, "marey_claim_delay_seconds_bucket", le="1.0") == 1


def test_a_gauge_returns_to_zero_when_the_queue_is_empty(desk: Desk) -> None:
    metrics = Metrics()
    desk.submit()
    metrics.operator.show(figures(desk), "database")
    assert sample(metrics, "marey_jobs_queued", kind="errand", labels="none") == 1
    desk.claim_many(1)
    metrics.operator.show(figures(desk), "database")
    assert sample(metrics, "marey_jobs_queued", kind="errand", labels="none") == 0
    assert sample(metrics, "marey_jobs_running", kind="errand") == 1
