"""Scripts: commands of pinned Git commits that projects run as jobs, and the values that their runs log."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, field_validator, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.consents import ConsentOverride
from marey_schemas.formats import FORMATS, WHOLE_FORMATS, ExportFormat
from marey_schemas.kinds import Kind
from marey_schemas.names import SLUG, Message, ReceivingPath, form
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import InputSpec, JobInput, JobState, Resources
from marey_schemas.queue.own_pods import Image
from marey_schemas.sizes import GIB, MIB, SEEDS

SCRIPT = "script"
"""Name of the job kind that runs scripts."""

REPOSITORIES_VARIABLE = "MAREY_SCRIPT_REPOSITORIES"
"""Environment variable with the allowed repositories as a JSON list; the setting of the server has the same name."""

STEPWISE = "jsonl"
"""Format of files with logged fields: JSON lines, each with the values of one step."""

PYTHON = "python"
"""First word of commands that the Python interpreter of the worker runs."""

MOST_WORDS = 200
MOST_DECLARED = 50
MOST_FIELDS = 100
LONGEST_TEXT = 500
"""Greatest number of characters of a text parameter, and of a logged text."""
LONGEST_NAME = 63
"""Greatest number of characters in the name of a parameter or a field."""

WORKER_S, WORKER_MB = 1800, 2048
"""Seconds, and MiB of memory, that a worker may use in addition to the script, for example to fetch the commit."""

ScriptName = Annotated[str, StringConstraints(pattern=SLUG)]
"""Name of a script: lower-case letters, digits, `-` and `_`; the name is part of URLs."""

_FIELD = form(r"^[A-Za-z][A-Za-z0-9_]{0,62}$", "have at most 63 letters, digits and _, and begin with a letter")
FieldName = Annotated[str, StringConstraints(pattern=_FIELD)]
"""Name of a parameter, an input, an output or a logged field."""

_REPOSITORY = form(
    r"^(?:https://[A-Za-z0-9.-]+(?::[0-9]{1,5})?|file://)(?:/[\w.~+-]+)+/?$",
    "be the address of a Git repository without a user name, beginning with https:// or file://",
)
Repository = Annotated[
    str,
    StringConstraints(max_length=500, pattern=_REPOSITORY),
]
"""Address of a Git repository, without user name, password or query."""

Value = bool | int | float | str
"""Value of a parameter or a logged field."""

_PLACEHOLDER = re.compile(r"\{(input|output|parameter):([A-Za-z][A-Za-z0-9_]{0,62})\}")
_COMMIT = re.compile(form(r"^[0-9a-f]{40}$", "be the full name of a commit, 40 hexadecimal digits in lower case"))
_MOTION_ENDINGS = {row.name: row.endings[0] for row in FORMATS if row.name in WHOLE_FORMATS}
"""Formats of clips that a script can write, with the endings of their files."""


class ScriptParameter(Request):
    """Parameter of a script, which becomes one word of its command."""

    type: Literal["number", "integer", "text", "boolean"] = "number"
    minimum: float | None = Field(None, allow_inf_nan=False, description="Least value of a number; null: no limit.")
    maximum: float | None = Field(None, allow_inf_nan=False, description="Greatest value of a number; null: no limit.")
    choices: tuple[str, ...] = Field((), max_length=100, description="Allowed texts; empty: any text.")
    default: Value | None = Field(
        None, description="Value that is used if a run gives no value; null: each run must give a value."
    )
    description: Message = ""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.type not in ("number", "integer") and (self.minimum is not None or self.maximum is not None):
            raise ValueError(f"minimum and maximum need a parameter of the type number or integer, not {self.type}")
        if self.choices and self.type != "text":
            raise ValueError(f"choices need a parameter of the type text, not {self.type}")
        if any("\x00" in choice for choice in self.choices):
            raise ValueError("choices: a text contains a NUL character; remove it")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise ValueError("minimum: must not be greater than maximum")
        if self.default is not None and (fault := self.fault_of(self.default)) is not None:
            raise ValueError(f"default: {fault}")
        return self

    def fault_of(self, value: Value) -> str | None:
        """Return the reason why a value is not allowed for this parameter; None if it is allowed."""
        if self.type == "boolean":
            return None if isinstance(value, bool) else "the value must be true or false"
        if self.type == "text":
            return self._fault_of_text(value)
        wanted = (int,) if self.type == "integer" else (int, float)
        if isinstance(value, bool) or not isinstance(value, wanted):
            return f"the value must be {'an integer' if self.type == 'integer' else 'a number'}"
        if not abs(value) < 1e300:
            return "the value must be a finite number"
        if self.minimum is not None and value < self.minimum:
            return f"the value must be at least {self.minimum:g}"
        if self.maximum is not None and value > self.maximum:
            return f"the value must be at most {self.maximum:g}"
        return None

    def _fault_of_text(self, value: Value) -> str | None:
        if not isinstance(value, str):
            return "the value must be a text"
        if self.choices:
            return None if value in self.choices else f"the value must be one of {', '.join(self.choices)}"
        if len(value) > LONGEST_TEXT or re.search(r"[\x00-\x1f\x7f]", value):
            return f"the value must be one line of at most {LONGEST_TEXT} characters"
        if value.startswith("-"):
            return "the value must not begin with -, because the script could take it for an option"
        return None


class ScriptInput(Request):
    """Input of a script: items of the project, which are written to files."""

    kind: Kind = Kind.CLIP
    format: ExportFormat = Field("bvh", description="Format of the files; items other than clips are written as json.")
    many: bool = Field(False, description="Whether the input is a folder of files instead of one file.")
    description: Message = ""

    @model_validator(mode="after")
    def _check_format(self) -> Self:
        if self.kind is not Kind.CLIP and self.format != "json":
            raise ValueError(f"format: an item of the kind {self.kind} can be written only as json")
        return self


class ScriptOutput(Request):
    """File that a script writes: a clip, which is imported, a JSON object of logged fields, or any other file."""

    kind: Literal["clip", "fields", "file"]
    format: str | None = Field(
        None,
        max_length=16,
        description="Format of a clip, such as bvh. For logged fields: jsonl, if each line is a JSON object of values "
        "of one step; absent: the file is one JSON object.",
    )
    max_bytes: int = Field(64 * MIB, ge=1, le=GIB, description="Greatest size of the file, in bytes.")
    required: bool = Field(True, description="Whether a run fails if the script does not write this file.")
    description: Message = ""

    @model_validator(mode="after")
    def _check_format(self) -> Self:
        if self.kind == "clip" and self.format not in _MOTION_ENDINGS:
            raise ValueError(f"format: a clip needs one of the formats {', '.join(_MOTION_ENDINGS)}")
        if self.kind == "fields" and self.format not in (None, STEPWISE):
            raise ValueError(f"format: fields have the format {STEPWISE}, or none for a file with one JSON object")
        if self.kind == "file" and self.format is not None:
            raise ValueError("format: leave it out, because only clips and fields have a format")
        return self

    @property
    def ending(self) -> str:
        """The ending of the name of the written file, such as `.bvh`."""
        if self.kind == "clip":
            return _MOTION_ENDINGS[self.format or ""]
        return f".{self.format or 'json'}" if self.kind == "fields" else ""


class ScriptLimits(Request):
    """Limits of one run of a script."""

    seconds: int = Field(3600, ge=1, le=86400, description="Greatest duration of a run, in seconds.")
    memory_mb: int = Field(2048, ge=64, le=262_144, description="Greatest memory of all its processes, in MiB.")
    written_mb: int = Field(1024, ge=1, le=65_536, description="Greatest size of all its files, in MiB.")
    processes: int = Field(32, ge=1, le=1024, description="Greatest number of processes at the same time.")
    network: bool = Field(False, description="Whether the script may use the network.")

    @property
    def resources(self) -> Resources:
        """The limits of the job: those of the script, plus the time and memory that the worker itself needs."""
        time_limit_s, memory_limit_mb = self.seconds + WORKER_S, self.memory_mb + WORKER_MB
        return Resources(time_limit_s=time_limit_s, memory_limit_mb=memory_limit_mb)


class ScriptDeclaration(Request):
    """Code and command of a script, its parameters, inputs and outputs, and its limits."""

    repository: Repository = Field(description="Address of the Git repository; the server must allow it.")
    commit: str = Field(pattern=_COMMIT.pattern, description="Full name of the commit, 40 hexadecimal digits.")
    argv: tuple[Annotated[str, StringConstraints(min_length=1, max_length=1000)], ...] = Field(
        min_length=1,
        max_length=MOST_WORDS,
        description="Words of the command. The first word is `python`, followed by a file of the commit, or a "
        "program of the commit, such as `./measure`. A word `{parameter:name}` is replaced by a value, a word "
        "`{input:name}` or `{output:name}` by the path of a file. No shell interprets the words.",
    )
    parameters: dict[FieldName, ScriptParameter] = Field(default_factory=dict, max_length=MOST_DECLARED)
    inputs: dict[FieldName, ScriptInput] = Field(default_factory=dict, max_length=MOST_DECLARED)
    outputs: dict[FieldName, ScriptOutput] = Field(min_length=1, max_length=MOST_DECLARED)
    limits: ScriptLimits = ScriptLimits()
    image: Image | None = Field(
        None,
        description="Container image in which the script runs, named by its digest. The image must contain a worker "
        "of Marey, the server must allow the image, and the server must start pods for single jobs. null: the "
        "image of the worker.",
    )

    @field_validator("commit", mode="before")
    @classmethod
    def _check_commit(cls, commit: object) -> object:
        if isinstance(commit, str) and not _COMMIT.fullmatch(commit):
            raise ValueError("give the full name of a commit, 40 hexadecimal digits, as `git rev-parse` prints it")
        return commit

    @field_validator("repository")
    @classmethod
    def _check_repository(cls, repository: str) -> str:
        if any(set(part) == {"."} for part in repository.split("/")):
            raise ValueError("the address must not contain the folders . or ..")
        return repository

    @model_validator(mode="after")
    def _check_words(self) -> Self:
        if any("\x00" in word for word in self.argv):
            raise ValueError("argv: a word contains a NUL character; remove it")
        self._check_program()
        used = set()
        for place, word in enumerate(self.argv):
            match = _PLACEHOLDER.fullmatch(word)
            if match is not None:
                used.add(match.groups())
            elif re.search(r"\{(input|output|parameter):", word):
                raise ValueError(f"argv.{place}: a placeholder must be a word of its own, as in {{parameter:name}}")
        declared = {
            (kind, name)
            for kind, names in (("parameter", self.parameters), ("input", self.inputs), ("output", self.outputs))
            for name in names
        }
        for kind, name in sorted(used - declared):
            raise ValueError(f"argv: the {kind} {name!r} is not declared; declare it, or remove the word")
        for kind, name in sorted(declared - used):
            raise ValueError(
                f"argv: the {kind} {name!r} is declared, but no word is {{{kind}:{name}}}; add this "
                "word, or remove the declaration"
            )
        if sum(output.kind == "fields" for output in self.outputs.values()) > 1:
            raise ValueError("outputs: at most one output can be of the kind fields")
        return self

    def _check_program(self) -> None:
        program = self.argv[0]
        file = (self.argv[1] if len(self.argv) > 1 else "") if program == PYTHON else program.removeprefix("./")
        if program != PYTHON and not program.startswith("./"):
            raise ValueError(f"argv.0: the first word must be {PYTHON}, or a file of the commit such as ./measure")
        if not re.fullmatch(r"[\w][\w./+-]*", file) or ".." in file.split("/"):
            raise ValueError(f"argv: {file!r} is not the path of a file in the commit")

    @property
    def program(self) -> str:
        """The path of the file in the commit that the command runs."""
        return self.argv[1] if self.argv[0] == PYTHON else self.argv[0].removeprefix("./")

    def words(self, paths: Mapping[tuple[str, str], str], values: Mapping[str, Value]) -> Iterator[str]:
        """Yield the words of the command, with paths and values in place of the placeholders.

        `paths` contains the path of each input and output; its keys are pairs such as ("input", name). `values`
        contains the value of each parameter.
        """
        for word in self.argv:
            match = _PLACEHOLDER.fullmatch(word)
            if match is None:
                yield word
            elif match[1] == "parameter":
                value = values[match[2]]
                yield str(value).lower() if isinstance(value, bool) else str(value)
            else:
                yield paths[match[1], match[2]]

    def input_specs(self) -> dict[str, InputSpec]:
        """Return the inputs in the form in which job kinds declare inputs."""
        return {
            name: InputSpec(kind=one.kind, many=one.many, description=one.description)
            for name, one in self.inputs.items()
        }

    def faults_of(self, given: Mapping[str, Value]) -> Iterator[tuple[str, str]]:
        """Yield the name of each wrong parameter of a run, with the reason."""
        for name in given.keys() - self.parameters.keys():
            yield name, f"the script has no parameter {name!r}; it has {', '.join(self.parameters) or 'none'}"
        for name, one in self.parameters.items():
            if name not in given and one.default is None:
                yield name, f"the script needs the parameter {name!r}"
            elif name in given and (fault := one.fault_of(given[name])) is not None:
                yield name, fault

    def values_of(self, given: Mapping[str, Value]) -> dict[str, Value]:
        """Return the values of all parameters of a run, with the defaults of those that are not given."""
        defaults = {name: one.default for name, one in self.parameters.items() if one.default is not None}
        return defaults | dict(given)


class ScriptCreate(ScriptDeclaration):
    """Request to register a script."""

    name: ScriptName
    description: Message = ""

    @property
    def declaration(self) -> ScriptDeclaration:
        """The declaration of the script, without its name and description."""
        return ScriptDeclaration.model_validate(self.model_dump(exclude={"name", "description"}))


class Script(Answer):
    """Script that is registered in a project, with the user who registered it."""

    name: str
    project: str
    description: str
    declaration: ScriptDeclaration
    author: str | None = Field(description="Name of the user who registered the script.")
    created_at: datetime


class ScriptParams(ConsentOverride):
    """Parameters of jobs of the kind `script`."""

    script: ScriptName = Field(description="Name of the script.")
    values: dict[FieldName, Value] = Field(
        default_factory=dict, max_length=MOST_DECLARED, description="Values of the parameters of the script."
    )
    declaration: ScriptDeclaration | None = Field(
        None,
        description="The script in the form in which it was registered at the submission of the job. The server "
        "sets this field; if a request contains the field, its value must equal the registered "
        "script.",
    )


class ScriptRunCreate(ConsentOverride):
    """Request to run a script as a job, with values for its parameters and inputs."""

    values: dict[FieldName, Value] = Field(
        default_factory=dict, max_length=MOST_DECLARED, description="Values of the parameters."
    )
    inputs: dict[FieldName, JobInput | tuple[JobInput, ...]] = Field(default_factory=dict)
    into: ReceivingPath = Field("", description="The collection that receives the clips.")
    seed: int = Field(0, ge=0, lt=SEEDS, description="Value of the environment variable MAREY_SEED of the script.")
    message: Message = Field("", description="Message of the run, shown in the history of its results.")
    commit: OutputsCommit | None = Field(
        None,
        description="Commit of the outputs to a branch of a dataset, made when the run succeeds; null: none is made.",
    )


class ScriptRun(Answer):
    """Run of a script: its state, the values of its parameters, and the fields that it logged."""

    job: str
    state: JobState
    values: dict[str, Value]
    fields: dict[str, Value] = Field(description="Logged fields; empty until the run has succeeded.")
    commit: str
    seed: int
    author: str | None
    created_at: datetime
    finished_at: datetime | None


def read_repositories(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the allowed repositories from `REPOSITORIES_VARIABLE`, none if it is not set.

    Raises `ValueError` if the value of the variable is not a JSON list of texts.
    """
    text = environment.get(REPOSITORIES_VARIABLE, "").strip()
    if not text:
        return ()
    try:
        found = json.loads(text)
    except ValueError:
        found = None
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found):
        raise ValueError(f'{REPOSITORIES_VARIABLE} must be a JSON list, such as ["https://git.lab.example/motion/"]')
    return tuple(found)


def is_allowed(repository: str, allowed: Iterable[str]) -> bool:
    """Return whether a repository is in the list; an entry that ends in `/` allows all repositories below it."""
    return any(repository == one or (one.endswith("/") and repository.startswith(one)) for one in allowed)
