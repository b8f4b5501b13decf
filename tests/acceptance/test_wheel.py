"""Content of the wheel: everything that an installation without the source tree needs."""

import contextlib
import os
import re
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import hatch_build
import httpx
import pytest
from docs.generate import ROOT
from hatchling.builders.wheel import WheelBuilder
from tests.support.server_process import READY_S, reserved_port

UNNEEDED = {"__pycache__"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    environment = os.environ | {"MAREY_WEB": "skip"}  # a build of the pages needs the network
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120, env=environment)
    (file,) = folder.iterdir()
    return file


def test_the_wheel_contains_every_file_of_the_packages_and_the_migrations(wheel: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = [ROOT / folder for folder in project["tool"]["pyrefly"]["search-path"] if folder != "."]
    homes = {package: package.name for folder in packages for package in folder.glob("marey*/")}
    homes[ROOT / "migrations"] = "marey_server/migrations"
    needed = {
        f"{home}/{file.relative_to(folder).as_posix()}"
        for folder, home in homes.items()
        for file in folder.rglob("*")
        if file.is_file() and not UNNEEDED & set(file.parts)
    }
    assert {name.partition("/")[0] for name in needed if name.endswith("/py.typed")} == set(
        project["tool"]["importlinter"]["root_packages"]
    )
    assert needed - set(zipfile.ZipFile(wheel).namelist()) == set()


def test_the_wheel_serves_pages_and_a_new_database_without_the_source_tree_and_node(
    wheel: Path, tmp_path: Path
) -> None:
    with zipfile.ZipFile(wheel) as content:
        content.extractall(tmp_path / "installed")
    (tmp_path / "no-programs").mkdir()
    port = reserved_port()
    url = f"http://127.0.0.1:{port}"
    words = ["serve", "--workers", "0", "--port", str(port), "--data", str(tmp_path / "data")]
    environment = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
    environment |= {"PYTHONPATH": str(tmp_path / "installed"), "PATH": str(tmp_path / "no-programs")}
    environment["MAREY_WARM_UP"] = "false"  # a new installation would compile all kernels
    with (tmp_path / "log").open("wb") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "marey_client.cli", *words], cwd=tmp_path, env=environment, stdout=log, stderr=log
        )
    try:
        _wait_until_ready(url, server, tmp_path / "log")
        assert (tmp_path / "data" / "marey.db").is_file()
        page = httpx.get(f"{url}/studies?study=lab/x")
        if not (hatch_build.PAGES / "index.html").is_file():
            assert (page.status_code, "make web" in page.text) == (404, True)
            return
        assert page.status_code == 200
        (script,) = re.findall(r'<script type="module"[^>]* src="./(assets/[^"]+[.]js)"', page.text)
        loaded = httpx.get(f"{url}/{script}")
        assert (loaded.status_code, loaded.headers["Content-Encoding"]) == (200, "gzip")
        assert loaded.text == (hatch_build.PAGES / script).read_text(encoding="utf-8")
    finally:
        server.terminate()
        server.wait(60)


def _wait_until_ready(url: str, server: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + READY_S
    while time.monotonic() < end:
        assert server.poll() is None, log.read_text()[-3000:]
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{url}/readyz", timeout=5).status_code == 200:
                return
        time.sleep(0.1)
    raise AssertionError(f"the server is not ready: {log.read_text()[-3000:]}")


def test_without_npm_a_wheel_is_built_and_the_command_for_the_pages_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sources, pages = tmp_path / "web", tmp_path / "webui"
    for folder in (sources, pages):
        folder.mkdir()
    (sources / "index.html").write_text("<title>Marey</title>")
    for name, value in (("SOURCES", sources), ("PAGES", pages), ("STAMP", pages / ".sources")):
        monkeypatch.setattr(hatch_build, name, value)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("MAREY_WEB", raising=False)
    builder = WheelBuilder(str(ROOT))
    hook = hatch_build.PagesHook(
        str(tmp_path), {}, builder.config, builder.metadata, str(tmp_path), "wheel", builder.app
    )

    hook.initialize("standard", {})
    assert "no browser pages: npm is not installed; install Node 20.19 or newer, and run `make web`." in (
        "".join(capsys.readouterr())
    )
    monkeypatch.setenv("MAREY_WEB", "require")
    with pytest.raises(hatch_build.PagesNotBuilt, match="make web"):
        hook.initialize("standard", {})
    (pages / ".sources").write_text(hatch_build.source_digest())  # built elsewhere from the same sources
    hook.initialize("standard", {})
    (sources / "index.html").write_text("<title>changed</title>")
    with pytest.raises(hatch_build.PagesNotBuilt):
        hook.initialize("standard", {})
