"""Generates reference pages, a manifest and types of arguments from the code.

`python -m docs.generate` writes the files; with `--check`, it only compares them.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
import yaml
from docs.async_client import async_modules
from docs.keyword_types import keyword_modules
from docs.motion_library import library_page
from docs.sdk_reference import sdk_page
from prometheus_client.metrics import MetricWrapperBase
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

import marey_server.app  # noqa: F401 - loads every module, and so every class of errors
from marey_client.cli.app import app
from marey_motion.importing import checks
from marey_schemas.documents.evaluations import HEADLINE_METRICS
from marey_schemas.queries.fields import FACET_PREFIX, FIELDS, OPERATORS, declared_facets
from marey_schemas.queries.grammar import (
    MOST_ALIKE,
    MOST_CHARACTERS,
    MOST_COMPARED_VALUES,
    MOST_CONDITIONS,
    MOST_LIKENESSES,
)
from marey_schemas.queue.job_kinds import job_kinds
from marey_schemas.tracing.declared import ATTRIBUTES, SPANS
from marey_server import errors
from marey_server.launchers.kubernetes.manifests import Pool, pool_deployment
from marey_server.launchers.kubernetes.options import ClusterOptions
from marey_server.launchers.slurm import SlurmOptions
from marey_server.process.observe import Metrics
from marey_server.process.settings import Settings
from marey_server.process.worker_pools import OwnPods, WorkerPool

ROOT = Path(__file__).parents[1]
REFERENCE = Path(__file__).parent / "reference"
KEYWORDS = ROOT / "client" / "marey_client" / "keywords"
POOL_MANIFEST = ROOT / "deploy" / "kubernetes" / "base" / "workers.yaml"
UNKNOWN = "…"
"""Text in place of a value that is known only at run time."""
NOTE = "<!-- Written by `make docs` from the code; change it there. -->\n\n"


def pages() -> dict[str, str]:
    """Return the text of every generated page, by file name."""
    return {
        "command-line.md": command_line_page(),
        "settings.md": settings_page(),
        "job-kinds.md": job_kinds_page(),
        "checks.md": checks_page(),
        "queries.md": queries_page(),
        "errors.md": errors_page(),
        "metrics.md": metrics_page(),
        "traces.md": traces_page(),
        "motion-library.md": NOTE + library_page(),
        "python-sdk.md": NOTE + sdk_page(),
    }


def command_line_page() -> str:
    """Return the page of all commands with their arguments and options."""
    text = "# Command line\n\nExit status: 0 success, 1 refused or failed, 2 wrong usage, 130 interrupted (Ctrl-C).\n\n"
    root = typer.main.get_command(app)
    text += "## marey\n\n" + _parameters(root)
    for name, command in _commands(root, "marey"):
        text += f"## {name}\n\n{(command.help or '').strip()}\n\n" + _parameters(command)
    return NOTE + text.rstrip() + "\n"


def _commands(group: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, command in sorted(group.commands.items()):
        if hasattr(command, "commands"):
            if command.invoke_without_command:
                yield f"{prefix} {name}", command
            yield from _commands(command, f"{prefix} {name}")
        else:
            yield f"{prefix} {name}", command


def _parameters(command: Any) -> str:
    context = typer.Context(command)
    rows = [
        (f"`{one.name}`" if one.param_type_name == "argument" else _spelled(one, context), one.help)
        for one in command.get_params(context)
        if one.name not in ("help", "install_completion", "show_completion", "version")
    ]
    return _table(("option or argument", "meaning"), rows)


def _spelled(option: Any, context: typer.Context) -> str:
    """Return the spellings of an option and the type of its value, as the help of the command shows them."""
    shown, _ = option.get_help_record(context)
    return f"`{shown}`"


def queries_page() -> str:
    """Return the page of the query language and all fields."""
    rows = [
        (f"`{name}`", field.type, ", ".join(f"`{one}`" for one in OPERATORS[field.type]), field.description)
        for name, field in FIELDS.items()
    ]
    text = f"""# Queries

A query selects items: `subject = 02 and action ~ walk and frames > 120 and not warning = foot-slide and tag in (night,
day)`. `marey ls --query`, the parameter `query` of lists in the REST API, and `list(query=...)` of the SDK take a
query.

* A condition is a field, an operator and a value: `frames > 120`. `=` and `!=` compare the whole value of the field.
  With `~`, the field must contain the given text; upper and lower case are equal. With `in (a, b)`, the field must
  have one of the given values. `has take` selects items that have any value in the field `take`.
* `not`, `and`, `or` and brackets combine conditions; `not` binds strongest, then `and`. `a != b` means `not a = b`.
* If an item has no value for a field, every condition about this field is false, and the negation of the condition is
  true: `not select = best` also selects clips without a choice. A field with several values, such as `tag`, meets a
  condition if one of its values does.
* Values with spaces or special characters are written between quotation marks: `action = "walk, slow"`. Within the
  quotation marks, a quotation mark is written with a backslash before it, and so is a backslash.
* A date is written as a day, 2026-11-23, or as a time, 2026-11-23T15:04:05Z. A day means the whole day, in UTC.
* `like("walks/a:30-90") < 0.2` selects clips that move like frames 30 to 89 of the clip `walks/a`, as explained below.
* A query has at most {MOST_CHARACTERS:,} characters, {MOST_CONDITIONS} conditions and {MOST_COMPARED_VALUES} values.

"""
    text += _table(("field", "type", "operators", "meaning"), rows)
    text += (
        _motion_conditions()
        + f"""## Facets

Jobs publish numbers about their inputs, which are called facets; [job kinds](job-kinds.md) declare them. A query
compares them as numbers: `{FACET_PREFIX}used_frames > 0.5`. A facet belongs to the revision from which it was computed:
if a clip has a newer revision, every condition on the facet is false, until a job measures the clip again.

"""
    )
    facets = [(f"`{FACET_PREFIX}{name}`", meaning) for name, meaning in declared_facets().items()]
    return NOTE + text + _table(("facet", "meaning"), facets).rstrip() + "\n"


def _motion_conditions() -> str:
    """Return the section on conditions that compare motions."""
    return f"""## Motion

`like(CLIP:FIRST-END) < DISTANCE` selects the clips that have a moment which looks like some frames of a clip of the
project: `like("walks/a:30-90") < 0.2 and folder = studio and not warning = foot-slide`. `:30` means a single pose.
Moments have the length of the example. The distance is that of [searches by
example](../how-to/find-similar-motion.md), by the default metric. `like("walks/a:30-90", published/sigmoid) < 0.5`
chooses another built-in metric, or a stored one by its path. Use `<` or `<=`.

* The index that `marey index` updated last is searched. Without an index, or if clips have changed since the update,
  the query is refused: a list cannot say which clips are missing. Clips that the index left out meet no such condition.
* Only lists of existing clips accept the condition. An index has the newest revisions, and neither the older ones that
  versions of datasets contain, nor deleted clips. So checkouts, purges and lists of deleted items refuse it. Items of
  other kinds do not meet it.
* A query has at most {MOST_LIKENESSES} such conditions. Each may select at most {MOST_ALIKE:,} clips, and is evaluated
  again for every page of a list.

"""


def declared_metrics() -> list[MetricWrapperBase]:
    """Return all metrics of a server in the order of their declarations."""
    metrics = Metrics()
    declared = (*vars(metrics).values(), *vars(metrics.operator).values())
    return [one for one in declared if isinstance(one, MetricWrapperBase)]


def metrics_page() -> str:
    """Return the page of the metrics of a server."""
    rows = [
        (
            f"`{one._name}{'_total' if one._type == 'counter' else ''}`",
            one._type,
            ", ".join(f"`{label}`" for label in one._labelnames),
            one._documentation,
        )
        for one in declared_metrics()
    ]
    text = """# Metrics

`GET /metrics` returns these metrics in the text format of Prometheus, and the usual metrics of the process
(`process_…`). Labels never contain what a client sent, such as names, addresses or tokens. [Detect
attacks](../how-to/see-attacks.md) describes which metrics show an attack.

"""
    return NOTE + text + _table(("metric", "type", "labels", "meaning"), rows)


def traces_page() -> str:
    """Return the page of the spans of traces, and of their attributes."""
    text = """# Traces

With the extra `traces`, Marey sends these spans to a collector; see [Trace requests and
jobs](../how-to/trace-requests.md). Names of spans contain methods, patterns of addresses and names of commands. Neither
they nor attributes contain names of projects, items, files or users, tokens, or parameters of SQL statements. Only
`marey.request_id` may be a text from the client: the id that it has chosen for the request.

"""
    spans = [
        (f"`{one.name}`", one.maker, one.kind, one.meaning, ", ".join(f"`{name}`" for name in one.attributes))
        for one in SPANS
    ]
    text += _table(("span", "made by", "kind", "meaning", "attributes"), spans)
    attributes = [(f"`{name}`", meaning) for name, meaning in ATTRIBUTES.items()]
    return NOTE + text + "## Attributes\n\n" + _table(("attribute", "meaning"), attributes).rstrip() + "\n"


def settings_page() -> str:
    """Return the page of all settings of a server."""
    rows = [(name, f"`MAREY_{name.strip('`').upper()}`", *rest) for name, *rest in _fields_of(Settings)]
    return (
        NOTE
        + "# Settings\n\nIf a setting is given in several places, the first of these counts: the option of "
        "`marey serve`, the environment variable, the file `marey.toml`, the default.\n\n"
        + _table(("setting", "variable", "default", "meaning"), rows)
        + "## Pools\n\nEach entry of `pools` has these settings, in `marey.toml` below a line `[[pools]]`, in "
        "`MAREY_POOLS` as a list of JSON objects. [Run workers on Slurm](../how-to/run-workers-on-slurm.md) and "
        "[Run Marey on Kubernetes](../how-to/run-on-kubernetes.md) have examples.\n\n"
        + _table(("setting", "default", "meaning"), _fields_of(WorkerPool))
        + "## Own pods\n\nThe setting `own_pods` has these members, in `marey.toml` below a line `[own_pods]`, in "
        "`MAREY_OWN_PODS` as a JSON object.\n\n"
        + _table(("setting", "default", "meaning"), _fields_of(OwnPods))
        + "".join(
            f"## Options of the launcher {name}\n\nIn `launcher_options` for all pools, and in `options` of a pool.\n\n"
            + _table(("option", "default", "meaning"), _fields_of(options))
            for name, options in (("kubernetes", ClusterOptions), ("slurm", SlurmOptions))
        )
    )  # fmt: skip


def _fields_of(model: type[BaseModel]) -> list[tuple[str, str, str]]:
    """Return name, default and description of each field of a model."""
    return [
        (
            f"`{name}`",
            "" if field.default in (None, PydanticUndefined) else f"`{field.default}`",
            field.description or "",
        )
        for name, field in model.model_fields.items()
    ]


def job_kinds_page() -> str:
    """Return the page of all built-in job kinds."""
    text = "# Job kinds\n\nA running server returns this list, with full JSON Schemas, at `/api/v1/job-kinds`.\n\n"
    for kind in job_kinds().values():
        text += f"## {kind.name}\n\n{kind.description}\n\n"
        inputs = [(f"`{name}`", _input(spec), spec.description) for name, spec in kind.inputs.items()]
        text += _table(("input", "takes", "meaning"), inputs) if inputs else ""
        schema = kind.params.model_json_schema()
        text += _table(("parameter", "type", "meaning"), list(_properties(schema, schema.get("$defs", {}))))
        if kind.facets:
            facets = [(f"`{FACET_PREFIX}{name}`", meaning) for name, meaning in kind.facets.items()]
            text += "Facets of its inputs, which [queries](queries.md) compare:\n\n" + _table(
                ("facet", "meaning"), facets
            )
        if kind.name == "evaluate":
            metrics = [(f"`{name}`", metric.meaning) for name, metric in HEADLINE_METRICS.items()]
            text += "Metrics of the result, as `marey dataset bisect --metric` names them:\n\n"
            text += _table(("metric", "meaning"), metrics)
    return NOTE + text.rstrip() + "\n"


def _properties(schema: dict[str, Any], known: dict[str, Any], within: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield name, type and meaning of each parameter; members of an object parameter are named `object.member`."""
    for name, each in schema["properties"].items():
        inner = known.get(str(each.get("$ref", "")).rpartition("/")[2])
        if inner is not None and "properties" in inner:
            yield from _properties(inner, known, f"{within}{name}.")
        else:
            yield f"`{within}{name}`", _type(each), each.get("description", "")


def _input(spec: Any) -> str:
    return f"{'many ' if spec.many else 'one '}{spec.kind.plural if spec.many else spec.kind.value}"


def _type(schema: dict[str, Any]) -> str:
    if "anyOf" in schema:
        return " or ".join(_type(each) for each in schema["anyOf"] if each.get("type") != "null")
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    return str(schema.get("type", schema.get("$ref", "").rpartition("/")[2]))


def checks_page() -> str:
    """Return the page of all warnings that an import may give."""
    text = (
        "# Import checks\n\nA file is imported even if these checks give warnings. `marey show` lists the warnings of "
        "a clip with joints and frames.\n\n"
    )
    return NOTE + text + _table(("code", "meaning"), [(f"`{code}`", meaning) for code, meaning in checks.CODES.items()])


def errors_page() -> str:
    """Return the page of all error codes of the REST API."""
    text = (
        "# Errors\n\nErrors are sent as `application/problem+json` (RFC 9457). The member `code` does not change "
        "between versions. `instance` is the id of the request; quote it when you ask for help. `errors` lists the "
        "wrong fields of the request.\n\nIn the table, … is a text that differs from case to case.\n\n"
    )
    classes = {one.__name__: one for one in _subclasses(errors.ApiProblem)}
    found = {(one.code, one.status): one.__doc__.strip().splitlines()[0] for one in classes.values() if one.__doc__}
    for code, name, detail in _raised(classes):
        found.setdefault((code, classes[name].status), detail)
    rows = [
        (f"`{code}`", str(status), says)
        for (code, status), says in sorted(found.items(), key=lambda each: each[0][::-1])
    ]
    return NOTE + text + _table(("code", "status", "message"), rows)


def _subclasses(base: type[errors.ApiProblem]) -> Iterator[type[errors.ApiProblem]]:
    yield base
    for each in base.__subclasses__():
        yield from _subclasses(each)


def _raised(classes: dict[str, type[errors.ApiProblem]]) -> Iterator[tuple[str, str, str]]:
    """Yield code, class name and message of each error that the server creates with an explicit `code`."""
    for file in sorted((ROOT / "server").rglob("*.py")):
        texts = _constants_of(file)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in classes):
                continue
            codes = [_spoken(each.value, texts) for each in node.keywords if each.arg == "code"]
            if codes and UNKNOWN not in codes[0] and node.args:
                yield codes[0], node.func.id, _spoken(node.args[0], texts)


def _constants_of(file: Path) -> dict[str, str]:
    """Return the constant texts that a loaded module of the server defines or imports, by name."""
    module = sys.modules.get(".".join(file.relative_to(ROOT / "server").with_suffix("").parts))
    return {
        name: text
        for name, text in ({} if module is None else vars(module)).items()
        if name.isupper() and isinstance(text, str)
    }


def _spoken(node: ast.expr, texts: Mapping[str, str]) -> str:
    """Return the text that an expression gives, with … in place of values that are known only at run time.

    `texts` contains constants by name.
    """
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.Name):
        return texts.get(node.id, UNKNOWN)
    if isinstance(node, ast.FormattedValue):
        return _spoken(node.value, texts)
    if isinstance(node, ast.JoinedStr):
        return "".join(_spoken(each, texts) for each in node.values)
    return UNKNOWN


def _table(heads: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    if not rows:
        return ""
    lines = [heads, tuple("---" for _ in heads), *rows]
    return "".join(f"| {' | '.join(_cell(cell) for cell in line)} |\n" for line in lines) + "\n"


def _cell(text: object) -> str:
    return " ".join(str(text or "").split()).replace("|", "\\|")


def pool_manifest() -> str:
    """Return the Deployment of a fixed number of workers, whose pods are like those that the launcher starts."""
    image = f"marey-worker@sha256:{'0' * 64}"
    pool = Pool("pool", "http://marey:8460", ClusterOptions(image=image))
    deployment = pool_deployment(pool, replicas=2, secret="marey-worker-token")  # noqa: S106 - the name of a Secret
    (container,) = deployment["spec"]["template"]["spec"]["containers"]
    container["image"] = "marey-worker"  # the overlays replace this name
    note = "# Written by `make docs` from server/marey_server/launchers/kubernetes/manifests.py; change it there.\n"
    text: str = yaml.dump(deployment, Dumper=_Dumper, sort_keys=False)
    return note + text


class _Dumper(yaml.SafeDumper):  # PyYAML has no types
    """Writer of YAML that repeats equal values, so that each is read where it is used."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002 - the signature of PyYAML
        return True


def files() -> dict[Path, str]:
    """Return the text of every generated file, by its path."""
    return {
        **{REFERENCE / name: text for name, text in pages().items()},
        **{KEYWORDS / name: text for name, text in keyword_modules().items()},
        **async_modules(),
        POOL_MANIFEST: pool_manifest(),
    }


def main() -> int:
    """Write the files that are out of date; with `--check`, only name these files, and return 1 if there are any."""
    stale = {file: text for file, text in files().items() if not _is(file, text)}
    for file, text in stale.items():
        name = file.relative_to(ROOT)
        if "--check" in sys.argv[1:]:
            sys.stderr.write(f"{name} is out of date; run `make docs`\n")
        else:
            file.write_text(text, encoding="utf-8")
            sys.stdout.write(f"wrote {name}\n")
    return int(bool(stale) and "--check" in sys.argv[1:])


def _is(file: Path, text: str) -> bool:
    return file.is_file() and file.read_text(encoding="utf-8") == text


if __name__ == "__main__":
    sys.exit(main())
