"""Rules that ruff and import-linter check: each refuses a planted violation."""

import json
import subprocess
import sys
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from grimp import ImportGraph, build_graph
from importlinter.api import read_configuration
from importlinter.contracts.forbidden import ForbiddenContract
from importlinter.contracts.layers import LayersContract

ROOT = Path(__file__).parents[3]
CONFIGURATION = read_configuration(str(ROOT / "pyproject.toml"))
CONTRACTS = {contract["name"]: contract for contract in CONFIGURATION["contracts_options"]}
PLANTED = {
    "schemas imports nothing of ours": ("marey_schemas.names", "marey_versions.records"),
    "versions knows only schemas": ("marey_versions.records", "marey_motion.clip"),
    "motion knows only schemas": ("marey_motion.clip", "httpx"),
    "motion takes options and documents, and knows nothing of jobs and access": (
        "marey_motion.clip",
        "marey_schemas.access",
    ),
    "reports draw what motion computed": ("marey_reports.drawing.page", "marey_client.jobs"),
    "the client reaches others lazily from its commands only": ("marey_client.jobs", "marey_worker.child"),
    "`import marey` is a door to the client, and nothing goes through it from inside": ("marey_client.jobs", "marey"),
    "the server never imports the worker, the client or the reports": ("marey_server.app", "marey_worker.child"),
    "the worker reaches data only through the client": ("marey_worker.child", "marey_server.errors"),
    "matplotlib is known to the reports only": ("marey_worker.child", "matplotlib"),
    "SQL lives in the store": ("marey_worker.child", "sqlalchemy"),
    "the server's rooms import downwards only": ("marey_server.store.items", "marey_server.motions.reading"),
    "Tornado is known to the application, its handlers and their machinery": ("marey_server.capacity.needs", "tornado"),
    "motion is computed in the room for it": ("marey_server.http.reply", "marey_motion.clip"),
    "object storage does not know the database that uses it": (
        "marey_server.store.object_storage",
        "marey_server.store.database.connections",
    ),
    "the database does not know the upkeep of object storage": (
        "marey_server.store.database.connections",
        "marey_server.store.object_upkeep",
    ),
    "jobs count against quotas, and quotas do not know jobs": ("marey_server.store.quotas", "marey_server.store.jobs"),
    "requests do not know where blobs are stored": ("marey_server.handlers.blobs", "marey_server.store.object_storage"),
    "the store does not compute motion": ("marey_server.store.items", "marey_server.motions.reading"),
}
"""A forbidden import for each contract: the importing module, and the imported one."""

OFFENCES = """\
import asyncio
import importlib
import os, subprocess
from . import neighbour
from datetime import datetime
from typing import List

__all__ = [1]
l = 1

def Function(id, unused, more=[]):
    try:
        if more == None and id is 3:
            return True
        else:
            return False
    except Exception:
        print(datetime.now(), f"no", end=u"")
    found = []
    for each in more:
        found.append(str(each))
    for each in range(3):
        found.append(lambda: each)
    if "a" in dict([(1, 2)]).keys(): found = None
    subprocess.call("ls", shell=True)
    asyncio.wait_for(1, 2)
    importlib.import_module("os")
    global l
    l = 2
    assert more and id, "\\d"
    class Empty(object):
        more: List[int] = []
        pass
        ...
    return found
"""


@pytest.fixture(scope="module")
def imports() -> ImportGraph:
    """The imports of all packages."""
    names = CONFIGURATION["session_options"]["root_packages"]
    return build_graph(*names, include_external_packages=True, cache_dir=None)


@pytest.mark.parametrize("name", CONTRACTS)
def test_a_contract_on_imports_refuses_a_planted_import(name: str, imports: ImportGraph) -> None:
    importer, imported = PLANTED[name]
    planted = deepcopy(imports)
    planted.add_import(importer=importer, imported=imported)
    sort: Any = LayersContract if CONTRACTS[name]["type"] == "layers" else ForbiddenContract
    contract = sort(name, CONFIGURATION["session_options"], CONTRACTS[name])
    assert not contract.check(planted, verbose=False).kept


def test_each_family_of_rules_that_ruff_checks_refuses_planted_code() -> None:
    families = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["ruff"]["lint"]["select"]
    path = "server/marey_server/planted.py"
    arguments = ["check", "--no-cache", "--output-format", "json", "--stdin-filename", path, "-"]
    program = [Path(sys.executable).with_name("ruff"), *arguments]
    ruff = subprocess.run(program, input=OFFENCES, capture_output=True, text=True, cwd=ROOT)
    found = {offence["code"] for offence in json.loads(ruff.stdout)}
    assert [family for family in families if not any(code.startswith(family) for code in found)] == []
    assert {"TID251", "TID252"} <= found
    messages = [offence["message"] for offence in json.loads(ruff.stdout) if offence["code"] == "TID251"]
    assert len({message.partition(" ")[0] for message in messages}) == 2, "imports by name, and `asyncio.wait_for`"
