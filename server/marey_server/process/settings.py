"""Settings of a server, from flags, `MAREY_*` variables, `marey.toml` and defaults, in this order of precedence."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlsplit

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from marey_schemas.address import DATABASE_FILE, DEFAULT_DATA, DEFAULT_HOST, DEFAULT_PORT, SETTINGS_FILE
from marey_schemas.names import form
from marey_schemas.sizes import KIB, MIB
from marey_server.access.network_addresses import Network, read_network
from marey_server.process.secret_files import read_secret
from marey_server.process.setting_groups.blob_settings import BlobSettings
from marey_server.process.setting_groups.identity_settings import IdentitySettings
from marey_server.process.setting_groups.process_settings import ProcessSettings
from marey_server.process.setting_groups.trace_settings import TraceSettings
from marey_server.process.worker_pools import OwnPods, WorkerPools
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.monitoring.workers import ALIVE_S, MOST_OF_USER, MOST_REMEMBERED
from marey_server.store.retention import Retention
from marey_server.store.transaction import Quotas

PREFIX = "MAREY_"
"""Prefix of the variables: MAREY_PORT sets `port`. Client, worker and tests have other variables with this prefix."""


class Settings(ProcessSettings, BlobSettings, IdentitySettings, TraceSettings):
    """Settings of a server. The environment variable of the setting `data` is MAREY_DATA, and so on."""

    model_config = SettingsConfigDict(
        env_prefix=PREFIX,
        env_ignore_empty=True,  # as in a file for compose that sets a variable to another one, which is not set
        toml_file=SETTINGS_FILE,
        extra="forbid",
        frozen=True,
    )

    data: Path = Field(
        Path(DEFAULT_DATA), description="Folder of the database file, the administrator's token, and blobs."
    )
    host: str = Field(DEFAULT_HOST, min_length=1, description="Address to listen on; 0.0.0.0: all networks.")
    port: int = Field(DEFAULT_PORT, ge=0, le=65535, description="Port to listen on; 0: any free port.")
    database_url: str | None = Field(
        None,
        description="SQLAlchemy URL of the database, such as postgresql://...; absent: the SQLite file "
        f"{DATABASE_FILE} in the data folder.",
    )
    database_password_file: Path | None = Field(
        None,
        description="File that contains the password of the database user and nothing else; instead of a password in "
        "database_url.",
    )
    database_threads: int | None = Field(
        None,
        ge=1,
        le=128,
        description="Greatest number of reading transactions at the same time. Absent: 2 on SQLite, 8 on Postgres.",
    )
    answer_cache_bytes: int = Field(64 * MIB, ge=0, description="Memory in bytes for a cache of encoded documents.")
    trust_proxy: bool = Field(
        False,
        description="Read the addresses of clients from the header proxy_header. Safe only if all clients reach the "
        "server through a proxy that sets this header.",
    )
    proxy_header: Literal["X-Forwarded-For", "X-Real-IP"] = Field(
        "X-Forwarded-For", description="Header in which the proxy names the client's address, if trust_proxy is set."
    )
    proxy_hops: int = Field(
        1,
        ge=1,
        le=16,
        description="Number of proxies that append an address to the header. Earlier entries are ignored, because a "
        "client can invent them.",
    )
    log_form: Literal["json", "text"] = Field(
        "json", description="Format of the log: one JSON object per line, or text for people."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Lowest level of the messages that the log contains."
    )
    drain_s: float = Field(
        25.0, ge=0, le=600, description="Seconds that running requests have to finish after SIGTERM or SIGINT."
    )
    header_timeout_s: float = Field(
        75.0,
        gt=0,
        description="Seconds after which an idle connection, or one that sends its headers too slowly, is closed.",
    )
    body_timeout_s: float = Field(
        60.0,
        gt=0,
        description="Greatest number of seconds to receive an ordinary request body; also the longest pause in seconds "
        "in a streamed request body, such as an upload.",
    )
    upload_timeout_s: float = Field(
        6 * 3600.0, gt=0, description="Greatest number of seconds to receive a streamed request body."
    )
    write_timeout_s: float = Field(
        60.0,
        gt=0,
        description="Seconds within which a client must read 64 KiB of an answer, or the rest of the answer; otherwise "
        "the server closes the connection.",
    )
    max_connections: int | None = Field(
        None,
        ge=16,
        description="Greatest number of open connections; at most three quarters of them from one address. Absent: "
        "10000, or fewer if the limit on open files requires it.",
    )
    request_memory_bytes: int = Field(
        256 * MIB,
        ge=MIB,
        description="Memory in bytes for bodies, loaded documents and long answers of all requests together. One "
        "client gets at most three quarters of it; all requests without a token together, at most a quarter.",
    )
    min_free_bytes: int = Field(
        64 * MIB,
        ge=0,
        description="Free bytes on the data folder's disk below which nothing is stored; deleting stays possible.",
    )
    max_header_bytes: int = Field(
        64 * KIB, ge=4096, description="Greatest size of the request line and the headers, in bytes."
    )
    login_tries_per_minute: int = Field(
        10,
        ge=1,
        description="Greatest number of wrong passwords per minute for one user name from one address (in IPv6, one "
        "network of 64 bits). For all names from one address, the limit is ten times as high. All addresses from "
        "which a user has not signed in for 90 days share one more limit for this user's name: at first ten times this "
        "number of wrong passwords, and then this number per minute.",
    )
    name_guesses_per_hour: int = Field(
        20,
        ge=1,
        description="Greatest number of times per hour that a user may try to create a project whose name is taken by "
        "a project that the user may not see.",
    )
    import_files_now: int = Field(
        64,
        ge=0,
        description="Greatest number of files in an import that is done immediately; larger imports become a job.",
    )
    import_bytes_now: int = Field(
        64 * MIB,
        ge=0,
        description="Greatest number of bytes in an import that is done immediately; larger imports become a job.",
    )
    lease_ttl_s: float = Field(
        QueuePolicy.lease_ttl_s,
        ge=1,
        le=3600,
        description="Seconds without a heartbeat after which a worker loses its job.",
    )
    heartbeat_s: float = Field(
        QueuePolicy.heartbeat_s,
        ge=0.1,
        le=600,
        description="Seconds between the heartbeats of a worker; at most half of lease_ttl_s.",
    )
    cancel_grace_s: float = Field(
        QueuePolicy.end_grace_s,
        ge=0,
        le=3600,
        description="Seconds that a worker has to stop a job that was cancelled or whose time limit has passed.",
    )
    user_uploads: int = Field(Quotas.user_uploads, ge=0, description="Greatest number of unfinished uploads of a user.")
    user_upload_bytes: int = Field(
        Quotas.user_upload_bytes,
        ge=0,
        description="Greatest total size, in bytes, of the unfinished uploads of a user.",
    )
    user_daily_bytes: int = Field(
        Quotas.user_daily_bytes,
        ge=0,
        description="Number of bytes that a user may send without waiting, and after that on each further day; bytes "
        "that the server has already do not count.",
    )
    user_tokens: int = Field(
        Quotas.user_tokens, ge=0, description="Greatest number of valid tokens of a user, not counting sign-ins."
    )
    user_projects: int = Field(
        Quotas.user_projects,
        ge=0,
        description="A user who owns this number of projects, or more, cannot create or restore another one.",
    )
    user_jobs: int = Field(
        Quotas.user_jobs,
        ge=0,
        description="Greatest number of unfinished jobs of a user, including their tasks.",
    )
    user_daily_inputs: int = Field(
        Quotas.user_daily_inputs,
        ge=0,
        description="Number of inputs of jobs, with those of their tasks, that a user may submit without waiting, and "
        "after that on each further day.",
    )
    user_followers: int = Field(
        256,
        ge=0,
        description="Greatest number of open connections over which a user may follow events.",
    )
    user_workers: int = Field(
        MOST_OF_USER,
        ge=1,
        le=MOST_REMEMBERED,
        description="Greatest number of workers of a user, by their names, that have claimed jobs from one server "
        f"process in the last {ALIVE_S:.0f} seconds.",
    )
    user_items: int = Field(
        Quotas.user_items, ge=0, description="Greatest number of existing items that a user has created."
    )
    user_stored_bytes: int = Field(
        Quotas.user_stored_bytes,
        ge=0,
        description="Greatest number of bytes that the revisions of a user's items take.",
    )
    project_items: int = Field(Quotas.project_items, ge=0, description="Greatest number of items in a project.")
    project_stored_bytes: int = Field(
        Quotas.project_stored_bytes,
        ge=0,
        description="Greatest number of bytes that the revisions of a project's items take.",
    )
    project_webhooks: int = Field(
        Quotas.project_webhooks, ge=0, description="Greatest number of webhooks of a project; 0: no webhooks."
    )
    project_schedules: int = Field(
        Quotas.project_schedules, ge=0, description="Greatest number of schedules of a project; 0: no schedules."
    )
    project_scripts: int = Field(
        Quotas.project_scripts, ge=0, description="Greatest number of scripts of a project; 0: no scripts."
    )
    script_repositories: tuple[str, ...] = Field(
        (),
        description='Git repositories whose scripts projects may run, such as ["https://git.lab.example/motion/"]; an '
        "entry that ends in / allows all repositories below it. Empty: no scripts. Workers that run scripts need the "
        "variable MAREY_SCRIPT_REPOSITORIES, too.",
    )
    project_invitations: int = Field(
        Quotas.project_invitations, ge=0, description="Greatest number of open invitations to a project."
    )
    project_participants: int = Field(
        Quotas.project_participants,
        ge=0,
        description="Greatest number of participants of a project's studies, with those who have withdrawn.",
    )
    user_invitations: int = Field(
        Quotas.user_invitations, ge=0, description="Greatest number of open invitations that a user has created."
    )
    project_proposal_bytes: int = Field(
        Quotas.project_proposal_bytes,
        ge=0,
        description="Greatest number of bytes of the descriptions, comments, reviews and checks of all proposals of a "
        "project; a quarter is reserved for maintainers.",
    )
    webhook_networks: tuple[Annotated[Network, BeforeValidator(read_network)], ...] = Field(
        (),
        description='Networks to which webhooks may be sent although they are not public, such as ["10.1.0.0/16"].',
    )
    webhook_failing_days: int = Field(
        5, ge=0, description="Days after which a webhook is paused if all attempts have failed; 0: never."
    )
    events_days: int = Field(Retention.events_days, ge=0, description="Days for which events are kept; 0: for ever.")
    audit_days: int = Field(
        Retention.audit_days,
        ge=0,
        description="Days for which entries of the audit log are kept, at least events_days; 0: for ever.",
    )
    logs_days: int = Field(
        Retention.logs_days,
        ge=0,
        description="Days for which the log of an attempt is kept after its end; 0: for ever.",
    )
    jobs_days: int = Field(
        Retention.jobs_days,
        ge=0,
        description="Days for which a job is kept after its end; 0: for ever. A job that made a revision is kept for "
        "ever.",
    )
    local_workers: int = Field(0, ge=0, le=256, description="Number of worker processes that the server starts.")
    launcher: str = Field(
        "local",
        description="Engine that runs the workers in pools: local (processes on the server's machine), slurm, "
        "kubernetes, or an entry point of another package in the group marey.launchers.",
    )
    launcher_options: dict[str, Any] = Field({}, description="Options of the launcher.")
    pools: WorkerPools = Field((), description="Pools of workers, whose sizes follow the queue; see below.")
    own_pods: OwnPods | None = Field(
        None,
        description="Pods for single jobs that need more than a worker of a pool has, see below; only with the "
        "launcher kubernetes. Absent: no job gets a pod of its own.",
    )
    worker_url: str | None = Field(
        None,
        pattern=form(r"^https?://", "begin with https:// or http://"),
        description="Address at which workers in pools reach the server. Absent: the address that the server listens "
        "on.",
    )

    @field_validator("own_pods")
    @classmethod
    def _check_own_pods(cls, own_pods: OwnPods | None, others: ValidationInfo) -> OwnPods | None:
        if own_pods is not None and others.data.get("launcher") != "kubernetes":
            raise ValueError("only the launcher kubernetes starts pods; set launcher to kubernetes, or remove own_pods")
        return own_pods

    @field_validator("data")
    @classmethod
    def _check_data(cls, data: Path) -> Path:
        if data.exists() and not data.is_dir():
            raise ValueError(f"{data} is a file, but must be a folder; a folder that does not exist is created")
        return data

    @field_validator("database_password_file")
    @classmethod
    def _check_database_password_file(cls, file: Path | None, others: ValidationInfo) -> Path | None:
        url = urlsplit(others.data.get("database_url") or "")
        if file is None:
            return None
        if not url.username or url.password is not None:
            raise ValueError(
                "database_url must contain a user and no password, as in postgresql://marey@db.internal/marey"
            )
        if not read_secret(file):
            raise ValueError(f"{file} is empty, but must contain the password of the database user")
        return file

    @field_validator("heartbeat_s")
    @classmethod
    def _check_heartbeat(cls, heartbeat_s: float, others: ValidationInfo) -> float:
        lease_ttl_s = others.data.get("lease_ttl_s")  # absent where it was refused itself
        if lease_ttl_s is not None and heartbeat_s > lease_ttl_s / 2:
            raise ValueError(
                f"the value must be at most {lease_ttl_s / 2:g}, which is half of lease_ttl_s ({lease_ttl_s:g}); "
                "otherwise workers would lose running jobs"
            )
        return heartbeat_s

    @field_validator("audit_days")
    @classmethod
    def _check_audit_days(cls, audit_days: int, others: ValidationInfo) -> int:
        events_days = others.data.get("events_days", 0)
        if audit_days and not 0 < events_days <= audit_days:
            kept = f"{events_days} days" if events_days else "for ever"
            raise ValueError(
                f"the value must be 0 or at least events_days, because audit entries are events, which are kept {kept}"
            )
        return audit_days

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - no .env files
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - no secret folders
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return the sources in order of precedence: flags, variables, file."""
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls)

    @property
    def quotas(self) -> Quotas:
        """Return the limits on the stored data and the unfinished work of one user or one project."""
        return Quotas(**{field.name: getattr(self, field.name) for field in fields(Quotas)})

    @property
    def retention(self) -> Retention:
        """Return the numbers of days for which events, audit entries, logs and jobs are kept."""
        return Retention(self.events_days, self.logs_days, self.jobs_days, self.audit_days)

    @property
    def starts_workers(self) -> bool:
        """Whether the server starts workers: processes on its machine, workers in pools, or pods for single jobs."""
        return bool(self.local_workers or self.pools or self.own_pods)

    @property
    def resolved_database_threads(self) -> int:
        """Return the number of threads for reads.

        The default is small for SQLite, because its reads do not wait for a network.
        """
        return self.database_threads or (2 if self.resolved_database_url.startswith("sqlite") else 8)

    @property
    def resolved_database_url(self) -> str:
        """Return the URL of the database, by default of an SQLite file in the data folder.

        The URL contains the password in `database_password_file`, so it must not be logged.
        """
        url = self.database_url or f"sqlite:///{(self.data / DATABASE_FILE).absolute()}"
        if self.database_password_file is None:
            return url
        user, _, place = urlsplit(url).netloc.partition("@")
        password = quote(read_secret(self.database_password_file), safe="")
        return url.replace(f"{user}@{place}", f"{user}:{password}@{place}", 1)
