"""Explanations of invalid settings: where each is set, the reason, and the setting with the most similar name."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_settings.exceptions import SettingsError

from marey_schemas.address import SETTINGS_FILE
from marey_schemas.validation.reasons import plain_reason
from marey_schemas.wording import nearest
from marey_server.process.settings import PREFIX, Settings

_JSON_FORMS = """write a list as ["a", "b"], and an object as {"a": "b"}"""


def explain_faults(error: ValidationError, given: Mapping[str, Any]) -> str:
    """Return the faults of settings in one line; `given` are the settings that the command line sets."""
    faults = error.errors(include_url=False)
    return "; ".join(f"{_setting_at(one['loc'], given)}: {_reason(one)}" for one in faults)


def explain_variable(error: SettingsError) -> str:
    """Return the reason why a variable is refused whose setting must be a list or an object: it is not valid JSON."""
    setting = re.search(r'field "(\w+)"', str(error))
    variable = f"{PREFIX}{setting[1]}".upper() if setting else f"a variable that begins with {PREFIX}"
    return f"{variable}: the value is not JSON ({error.__cause__}); {_JSON_FORMS}"


def misspelt_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that look like misspelt settings, each with the most similar setting."""
    known = [f"{PREFIX}{name.upper()}" for name in Settings.model_fields]
    unknown = [name for name in environment if name.startswith(PREFIX) and name.upper() not in known]
    own = [name for name in unknown if not name.startswith(f"{PREFIX}TEST_")]
    alike = {name: difflib.get_close_matches(name.upper(), known, 1, 0.82) for name in own}
    return {name: found[0] for name, found in alike.items() if found}


def _reason(fault: Any) -> str:
    if fault["type"] != "extra_forbidden" or len(fault["loc"]) > 1:
        return plain_reason(fault, Settings)
    near = nearest(str(fault["loc"][0]), Settings.model_fields)
    return f"there is no setting of this name{f'; did you mean {near!r}?' if near else ''}"


def _setting_at(steps: Sequence[int | str], given: Mapping[str, Any]) -> str:
    """Return the place where a setting is set: the name of its variable, or the file, the line and its name.

    For a setting of the command line (`given`), and for one that is set nowhere, return only its name.
    """
    name, whole = str(steps[0]) if steps else "", ".".join(map(str, steps))
    if given.get(name) is not None:
        return whole
    if (variable := f"{PREFIX}{name}".upper()) in map(str.upper, os.environ):
        return ".".join((variable, *map(str, steps[1:])))
    try:
        lines = Path(SETTINGS_FILE).read_text(encoding="utf-8").splitlines()
    except OSError:
        return whole
    sets = re.compile(rf"\s*\[*\s*[\"']?{re.escape(name)}[\"']?\s*[=.\]]")
    number = next((number for number, line in enumerate(lines, 1) if sets.match(line)), None)
    return whole if number is None else f"{SETTINGS_FILE}, line {number}: {whole}"
