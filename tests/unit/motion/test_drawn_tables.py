"""Tables of figures and reports, written as CSV."""

from marey_reports.drawing.drawn import as_csv


def test_names_that_a_spreadsheet_would_run_begin_with_an_apostrophe() -> None:
    table = as_csv({"name": ['=HYPERLINK("http://x")', "@sum", "walk"], "rise_m": [-1.0, 2.0, None]})
    assert table.splitlines() == ["name,rise_m", '"\'=HYPERLINK(""http://x"")",-1.0', "'@sum,2.0", "walk,"]
