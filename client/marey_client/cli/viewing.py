"""Command `view`, which shows clips in a browser or draws poses to a file, and functions for addresses of pages."""

from __future__ import annotations

import html
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote, urlencode

import typer

from marey_client.cli.addresses import addresses_in_one_project
from marey_client.cli.difference.diff import PICTURES
from marey_client.cli.revisions import RevisionNumber, at_revision, require_revision
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import connect, output_option, refuse_ignored
from marey_client.cli.terminal.output import print_message
from marey_schemas.kinds import Kind
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.items import ItemHandle
    from marey_client.marey import Marey

InBrowser = Annotated[
    bool, typer.Option("--browser", help="Open the page in a browser of this machine; default: print its address.")
]
DRAWN_KINDS = (Kind.CLIP, Kind.MODEL, Kind.EVALUATION)
PAGE_ENDING = ".html"
DEFAULT_MOMENTS = 8
DEFAULT_ROWS = 3
SOURCE = "source"
"""Value of `--beside` that means the clip from which the clip was made."""
_REDIRECT = '<!doctype html><meta charset="utf-8"><title>Marey</title><meta http-equiv="refresh" content="0;url={url}">'


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(view)


def view(
    context: typer.Context,
    place: Annotated[
        str,
        typer.Argument(
            help="The clip: project/folder/name[@revision], or project/id[@revision]. With --out also a model, to draw "
            "samples, or an evaluation, to draw its worst trials."
        ),
    ],
    beside: Annotated[
        str | None,
        typer.Option(
            help="Another clip of the project to show beside the clip, or `source`: the clip from which "
            "the clip was made."
        ),
    ] = None,
    revision: RevisionNumber = None,
    beside_revision: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Revision of the clip that --beside names; without --beside, show this revision of the same clip "
            "beside the clip.",
        ),
    ] = None,
    browser: InBrowser = False,
    out: Annotated[
        Path | None,
        output_option(
            "Draw poses to this file, which ends in .png or .svg; or write a page that plays the motion without a "
            "server or network, if it ends in .html.",
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="With --out: frames of the clip, such as 100:200. Default: all frames.")
    ] = None,
    moments: Annotated[
        int, typer.Option(min=1, help="Number of poses in a row, if --out names a picture (.png or .svg).")
    ] = DEFAULT_MOMENTS,
    n: Annotated[
        int, typer.Option("-n", min=1, help="With --out: number of samples of a model, or of trials of an evaluation.")
    ] = DEFAULT_ROWS,
    seed: Annotated[int, typer.Option(min=0, help="With --out: seed of the samples of a model.")] = 0,
) -> None:
    """Show a clip in a browser, or draw it; --out also draws samples of a model, and worst trials of an evaluation.

    Prints the address of the page. The first browser that opens the address within two minutes is signed in, once.
    """
    from marey_schemas.sign_ins import VIEW_PATH

    other = [] if beside in (None, SOURCE) else [str(beside)]
    addresses = addresses_in_one_project([at_revision(place, revision), *other])
    project = addresses[0].project
    if out is None:
        refuse_ignored(context, "without --out", "frames", "moments", "n", "seed")
    with connect(context) as marey:
        found, number = require_revision(marey, addresses[0], DRAWN_KINDS if out is not None else [Kind.CLIP])
        if out is not None and out.suffix.lower() == PAGE_ENDING:
            refuse_ignored(context, "in a page", "moments")
        if out is not None and found.item.kind is not Kind.CLIP:
            refuse_ignored(context, "on a model or an evaluation", "beside", "beside_revision", "frames")
            drawn = Drawing(out, moments, n, seed).of_item(found, number)
            return print_message(f"wrote {drawn}")
        pair = [(found, number)]
        if beside == SOURCE:
            pair.append(_source_of(marey, *pair[0]))
        elif other:
            pair.append(require_revision(marey, addresses[1], [Kind.CLIP]))
        if beside_revision is not None:
            pair = [pair[0], (pair[-1][0], beside_revision)]
        if out is not None:
            refuse_ignored(context, "on a clip", "n", "seed")
            return print_message(f"wrote {Drawing(out, moments, n, seed).of_clips(pair, frames)}")
        shown = (f"{project}/{_named(clip.id, one)}" for clip, one in pair)
        url = page_address(marey, project, VIEW_PATH, dict(zip(("clip", "beside"), shown, strict=False)))
    return show_page(url, browser=browser)


def page_address(marey: Marey, project: str, path: str, query: Mapping[str, str]) -> str:
    """Return the address of a page about a project, with a new code that signs in the first browser that opens it."""
    link = marey.project(project).browser_link()
    return f"{marey.transport.url}{path}?{urlencode(query, safe='/@')}#{quote(link.code)}"


def show_page(url: str, *, browser: bool) -> None:
    """Print the address of a page; with `browser`, open the page in a browser of this machine instead.

    Raises `WrongUsage` if no browser is found.
    """
    if browser:
        return _open(url)
    return typer.echo(url)


def _named(item: str, revision: int | None) -> str:
    return item if revision is None else f"{item}@{revision}"


def _source_of(marey: Marey, clip: ItemHandle, revision: int | None) -> tuple[ItemHandle, int]:
    """Return the source of a clip, and the revision of the source.

    Raises `WrongUsage` unless the clip was made from exactly one clip that still exists.
    """
    graph = clip.lineage_graph(revision, direction="inputs", depth=1)
    sources = [one for one in graph.revisions if one.kind is Kind.CLIP and one.distance == -1 and not one.deleted]
    if len(sources) != 1:
        place = f"{clip.project}/{clip.path}"
        made = f"made from {counted(len(sources), 'clip')}" if sources else "not made from a clip that still exists"
        raise WrongUsage(f"{place} was {made}; name a clip after --beside, see `marey lineage {place}`")
    found: ItemHandle = marey.project(clip.project).items(Kind.CLIP).get(sources[0].item)
    return found, sources[0].revision


@dataclass(frozen=True)
class Drawing:
    """Picture or page to write to the file `out`.

    `moments` is the number of poses in a row, and `rows` the number of samples or trials; samples are drawn with
    `seed`.
    """

    out: Path
    moments: int
    rows: int
    seed: int

    def of_item(self, found: Any, revision: int | None) -> Path:
        """Draw samples of a model, or the worst trials of an evaluation; return the path of the file."""
        from marey_client.poses.strips import draw_samples, draw_worst_trials

        if self._is_page:
            return self._play_item(found, revision)
        form = self._file_type
        if found.item.kind is Kind.MODEL:
            return self._write(draw_samples(found, revision, self.rows, self.seed, self.moments, form))
        return self._write(draw_worst_trials(found, revision, self.rows, self.moments, form))

    def of_clips(self, pair: Sequence[tuple[Any, int | None]], frames: str | None) -> Path:
        """Draw one or two clips, each at a revision, the second one below the first; return the path of the file."""
        from marey_client.poses.strips import ClipOfStrip, draw_clips

        chosen = None if frames is None else read_frames(frames)
        if self._is_page:
            return self._play_clips(pair, chosen)
        form = self._file_type
        clips = [ClipOfStrip(clip, revision, chosen) for clip, revision in pair]
        return self._write(draw_clips(clips[0], clips[1] if len(clips) > 1 else None, self.moments, form))

    def _play_item(self, found: Any, revision: int | None) -> Path:
        from marey_client.poses.player_pages import motions_of_samples, save_page
        from marey_client.poses.trials import motions_of_worst_trials

        if found.item.kind is Kind.MODEL:
            motions = motions_of_samples(found, revision, self.rows, self.seed)
            about = f"samples of {found.path}, seed {self.seed}"
        else:
            motions = motions_of_worst_trials(found, revision, self.rows)
            about = f"worst trials of {found.path}"
        save_page(found.transport, self.out, motions, about)
        return self.out

    def _play_clips(self, pair: Sequence[tuple[Any, int | None]], frames: slice | None) -> Path:
        from marey_client.poses.player_pages import motions_of_clips, save_page

        save_page(pair[0][0].transport, self.out, motions_of_clips(pair, frames))
        return self.out

    @property
    def _is_page(self) -> bool:
        return self.out.suffix.lower() == PAGE_ENDING

    @property
    def _file_type(self) -> str:
        file_type = self.out.suffix.lower().lstrip(".")
        if file_type not in PICTURES:
            raise WrongUsage(f"{self.out} must end in .html, .png or .svg")
        return file_type

    def _write(self, data: bytes) -> Path:
        from marey_client.downloads import write_whole

        write_whole(self.out, data)
        return self.out


def read_frames(text: str) -> slice:
    """Return the range of frames in a text such as 100:200. Raises `WrongUsage` for other texts."""
    first, colon, end = text.partition(":")
    if not (colon and all(one == "" or one.isdecimal() for one in (first, end))):
        raise WrongUsage(f"--frames: {text!r} is not a range of frames; write first:end, such as 100:200")
    return slice(int(first) if first else None, int(end) if end else None)


def _open(url: str) -> None:
    """Open an address in the browser through a file, because arguments of programs are visible to other users."""
    with tempfile.NamedTemporaryFile("w", prefix="marey-view-", suffix=".html", delete=False) as file:
        file.write(_REDIRECT.format(url=html.escape(url)))
    if webbrowser.open(Path(file.name).as_uri()):
        return print_message("opened the page in the browser; the link works once")
    Path(file.name).unlink()
    raise WrongUsage("no browser was found on this machine; leave out --browser, and open the address that is printed")
