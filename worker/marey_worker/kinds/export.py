"""Kind `export`: writes clips as files of one format to an archive."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from typing import Any, NamedTuple

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.exporting import write_motion_file
from marey_motion.skeleton import Skeleton
from marey_schemas.consents import CONSENT_EXPIRED, CONSENT_REMEDY
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.reports import StoredFile
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.formats import ZIP_EPOCH
from marey_schemas.item_files import ItemToExport, item_as_json, original_of_clip
from marey_schemas.kinds import Kind
from marey_schemas.options.exporting import MotionFileOptions
from marey_schemas.queue.job_params import ExportParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_schemas.wording import counted
from marey_worker.context import Context, JobRefused, Unreadable
from marey_worker.job_io.refusals import present

READABLE_BY_ALL = 0o644 << 16


class _File(NamedTuple):
    name: str
    data: bytes


def run(context: Context, params: ExportParams) -> dict[str, Any]:
    """Write the clips of the job to an archive; the result refers to the archive, and lists clips that were refused.

    Clips whose consent has ended are written only if the parameters of the job allow it; the result lists these clips,
    too. Raises `JobRefused` if no clip can be written.
    """
    exporting = ClipFiles(context, params)
    archive = context.scratch / "archive.zip"
    written: set[str] = set()
    given = sorted(context.inputs["clips"], key=lambda pin: (pin.collection, pin.name, pin.item))
    ended = [pin for pin in given if pin.consent_ended is not None]
    barred = set() if params.allow_expired_consent else {pin.item for pin in ended}
    pins = [pin for pin in given if pin.item not in barred]
    refused = [_refusal(pin, CONSENT_EXPIRED, _end_of_consent(pin)) for pin in ended if pin.item in barred]
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as target:
        parts = ("info",) if params.format == "original" else ("info", "motion")
        for done, (pin, (info, *motion)) in enumerate(context.documents_of_each(pins, *parts)):
            context.progress(done, len(pins), f"writing {pin.name}")
            try:
                file = exporting.file_of(pin, info or {}, *motion)
            except (MotionError, Unreadable) as error:
                refused.append(_refusal(pin, error.code, str(error)))
                continue
            name = _free_name(pin, file.name, written)
            written.add(name)
            target.writestr(_entry(name), file.data)
    if not written:
        what = f"none of {counted(len(given), 'clip')} can be exported in the format {params.format}"
        raise JobRefused("nothing-to-export", f"{what}; {refused[0]['name']}: {refused[0]['detail']}")
    size = archive.stat().st_size
    stored = StoredFile(blob=context.put_file(archive), size_bytes=size)
    return {
        "archive": stored.model_dump(mode="json"),
        "clips": len(written),
        "refused": refused,
        "consent_ended": sorted({pin.item for pin in ended}),
    }


class ClipFiles:
    """Converter of clips to files of one format; each skeleton is read only once."""

    def __init__(self, context: Context, params: ExportParams) -> None:
        self._context = context
        self._params = params
        self._skeletons: dict[RevisionRef, tuple[Skeleton, dict[str, Any]]] = {}

    def file_of(self, pin: PinnedInput, info: dict[str, Any], tree: Any = None) -> _File:
        """Return a clip as a file in the requested format.

        `info` and `tree` are the parts `info` and `motion` of the clip; the format "original" does not need `tree`.
        Raises `MotionError` or `Unreadable` if the clip has no file in this format.
        """
        if self._params.format == "original":
            return self._original(pin, info)
        ref = RevisionRef.model_validate(present(pin, tree)["skeleton"])
        skeleton, hierarchy = self._skeleton(ref)
        parts = {"motion": tree, **({"info": info} if info else {})}
        source = ItemToExport(pin.item, pin.kind, pin.name, pin.collection, pin.revision, parts, hierarchy)
        if self._params.format == "json":
            return _File(f"{_place(pin)}.json", item_as_json(source))
        written = write_motion_file(source, MotionFileOptions.of(self._params), skeleton=skeleton)
        return _File(_place(pin) + written.suffix, written.data)

    def _original(self, pin: PinnedInput, info: dict[str, Any]) -> _File:
        original = original_of_clip(pin.item, info)
        if original is None:
            raise MotionError(
                "the clip was not imported from a file, so it has no original file to export", code="no-original"
            )
        ending = original.name.rpartition(".")[2] if "." in original.name else ""
        return _File(f"{_place(pin)}.{ending}" if ending else _place(pin), self._context.blob(original.digest))

    def _skeleton(self, ref: RevisionRef) -> tuple[Skeleton, dict[str, Any]]:
        if ref not in self._skeletons:
            hierarchy = self._context.document(Kind.SKELETON, ref.item, ref.revision, "hierarchy")
            skeleton = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
            self._skeletons[ref] = skeleton, hierarchy
        return self._skeletons[ref]


def _refusal(pin: PinnedInput, code: str, detail: str) -> dict[str, Any]:
    return {"name": _place(pin), "item": pin.item, "code": code, "detail": detail}


def _end_of_consent(pin: PinnedInput) -> str:
    return f"the consent for the clip ended on {pin.consent_ended}. {CONSENT_REMEDY}"


def _place(pin: PinnedInput) -> str:
    """Return the path of a clip in the archive; it never leads out of the folder in which the archive is extracted."""
    parts = [part for part in (*pin.collection.split("/"), pin.name) if part not in ("", ".", "..")]
    return "/".join(part.replace("\\", "_") for part in parts)


def _free_name(pin: PinnedInput, name: str, taken: Collection[str]) -> str:
    """Return a name that is not in `taken`: `name`, or a name with the item's id, or with id and revision."""
    file = name.rpartition("/")[2]
    candidates = (name, f"{pin.item}-{file}", f"{pin.item}-{pin.revision}-{file}")
    return next(one for one in candidates if one not in taken)


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, ZIP_EPOCH)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.create_system = 3  # Unix, whatever this machine is
    entry.external_attr = READABLE_BY_ALL
    return entry
