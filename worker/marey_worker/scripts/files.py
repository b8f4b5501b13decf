"""Files that scripts read and write: inputs of the job as files, and outputs, which are not trusted."""

from __future__ import annotations

import json
import os
import shutil
import stat
from pathlib import Path
from typing import Any

from marey_motion.errors import MotionError
from marey_schemas.consents import CONSENT_EXPIRED, CONSENT_REMEDY
from marey_schemas.item_files import ItemToExport, item_as_json
from marey_schemas.kinds import PARTS, Kind
from marey_schemas.queue.job_params import ExportParams
from marey_schemas.queue.scripts import ScriptDeclaration, ScriptOutput
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.kinds.export import ClipFiles

INPUTS, OUTPUTS = "inputs", "outputs"


def write_inputs(
    context: Context, declared: ScriptDeclaration, folder: Path, *, allow_expired_consent: bool
) -> tuple[dict[str, str], list[str]]:
    """Write the inputs of a job as files to the subfolder `inputs` of a folder.

    Return the path of each input, and the ids of the clips whose consent has ended. The file `inputs.json` lists the
    items of each input with the names of their files. Raises `JobRefused` if the consent for a clip has ended and the
    job does not allow exports after that, or if a clip cannot be written in the format of its input.
    """
    paths: dict[str, str] = {}
    listed: dict[str, list[dict[str, Any]]] = {}
    ended: list[str] = []
    for name, one in declared.inputs.items():
        files = ClipFiles(context, ExportParams(format=one.format))
        listed[name] = []
        for number, pin in enumerate(context.inputs[name]):
            if pin.consent_ended is not None:
                _check_consent(pin, allowed=allow_expired_consent)
                ended.append(pin.item)
            data, ending = _content(context, files, pin)
            path = f"{INPUTS}/{name}/{number:06d}{ending}" if one.many else f"{INPUTS}/{name}{ending}"
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(data)
            listed[name].append(
                {"file": path, "item": pin.item, "revision": pin.revision, "name": pin.name, "folder": pin.collection}
            )
            paths[name] = f"{INPUTS}/{name}" if one.many else path
    (folder / "inputs.json").write_text(json.dumps(listed, indent=1))
    return paths, sorted(set(ended))


def _check_consent(pin: PinnedInput, *, allowed: bool) -> None:
    if not allowed:
        detail = f"the consent for the clip {pin.path} ended on {pin.consent_ended}. {CONSENT_REMEDY}"
        raise JobRefused(CONSENT_EXPIRED, detail)


def _content(context: Context, files: ClipFiles, pin: PinnedInput) -> tuple[bytes, str]:
    """Return an item as a file, and the ending of the file's name. Raises `JobRefused` if it cannot be written."""
    if pin.kind is not Kind.CLIP:
        ((_, found),) = context.documents_of_each([pin], *PARTS[pin.kind])
        parts = {name: one for name, one in zip(PARTS[pin.kind], found, strict=True) if one is not None}
        return item_as_json(ItemToExport(pin.item, pin.kind, pin.name, pin.collection, pin.revision, parts)), ".json"
    ((_, (info, motion)),) = context.documents_of_each([pin], "info", "motion")
    try:
        file = files.file_of(pin, info or {}, motion)
    except MotionError as error:
        raise JobRefused(error.code, f"{pin.path} cannot be written for the script: {error}") from error
    return file.data, Path(file.name).suffix


def output_path(name: str, declared: ScriptOutput) -> str:
    """Return the path of an output, relative to the folder of the run."""
    return f"{OUTPUTS}/{name}{declared.ending}"


def collect(declared: ScriptDeclaration, folder: Path, target: Path) -> dict[str, Path]:
    """Copy the outputs of a script that has ended from `folder` to `target`; return the path of each copy by output.

    Raises `JobRefused` if a required output is missing, or if an output is too large, a link, or not an ordinary file.
    Nothing below `folder` is trusted: the script may have replaced any file or folder by a link.
    """
    try:
        run = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise JobRefused(
            "unsafe-output", "the script has made its folder unreadable, so its outputs cannot be read"
        ) from error
    try:
        try:
            outputs = os.open(OUTPUTS, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=run)
        except OSError as error:
            raise JobRefused(
                "unsafe-output",
                "the script has replaced or removed the folder `outputs`; it must write its outputs into this folder",
            ) from error
        try:
            target.mkdir()
            found = {
                name: _collect_one(name, one, outputs, target / (name + one.ending))
                for name, one in declared.outputs.items()
            }
        finally:
            os.close(outputs)
    finally:
        os.close(run)
    return {name: path for name, path in found.items() if path is not None}


def _collect_one(name: str, declared: ScriptOutput, outputs: int, target: Path) -> Path | None:
    try:
        opened = os.open(name + declared.ending, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=outputs)
    except FileNotFoundError:
        if declared.required:
            file = output_path(name, declared)
            detail = f"the script has not written the required output {name!r} to the file {file}"
            raise JobRefused("no-output", detail) from None
        return None
    except OSError as error:
        raise JobRefused("unsafe-output", f"the output {name!r} is a link, or cannot be read") from error
    facts = os.fstat(opened)
    if not stat.S_ISREG(facts.st_mode) or facts.st_nlink != 1:
        os.close(opened)
        raise JobRefused("unsafe-output", f"the output {name!r} is not an ordinary file, or has several hard links")
    with os.fdopen(opened, "rb") as source:
        if facts.st_size > declared.max_bytes:
            detail = f"the output {name!r} has {facts.st_size:,} bytes; it may have at most {declared.max_bytes:,}"
            raise JobRefused("output-too-large", detail)
        with target.open("xb") as copy:
            shutil.copyfileobj(source, copy)
    return target
