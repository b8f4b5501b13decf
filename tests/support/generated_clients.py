"""Clients of the REST API that other people's programs generate from the OpenAPI document."""

from __future__ import annotations

import importlib
import io
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.support.tiers import NODE_PACKAGES

BYTES_TYPES = ("application/zip", "image/png")
"""Media types that the generator must be configured to treat as bytes."""
ONLY_AS_JSON = ("Unsupported content type application/msgpack", "Unsupported content type application/bson")
"""Expected warnings: a generated client sends bodies as JSON only."""


def generate_python_client(document: Path, package: Path) -> list[str]:
    """Generate a Python package from an OpenAPI document in a file; return the warnings of the generator."""
    import openapi_python_client  # takes long to load, and each test process imports this module
    from openapi_python_client.config import Config, ConfigFile, MetaType

    types = dict.fromkeys(BYTES_TYPES, "application/octet-stream")
    settings = ConfigFile(literal_enums=True, post_hooks=[], content_type_overrides=types)
    config = Config.from_sources(settings, MetaType.NONE, document, "utf-8", overwrite=True, output_path=package)
    errors = openapi_python_client.generate(config=config)
    return [f"{one.header}: {one.detail}" for one in errors if one.detail not in ONLY_AS_JSON]


def check_typescript_program(document: Path, program: Path) -> str:
    """Generate TypeScript types from an OpenAPI document into `api.ts` in the folder of a program; check the program.

    Return the errors of the compiler.
    """
    tools = NODE_PACKAGES / ".bin"
    generate = [str(tools / "openapi-typescript"), str(document), "--output", str(program.with_name("api.ts"))]
    subprocess.run(generate, check=True, capture_output=True, timeout=300)
    settings = ["--noEmit", "--strict", "--skipDefaultLibCheck", "--target", "es2022", "--lib", "es2022,dom"]
    modules = ["--module", "esnext", "--moduleResolution", "bundler"]
    check = [str(tools / "tsc"), *settings, *modules, str(program)]
    return subprocess.run(check, check=False, capture_output=True, text=True, timeout=300).stdout


class PythonClient:
    """Imported package of a generated client, with its operations by their ids."""

    def __init__(self, package: Path, address: str, token: str) -> None:
        sys.path.insert(0, str(package.parent))
        try:
            importlib.invalidate_caches()
            self.package = importlib.import_module(package.name)
            self.models = importlib.import_module(f"{package.name}.models")
            self.types = importlib.import_module(f"{package.name}.types")
            self._operations = {
                file.stem: importlib.import_module(".".join((package.name, "api", file.parent.name, file.stem)))
                for file in package.glob("api/*/*.py")
                if file.stem != "__init__"
            }
        finally:
            sys.path.remove(str(package.parent))
        self.connection = self.package.AuthenticatedClient(base_url=address, token=token)

    @property
    def operations(self) -> set[str]:
        """The ids of all operations that the client has."""
        return set(self._operations)

    def call(self, operation: str, *path: object, status: int = 200, **values: Any) -> Any:
        """Call an operation, check the status of the answer, and return the answer as the client parsed it."""
        answer = self._operations[operation].sync_detailed(*path, client=self.connection, **values)
        assert answer.status_code == status, (operation, answer.content[:2000])
        return answer.parsed

    def request(self, operation: str, *path: object, **values: Any) -> dict[str, Any]:
        """Return the method, URL and body of a request, which the caller may change before sending it."""
        return dict(self._operations[operation]._get_kwargs(*path, **values))

    def file(self, data: bytes, name: str | None = None) -> Any:
        """Return bytes in the form in which the generated client sends files."""
        return self.types.File(payload=io.BytesIO(data), file_name=name)
