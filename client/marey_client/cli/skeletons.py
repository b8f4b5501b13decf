"""Commands `skeleton map`, `skeleton axes` and `skeleton merge`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated

import typer

from marey_client.cli.addresses import Address, addresses_in_one_project, require_item
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message, print_table

skeleton = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Edit the joint mapping and the joint axes of skeletons, and merge skeletons.",
)


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(skeleton, name="skeleton")


@skeleton.command("map")
def map_joints(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="The skeleton: project/folder/name, or project/id.")],
    assignments: Annotated[
        list[str] | None,
        typer.Argument(
            help="Mapping of a joint: standard_joint=JointName to set it, standard_joint= to clear "
            "it. Default: show the mapping."
        ),
    ] = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="Confirm the recognised mapping, even if it was uncertain.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the mapping of standard joints to joints, or change it; a change creates a new revision."""
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        found = require_item(marey, Address.parse(place), [Kind.SKELETON])
        mapping = found.mapping()
        if assignments or confirm:
            known = {joint.name for joint in found.hierarchy().joints}
            joints = {**mapping.joints, **_assigned(assignments or [], known, mapping.joints)}
            chosen = {standard: joint for standard, joint in joints.items() if joint}
            changed = mapping.model_copy(update={"joints": chosen, "method": "manual", "confidence": 1.0})
            if changed == mapping or (chosen == mapping.joints and not confirm):
                print_message(f"{place}: nothing changes")
            else:
                mapping = changed
                print_message(f"{place}: revision {found.put_mapping(mapping).revision}")
    if as_json:
        return print_json(mapping)
    rig = mapping.rig or "no known rig"
    print_message(f"{rig}; found by {mapping.method}, confidence {mapping.confidence:.2f}")
    return print_table(("standard joint", "joint"), sorted(mapping.joints.items()))


@skeleton.command("axes")
def joint_axes(
    context: typer.Context,
    place: Annotated[str, typer.Argument(help="The skeleton: project/folder/name, or project/id.")],
    joint: Annotated[str | None, typer.Argument(help="The joint to change; default: show all joints.")] = None,
    twist: Annotated[
        str | None, typer.Option(help="New axis along the bone, in the joint's frame: x,y,z. Default: unchanged.")
    ] = None,
    swing: Annotated[
        str | None,
        typer.Option(help="New swing axis, orthogonal to the bone, in the joint's frame: x,y,z. Default: unchanged."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the twist and swing axes of joints, or change the axes of one joint."""
    from marey_schemas.documents.skeletons import JointAxesDocument
    from marey_schemas.kinds import Kind

    with connect(context) as marey:
        found = require_item(marey, Address.parse(place), [Kind.SKELETON])
        mapping = found.mapping()
        if joint is not None and joint not in mapping.axes:
            _require_joint(joint, {one.name for one in found.hierarchy().joints})
        if twist or swing:
            if joint is None:
                raise WrongUsage("name the joint whose axes `--twist` or `--swing` changes")
            old = mapping.axes.get(joint)
            new_twist = _vector(twist) or (old and old.twist)
            new_swing = _vector(swing) or (old and old.swing)
            if new_twist is None or new_swing is None:
                raise WrongUsage(f"the joint {joint!r} has no axes yet; give it both `--twist` and `--swing`")
            new = JointAxesDocument(twist=new_twist, swing=new_swing)
            mapping = mapping.model_copy(update={"axes": {**mapping.axes, joint: new}, "method": "manual"})
            item = found.put_mapping(mapping)
            print_message(f"{place}: revision {item.revision}")
    shown = {name: axes for name, axes in mapping.axes.items() if joint in (None, name)}
    if as_json:
        return print_json(shown)
    rows = [(name, _text(axes.twist), _text(axes.swing)) for name, axes in shown.items()]
    return print_table(("joint", "twist", "swing"), rows)


@skeleton.command("merge")
def merge(
    context: typer.Context,
    places: Annotated[
        list[str],
        typer.Argument(help="A project, or several skeletons of one rig: project/folder/name, or project/id."),
    ],
    keep: Annotated[
        str | None,
        typer.Option(
            help="The skeleton that remains: project/folder/name, or project/id. Default: "
            "for each rig, a skeleton with an edited joint mapping, else the most used "
            "one."
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be merged, and change nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Merge skeletons of one rig, for example if an earlier version created a skeleton for each take.

    Skeletons are of one rig if they differ only in the offset of the root, in offsets that motions replace by
    translations, or by rounding. Clips and models get a new revision with the remaining skeleton and the same motion;
    the other skeletons are deleted.
    """
    from marey_schemas.kinds import Kind

    addresses = addresses_in_one_project([*places, *([keep] if keep else ())])
    if len(places) > 1 and any(not one.path for one in addresses):
        raise WrongUsage("name either a project or skeletons in it, not both")
    with connect(context) as marey:
        project = marey.project(addresses[0].project)
        found = [require_item(marey, one, [Kind.SKELETON]) for one in addresses if one.path]
        if addresses[0].path and len({one.id for one in found}) == 1:
            raise WrongUsage(
                f"{places[0]} alone has nothing to be merged with; name the other skeletons of the rig, too, or merge "
                f"all of them into this one: marey skeleton merge {addresses[0].project} --keep {places[0]}"
            )
        kept = found.pop() if keep else None
        answer = project.merge_skeletons(found, keep=kept, dry_run=dry_run)
    if as_json:
        return print_json(answer)
    for rig in answer.rigs:
        for one in rig.merged:
            moved = ", ".join(f"{n} {kind if n == 1 else Kind(kind).plural}" for kind, n in sorted(one.moved.items()))
            done = "would be merged" if answer.dry_run else "merged"
            print_message(f"{one.path} {done} into {rig.kept.path}; {moved or 'nothing used it'}")
    if not answer.rigs:
        print_message("no skeletons of one rig; nothing to merge")
    return None


def _assigned(assignments: list[str], known: set[str], mapped: Mapping[str, str]) -> dict[str, str]:
    """Parse texts such as `hips=Pelvis`; return the joint by standard joint, an empty text to clear the mapping.

    A name in `mapped` can be cleared even if it is not a standard joint.
    """
    from marey_schemas.documents.standard_joints import STANDARD_JOINTS

    given: dict[str, str] = {}
    for assignment in assignments:
        standard, equals, joint = assignment.partition("=")
        if not equals or not standard:
            raise WrongUsage(f"{assignment!r} does not map a joint; write standard_joint=JointName")
        if standard not in STANDARD_JOINTS and (joint or standard not in mapped):
            raise WrongUsage(f"{standard!r} is not a standard joint{_nearest(standard, STANDARD_JOINTS)}")
        if joint:
            _require_joint(joint, known)
        given[standard] = joint
    return given


def _require_joint(joint: str, known: set[str]) -> None:
    """Raise `WrongUsage`, with the most similar joints, if `known` does not contain `joint`."""
    if joint not in known:
        raise WrongUsage(f"{joint!r} is not a joint of this skeleton{_nearest(joint, sorted(known))}")


def _nearest(name: str, names: Sequence[str]) -> str:
    """Return the end of an error text about a wrong name: the most similar valid names, otherwise the first few."""
    similar = get_close_matches(name, names, n=3)
    if similar:
        return f"; did you mean {' or '.join(similar)}?"
    return f"; it must be one of {', '.join(names[:8])}" + (", ..." if len(names) > 8 else "")


def _vector(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, z = (float(number) for number in text.split(","))
    except ValueError:
        raise WrongUsage(f"{text!r}: an axis is three numbers, x,y,z") from None
    length = (x * x + y * y + z * z) ** 0.5
    if not 0 < length < float("inf"):
        raise WrongUsage(f"{text!r}: the numbers of an axis must be finite, and at least one must not be zero")
    return x / length, y / length, z / length


def _text(vector: tuple[float, float, float]) -> str:
    return " ".join(f"{number:+.3f}" for number in vector)
