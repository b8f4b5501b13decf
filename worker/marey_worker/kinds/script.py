"""Kind `script`: runs a command of a pinned Git commit on files, and publishes the files that it writes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from marey_motion.errors import MotionError
from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport
from marey_motion.importing.plan import plan_imports
from marey_schemas.documents.reports import StoredFile
from marey_schemas.formats import DEFAULT_UNIT
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions
from marey_schemas.processes.environment import clean_environment, thread_limits
from marey_schemas.queue.comparisons import Curves
from marey_schemas.queue.own_pods import IMAGE_VARIABLE
from marey_schemas.queue.scripts import PYTHON, ScriptDeclaration, ScriptLimits, ScriptParams
from marey_schemas.queue.worker_protocol import StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.staged_results import StagedResults
from marey_worker.scripts.checkout import check_out
from marey_worker.scripts.confinement import landlock_version
from marey_worker.scripts.fields import LoggedFields, read_fields
from marey_worker.scripts.files import OUTPUTS, collect, output_path, write_inputs
from marey_worker.scripts.guard import CommandEnd, GuardedCommand

CODE = "code"
"""Folder of the commit, below the folder of a run."""
LAST_LINES = 10
NOT_ISOLATED = (
    "this system allows no namespaces with mounts, so that the script could change modes and times of files of the "
    "worker's user"
)
NOT_BOUNDED = (
    "the kernel of this system does not limit the number of the script's processes, which only its guard counts; run "
    "the worker as an ordinary user, and allow namespaces"
)
GUARD_MODULE = "marey_worker.scripts.guard"


def run(context: Context, params: ScriptParams) -> dict[str, Any]:
    """Run a script, and store its outputs; the result contains the logged fields, and refers to the files.

    Clips that the script has written are imported. Raises `JobRefused` if the script fails, exceeds a limit, or does
    not write the outputs that it declares.
    """
    declared = params.declaration
    if declared is None:
        raise JobRefused(
            "no-declaration", "the job has no declaration of its script; update the server, and submit the job again"
        )
    if declared.image is not None and declared.image != os.environ.get(IMAGE_VARIABLE):
        raise JobRefused(
            "wrong-image",
            f"the script needs the image {declared.image}, but this worker runs in another image; start a worker in "
            "the needed image",
        )
    if landlock_version() == 0:
        raise JobRefused(
            "no-confinement", "this worker cannot confine scripts: run the worker on Linux 5.13 or later with Landlock"
        )
    folder = Path(tempfile.mkdtemp(prefix="run-", dir=context.scratch))
    for below in (CODE, OUTPUTS, "tmp"):
        (folder / below).mkdir()
    context.progress(0, 3, "fetching the commit")
    check_out(declared, folder / CODE, os.environ)
    _require_program(declared, folder / CODE)
    paths, ended = write_inputs(context, declared, folder, allow_expired_consent=params.allow_expired_consent)
    context.progress(1, 3, "running the script")
    end = _run_guarded(_order(context, params, declared, folder, paths))
    context.log(_words_of(end))
    if end.stopped is not None or end.status != 0:
        raise JobRefused("script-failed" if end.stopped is None else "script-limit", _failure(end))
    context.progress(2, 3, "storing the results")
    return {"script": params.script, **_publish(context, params, declared, folder), "consent_ended": ended}


def examine() -> tuple[str, str, str]:
    """Check whether this machine can run scripts, by a script that does nothing.

    Return the name of the check, its state (ok, warning or fault), and a detail.
    """
    if landlock_version() == 0:
        return "scripts", "fault", "this machine cannot confine scripts: they need Linux 5.13 with Landlock"
    with tempfile.TemporaryDirectory(prefix="marey-doctor-") as folder:
        limits = ScriptLimits().model_dump()
        end = _run_guarded(GuardedCommand((sys.executable, "-c", "pass"), folder, {}, **limits))
    if end.status != 0:
        return "scripts", "fault", _failure(end)
    missing = _missing(end)
    return "scripts", "warning" if missing else "ok", "; ".join(missing) or "confined, with all limits"


def _require_program(declared: ScriptDeclaration, code: Path) -> None:
    program = code / declared.program
    if not program.resolve().is_relative_to(code.resolve()) or not program.is_file():
        detail = f"the commit {declared.commit} has no file {declared.program}, which the script is to run"
        raise JobRefused("no-program", detail)


def _order(
    context: Context, params: ScriptParams, declared: ScriptDeclaration, folder: Path, inputs: dict[str, str]
) -> GuardedCommand:
    """Return the command of the script, with its limits and its whole environment."""
    paths = {("input", name): path for name, path in inputs.items()}
    paths |= {("output", name): output_path(name, one) for name, one in declared.outputs.items()}
    first, *rest = declared.words(paths, declared.values_of(params.values))
    argv = [sys.executable, f"{CODE}/{rest[0]}", *rest[1:]] if first == PYTHON else [f"{CODE}/{first[2:]}", *rest]
    environment = {
        "PATH": f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin",
        "HOME": str(folder / "tmp"),
        "TMPDIR": str(folder / "tmp"),
        "LANG": "C.UTF-8",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONUNBUFFERED": "1",
        "MAREY_SEED": str(context.seed),
        **thread_limits(context.threads),
    }
    limits = declared.limits.model_dump()
    return GuardedCommand(argv=tuple(argv), folder=str(folder), environment=environment, **limits)


def _run_guarded(order: GuardedCommand) -> CommandEnd:
    read_end, write_end = os.pipe()
    try:
        guard = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [sys.executable, "-m", GUARD_MODULE, str(write_end)],
            stdin=subprocess.PIPE,
            pass_fds=[write_end],
            env=clean_environment(),
            text=True,
        )
    finally:
        os.close(write_end)
    with os.fdopen(read_end) as result:
        guard.communicate(json.dumps(asdict(order)))
        said = result.read()
    if guard.returncode != 0 or not said:
        raise RuntimeError(f"the guard of the script ended with status {guard.returncode}; the job's log says why")
    return CommandEnd(**json.loads(said))


def _words_of(end: CommandEnd) -> str:
    how = f"exit status {end.status}" if end.stopped is None else f"stopped: {end.stopped}"
    return "; ".join([how, *_missing(end)])


def _missing(end: CommandEnd) -> list[str]:
    """Return the protections and limits that this system did not provide, as texts."""
    return [*([] if end.isolated else [NOT_ISOLATED]), *([] if end.bounded else [NOT_BOUNDED])]


def _failure(end: CommandEnd) -> str:
    what = f"the script ended with exit status {end.status}" if end.stopped is None else f"stopped: {end.stopped}"
    last = "\n".join(end.tail.splitlines()[-LAST_LINES:])
    return f"{what}; its last output:\n{last}" if last else f"{what}; it printed nothing"


# -- results --


def _publish(context: Context, params: ScriptParams, declared: ScriptDeclaration, folder: Path) -> dict[str, Any]:
    """Store the outputs of a script that has ended; return the members of the job's result about them."""
    files: dict[str, Any] = {}
    logged = LoggedFields({}, {})
    results = StagedResults(context)
    for name, path in collect(declared, folder, context.scratch / "collected").items():
        kind = declared.outputs[name].kind
        if kind == "fields":
            logged = read_fields(name, declared.outputs[name], path)
        if kind == "clip":
            _stage_clip(context, params, results, name, path)
        else:
            files[name] = _stored(context, path)
    results.flush()
    values = declared.values_of(params.values)
    result = {"values": values, "fields": logged.fields, "files": files}
    if logged.curves:
        path = context.scratch / "curves.json"
        path.write_text(Curves(curves=logged.curves).model_dump_json())
        result["curves"] = _stored(context, path)
    return {**result, "commit": declared.commit, "items": results.count}


def _stored(context: Context, path: Path) -> dict[str, Any]:
    stored = StoredFile(blob=context.put_file(path), size_bytes=path.stat().st_size)
    return stored.model_dump(mode="json")


def _stage_clip(context: Context, params: ScriptParams, results: StagedResults, name: str, path: Path) -> None:
    """Import a clip that the script has written. Raises `JobRefused` if the file cannot be imported."""
    (planned,) = plan_imports([path.name])
    digest = context.put_file(path)
    options = ImportOptions(unit=DEFAULT_UNIT)
    try:
        found = import_file(FileToImport(planned, path.read_bytes(), digest, options))
    except MotionError as error:
        raise JobRefused("bad-clip", f"the output {name!r} cannot be imported: {error}") from error
    if found.refusal is not None:
        raise JobRefused("bad-clip", f"the output {name!r} cannot be imported: {found.refusal.detail}")
    for item in found.items:
        results.add(
            StagedOutput(
                name=item.name,
                kind=item.kind,
                item_name=f"{params.script}-{name}" if item.kind is Kind.CLIP else item.item_name,
                collection=item.collection,
                parts=dict(item.parts),
                reuse=item.reuse,
            )
        )
