"""The pages for operators, administrators and developers, run as printed on servers of their own."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandLine
from tests.support.database_fixtures import copied_sqlite
from tests.support.present import present
from tests.support.printed_pages import ROOT, PrintedPage, blocks, commands_of
from tests.support.server_process import ServerProcess, serving
from tests.support.short_walks import write_named_walks

from marey_client import Marey
from marey_client.errors import Unauthenticated
from marey_schemas.access import Login, ProjectCreate, UserCreate
from marey_schemas.base import Request
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_server.process.settings import Settings

Reads = Callable[..., PrintedPage]
PASSWORD = "a password of nobody else"

pytestmark = [pytest.mark.soak, pytest.mark.timeout(300)]


@pytest.fixture
def server(sqlite_template: Path, tmp_path: Path) -> Iterator[ServerProcess]:
    """A server without workers, whose database a test may spoil."""
    (tmp_path / "data").mkdir()
    copied_sqlite(sqlite_template, tmp_path / "data")
    process = ServerProcess(tmp_path).start()
    yield process
    process.stop()


@pytest.fixture
def run(server: ServerProcess, tmp_path: Path) -> CommandLine:
    return CommandLine(server, tmp_path)


def prefix_of(file: Path) -> str:
    """Return the prefix of the token in a file."""
    return file.read_text(encoding="utf-8").split("_")[1]


def id_of(run: CommandLine, file: Path) -> str:
    """Return the id of the token in a file."""
    tokens = json.loads(run("token", "ls", "--everybody", "--prefix", prefix_of(file), "--json").stdout)
    return str(tokens[0]["id"])


def test_rotate_secrets(server: ServerProcess, run: CommandLine, reads: Reads, tmp_path: Path) -> None:
    with server.client() as marey:
        for name in ("ada", "ops"):
            marey.users.create(UserCreate(name=name, password=PASSWORD, administrator=name == "ops"))
        session = marey.sign_in(Login(name="ops", password=PASSWORD)).secret
    run("token", "create", "worker", "--scope", "work", "--output", "worker.token")
    tokens = tmp_path / "worker.token", server.data / "admin.token"
    page = reads(
        "docs/how-to/rotate-secrets.md",
        inputs={
            "marey user password": f"another password of ops\n{PASSWORD}\n",
            "marey user password ada": "another password of ada\n",
        },
    )
    prefixes = [prefix_of(tokens[0])]
    page.follow(1)
    prefixes.append(prefix_of(tokens[0]))
    for file in tokens:
        old = file.read_text(encoding="utf-8").strip()
        page.replaced = {"token_01": id_of(run, file), "/srv/marey": str(server.data)}
        page.follow(1)
        prefixes.append(prefix_of(file))
        with Marey(server.url, old) as marey, pytest.raises(Unauthenticated):
            marey.me()
        with Marey(server.url, file.read_text(encoding="utf-8").strip()) as marey:
            marey.me()
    assert len(set(prefixes)) == len(prefixes)
    page.variables["MAREY_TOKEN"] = session
    page.follow()
    run("login", "--name", "ada", stdin="another password of ada\n")
    run("login", "--name", "ops", stdin="another password of ops\n")


def test_when_a_token_leaks(server: ServerProcess, run: CommandLine, reads: Reads, tmp_path: Path) -> None:
    with server.client() as marey:
        for name in ("ada", "root"):
            marey.users.create(UserCreate(name=name, password=PASSWORD, administrator=name == "root"))
    run("token", "create", "leaked", "--output", "leaked.token")
    run("token", "create", "copied", "--output", "copied.token", "--token-file", "leaked.token")
    page = reads(
        "docs/how-to/when-a-token-leaks.md",
        replaced={
            "4f0c1a2b3d4e": prefix_of(tmp_path / "leaked.token"),
            "token_01": id_of(run, tmp_path / "leaked.token"),
        },
        inputs={"marey user password ada": "another password of ada\n"},
    )
    page.follow(1)
    assert "leaked" in page.printed("marey token ls --everybody --prefix")
    for name in ("leaked", "copied"):
        run("project", "ls", "--token-file", f"{name}.token", status=1)
    page.follow()
    assert "ada" in page.printed("marey user ls")
    run("login", "--name", "ada", stdin="another password of ada\n")


def test_set_limits(server: ServerProcess, run: CommandLine, reads: Reads) -> None:
    with server.client() as marey:
        marey.users.create(UserCreate(name="ada", password=PASSWORD))
        marey.create_project(ProjectCreate(name="motion-library"))
    page = reads("docs/how-to/set-limits.md")
    page.follow(1)
    assert "5000000" in re.sub(r"\D", "", page.printed("marey project quota motion-library --items"))
    page.follow()
    assert "20" in page.printed("marey project quota motion-library --running-jobs 20")


def test_complete_commands(server: ServerProcess, run: CommandLine, reads: Reads) -> None:
    page = reads("docs/how-to/complete-commands.md", left_out={"marey --install-completion": "changes the shell"})
    page.follow()
    for shell, word in (("bash", "complete "), ("zsh", "compdef"), ("fish", "complete ")):
        assert word in run("--show-completion", shell).stdout


def settings_of(
    page: str, folder: Path, monkeypatch: pytest.MonkeyPatch, replaced: Mapping[str, str] | None = None
) -> Settings:
    """Return the settings that the first block of settings on a page makes, as a server in `folder` reads them."""
    (block, *_) = re.findall(r"```toml\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    for printed, own in (replaced or {}).items():
        block = block.replace(printed, own)
    (folder / "marey.toml").write_text(block, encoding="utf-8")
    monkeypatch.chdir(folder)
    return Settings()


def test_object_storage(
    server: ServerProcess, run: CommandLine, reads: Reads, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "s3-secret-key").write_text("secret", encoding="utf-8")
    secret = {"/etc/marey/s3-secret-key": str(tmp_path / "s3-secret-key")}
    settings = settings_of("docs/how-to/object-storage.md", tmp_path, monkeypatch, secret)
    assert (settings.blobs, settings.s3_bucket, settings.s3_region) == ("s3", "marey", "eu-central-1")
    (tmp_path / "marey.toml").unlink()
    with server.client() as marey:
        marey.create_project(ProjectCreate(name="lab")).upload(write_named_walks(tmp_path / "takes", "walk"))
    # Tests of the REST API move blobs into a bucket; here they are moved into files.
    page = reads("docs/how-to/object-storage.md", variables={"MAREY_BLOBS": "directory"})
    page.follow()
    assert "fault" not in page.printed("marey doctor")
    assert [file for file in (server.data / "blobs").rglob("*") if file.is_file()]
    assert "2 blobs" in page.printed("marey db fsck")


def test_run_workers_on_slurm(tmp_path: Path, run: CommandLine, reads: Reads, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of("docs/how-to/run-workers-on-slurm.md", tmp_path, monkeypatch)
    assert settings.launcher == "slurm"
    assert [(pool.name, pool.most) for pool in settings.pools] == [("cpu", 20), ("gpu", 4)]
    slurm = "needs a Slurm cluster; tests/contract/test_slurm_launcher.py starts and stops workers on one"
    reads("docs/how-to/run-workers-on-slurm.md", left_out={"squeue": slurm, "scancel": slurm}).follow()


def test_run_a_server(server: ServerProcess, run: CommandLine, reads: Reads, tmp_path: Path) -> None:
    program = "runs until it is stopped; the fixture starts the same program"
    page = reads(
        "docs/how-to/run-a-server.md",
        replaced={"/srv/marey": str(server.data)},
        left_out={
            "marey serve": program,
            "marey worker": program,
            "export MAREY_DATABASE_URL": "needs the Postgres server of the example",
        },
        inputs={"marey db clock --set": "y\n"},
    )
    run("project", "create", "lab")
    page.follow(7)
    assert "lab" in page.printed("marey project ls")
    assert (tmp_path / "lyon.token").is_file()
    assert (tmp_path / "marey-2026-11-21.db").is_file()
    server.stop()
    shutil.move(server.data / "marey.db", tmp_path / "old.db")
    for suffix in ("-wal", "-shm"):
        (server.data / f"marey.db{suffix}").unlink(missing_ok=True)
    page.follow(3)
    server.start()
    page.follow()
    assert "lab" in run("project", "ls").stdout
    assert "deleted 0 jobs" in page.printed("marey db purge")
    assert "the database was last used at" in page.printed("marey db clock")
    assert "ok" in page.printed("marey doctor --no-local")


def write_package(folder: Path, page: str) -> None:
    """Write the package of the page about job kinds as it would be after its installation."""
    package = folder / "acme_motion"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "kinds.py").write_text(blocks(page)[0][1], encoding="utf-8")
    text = (ROOT / page).read_text(encoding="utf-8")
    (entry,) = re.findall(r'"(marey\.\w+)"\]\n(\w+) = "([\w.:]+)"', text)
    information = folder / "acme_motion-0.1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-motion\nVersion: 0.1\n")
    (information / "entry_points.txt").write_text("[{}]\n{} = {}\n".format(*entry))


def test_write_a_job_kind(sqlite_template: Path, tmp_path: Path) -> None:
    page = "docs/how-to/write-a-job-kind.md"
    write_package(tmp_path / "installed", page)
    write_named_walks(tmp_path / "takes", "walk", "turn")
    url = copied_sqlite(sqlite_template, tmp_path)
    _, (_, block), (_, sweep) = blocks(page)
    lines = [line for line in commands_of("sh", block) if line not in ("pip install -e .", "marey serve")]
    with serving(tmp_path, url, PYTHONPATH=str(tmp_path / "installed")) as server, server.client() as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        run = CommandLine(server, tmp_path)
        run("upload", "takes", "--project", "lab", "--collection", "raw")
        shown, submitted = (run(*line.split()[1:]).stdout for line in lines)
        assert "percentile" in shown
        (job,) = lab.jobs()
        speeds = present(marey.jobs.wait(job.id).result)["speed_m_s"]
        assert sorted(speeds) == ["turn", "walk"]
        assert all(0.9 < speed < 1.3 for speed in speeds.values())
        assert "speed_m_s" in submitted
    params = type("SweepParams", (Request,), {})
    stated = {"name": "sweep", "description": "Sweeps.", "params": params, "version": 1, "inputs": {}, "outputs": {}}
    names: dict[str, Any] = {"KindDeclaration": partial(KindDeclaration, **stated)}
    exec(compile(sweep.replace("...,", "", 1), page, "exec"), names)
    assert callable(names["SWEEP"].task_count)


def test_contributing() -> None:
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):", text, re.MULTILINE))
    lines = [line for language, block in blocks("CONTRIBUTING.md") for line in commands_of(language, block)]
    made = {line.split()[1] for line in lines if line.startswith("make ")}
    assert {"dev", "check", "test", "soak", "bench"} == made
    assert made <= targets
    left_out = {
        "make ": "runs a server, or tests and benchmarks for minutes to hours",
        "python3 -m venv": "downloads other programs",
        "export": "names these programs",
    }
    rest = [line.split() for line in lines if not line.startswith(tuple(left_out))]
    assert [words[:3] for words in rest] == [
        ["python", "-m", "benchmarks"],
        ["python", "-m", "benchmarks.compare"],
    ]
    for _, _, module, *arguments in rest:
        told = subprocess.check_output([sys.executable, "-m", module, "--help"], cwd=ROOT, text=True)
        assert [word for word in arguments if word.startswith("--") and word not in told] == []
    variables = {*re.findall(r"MAREY_BENCH_\w+", " ".join(lines))}
    known = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "benchmarks").rglob("*.py"))
    assert [name for name in sorted(variables) if name not in known] == []


@pytest.mark.curl
def test_answer_an_alert(server: ServerProcess, reads: Reads, tmp_path: Path) -> None:
    with server.client() as marey:
        lab = marey.create_project(ProjectCreate(name="lab"))
        lab.upload(write_named_walks(tmp_path / "takes", "walk"))
        job = lab.index()
        page = reads(
            "docs/how-to/answer-an-alert.md",
            replaced={"http://marey.internal:8460": server.url, "/srv/marey": str(server.data), "JOB": job.id},
        )
        page.follow()
    assert "HTTP/1.1 200" in page.printed("curl -i http://marey.internal:8460/readyz")
    assert "index" in page.printed("marey job ls lab --state queued")
    assert "marey_figures_age_seconds" in page.printed(
        "curl -s http://marey.internal:8460/metrics | grep -E '^marey_(fig"
    )
