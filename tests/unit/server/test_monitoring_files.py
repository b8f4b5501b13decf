"""Files in `deploy/monitoring`: they use only metrics and labels that exist, and the runbook describes each alert."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from docs.generate import declared_metrics

ROOT = Path(__file__).parents[3]
FILES = ROOT / "deploy" / "monitoring"
GROUPS = {group["name"]: group["rules"] for group in yaml.safe_load((FILES / "alerts.yml").read_text())["groups"]}
ALERTS = [rule for rules in GROUPS.values() for rule in rules]
RUNBOOKS = {"marey": "answer-an-alert.md", "marey-attacks": "see-attacks.md"}
"""The page that describes the alerts of each group."""
PANELS = json.loads((FILES / "dashboard.json").read_text())["panels"]
OF_PROMETHEUS = {"instance", "job", "le"}
"""Labels that Prometheus adds, and the label of the buckets of histograms."""
UNITS = ("_total", "_seconds", "_bytes")
UNITLESS = {
    "marey_http_in_flight", "marey_connections", "marey_waiting", "marey_database_connections", "marey_children",
    "marey_draining", "marey_jobs_queued", "marey_jobs_running", "marey_workers", "marey_upload_sessions",
}  # fmt: skip
"""Gauges that count things, so that their names have no unit."""


def known() -> dict[str, set[str]]:
    """Return the labels of each metric by the names that a query may use."""
    found: dict[str, set[str]] = {}
    for metric in declared_metrics():
        labels = set(metric._labelnames) | OF_PROMETHEUS
        endings = {"counter": ["_total"], "histogram": ["_bucket", "_count", "_sum"]}.get(str(metric._type), [""])
        found |= {metric._name + ending: labels for ending in endings}
    return found


def queries() -> Iterator[str]:
    yield from (alert["expr"] for alert in ALERTS)
    yield from (target["expr"] for panel in PANELS for target in panel["targets"])


def labels_in(query: str) -> set[str]:
    """Return the labels that a query selects or groups by."""
    selected = {name for inner in re.findall(r"\{([^}]*)\}", query) for name in re.findall(r"(\w+)\s*[=!]", inner)}
    grouped = {name.strip() for inner in re.findall(r"\bby \(([^)]*)\)", query) for name in inner.split(",")}
    return selected | grouped


@pytest.mark.parametrize("query", list(queries()))
def test_a_query_uses_only_metrics_and_labels_that_exist(query: str) -> None:
    metrics = known()
    used = set(re.findall(r"\bmarey_\w+", query))
    assert used <= metrics.keys()
    for name in used:
        assert labels_in(query) <= metrics[name], name
    assert used or "up{" in query


def test_texts_of_alerts_and_legends_use_labels_of_their_queries() -> None:
    texts = [(alert["annotations"]["summary"], alert["expr"]) for alert in ALERTS]
    texts += [(target["legendFormat"], target["expr"]) for panel in PANELS for target in panel["targets"]]
    metrics = known()
    for text, query in texts:
        used = re.findall(r"\{\{ ?(?:\$labels\.)?(\w+) ?\}\}", text)
        names = re.findall(r"\bmarey_\w+", query)
        allowed = set.union(OF_PROMETHEUS, *(metrics[name] for name in names))
        assert set(used) <= allowed, text


@pytest.mark.parametrize("group", GROUPS)
def test_the_runbook_describes_each_alert_of_a_group_once_and_no_other(group: str) -> None:
    runbook = (ROOT / "docs" / "how-to" / RUNBOOKS[group]).read_text()
    sections = re.findall(r"^## (\w+)\n\n(.*?)(?=^## |\Z)", runbook, re.MULTILINE | re.DOTALL)
    assert [name for name, _ in sections] == [alert["alert"] for alert in GROUPS[group]]
    for name, text in sections:
        assert all(part in text for part in ("**Meaning.**", "```sh", "**Expect**")), name


def watched() -> set[tuple[str, str, str, str]]:
    """Return (alert, metric, label, value) for each value of a label that an alert about attacks selects."""
    return {
        (alert["alert"], metric, label, value)
        for alert in ALERTS
        for metric, inner in re.findall(r"(marey_\w+)(?:\{([^}]*)\})?", alert["expr"])
        for label, values in re.findall(r'(\w+)=~?"([^"]*)"', inner) or [("", "")]
        for value in values.split("|")
    }


def test_each_sign_of_an_attack_has_an_alert_and_each_alert_is_in_the_table() -> None:
    page = (ROOT / "docs" / "how-to" / "see-attacks.md").read_text()
    described = set()
    for signs, alert in re.findall(r"^\| (`marey_.*?) \|.*\| \[?(\w+)\]?[^|]*\|$", page, re.MULTILINE):
        (metric,) = set(re.findall(r"marey_\w+", signs))
        pairs = re.findall(r'(\w+)="([^"]*)"', signs) or [("", "")]
        described |= {(alert, metric, label, value) for label, value in pairs}
    of_attacks = {alert["alert"] for alert in GROUPS["marey-attacks"]} | {"MareyCallsWait"}
    assert described == {one for one in watched() if one[0] in of_attacks}


def test_names_of_metrics_end_in_their_unit() -> None:
    names = {f"{one._name}{'_total' if one._type == 'counter' else ''}" for one in declared_metrics()}
    assert {name for name in names if not name.endswith(UNITS)} == UNITLESS
