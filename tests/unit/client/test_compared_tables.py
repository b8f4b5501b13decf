"""Tables of comparisons on the command line: marks, exact CSV, and cells that would be formulas."""

from __future__ import annotations

import csv
import io
from contextlib import nullcontext

import httpx
import pytest
from tests.support.command_line import run_here
from tests.support.compared_runs import a_run, compared_of
from tests.support.scripted_server import ScriptedServer

from marey_client.cli.queue import comparing
from marey_client.cli.queue.compared_tables import shown_columns, table_of_means, table_of_runs, texts_of_means
from marey_client.cli.terminal.output import print_message, print_table
from marey_schemas.queue.comparisons import RunComparison


def replicated() -> RunComparison:
    runs = [
        a_run(3 * group + seed, {"size": group, "mode": "fast"}, {"loss": 1.0 / 3 + group + seed, "ok": seed == 1},
              seed=seed)
        for group in range(2)
        for seed in range(3)
    ]  # fmt: skip
    return compared_of(runs, goals={"loss": "lowest"})


def test_only_columns_that_differ_are_shown_and_the_best_values_are_marked() -> None:
    found = replicated()
    table = table_of_runs(found, shown_columns(found, every=False))
    assert table.heads == ("job", "seed", "size", "loss", "ok")
    assert table.texts()[0] == ["job_0000", "0", "0", "0.333333 *", "false"]
    assert sum("*" in cell for row in table.texts() for cell in row) == 1
    everything = table_of_runs(found, shown_columns(found, every=True))
    assert set(everything.heads) - set(table.heads) == {"mode", "commit"}
    assert shown_columns(compared_of([a_run(0, {"size": 1}, {"a": 1})]), every=False) != ()


def test_means_have_exact_intervals_in_csv_and_short_ones_for_people() -> None:
    found = replicated()
    columns = shown_columns(found, every=False)
    rows = list(csv.DictReader(io.StringIO(table_of_means(found, columns).csv())))
    summary = found.settings[0].fields["loss"]
    assert [float(rows[0][f"loss.{part}"]) for part in ("mean", "low", "high")] == [
        summary.mean, summary.low, summary.high
    ]  # fmt: skip
    assert texts_of_means(found, columns).heads == ("size", "n", "loss")
    assert texts_of_means(found, columns).texts()[0] == ["0", "3", "1.33333 (-1.1508 to 3.81747) *"]


def test_texts_that_a_spreadsheet_would_run_begin_with_an_apostrophe() -> None:
    texts = ["=1+1", "+1", "-1", "@a", "\tx", 'plain, "quoted"', "<b>"]
    found = compared_of([a_run(number, {"text": text}, {"a": -number}) for number, text in enumerate(texts)])
    rows = list(csv.DictReader(io.StringIO(table_of_runs(found, shown_columns(found, every=False)).csv())))
    assert [row["text"] for row in rows] == [f"'{text}" for text in texts[:5]] + texts[5:]
    assert [row["a"] for row in rows] == [str(-number) for number in range(7)], "negative numbers stay numbers"
    named = compared_of([a_run(number, {}, {"=1+1": number}) for number in range(2)])
    assert table_of_runs(named, shown_columns(named, every=False)).csv().splitlines()[0] == "job,'=1+1"


def test_the_name_of_a_field_can_neither_control_the_terminal_nor_style_the_table(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_table(("[/x]", "[red]a", "b\x1b]0;title\x07"), [(1, 2, 3)])
    assert capsys.readouterr().out.split()[:3] == ["[/x]", "[red]a", r"b\x1b]0;title\x07"]


def test_columns_with_one_name_are_told_apart() -> None:
    runs = [a_run(number, {"size": number}, {"size": 2 * number}, inputs={"size": f"a@{number}"}) for number in (1, 2)]
    found = compared_of(runs)
    table = table_of_runs(found, shown_columns(found, every=False))
    assert table.heads == ("job", "input.size", "value.size", "field.size")
    assert table.rows[1] == ["job_0002", "a@2", 2, 4]


def test_the_sdk_sends_goals_by_their_kind() -> None:
    server = ScriptedServer()
    server.answers.append(httpx.Response(200, content=replicated().model_dump_json().encode()))
    script = server.marey().project("lab").scripts.at("train")
    found = script.compare(fields=("loss", "ok"), goals={"loss": "lowest", "score": "highest"}, curves=True)
    assert found == replicated()
    (request,) = server.requests
    assert dict(request.url.params) == {
        "sort": "-created_at", "limit": "100", "fields": "loss,ok", "highest": "score", "lowest": "loss",
        "curves": "true",
    }  # fmt: skip


WRONG = [
    (["--csv", "--json"], "choose one of --csv and --json"),
    (["--plot", "bars"], "have an effect only with --chart"),
    (["--chart", "runs.pdf"], "must end in .html, .svg or .png"),
    (["--highest", "a", "--lowest", "a"], "a is named by --highest and by --lowest"),
]


@pytest.mark.parametrize(("options", "reason"), WRONG)
def test_options_that_contradict_each_other_are_refused_before_any_request(options: list[str], reason: str) -> None:
    done = run_here(["script", "compare", "lab", "train", *options])
    assert (done.returncode, reason in " ".join(done.stderr.split())) == (2, True), done.stderr


def test_the_detail_of_a_refusal_cannot_control_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = {
        "type": "t",
        "title": "t",
        "status": 400,
        "code": "no-field",
        "detail": "the fields are b\x1b]0;title\x07",
    }
    server = ScriptedServer()
    headers = {"Content-Type": "application/problem+json"}
    server.answers.append(httpx.Response(400, headers=headers, json=problem | {"instance": "i"}))
    monkeypatch.setattr(comparing, "connect", lambda _: nullcontext(server.marey()))
    told = run_here(["script", "compare", "lab", "train"]).stderr
    assert told == "marey: the fields are b\\x1b]0;title\\x07 (no-field, request i at http://server.test)\n"
    print_message("b\x1b]0;title\x07")
    assert capsys.readouterr().err == "b\\x1b]0;title\\x07\n"
