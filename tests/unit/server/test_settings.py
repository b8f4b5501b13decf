"""Sources of settings and their precedence."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from sqlalchemy import make_url

from marey_server.commands import CommandFailed, read_settings
from marey_server.process.setting_faults import misspelt_variables
from marey_server.process.settings import Settings


def test_flags_win_over_variables_and_variables_over_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "marey.toml").write_text('port = 1111\nhost = "10.0.0.1"\nlog_level = "error"\n')
    monkeypatch.setenv("MAREY_HOST", "10.0.0.2")
    monkeypatch.setenv("MAREY_LOG_LEVEL", "warning")
    chosen = Settings(log_level="debug")
    assert (chosen.port, chosen.host, chosen.log_level) == (1111, "10.0.0.2", "debug")


def test_variables_without_a_value_are_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("HOST", "PORT", "DATA"):
        monkeypatch.setenv(f"MAREY_{name}", "")
    chosen = Settings()
    default = Settings.model_fields
    assert (chosen.host, chosen.port, chosen.data) == tuple(default[name].default for name in ("host", "port", "data"))


def test_an_empty_host_which_would_mean_all_networks_is_refused() -> None:
    with pytest.raises(ValidationError, match="at least 1 character"):
        Settings(host="")


def test_a_misspelt_setting_in_the_file_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "marey.toml").write_text("prot = 1111\n")
    with pytest.raises(ValidationError, match="prot"):
        Settings()


def test_a_data_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "takes.zip").touch()
    with pytest.raises(ValueError, match=r"takes\.zip is a file, but must be a folder"):
        Settings(data=tmp_path / "takes.zip")


def test_the_password_of_the_database_may_be_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("p@ss/word:%\n")
    settings = Settings(database_url="postgresql://marey@db:5433/marey?sslmode=require", database_password_file=file)
    assert make_url(settings.resolved_database_url) == make_url("postgresql://marey@db:5433/marey?sslmode=require").set(
        password="p@ss/word:%"
    )
    assert "p@ss" not in repr(settings)


@pytest.mark.parametrize(
    ("url", "password", "reason"),
    [
        ("postgresql://marey@db/marey", "", "is empty"),
        (
            "postgresql://marey@db/marey",
            None,
            "cannot be read: No such file or directory; this setting must name a UTF-8",
        ),
        ("postgresql://marey:other@db/marey", "secret", "database_url must contain a user and no password"),
        ("postgresql://db/marey", "secret", "database_url must contain a user and no password"),
        (None, "secret", "database_url must contain a user and no password"),
    ],
)
def test_a_password_that_cannot_be_used_is_refused(
    tmp_path: Path, url: str | None, password: str | None, reason: str
) -> None:
    file = tmp_path / "password"
    if password is not None:
        file.write_text(password)
    with pytest.raises(ValidationError, match=reason):
        Settings(database_url=url, database_password_file=file)


@pytest.mark.parametrize("given", [{"lease_ttl_s": 20}, {"heartbeat_s": 31}, {"lease_ttl_s": 1, "heartbeat_s": 0.6}])
def test_leases_that_would_run_out_between_two_heartbeats_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=r"heartbeat_s\n.*, which is half of lease_ttl_s"):
        Settings(**given)


def test_leases_of_two_heartbeats_are_taken() -> None:
    assert Settings(lease_ttl_s=30).heartbeat_s == 15


@pytest.mark.parametrize("given", [{"audit_days": 364}, {"audit_days": 1, "events_days": 2}, {"events_days": 0}])
def test_audit_entries_cannot_end_before_other_events(given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=r"audit_days\n.* at least events_days"):
        Settings(**dict[str, Any](audit_days=9) | given)


def test_audit_entries_may_be_kept_longer_or_for_ever() -> None:
    assert Settings().retention.audit_days == 0
    assert Settings(audit_days=365).retention.audit_days == 365
    assert Settings(audit_days=30, events_days=30).retention.events_days == 30


@pytest.mark.parametrize(
    ("pools", "reason"),
    [
        ([{"name": "gpu", "most": 1}, {"name": "gpu", "most": 2}], "several pools have the name 'gpu'"),
        ([{"name": "gpu", "least": 2, "most": 1}], "least is 2, but must not be greater than most, which is 1"),
        ([{"name": "GPU", "most": 1}], "should match pattern"),
        ([{"name": "gpu", "most": 1, "labels": {"a=b": "c"}}], "should match pattern"),
        ([{"name": "gpu", "most": 1, "cpu": 1}], "Extra inputs are not permitted"),
    ],
)
def test_pools_that_make_no_sense_are_refused(pools: list[dict[str, Any]], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Settings(pools=pools)


def test_every_setting_is_documented() -> None:
    undocumented = {name for name, field in Settings.model_fields.items() if not field.description}
    assert undocumented <= {"log_level"}


def test_a_misspelt_variable_is_told_with_the_one_that_was_meant() -> None:
    given = {"MAREY_LEASE_TLL_S": "3", "MAREY_PROT": "1", "MAREY_DATA_DIR": "x", "MAREY_PORT": "1", "marey_host": "x"}
    others = {"MAREY_URL": "x", "MAREY_TOKEN": "x", "MAREY_FAULT": "x", "MAREY_TEST_DATABASE_URL": "x", "PORT": "1"}
    assert misspelt_variables(given | others) == {
        "MAREY_LEASE_TLL_S": "MAREY_LEASE_TTL_S",
        "MAREY_PROT": "MAREY_PORT",
        "MAREY_DATA_DIR": "MAREY_DATA",
    }


def test_workers_on_this_machine_send_traces_to_the_same_collector(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_HEADERS", "key=1")
    monkeypatch.setenv("OTEL_SERVICE_NAME", "the-server")
    given = Settings(traces_endpoint="http://collector:4318", traces_share=0.5).worker_trace_variables
    own = {name: text for name, text in given.items() if name.startswith("MAREY_")}
    assert own == {"MAREY_TRACES_ENDPOINT": "http://collector:4318/v1/traces", "MAREY_TRACES_SHARE": "0.5"}
    assert given["OTEL_EXPORTER_OTLP_HEADERS"] == "key=1"
    assert "OTEL_SERVICE_NAME" not in given
    with pytest.raises(ValidationError, match="not an address of a collector"):
        Settings(traces_endpoint="collector:4318")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("# ours\nport = 'abc'\n", "invalid setting: marey.toml, line 2: port: the value must be a whole number"),
        ("[server]\nport = 1\n", "invalid setting: marey.toml, line 1: server: there is no setting of this name"),
        (
            "webhook_networks = ['10.0.0.1/8']\n",
            "line 1: webhook_networks.0: 10.0.0.1/8 is an address in a network; the network is 10.0.0.0/8",
        ),
        ("webhook_networks = ['lab']\n", "line 1: webhook_networks.0: 'lab' is not a network, such as 10.1.0.0/16"),
        ("data = 'x'\nport ==\n", "marey.toml cannot be read as TOML: Invalid value (at line 2"),
    ],
)
def test_a_wrong_settings_file_is_refused_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MAREY_PORT", raising=False)
    (tmp_path / "marey.toml").write_text(text)
    with pytest.raises(CommandFailed) as refused:
        read_settings()
    assert told in str(refused.value)
    if "abc" in text:
        with pytest.raises(CommandFailed, match=r"^invalid setting: port: "):
            read_settings(port="xyz")
