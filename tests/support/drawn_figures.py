"""Checks of drawn figures: readable text, consistent tables, and no text that is cut off."""

import io
import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection, PathCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imread
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from marey_reports.drawing.drawn import DrawnFigure


def is_sound(figure: DrawnFigure) -> DrawnFigure:
    """Check that the PNG can be read, and what `is_sound_svg` checks; return the figure."""
    assert imread(io.BytesIO(figure.png)).shape[0] > 100
    return is_sound_svg(figure)


def is_sound_svg(figure: DrawnFigure) -> DrawnFigure:
    """Check that the SVG can be read, and what `has_sound_data` checks; return the figure.

    Drawing an SVG takes less time than drawing a PNG, and also computes the layout of all texts.
    """
    assert ElementTree.fromstring(figure.svg).tag.endswith("svg")
    return has_sound_data(figure)


def has_sound_data(figure: DrawnFigure) -> DrawnFigure:
    """Check that the columns of each table are equally long and that the caption is a sentence; return the figure."""
    assert figure.caption.endswith(".")
    assert "nan" not in figure.caption
    for columns in figure.data["tables"].values():
        assert len({len(values) for values in columns.values()}) == 1
    json.dumps(figure.data, allow_nan=False)
    return figure


def rows_of(figure: DrawnFigure, table: str) -> list[Any]:
    columns = figure.data["tables"][table]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def cut_off(figure: Figure) -> list[Any]:
    """Return the texts of a matplotlib figure that extend beyond the borders of the figure."""
    canvas = FigureCanvasAgg(figure)
    figure.draw_without_rendering()  # places every text, as drawing does
    page = figure.bbox.padded(1.0)
    hidden = {id(label) for axes in figure.axes for label in _labels_beyond(axes)}
    texts = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    boxes = [(text, text.get_window_extent(canvas.get_renderer())) for text in texts if id(text) not in hidden]
    return [text.get_text() for text, box in boxes if not (page.contains(*box.min) and page.contains(*box.max))]


def _labels_beyond(axes: Axes) -> Iterator[Any]:
    """Yield the labels of ticks outside the limits of an axis; matplotlib does not draw these labels."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        for tick in axis.get_major_ticks():
            if not (axes.axison and low <= tick.get_loc() <= high):
                yield from (tick.label1, tick.label2)


def covered_by_legends(figure: Figure) -> list[str]:
    """Return the data and the texts that a legend of a figure covers, each after the first label of the legend."""
    canvas = FigureCanvasAgg(figure)
    figure.draw_without_rendering()
    renderer = canvas.get_renderer()
    found = []
    for legend in (each.get_legend() for each in figure.axes):
        if legend is not None:
            box = legend.get_window_extent(renderer)
            name = legend.get_texts()[0].get_text()
            found += [f"{name}: {what}" for axes in figure.axes for what in _drawn_within(axes, box)]
            own = {id(text) for text in legend.get_texts()}
            hidden = {id(label) for axes in figure.axes for label in _labels_beyond(axes)}
            found += [
                f"{name}: {text.get_text()}"
                for text in figure.findobj(Text)
                if text.get_visible() and text.get_text().strip() and id(text) not in own | hidden
                and text.get_window_extent(renderer).overlaps(box)
            ]  # fmt: skip
    return found


def _drawn_within(axes: Axes, box: Bbox) -> Iterator[str]:
    """Yield the data of axes that lie within a box on the page; what the axes cut off does not count."""
    for artist in (*axes.lines, *axes.patches, *axes.collections, *axes.images):
        inner = Bbox.intersection(box, axes.bbox) if artist.get_clip_on() else box
        if inner is None or inner.width <= 0.0 or inner.height <= 0.0 or not artist.get_visible():
            continue
        if isinstance(artist, PathCollection):
            places = artist.get_offset_transform().transform(artist.get_offsets())
            if inner.padded(2.0).count_contains(places):
                yield "points"
        elif isinstance(artist, QuadMesh | AxesImage):
            yield "a map"
        elif isinstance(artist, Collection):
            paths = [artist.get_transform().transform_path(path) for path in artist.get_paths()]
            if any(path.intersects_bbox(inner, filled=True) for path in paths):
                yield "areas"
        elif (
            artist.get_transform()
            .transform_path(artist.get_path())
            .intersects_bbox(inner, filled=isinstance(artist, Patch))
        ):
            yield str(artist)
