"""What a server makes before it first serves."""

import stat
from pathlib import Path

from marey_server.access.principal import SYSTEM
from marey_server.app import make_first_administrator
from marey_server.store import tokens
from marey_server.store.database import Database


def test_the_first_administrator_is_made_once_and_the_token_works(database: Database, tmp_path: Path):
    file = tmp_path / "admin.token"
    database.write(SYSTEM, make_first_administrator, file)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    secret = file.read_text().strip()
    assert database.read(SYSTEM, tokens.resolve_token, secret).administrator
    database.write(SYSTEM, make_first_administrator, file)
    assert file.read_text().strip() == secret
