from __future__ import annotations

import pytest

from marey_schemas.documents.reports import StoredFigure, StoredFile
from marey_server.errors import NotFoundProblem
from marey_server.handlers.reports import FigureQuery, file_of


def test_a_figure_without_tables_says_so() -> None:
    file = StoredFile(blob="sha256:" + "0" * 64, size_bytes=1)
    figure = StoredFigure(
        name="paths", number="1", title="Paths", caption="", trial=None, png=file, svg=file, json_=file, csv={}
    )
    with pytest.raises(NotFoundProblem, match="figure 'paths' has no tables"):
        file_of(figure, FigureQuery(format="csv"))
