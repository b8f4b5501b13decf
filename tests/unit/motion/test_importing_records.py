"""Import of records of work with the predecessor: what is recognised, shown and hidden."""

from __future__ import annotations

import datetime
import json
from typing import Any

import bson
import pytest
from tests.support import predecessor_documents as old
from tests.support import predecessor_records as written

from marey_motion.importing.files import import_file
from marey_motion.importing.items import FileToImport, ImportedFile
from marey_motion.importing.plan import plan_imports
from marey_schemas.documents.predecessor_records import HIDDEN, LONGEST_TEXT, MOST_SHOWN, PredecessorRecord
from marey_schemas.kinds import Kind

DIGEST = f"sha256:{'1' * 64}"


def imported(data: bytes, name: str = "one.json") -> ImportedFile:
    return import_file(FileToImport(plan_imports([name])[0], data, DIGEST))


def record(content: Any) -> PredecessorRecord:
    found = imported(json.dumps(content).encode())
    assert found.refusal is None, found.refusal
    (item,) = found.items
    assert item.kind is Kind.RECORD
    return PredecessorRecord.model_validate(item.parts["record"])


@pytest.mark.parametrize(
    ("name", "form"),
    [("train_job.json", "job"), ("statistics_run.bson", "transform run"), ("begin_history.json", "edit history"),
     ("fetch_input.json", "synthesis input")],
)  # fmt: skip
def test_each_record_is_recognised_by_its_members_in_each_encoding(name: str, form: str) -> None:
    found = imported(written.records()[name], f"in/{name}")
    assert found.refusal is None
    (item,) = found.items
    assert (item.kind, item.collection, item.item_name) == (Kind.RECORD, "in", name.split(".")[0])
    assert item.parts["record"]["form"] == form
    assert item.parts["record"]["original"]["blob"] == DIGEST


def test_fields_are_shown_by_their_pointers_with_lists_of_plain_values_as_one() -> None:
    shown = record(written.synthesis_input()).fields
    assert shown["/elementaryActions/0/action"] == "walk"
    assert shown["/elementaryActions/0/constraints/0/trajectoryConstraints/1/position"] == "[40.0, null, 350.5]"
    assert shown["/elementaryActions/1/constraints/0/keyframeConstraints/0/time"] == 1.5
    shown = record(written.edit_history()).fields
    assert (shown["/0/0"], shown["/1"]) == ("rotate_joint", '["mirror_animation", null]')


def test_credentials_are_hidden_and_named_in_a_warning() -> None:
    found = imported(json.dumps(written.job()).encode())
    fields = found.items[0].parts["record"]["fields"]
    assert fields["/token"] == fields["/job_desc/aws/secret_key"] == fields["/job_desc/aws/access_key"] == HIDDEN
    assert fields["/job_desc/aws/src_bucket"] == "in"
    assert written.SECRET not in json.dumps(found.items[0].parts)
    (check,) = found.checks
    assert check["code"] == "credentials-in-file"
    assert "/job_desc/aws/secret_key" in check["message"]
    assert imported(old.encode(written.transform_run(), "one.json")).checks == (), "its token is empty"
    below = record({**written.job(), "token": {"value": [written.SECRET]}})
    assert below.fields["/token"] == HIDDEN


@pytest.mark.parametrize(
    ("member", "pointer"),
    [
        ({"apiKey": "x"}, "/apiKey"),
        ({"accessKey": "x"}, "/accessKey"),
        ({"authorization": "Bearer zz"}, "/authorization"),
        ({"header": "Bearer zz"}, "/header"),
        ({"auth": ["eva", "x"]}, "/auth"),
        ({"passwd": "x"}, "/passwd"),
        ({"pwd": "x"}, "/pwd"),
        ({"private_key": "x"}, "/private_key"),
        ({"credentials": {"pass": "x"}}, "/credentials"),
        ({"env": ["TOKEN=abc", "DB_PASSWORD=s3"]}, "/env"),
        ({"env": ["A=1", {"name": "DB_PASSWORD", "value": "topsecret"}]}, "/env/1/value"),
        ({"run": "python train.py --password hunter2"}, "/run"),
        ({"run": ["train.py", "--password", "hunter2"]}, "/run"),
        ({"run": "curl -H 'Authorization: Bearer zz'"}, "/run"),
        ({"set": '{"env": "TOKEN=abc"}'}, "/set"),
        ({"repo": "https://eva:x@git.lab/mg.git"}, "/repo"),
        ({"token": {"n": [{"token": 1}], "value": "x"}}, "/token"),
    ],
)
def test_credentials_are_found_by_whole_words_in_names_and_by_assignments(member: Any, pointer: str) -> None:
    found = imported(json.dumps({**written.transform_run(), "hparams": member}).encode())
    fields = found.items[0].parts["record"]["fields"]
    assert [name for name, value in fields.items() if value == HIDDEN] == [f"/hparams{pointer}"]
    assert f"(/hparams{pointer})" in found.checks[0]["message"]


def test_credentials_in_commands_of_a_history_are_hidden() -> None:
    assert record([["set_token", "tok123"], ["smooth", None]]).fields == {"/0": HIDDEN, "/1": '["smooth", null]'}
    assert record([["set_token", {"to": "tok123"}]]).fields == {"/0": HIDDEN}


def test_numbers_and_names_that_only_contain_a_word_are_shown() -> None:
    plain = {"n_tokens": 5, "max_token_length": 512, "tokenizer": "bert", "secretary": "eva", "token": {"count": [1]},
             "use_password": True, "author": "eva", "run": "train.py --max_token_length 512 --tokenizer bert",
             "url": "https://git.lab/mg.git", "image": "registry.lab/mg:3", "text": "the keyframe=3"}  # fmt: skip
    found = imported(json.dumps({**written.transform_run(), "hparams": plain}).encode())
    assert found.checks == ()
    fields = found.items[0].parts["record"]["fields"]
    assert fields["/hparams/max_token_length"] == 512
    assert fields["/hparams/token/count"] == "[1]"


def test_pointers_in_the_warning_are_short() -> None:
    found = imported(json.dumps({**written.job(), "x" * 100_000: {"token": "a"}}).encode())
    assert len(found.checks[0]["message"]) < 1000


def test_what_json_cannot_contain_is_shown_as_text_and_long_documents_are_cut() -> None:
    when = datetime.datetime(2019, 11, 14, tzinfo=datetime.UTC)
    kept = {"when": when, "id": bson.ObjectId("a" * 24), "raw": b"\x00", "nan": float("nan"), "big": 2**60}
    odd = {**written.transform_run(), "hparams": kept}
    found = imported(bson.encode(odd), "one.bson")
    assert found.refusal is None, found.refusal
    fields = PredecessorRecord.model_validate(found.items[0].parts["record"]).fields
    assert str(fields["/hparams/when"]).startswith("2019-11-14 00:00:00")
    assert (fields["/hparams/id"], fields["/hparams/nan"], fields["/hparams/big"]) == ("a" * 24, "nan", str(2**60))
    many = record([["smooth", {"window": number}] for number in range(MOST_SHOWN)])
    assert (len(many.fields), many.fields_left_out) == (MOST_SHOWN, MOST_SHOWN)
    long = record([["smooth", {"text": "\ud800" + "x" * 5000}]]).fields["/0/1/text"]
    assert isinstance(long, str)
    assert len(long) == LONGEST_TEXT


def test_pointers_of_deep_documents_are_made_without_recursion() -> None:
    levels = 900
    document = b'[["smooth",' + b'{"a":' * levels + b"7" + b"}" * levels + b"]]"
    found = imported(document)
    assert found.refusal is None, found.refusal
    record_part = PredecessorRecord.model_validate(found.items[0].parts["record"])
    assert (record_part.fields, record_part.fields_left_out) == ({"/0/0": "smooth"}, 1)
    short = b'[["smooth",' + b'{"a":' * 400 + b"7" + b"}" * 400 + b"]]"
    fields = PredecessorRecord.model_validate(imported(short).items[0].parts["record"]).fields
    assert fields == {"/0/0": "smooth", "/0/1" + "/a" * 400: 7}


def test_fields_that_look_like_references_to_stored_bytes_are_none() -> None:
    forged = {"dtype": "<f4", "shape": [1], "content": DIGEST, "blob": DIGEST, "output": "x"}
    fields = record({**written.transform_run(), "hparams": forged}).fields
    assert fields["/hparams/blob"] == DIGEST
    assert not {"blob", "content", "dtype"} & fields.keys()


@pytest.mark.parametrize("data", [b"[1, 2]", b"[]"])
def test_other_lists_are_refused_with_the_form_of_a_history(data: bytes) -> None:
    refused = imported(data).refusal
    assert refused is not None
    assert refused.code == "document-unknown"
    assert "[command, parameters]" in refused.detail
