"""Prepared statements: compiled once by SQLAlchemy, then passed to the driver as text.

SQLAlchemy spends about 55 µs on a statement that SQLite answers in 10 µs: for each execution, SQLAlchemy looks up the
compiled form, and builds a context and a result with metadata. A prepared statement stores the text, the order of the
parameters and the conversions of values at its first run (docs/decisions/0012).
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import chain
from typing import Any, TypeVar, cast

from sqlalchemy import BindParameter, Connection, Delete, Dialect, Insert, Select, Update, exc
from sqlalchemy.sql.schema import ScalarElementColumnDefault

T = TypeVar("T")

Statement = Select[*tuple[Any, ...]] | Insert | Update | Delete
Convert = Callable[[Any], Any]
Parameters = Mapping[str, Any]

MOST_FORMS = 64
"""Greatest number of stored texts of one statement: one for each combination of parameter names and list lengths."""


class Prepared:
    """Statement of SQLAlchemy Core with `bindparam`s; lists are parameters with `expanding=True`.

    An INSERT without values sets the columns named in the parameters of the run; the other columns get their defaults.
    """

    def __init__(self, statement: Statement) -> None:
        self._statement = statement.inline() if isinstance(statement, Insert) else statement
        self._lists: tuple[str, ...] | None = None
        self._forms: dict[tuple[object, ...], _Form] = {}

    def run(self, connection: Connection, parameters: Parameters) -> list[Any]:
        """Run the statement and return its rows as named tuples."""
        form = self.form(connection.dialect, parameters)
        rows = _run(connection, form.text, form.values(parameters), gives_rows=form.to_row is not None)
        return form.rows(rows)

    def run_each(self, connection: Connection, many: Sequence[Parameters]) -> None:
        """Run the statement once for each mapping in `many`, all with the same keys; return no rows."""
        if len(many) == 1:
            self.run(connection, many[0])
        elif many:
            form = self.form(connection.dialect, many[0])
            _run(connection, form.text, [form.values(one) for one in many], many=True)

    def form(self, dialect: Dialect, parameters: Parameters) -> _Form:
        """Return the statement compiled for the names of the parameters and the lengths of the lists among them."""
        if self._lists is not None:
            form = self._forms.get(self._key(dialect, self._lists, parameters))
            if form is not None:
                return form
        form = _compile(self._statement, dialect, parameters)
        self._lists = tuple(form.expansion)
        if len(self._forms) >= MOST_FORMS:
            self._forms.clear()
        self._forms[self._key(dialect, self._lists, parameters)] = form
        return form

    @staticmethod
    def _key(dialect: Dialect, lists: Iterable[str], parameters: Parameters) -> tuple[object, ...]:
        return (dialect.name, *parameters, *[len(parameters[name]) for name in lists])


def run_together(connection: Connection, runs: Sequence[tuple[Prepared, Parameters]]) -> list[list[Any]]:
    """Run statements that do not depend on each other, and return the rows of each.

    On Postgres, the driver sends all of them at once, and then waits once.
    """
    if connection.dialect.name != "postgresql" or len(runs) < 2:
        return [statement.run(connection, parameters) for statement, parameters in runs]
    forms = [(statement.form(connection.dialect, parameters), parameters) for statement, parameters in runs]
    driver: Any = connection.connection.driver_connection
    text = ""
    try:
        with ExitStack() as cursors:
            with driver.pipeline():
                filled = []
                for form, parameters in forms:
                    text = form.text
                    filled.append(cursors.enter_context(driver.cursor()).execute(text, form.values(parameters)))
            return [form.rows(cursor.fetchall()) for (form, _), cursor in zip(forms, filled, strict=True)]
    except connection.dialect.loaded_dbapi.Error as error:
        raise _failure(connection, text, error) from error


def padded(values: Iterable[T]) -> list[T]:
    """Extend a list for `IN` to a length that is a power of two, by repeating its last value.

    Statements are compiled once for each length of a list, so padded lists need only a few compilations.
    """
    known = list(values)
    return known + known[-1:] * ((1 << max(len(known) - 1, 0).bit_length()) - len(known))


def run_text(connection: Connection, text: str) -> None:
    """Run a statement that has no parameters and returns no rows."""
    _run(connection, text, ())


def run_texts(connection: Connection, texts: Sequence[str]) -> list[Any]:
    """Run statements without parameters on Postgres, in one round trip; return the rows of the last one."""
    try:
        with closing(connection.connection.cursor()) as cursor:
            cursor.execute("; ".join(texts))
            while cursor.nextset():
                pass
            return list(cursor.fetchall())
    except connection.dialect.loaded_dbapi.Error as error:
        raise _failure(connection, texts[0], error) from error


@dataclass(frozen=True, slots=True)
class _Form:
    """Text of a statement, compiled for one database and for one length of each list parameter."""

    text: str
    constants: Mapping[str, Any]
    """Values of the constants in the statement, by parameter name."""
    expansion: Mapping[str, Sequence[str]]
    """For each list parameter, the names under which the statement contains its values."""
    converts: Mapping[str, Convert]
    order: tuple[str, ...] | None
    """Names of the parameters in the order of the text; None if the driver takes parameters by name."""
    to_row: Convert | None

    def values(self, parameters: Parameters) -> Any:
        """Return the parameters as the driver takes them: a tuple in the order of the text, or a mapping by name."""
        named = {**self.constants, **parameters}
        for name, members in self.expansion.items():
            named.update(_members(members, named.pop(name)))
        for name, convert in self.converts.items():
            named[name] = convert(named[name])
        return named if self.order is None else tuple([named[name] for name in self.order])

    def rows(self, found: list[Any]) -> list[Any]:
        """Return rows of the driver as named tuples."""
        return found if self.to_row is None else list(map(self.to_row, found))


def _members(names: Sequence[str], given: Sequence[Any]) -> Iterable[tuple[str, Any]]:
    """Pair the placeholder names of a list parameter with the values; a list of tuples is flattened first."""
    nested = bool(given) and isinstance(given[0], tuple)
    return zip(names, chain.from_iterable(given) if nested else given, strict=True)


def _compile(statement: Statement, dialect: Dialect, parameters: Parameters) -> _Form:
    compiled = statement.compile(
        dialect=dialect, column_keys=list(parameters) if isinstance(statement, Insert) else None
    )
    binds: Mapping[str, BindParameter[Any]] = compiled.binds
    if unknown := parameters.keys() - binds.keys():
        raise TypeError(f"the SQL statement has no parameters of these names: {', '.join(sorted(unknown))}")
    state = compiled.construct_expanded_state(dict(parameters))
    converts = {
        name: convert
        for name, bind in binds.items()
        if name not in state.parameter_expansion
        and (convert := bind.type.dialect_impl(dialect).bind_processor(dialect)) is not None
    }
    fixed = {name: value for name, value in compiled.params.items() if name not in parameters}
    for column in compiled.insert_prefetch:
        assert isinstance(column.default, ScalarElementColumnDefault), f"{column} has no fixed value"
        fixed[column.key] = column.default.arg
    for name in fixed.keys() & state.parameter_expansion.keys():  # lists that are part of the statement itself
        fixed.update(_members(state.parameter_expansion[name], fixed.pop(name)))
    return _Form(
        state.statement,
        {name: converts[name](value) if name in converts else value for name, value in fixed.items()},
        {name: members for name, members in state.parameter_expansion.items() if name in parameters},
        {name: convert for name, convert in converts.items() if name in parameters},
        None if state.positiontup is None else tuple(state.positiontup),
        _row_maker(statement, dialect),
    )


def _row_maker(statement: Any, dialect: Dialect) -> Convert | None:
    """Return a function that makes named tuples from the driver's rows; None for a statement that returns no rows."""
    columns = statement.exported_columns
    if not columns:
        return None
    row: Any = namedtuple("Row", columns.keys())  # pyrefly: ignore[bad-class-definition]  # the columns are known only when this runs
    make: Convert = row._make
    converts = [
        (index, convert)
        for index, column in enumerate(columns)
        if (convert := column.type.dialect_impl(dialect).result_processor(dialect, None)) is not None
    ]
    if not converts:
        return make

    def make_converted(found: Iterable[Any]) -> Any:
        values = list(found)
        for index, convert in converts:
            values[index] = convert(values[index])
        return make(values)

    return make_converted


def _run(connection: Connection, text: str, values: Any, *, gives_rows: bool = False, many: bool = False) -> list[Any]:
    try:
        with closing(connection.connection.cursor()) as cursor:
            (cursor.executemany if many else cursor.execute)(text, values)
            return list(cursor.fetchall()) if gives_rows else []
    except connection.dialect.loaded_dbapi.Error as error:
        raise _failure(connection, text, error) from error


def _failure(connection: Connection, text: str, error: Exception) -> Exception:
    """Return the SQLAlchemy error for an error that the database driver raised.

    If the connection broke, also discard the idle connections of the pool.
    """
    dialect = connection.dialect
    lost = dialect.is_disconnect(cast(Any, error), connection.connection, None)
    if lost:
        connection.invalidate(error)
        connection.engine.dispose()
    return exc.DBAPIError.instance(
        text,
        None,
        error,
        dialect.loaded_dbapi.Error,
        hide_parameters=True,
        connection_invalidated=lost,
        dialect=dialect,
    )
