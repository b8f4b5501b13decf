"""Rules of `lint`: each finds a planted violation and reports its place."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lint import (
    circles,
    class_names,
    constants,
    docstrings,
    folders,
    lengths,
    lists,
    migrations,
    small_modules,
    unused,
    wording,
)
from lint.__main__ import RULES, check
from lint.commit_subject import faults_of
from lint.exceptions import (
    EXCEPTIONS,
    apply_baseline,
    apply_exceptions,
    read_baseline,
    shrink_baseline,
)
from lint.sample import draw
from lint.sources import House, Module, Offence, read_house, read_module

ROOT = Path("/checkout")
LONG = "\n".join("x = 1" for _ in range(70)) + "\n"


def house(modules: dict[str, str], pages: dict[str, str] | None = None) -> House:
    """Return modules with these names and texts as a `House` (all modules that `lint` checks); names give the paths."""
    found = {name: Module(name, ROOT / f"{name.replace('.', '/')}.py", text) for name, text in modules.items()}
    return House(found, {ROOT / name: text for name, text in (pages or {}).items()})


def messages(offences: Iterator[Any]) -> list[str]:
    return [offence.message for offence in offences]


@pytest.mark.parametrize(
    "back",
    [
        "from marey_x.a import A\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from marey_x.a import A\n",
        "def f():\n    import marey_x.a\n",
    ],
    ids=["at the top", "for types only", "in a function"],
)
def test_modules_that_import_each_other_are_found(back: str) -> None:
    circle = house({"marey_x.a": "from marey_x import b\n", "marey_x.b": "import marey_x.c\n", "marey_x.c": back})
    (offence,) = circles.find(circle)
    assert "marey_x.a -> marey_x.b -> marey_x.c -> marey_x.a; move" in offence.message


def test_a_circle_has_the_line_of_its_first_import() -> None:
    circle = house({"marey_x.a": "import ast\nfrom marey_x import b\n", "marey_x.b": "import marey_x.a\n"})
    (offence,) = circles.find(circle)
    assert (offence.path.name, offence.line) == ("a.py", 2)


def test_a_circle_through_two_packages_is_found() -> None:
    circle = house({"marey_x.a": "import marey_y.b\n", "marey_y.b": "def f():\n    from marey_x import a\n"})
    (offence,) = circles.find(circle)
    assert "marey_x.a -> marey_y.b -> marey_x.a; move" in offence.message


def test_a_circle_through_the_lazy_names_of_a_package_is_found(tmp_path: Path) -> None:
    package = tmp_path / "motion/marey_motion"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("import lazy_loader\n")
    (package / "__init__.pyi").write_text("from . import __version__ as __version__\nfrom .clip import Clip as Clip\n")
    (package / "clip.py").write_text("def f():\n    from marey_motion import Clip\n")
    (offence,) = circles.find(read_house(tmp_path))
    assert "marey_motion -> marey_motion.clip -> marey_motion; move" in offence.message
    assert (offence.path.name, offence.line) == ("__init__.pyi", 2)


@pytest.mark.parametrize("folder", ["tests/support", "benchmarks", "lint"])
def test_the_modules_beside_the_packages_have_no_circle(folder: str) -> None:
    checkout = Path(__file__).parents[3]
    modules = [read_module(path, checkout) for path in (checkout / folder).rglob("*.py")]
    assert messages(circles.find(House({module.name: module for module in modules}))) == []


def test_modules_that_import_downwards_are_no_circle() -> None:
    assert not list(circles.find(house({"marey_x.a": "from marey_x import b\n", "marey_x.b": ""})))


def test_a_folder_of_26_modules_is_full() -> None:
    full = {f"marey_x.m{number}": "" for number in range(26)}
    assert messages(folders.find(house(full))) == ["26 modules, more than 25; divide them into folders"]
    del full["marey_x.m0"]
    assert not list(folders.find(house(full)))


NUMPYDOC = '"""Turn.\n\n    Parameters\n    ----------\n    {}\n\n    Returns\n    -------\n    float\n    """'

WITHOUT_RESULT = NUMPYDOC.format("angle : float    radians").partition("    Returns")[0] + '"""'


@pytest.mark.parametrize(
    ("docstring", "fault"),
    [
        ("", "turned has no docstring; write one"),
        ('"""Turn."""', "turned does not document angle under Parameters; add the entry"),
        (
            NUMPYDOC.format("axis : str\n    angle : float"),
            "turned documents axis, which it does not take; remove the entry",
        ),
        (WITHOUT_RESULT, "turned does not document what it returns under Returns; add the section"),
    ],
)
def test_a_function_of_the_library_documents_what_it_takes_and_returns(docstring: str, fault: str) -> None:
    text = f"def turned(angle: float) -> float:\n    {docstring}\n    return angle\n"
    assert messages(docstrings.find(house({"marey_motion.turns": text}))) == [fault]
    assert not list(docstrings.find(house({"marey_motion.turn_kernels": text, "marey_server.turns": text})))


def test_a_documented_function_of_the_library_is_fine() -> None:
    text = f"def turned(angle: float) -> float:\n    {NUMPYDOC.format('angle : float    radians')}\n    return angle\n"
    assert not list(docstrings.find(house({"marey_motion.turns": text})))


def test_overloads_of_a_documented_function_need_no_docstring() -> None:
    text = "@overload\ndef turned() -> None: ...\n"
    assert not list(docstrings.find(house({"marey_motion.turns": text})))


def test_a_small_module_with_one_importer_belongs_into_it() -> None:
    modules = {"marey_x.small": "", "marey_x.one": f"import marey_x.small\n{LONG}", "marey_x.other": LONG}
    assert messages(small_modules.find(house(modules))) == ["0 lines, imported only by marey_x.one; merge it"]
    modules["marey_x.other"] = f"from marey_x.small import x\n{LONG}"
    assert not list(small_modules.find(house(modules)))


@pytest.mark.parametrize(
    "users",
    [
        {"marey_x.kinds": f'KIND = "marey_x.small:run"\n{LONG}'},
        {"marey_x.lazy": f'LATER = "marey_x.small"\n{LONG}'},
    ],
    ids=["function", "module"],
)
def test_a_small_module_that_is_loaded_by_name_stays(users: dict[str, str]) -> None:
    assert not list(small_modules.find(house({"marey_x.small": "", **users})))


def test_a_small_module_of_a_file_format_stays() -> None:
    small = {"marey_motion.formats.toy": "def read_toy(): ...\n", "marey_motion.formats.toys": "def read_toy(): ...\n"}
    assert [one.subject for one in small_modules.find(house(small))] == ["marey_motion.formats.toys"]


def test_two_classes_of_one_name_are_found_with_both_places() -> None:
    (offence,) = class_names.find(house({"marey_x.a": "class Take: ...\n", "marey_y.b": "\nclass Take: ...\n"}))
    assert (offence.subject, offence.line) == ("Take", 2)
    assert "marey_x.a, line 1" in offence.message


def test_a_function_that_only_its_definition_names_is_unused() -> None:
    text = "def used(): ...\n\ndef dead(): ...\n\nclass A:\n    def dead_too(self): used()\n\nA()\n"
    found = [offence.subject for offence in unused.find(house({"marey_x.a": text}))]
    assert found == ["marey_x.a.dead", "marey_x.a.A.dead_too"]


def test_a_local_function_is_used_only_where_its_own_function_names_it() -> None:
    text = """
def f():
    def body(): ...
    def used(): ...
    return used

@register
def g(body):
    return f, body
"""
    found = [offence.subject for offence in unused.find(house({"marey_x.a": text}))]
    assert found == ["marey_x.a.f.body"]


@pytest.mark.parametrize("code", ["`project.merge()`", "```py\nproject.merge()\n```"])
def test_names_in_code_of_the_docs_are_used(code: str) -> None:
    modules = {"marey_x.a": "def merge(): ...\n"}
    assert not list(unused.find(house(modules, {"docs/use.md": f"Words.\n\n{code}\n"})))


def test_words_in_the_text_of_the_docs_are_no_use_of_a_name() -> None:
    modules = {"marey_x.a": "def merge(): ...\n"}
    assert messages(unused.find(house(modules, {"docs/use.md": "How to merge two clips: use `cut`.\n"})))


def test_a_variable_of_a_module_that_nothing_reads_is_unused() -> None:
    text = "__all__ = []\nMOST = 3\nLEAST: int = 1\nZERO, ONE = 0, 1\nTWO, THREE = 2, 3\nLEAST = ONE\nprint(MOST)\n"
    found = [offence.subject for offence in unused.find(house({"marey_x.a": text}))]
    assert found == ["marey_x.a.LEAST", "marey_x.a.TWO", "marey_x.a.LEAST"]


def test_names_in_generated_modules_are_not_used() -> None:
    modules = {"marey_x.a": "def of_the_sdk(): ...\n", "marey_x.b": '"""Written by `make docs`."""\nof_the_sdk()\n'}
    assert [offence.subject for offence in unused.find(house(modules))] == ["marey_x.a.of_the_sdk"]


def test_reader_and_writer_of_a_format_are_used_by_the_name_of_their_module() -> None:
    text = "def read_toy(): pass\ndef write_toy(): pass\ndef read_other(): pass\n"
    found = [offence.subject for offence in unused.find(house({"marey_motion.formats.toy": text}))]
    assert found == ["marey_motion.formats.toy.read_other"]


def test_long_functions_and_modules_are_found_and_docstrings_do_not_count() -> None:
    body = "".join(f"    x = {number}\n" for number in range(41))
    docstring = '    """Do it.\n' + "\n" * 50 + '    """\n'
    assert messages(lengths.find(house({"marey_x.a": f"def f():\n{docstring}{body}"}))) == [
        "f has 41 lines, more than 40; split it"
    ]
    assert not list(lengths.find(house({"marey_x.a": f"def f():\n{docstring}{body[:-11]}"})))
    assert messages(lengths.find(house({"marey_x.a": "x = 1\n" * 401}))) == ["401 lines, more than 400; split it"]


def test_a_long_line_of_text_in_a_page_is_found() -> None:
    long = "word " * 30
    page = f"| {long} |\n```\n{long}\n```\n[1]: {long}\nshort\n{long}\n[A link](a.md): {long}\n"
    (offence, after_link) = lengths.find(house({}, {"docs/page.md": page}))
    assert (offence.line, offence.message) == (7, "the line has 150 characters, more than 120; wrap it")
    assert after_link.line == 8


def test_a_list_that_repeats_words_of_a_vocabulary_is_found() -> None:
    home = "class State(StrEnum):\n    A = 'waiting'\n    B = 'queued'\n    C = 'running'\n    D = 'failed'\n"
    copy = "OPEN = ('waiting', 'queued', 'running')\n"
    (offence,) = lists.find(house({"marey_schemas.queue.jobs": home, "marey_x.a": copy}))
    assert "words of marey_schemas.queue.jobs.State" in offence.message
    other = "OPEN = ('waiting', 'queued', 'opened')\n"
    assert not list(lists.find(house({"marey_schemas.queue.jobs": home, "marey_x.a": other})))


@pytest.mark.parametrize(
    ("home", "copy"),
    [
        ('MODES = ("loop", "trim", "clamp")\n', "ENDS = ['clamp', 'loop', 'trim']\n"),
        ('Mode = Literal["loop", "trim", "clamp"]\n', "def f(end: Literal['clamp', 'loop', 'trim']): ...\n"),
        ('MODES: set[str] = frozenset({"loop", "trim", "clamp"})\n', "for x in ('clamp', 'loop', 'trim'): ...\n"),
    ],
)
def test_a_list_that_repeats_all_words_of_a_list_with_a_name_is_found(home: str, copy: str) -> None:
    found = lists.find(house({"marey_x.a": home, "marey_y.b": copy}))
    assert any(offence.path == ROOT / "marey_y/b.py" for offence in found)
    assert not list(lists.find(house({"marey_x.a": home, "marey_y.b": copy.replace("clamp", "hold")})))
    assert not list(lists.find(house({"marey_x.a": home, "marey_y.b": f'"""Written by `make docs`."""\n{copy}'})))


def test_letters_are_no_words() -> None:
    assert not list(lists.find(house(dict.fromkeys(("marey_x.a", "marey_y.b"), "AXES = ('x', 'y', 'z')\n"))))


@pytest.mark.parametrize(
    "copy",
    [
        "MOST, LONGEST_BYTES = 3, 1048576\n",
        "LONGEST_BYTES: Final = 1048576\n",
        "_LONGEST_BYTES = 1 << 20\n",
        "LONGEST_BYTES = 1024 * 1024\n",
        "PIECE = 1024\nLONGEST_BYTES = 1024 * PIECE\n",
    ],
    ids=["one of several", "with a type", "private", "calculated", "calculated from another"],
)
def test_a_constant_that_two_modules_declare_is_found(copy: str) -> None:
    (offence,) = constants.find(house({"marey_x.a": "LONGEST_BYTES = 1_048_576\n", "marey_y.b": copy}))
    assert offence.subject == "marey_y.b.LONGEST_BYTES"
    assert offence.message.startswith("LONGEST_BYTES = 1048576 is also in marey_x.a, line 1")


@pytest.mark.parametrize("value", ["MIB", "frozenset({'a'})", "(1, 2)"])
def test_a_constant_is_found_whatever_its_value_is(value: str) -> None:
    (offence,) = constants.find(house(dict.fromkeys(("marey_x.a", "marey_y.b"), f"PIECE = {value}\n")))
    assert offence.subject == "marey_y.b.PIECE"


def test_constants_of_other_names_values_or_made_by_calls_are_no_offence() -> None:
    fine = {"marey_x.a": "MOST = 3\nLOG = get_log()\nkind = 1\n", "marey_y.b": "MOST = 4\nLOG = get_log()\nkind = 1\n"}
    assert not list(constants.find(house(fine)))


def test_a_constant_that_cannot_be_evaluated_is_no_offence() -> None:
    assert not list(constants.find(house(dict.fromkeys(("marey_x.a", "marey_y.b"), "MOST = {[]: 1}\n"))))


@pytest.mark.parametrize(
    "text",
    [
        '"""What is left of it."""\n',
        'def f():\n    """How often it was tried."""\n',
        'class A:\n    """Where it lies."""\n',
        'MOST = 3\n"""How many there are."""\n',
        'x = "it is read when the\\nlast\\n    word of an attempt arrives"\n',
        'x = "this tells the caller"\n',
        'x = "the caller is told"\n',
        'x = "the name stands in the file"\n',
        'x = "it is read anew"\n',
        'x = "what becomes of it"\n',
        'x = f"hand in {1} jobs"\n',
        'x = "the last word of an attempt"\n',
        'x = "mirrored twins of clips"\n',
        'x = "a made-up clip"\n',
        "class Allowance: ...\n",
        "def earlier_answer(): ...\n",
    ],
)
def test_phrases_and_names_of_the_word_list_are_found(text: str) -> None:
    assert len(list(wording.find(house({"marey_x.a": text})))) == 1


@pytest.mark.parametrize(
    "text", ['"""Counts retries."""\n', 'x = "it is made up of parts"\n', 'x = "a foot that stands still"\n']
)
def test_plain_english_is_left_alone(text: str) -> None:
    assert not list(wording.find(house({"marey_x.a": text})))


def test_pages_are_read_but_not_their_code() -> None:
    page = "# Title\n\n```sh\ntell me\n```\n\nIt tells nobody.\n"
    (offence,) = wording.find(house({}, {"docs/page.md": page}))
    assert offence.line == 7


def test_a_module_of_an_old_name_is_found() -> None:
    assert messages(wording.find(house({"marey_x.settling": ""}))) == ["module settling is called propagation now"]


MIGRATION = """
import sqlalchemy as sa
from alembic import op
phase = "{phase}"
FILL = "UPDATE job SET note = 'old'"
def upgrade() -> None:
    op.create_table("note", sa.Column("id", sa.Integer, nullable=False))
    {step}
def downgrade() -> None:
    op.drop_table("note")
"""


def migration_offences(step: str, phase: str = "before") -> list[str]:
    """Return the messages about a migration with this step."""
    path = ROOT / "migrations" / "versions" / "0099_next.py"
    return messages(migrations.find(House({}, {}, {path: MIGRATION.format(phase=phase, step=step)})))


@pytest.mark.parametrize(
    ("step", "fault"),
    [
        ('op.drop_column("job", "note")', "does more than add"),
        ('op.drop_index("ix_job_claim", "job")', "does more than add"),
        ('op.rename_table("job", "task")', "does more than add"),
        ('op.alter_column("job", "note", nullable=False)', "does more than add"),
        ('op.alter_column("job", "note", type_=sa.String(4))', "does more than add"),
        ('op.create_check_constraint("short", "job", "priority < 4")', "does more than add"),
        ('with op.batch_alter_table("job") as job: job.drop_column("note")', "does more than add"),
        ('remove = op.drop_table; remove("job")', "does more than add"),
        ('op.get_bind().execute(sa.text("DELETE FROM job"))', "does more than add"),
        ('op.add_column("job", sa.Column("note", sa.Text, nullable=False))', "no default in the database"),
        ('op.add_column("job", sa.Column("note", sa.Text, nullable=False, default=""))', "no default in the database"),
        ('op.add_column("job", sa.Column("note", sa.Text, unique=True))', "narrows the table"),
        ('op.add_column("job", NOTE)', "cannot be checked"),
        ('op.create_index("uq_job_note", "job", ["note"], unique=True)', "a unique index narrows"),
        ("from alembic import op as o", "not imported as"),
        ("from alembic.op import drop_table", "not imported as"),
        ("import alembic.op", "not imported as"),
        ('getattr(op, "drop_table")("job")', "without naming the operation"),
        ('op.get_context().connection.execute(sa.text("DELETE FROM job"))', "more than its dialect"),
        ('op.execute("ALTER TABLE job ALTER COLUMN note SET NOT NULL")', "does more than set storage parameters"),
        ('op.execute("ALTER TABLE job SET (fillfactor = 70); DROP TABLE note")', "does more than set"),
        ("op.execute(FILL)", "does more than set"),
    ],
)
def test_a_migration_before_the_new_servers_that_does_more_than_add_is_found(step: str, fault: str) -> None:
    (message,) = migration_offences(step)
    assert fault in message
    assert migration_offences(step, "stopped") == migration_offences(step, "after") == []


@pytest.mark.parametrize(
    "step",
    [
        'op.add_column("job", sa.Column("note", sa.Text))',
        "op.get_context().dialect.name",
        'op.add_column("job", sa.Column("note", sa.Text, nullable=False, server_default=sa.text("0")))',
        'op.create_index("ix_job_note", "job", ["note"])',
        'op.create_index("uq_note_id", "note", ["id"], unique=True)',
        'op.execute(f"ALTER TABLE {1} SET (autovacuum_vacuum_scale_factor = {2})")',
    ],
)
def test_a_migration_that_only_adds_may_run_before_the_new_servers(step: str) -> None:
    assert migration_offences(step) == []


def test_a_migration_of_an_unknown_phase_is_found() -> None:
    (message,) = migration_offences("pass", "befor")
    assert "the phase 'befor' is unknown" in message


@pytest.mark.parametrize("declared", ['EARLY = "before"\nphase = EARLY', 'revision, phase = "0099", "before"'])
def test_a_phase_that_is_not_declared_as_a_text_is_found(declared: str) -> None:
    path = ROOT / "migrations" / "versions" / "0099_next.py"
    (message,) = messages(migrations.find(House({}, {}, {path: declared + "\n"})))
    assert "the phase cannot be read; assign the text itself" in message


def test_the_command_checks_every_rule() -> None:
    """Plant an offence for each rule; each message has a remedy after a semicolon or a colon."""
    text = "import marey_motion.b\nMOST = 3\nWORDS = ('one', 'two', 'three')\nclass Take: ...\ndef turned(): ...\n"
    planted = {f"marey_x.m{number}": "" for number in range(26)}
    planted |= {"marey_motion.a": text.replace("n.b", "n.a2"), "marey_motion.a2": text.replace("n.b", "n.a")}
    planted |= {"marey_motion.long": "x = 'what becomes of it'\n" * 401}
    modules = house(planted).modules
    migration = {ROOT / "migrations" / "versions" / "0099_next.py": "phase = 'befor'\n"}
    found = list(check(House(modules, {}, migration), ROOT))
    assert {rule for rule, _ in found} >= {*RULES, "wording"}
    without_remedy = {rule for rule, offence in found if not any(sign in offence.message for sign in ("; ", ": "))}
    assert not without_remedy


def test_an_exception_with_a_reason_lets_one_offence_pass_and_is_reported_when_nothing_needs_it() -> None:
    offences = [Offence(ROOT / "a.py", 1, "marey_x.a", "too long"), Offence(ROOT / "b.py", 1, "marey_y.b", "too long")]
    assert [one.subject for one in apply_exceptions("lengths", offences, {"marey_x.*": "a table"})] == ["marey_y.b"]
    (left,) = apply_exceptions("lengths", [], {"marey_x.a": "a table"})
    assert "not needed any more" in left.message


def test_an_exception_that_is_not_needed_is_reported_with_its_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "exceptions.toml"
    path.write_text('[lengths]\n"marey_x.a" = "a table"\n', "utf-8")
    monkeypatch.setattr("lint.exceptions.EXCEPTIONS", path)
    (left,) = apply_exceptions("lengths", [], {"marey_x.a": "a table"})
    assert (left.path, left.line) == (path, 2)


def test_exceptions_of_an_unknown_rule_are_reported_in_their_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lint.__main__.read_exceptions", lambda: {"ghosts": {}})
    (offence,) = (one for rule, one in check(house({}), ROOT) if rule == "exceptions")
    assert (offence.path, offence.message.partition(";")[0]) == (EXCEPTIONS, "no rule is called ghosts")


def test_the_baseline_of_the_wording_only_shrinks(tmp_path: Path) -> None:
    path = tmp_path / "wording.toml"
    path.write_text('"a.py" = 2\n"b.py" = 1\n', "utf-8")
    offences = [Offence(ROOT / "a.py", line, "told", "'told'") for line in (1, 2, 3)]
    assert len(list(apply_baseline(offences, {"a.py": 2}, ROOT))) == 3, "one more than allowed shows all of the file"
    assert not list(apply_baseline(offences, {"a.py": 3}, ROOT))
    (left,) = apply_baseline(offences[:1], {"a.py": 3}, ROOT)
    assert "--shrink" in left.message
    shrink_baseline([*offences, *offences], ROOT, path)
    assert read_baseline(path) == {"a.py": 2}, "no more than before"
    shrink_baseline(offences[:1], ROOT, path)
    assert read_baseline(path) == {"a.py": 1}
    shrink_baseline([offences[0]._replace(path=ROOT / "c.py")], ROOT, path)
    assert read_baseline(path) == {"c.py": 1}, "the text has moved"


@pytest.mark.parametrize(
    ("subject", "fault"),
    [
        ("Mend the store", "area"),
        ("store: mended the pool", "imperative"),
        ("store: mending the pool", "imperative"),
        ("store: mend the pool.", "full stop"),
        ("store: " + "x" * 66, "72"),
    ],
)
def test_a_commit_subject_that_is_not_in_form_is_refused(subject: str, fault: str) -> None:
    assert any(fault in one for one in faults_of(subject))


@pytest.mark.parametrize("subject", ["store: omit the password from Database.shown", 'Revert "store: omit it"'])
def test_a_commit_subject_in_form_passes(subject: str) -> None:
    assert faults_of(subject) == []


def test_a_sample_of_texts_is_the_same_for_the_same_seed() -> None:
    text = (
        '"""Module."""\ndef f(n):\n    """Turn."""\n    raise ValueError(f"{n} is not a number")\n'
        'opt(help="Number of turns.")\n'
    )
    drawn = house({"marey_x": text}, {"docs/a.md": "A page."})
    sample = draw(drawn, seed=1)
    assert sample == draw(drawn, seed=1)
    assert {sort: sorted(found) for sort, found in sample.items()} == {
        "docstrings": [("marey_x", "Module."), ("marey_x:2", "In marey_x: Module.\ndef f(n):\nTurn.")],
        "error texts": [("marey_x:4", "{n} is not a number")],
        "help texts": [("marey_x:5", "Number of turns.")],
        "pages": [("/checkout/docs/a.md", "A page.")],
    }


def test_the_docstring_of_a_method_is_shown_with_its_class_and_signature() -> None:
    method = '    def g(self, n: int = 1) -> str:\n        """Go."""\n'
    text = '"""Module.\n\nMore."""\nclass A(B):\n    """Box.\n\n    Wide."""\n' + method
    found = dict(draw(house({"marey_x": text}), seed=1)["docstrings"])
    assert found["marey_x:8"] == "In marey_x: Module.\nclass A(B): Box.\ndef g(self, n: int=1) -> str:\nGo."
