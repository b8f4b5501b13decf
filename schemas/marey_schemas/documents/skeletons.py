"""Skeletons: the hierarchy of joints, and their mapping to standard joints.

Lengths are in metres. Quaternions are w,x,y,z. Axes are right-handed with Y up (docs/explanation/conventions.md).
"""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.originals import StoredOriginal
from marey_schemas.documents.references import OutputRef as OutputRef
from marey_schemas.documents.references import RevisionRef as RevisionRef
from marey_schemas.names import JointName

MAX_JOINTS = 4096
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
MappingMethod = Literal["names", "geometry", "manual"]


class Joint(Request):
    """Joint of a skeleton: its name, its parent, and its rest pose."""

    name: JointName
    parent: int = Field(ge=-1, description="Index of the parent, smaller than the joint's own; -1 for the root.")
    offset: Vector3 = Field(description="Position in the parent's rest frame, metres.")
    rest_rotation: Quaternion = Field(
        (1.0, 0.0, 0.0, 0.0), description="Local rest rotation as a unit quaternion w,x,y,z."
    )
    display_name: str | None = Field(None, description="Name in the imported file if it differs from `name`.")


class EndSiteDocument(Request):
    """End site of a joint, such as a fingertip: a point without a rotation of its own."""

    joint: int = Field(ge=0)
    offset: Vector3


class SkeletonHierarchy(Request):
    """Part `hierarchy` of a skeleton: joints with parents before children."""

    schema_: Literal["marey/skeleton@1"] = Field("marey/skeleton@1", alias="schema")
    joints: tuple[Joint, ...] = Field(min_length=1, max_length=MAX_JOINTS)
    end_sites: tuple[EndSiteDocument, ...] = Field((), max_length=4 * MAX_JOINTS)

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        seen: set[str] = set()
        for index, joint in enumerate(self.joints):
            if joint.name in seen:
                raise ValueError(
                    f"joints[{index}]: another joint has the name {joint.name!r}, too; give each joint its own name"
                )
            seen.add(joint.name)
            if (joint.parent == -1) != (index == 0) or joint.parent >= index:
                place = f"joints[{index}] ({joint.name})"
                raise ValueError(f"{place}: parent {joint.parent} must come before the joint; only joint 0 is the root")
        for index, site in enumerate(self.end_sites):
            if site.joint >= len(self.joints):
                raise ValueError(f"end_sites[{index}]: the skeleton has no joint with the index {site.joint}")
        return self


class JointAxesDocument(Request):
    """Anatomical axes of a joint in its own local frame: `twist` along the bone, `swing` orthogonal to it."""

    twist: Vector3
    swing: Vector3


class PredecessorSkeletonOrigin(Request):
    """Files of Marey's predecessor that a skeleton was imported from."""

    skeleton: StoredOriginal | None = Field(
        None, description="The file of the hierarchy; absent if it was not imported."
    )
    model: StoredOriginal | None = Field(
        None, description="The file of the skeleton model (joint mapping and axes); absent if it was not imported."
    )
    rest: dict[str, Any] = Field(
        default_factory=dict,
        description="Members of the skeleton model that have no counterpart here, such as limits of joints.",
    )


class SkeletonMapping(Request):
    """Part `mapping` of a skeleton, which users can edit: the joint for each standard joint, and the axes of joints."""

    schema_: Literal["marey/skeleton-mapping@1"] = Field("marey/skeleton-mapping@1", alias="schema")
    rig: str | None = Field(
        None, description="Name of the known rig whose joint names were recognised; absent: none was."
    )
    method: MappingMethod = "manual"
    confidence: float = Field(1.0, ge=0.0, le=1.0)
    joints: dict[str, JointName] = Field(
        default_factory=dict, description="Name of the skeleton's joint, by the name of the standard joint."
    )
    axes: dict[JointName, JointAxesDocument] = Field(default_factory=dict)
    notes: tuple[str, ...] = ()
    predecessor: PredecessorSkeletonOrigin | None = None
