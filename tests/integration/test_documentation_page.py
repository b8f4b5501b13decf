"""The documentation page of the API in a real Chromium: it fits, sends requests, and keeps no token."""

import json
import os
import subprocess

import pytest
from hatch_build import SOURCES as PAGE_SOURCES
from tests.support.rest_server import Server
from tests.support.tiers import chromium


@pytest.mark.soak
@pytest.mark.chromium
def test_the_page_fits_sends_requests_and_forgets_the_token(server: Server) -> None:
    token = server.make_project()
    pictures = os.environ.get("MAREY_WEB_PICTURES", "")
    look = ["node", "browser/docs.mjs", str(chromium()), server.address, token, pictures]
    done = subprocess.run(look, cwd=PAGE_SOURCES, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["errors"] == []
    assert found["widths"] == {"390": 390, "1280": 1280}
    assert found["answer"].startswith("200")
    assert '"name": "olga"' in found["answer"]
    assert len(set(found["methods"].values())) == 5
    assert found["kept"] == [f"{server.address}/api/v1/docs", "", 0]
    assert found["afterReload"] == ""
