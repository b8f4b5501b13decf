"""Style that all figures share, and writing of figures as PNG and SVG.

Only matplotlib's object interface is used, so several threads can draw at the same time. The global settings of
matplotlib are changed only while an SVG is written, because its SVG writer reads some of them; one SVG is written at a
time.
"""

from __future__ import annotations

import io
import re
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import takewhile
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SIDE = 2.7
"""Side of a square panel, in inches."""

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

# These four follow the theme of the page that a figure is shown in; see `marey_reports.drawing.page`.
INK, QUIET, HAIRLINE, PAPER = "#1f2430", "#5c6472", "#d5dae1", "#ffffff"
# On coloured ground, in any theme.
DARK, LIGHT = "#111318", "#fafbfc"

# Okabe and Ito (2008) without yellow and black, which vanish on a light or a dark page.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
REFERENCE = "#8a8f99"
MARKERS = "os^DvPX*"

# Lightness runs one way in each, so that they read in grey, too.
MORE_IS_WORSE = "magma_r"
MORE_IS_DENSER = "viridis"

TEXT, SMALL, HEADING = 9.0, 8.0, 10.5
DPI = 144
LONGEST_NAME = 30

# Björn Ottosson (2020), "A perceptual color space for image processing"; the second matrix gives linear sRGB.
_OKLAB_TO_LMS = np.array(
    ((1.0, 0.3963377774, 0.2158037573), (1.0, -0.1055613458, -0.0638541728), (1.0, -0.0894841775, -1.2914855480))
)
_LMS_TO_RGB = np.array(
    (
        (4.0767416621, -3.3077115913, 0.2309699292),
        (-1.2684380046, 2.6097574011, -0.3413193965),
        (-0.0041960863, -0.7034186147, 1.7076147010),
    )
)

_SVG_SETTINGS = {"svg.hashsalt": "marey", "svg.fonttype": "none", "svg.image_inline": True, "svg.id": None}
_svg_writer = threading.Lock()
_LINES = re.compile(r"<path[^>]* d=\"[^\"]*\"")
_FINER = re.compile(r"(?<=\.\d\d)\d+")


class Place(NamedTuple):
    """A rectangle on the page, in inches from its lower left corner."""

    left: float
    bottom: float
    width: float
    height: float


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty page with the given width and height in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=DPI, facecolor=PAPER)


def add_panel(
    figure: Figure,
    place: Place,
    *,
    title: str = "",
    x: str = "",
    y: str = "",
    grid: bool = True,
    below_title: float = 7.0,
) -> Axes:
    """Add axes with a title and labels at a place of the page, in the style of all figures; return the axes.

    `below_title` is the height between the axes and the title in points, for example for a legend.
    """
    width, height = figure.get_size_inches()
    left, bottom, across, up = place
    axes = figure.add_axes((left / width, bottom / height, across / width, up / height), facecolor="none")
    axes.tick_params(colors=QUIET, labelsize=SMALL, length=3, width=0.6)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(HAIRLINE)
    axes.set_axisbelow(True)
    if grid:
        axes.grid(visible=True, color=HAIRLINE, lw=0.5)
    axes.set_xlabel(x, fontsize=TEXT, color=INK, labelpad=4)
    axes.set_ylabel(y, fontsize=TEXT, color=INK, labelpad=4)
    axes.set_title(plain(title), fontsize=HEADING, color=INK, loc="left", fontweight="bold", parse_math=False,
                   pad=below_title)  # fmt: skip
    return axes


def add_colour_bar(
    figure: Figure, mappable: ScalarMappable, place: Place, label: str, ticks: NDArray[np.float64] | None = None
) -> Axes:
    """Draw a colour bar, vertical if its place is higher than wide, otherwise horizontal; return the bar's axes."""
    width, height = figure.get_size_inches()
    left, bottom, across, up = place
    axes = figure.add_axes((left / width, bottom / height, across / width, up / height))
    upright = up > across
    bar = figure.colorbar(mappable, cax=axes, orientation="vertical" if upright else "horizontal")
    axes.set_facecolor("none")
    bar.outline.set_visible(False)
    axes.tick_params(colors=QUIET, labelsize=SMALL, length=3, width=0.6)
    bar.set_label(label, fontsize=TEXT, color=INK)
    if ticks is not None:
        bar.set_ticks(ticks.tolist(), labels=[f"{tick:,.6g}" for tick in ticks])
    return axes


def write(axes: Axes, place: tuple[float, float], text: str, **options: Any) -> None:
    """Write text literally: matplotlib would read text between dollar signs as mathematical notation."""
    look: dict[str, Any] = {"fontsize": SMALL, "color": INK, "parse_math": False, "va": "center", **options}
    axes.text(*place, plain(text), **look)


def add_keys(axes: Axes, **options: Any) -> None:
    """Draw a legend without a frame; dollar signs in names do not begin mathematical notation."""
    legend = axes.legend(frameon=False, fontsize=SMALL, **options)
    for text in legend.get_texts():
        text.set_color(INK)
        text.set_parse_math(False)


def name_ticks(axes: Axes, places: Sequence[float], names: Sequence[str], others: Sequence[str] = ()) -> None:
    """Write names along the vertical axis: first shortened names of clips, then `others` in full."""
    labels = [plain(label) for label in (*labels_of(names), *others)]
    axes.set_yticks(list(places), labels, parse_math=False)
    axes.tick_params(axis="y", length=0, labelcolor=INK)


def tick_whole_numbers(axis: Axis) -> None:
    """Put ticks at whole numbers only, for axes of counts."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(nbins="auto", integer=True, steps=[1, 2, 5, 10]))


def plain(text: str) -> str:
    """Return a text on one line; U+FFFD replaces characters that cannot be drawn or written to an SVG."""
    return "".join(sign if sign.isprintable() else "�" for sign in text)


def without_shared_folder(names: Sequence[str]) -> list[str]:
    """Return the names without the folders that all of them share."""
    places = [name.split("/") for name in names]
    levels = zip(*(folders for *folders, _ in places), strict=False)
    shared = sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, levels))
    return ["/".join(place[shared:]) for place in places]


def differing_parts(names: Sequence[str]) -> list[str]:
    """Shorten names to the parts that differ: drop the folders and the first words that all names share.

    The words are kept if one of the names would be empty without them.
    """
    within = without_shared_folder(names)
    words = [re.split(r"(?<=[ _-])", name) for name in within]
    shared = sum(1 for _ in takewhile(lambda each: len(set(each)) == 1, zip(*words, strict=False)))
    return ["".join(own[shared:]) for own in words] if all(len(own) > shared for own in words) else within


def labels_of(names: Sequence[str], longest: int = LONGEST_NAME) -> list[str]:
    """Shorten names of clips to `longest` characters so that different names stay different.

    Folders are left out if the names are unique without folders. If one name is too long, the beginning that all names
    share is left out. Names that are still too long lose their middle; if this would make several names equal, their
    shared beginning is cut instead.
    """
    takes = [name.rpartition("/")[2] for name in names]
    apart = takes if len(set(takes)) == len(set(names)) else without_shared_folder(names)
    if any(len(name) > longest for name in apart):
        apart = differing_parts(apart)
    labels = [shortened(name, longest) for name in apart]
    for label in [label for label, count in Counter(labels).items() if count > 1]:
        places = [place for place, other in enumerate(labels) if other == label]
        signs = zip(*(apart[place] for place in places), strict=False)
        shared = sum(1 for _ in takewhile(lambda each: len(set(each)) == 1, signs))
        for place in places:
            if len(apart[place]) > longest:
                differing = apart[place][shared:]
                labels[place] = f"…{differing}" if len(differing) < longest else f"…{differing[: longest - 2]}…"
    return labels


def shortened(name: str, longest: int = LONGEST_NAME) -> str:
    """Shorten a name to `longest` characters by cutting its middle, where names of takes differ least."""
    if len(name) <= longest:
        return name
    tail = (longest - 1) // 2
    return f"{name[: longest - 1 - tail]}…{name[-tail:]}"


def reach(values: NDArray[np.floating[Any]], wanted: float) -> float:
    """Choose the upper end of an axis, at least `wanted` and at most twice as much; values beyond it are cut off."""
    if not len(values):
        return wanted
    most = float(np.quantile(values, 0.98))
    return max(wanted, min(float(values.max()), max(1.3 * wanted, 1.1 * most), 2.0 * wanted))


def nice_ceiling(value: float) -> float:
    """Round up to 1, 1.5, 2, 3, 4, 5, 6 or 8 times a power of ten; return 1 if `value` is not positive and finite."""
    if not value > 0.0 or not np.isfinite(value):
        return 1.0
    scale = 10.0 ** np.floor(np.log10(value))
    return float(next(step * scale for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if value <= step * scale * (1 + 1e-9)))


def warm_colours() -> Colormap:
    """Make a colour map from yellow to brown; even its lightest colour is visible on a white page."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["YlOrBr"](np.linspace(0.12, 1.0, 256)))


def colours_of_change(less: str, more: str) -> Colormap:
    """Make a colour map for changes: `less` at its lower end, `more` at its upper end, transparent at no change.

    The ground of the page shows through where nothing has changed, whether the page is light or dark.
    """
    from matplotlib.colors import ListedColormap, to_rgb

    shares = np.linspace(-1.0, 1.0, 257)
    ends = np.where((shares < 0.0)[:, None], to_rgb(less), to_rgb(more))
    return ListedColormap(np.column_stack((ends, np.abs(shares))))


def distinct_colours(count: int) -> list[str]:
    """Choose colours that differ from each other: `COLOURS`, or equally spaced hues if there are not enough of these.

    Neighbouring hues alternate between two lightnesses, both visible on light and on dark pages. Successive colours of
    the list are about a golden angle apart.
    """
    from matplotlib.colors import to_hex

    if count <= len(COLOURS):
        return list(COLOURS[:count])
    place = np.argsort(np.argsort(np.arange(count) * 0.5 * (3.0 - np.sqrt(5.0)) % 1.0))
    hue = 2.0 * np.pi * place / count
    oklab = np.stack((np.where(place % 2, 0.74, 0.54), 0.13 * np.cos(hue), 0.13 * np.sin(hue)), axis=1)
    linear = np.clip((oklab @ _OKLAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T, 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return [to_hex(colour) for colour in srgb]


def square_root_ticks(ceiling: float) -> NDArray[np.float64]:
    """Return ticks from 0 to `ceiling` for a colour bar with a square-root scale."""
    return ceiling * np.array((0.0, 0.05, 0.25, 0.5, 1.0))


def nice_levels(largest: float) -> NDArray[np.float64]:
    """Choose at most 11 levels in steps of 1, 2 or 5 times 10^n; the first is 0, the last is not below `largest`."""
    reach = largest if largest > 0.0 and np.isfinite(largest) else 1.0
    scale = 10.0 ** np.floor(np.log10(reach / 10.0))
    step = next(factor * scale for factor in (1, 2, 5, 10, 20) if reach <= 10 * factor * scale * (1 + 1e-9))
    return np.asarray(np.arange(round(np.ceil(reach / step * (1 - 1e-9))) + 1) * step, dtype=np.float64)


def luminance(colours: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Compute the relative luminance in [0, 1] of sRGB colours (..., 3 or 4), to choose the colour of text."""
    linear = np.where(
        colours[..., :3] <= 0.04045, colours[..., :3] / 12.92, ((colours[..., :3] + 0.055) / 1.055) ** 2.4
    )
    return np.asarray(linear @ (0.2126, 0.7152, 0.0722), dtype=np.float64)


def to_png(figure: Figure) -> bytes:
    """Return the figure as PNG; the same versions of matplotlib and Pillow give the same bytes.

    A page is opaque, so its PNG needs no transparency. The compression looks only for runs of equal bytes. This takes
    half as long as other methods, and the files are not larger.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    buffer = io.BytesIO()
    picture.save(buffer, format="png", dpi=(figure.dpi, figure.dpi), compress_type=Image.RLE)
    return buffer.getvalue()


def to_svg(figure: Figure, title: str) -> str:
    """Return the figure as SVG, with text, not outlines; the same version of matplotlib gives the same bytes."""
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with _svg_settings():
        figure.savefig(buffer, format="svg", dpi=DPI, metadata={"Title": plain(title), **nothing})
    # A hundredth of a point is finer than anything that shows it; lines are most of a drawing.
    return _LINES.sub(lambda line: _FINER.sub("", line[0]), buffer.getvalue())


@contextmanager
def _svg_settings() -> Iterator[None]:
    import matplotlib

    with _svg_writer:
        settings: Any = matplotlib.rcParams
        before = {name: settings[name] for name in _SVG_SETTINGS}
        settings.update(_SVG_SETTINGS)
        try:
            yield
        finally:
            settings.update(before)
