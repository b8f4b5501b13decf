"""Types of the files into which charts and graphs are drawn, and kinds of charts."""

from __future__ import annotations

from typing import Literal, get_args

ChartFile = Literal["html", "svg", "png"]
"""Type of a file of charts that compare runs: a page with all charts, or one chart."""
CHART_FILES: tuple[ChartFile, ...] = get_args(ChartFile)

Plot = Literal["lines", "scatter", "bars"]
"""Kind of chart of runs: fields over steps, a field over a parameter, or a bar for each setting."""
PLOTS: tuple[Plot, ...] = get_args(Plot)

LineageFile = Literal["svg", "png", "dot"]
"""Type of a file with the picture of a lineage graph; `dot` is the language of Graphviz."""
LINEAGE_FILES: tuple[LineageFile, ...] = get_args(LineageFile)
