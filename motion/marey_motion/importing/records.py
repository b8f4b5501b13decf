"""Import of records of work with the predecessor, the system that Marey replaces.

The file is kept, and its fields are shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_motion.formats.predecessor.records import fields_of_record
from marey_motion.importing.items import FileToImport, ImportedFile, Tree, main_item
from marey_schemas.documents.originals import original_of
from marey_schemas.documents.predecessor_records import RecordForm
from marey_schemas.kinds import Kind

SCHEMA = "marey/predecessor-record@1"
_FEW = 5


def import_record(file: FileToImport, document: Mapping[str, Any]) -> ImportedFile:
    """Make the item of a record.

    Parameters
    ----------
    file : FileToImport    the file
    document : mapping    the form of the record, and its decoded content

    Returns
    -------
    ImportedFile    the item, with a warning if the file contains credentials
    """
    form: RecordForm = document["form"]
    fields = fields_of_record(document["content"])
    record: Tree = {"schema": SCHEMA, "form": form, "fields": dict(fields.shown), "fields_left_out": fields.left_out}
    record["original"] = original_of("record", record, file.planned.name, file.digest)
    item = main_item(file, Kind.RECORD, file.planned.item_name, {"record": record})
    return ImportedFile(file.planned.name, (item,), _checks(fields.credentials))


def _checks(credentials: tuple[str, ...]) -> tuple[Tree, ...]:
    if not credentials:
        return ()
    named = ", ".join(credentials[:_FEW]) + (" and more" if len(credentials) > _FEW else "")
    message = (
        f"the file contains credentials ({named}); they are not shown, but everybody who may read the project can "
        "download the file: revoke them, or remove them from the file before you import it"
    )
    return ({"code": "credentials-in-file", "message": message},)
