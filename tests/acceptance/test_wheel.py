"""Content of the wheel: everything that an installation without the source tree needs."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from docs.generate import ROOT

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
    packages = [ROOT / folder for folder in project["tool"]["mypy"]["mypy_path"] if folder != "."]
    homes = {package: package.name for folder in packages for package in folder.glob("marey_*/")}
    homes[ROOT / "migrations"] = "marey_server/migrations"
    needed = {
        f"{home}/{file.relative_to(folder).as_posix()}"
        for folder, home in homes.items()
        for file in folder.rglob("*")
        if file.is_file() and not UNNEEDED & set(file.parts)
    }
    assert {name.partition("/")[0] for name in needed if name.endswith("/py.typed")} == {
        name for name in project["tool"]["mypy"]["packages"] if name.startswith("marey_")
    }
    assert needed - set(zipfile.ZipFile(wheel).namelist()) == set()


def test_the_wheel_creates_a_database_without_the_source_tree(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as content:
        content.extractall(tmp_path / "installed")
    environment = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
    made = subprocess.run(
        [sys.executable, "-m", "marey_client.cli", "db", "upgrade", "--data", str(tmp_path / "data")],
        cwd=tmp_path,
        env=environment | {"PYTHONPATH": str(tmp_path / "installed")},
        check=False,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert made.stdout == "the database's schema is up to date\n", made.stderr
    assert (tmp_path / "data" / "marey.db").is_file()
