"""Jobs that edit clips."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from marey_client.edits import Commands, EditHandle, as_edit
from marey_client.evaluations import Places, as_input, as_places, items_at
from marey_schemas.job_params import EditParams
from marey_schemas.jobs import ItemInput, JobCreate

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle


def edit_request(project: ProjectHandle, clips: Places, commands: Commands, **options: Any) -> JobCreate:
    """The job that edits clips, with the clips that the commands name, by the skeletons' mappings as they are now.

    `options` are those of `EditParams`.
    """
    places = as_places(clips)
    inputs: dict[str, Any] = {"clips": tuple(map(as_input, places))}
    if isinstance(commands, EditHandle):
        edit = commands.document(revision=commands.item.revision)
        inputs["edit"] = commands.as_input()
        params = EditParams.model_validate(options)
    else:
        edit = as_edit(commands)
        params = EditParams.model_validate({**options, "commands": edit.commands})
    if edit.sources:
        inputs["sources"] = tuple(ItemInput(item=item) for item in edit.sources)
    if edited := project.edited_rigs(item for place in places for item in items_at(project, place)):
        inputs["rigs"] = edited
    return JobCreate(kind="edit", inputs=inputs, params=params.model_dump(mode="json", exclude_unset=True))
