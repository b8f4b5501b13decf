"""Answers to shells that request completion: typer finds the parameter, and a function of `found` completes it."""

from __future__ import annotations

import contextlib
import copy
import inspect
import io
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, get_args, get_origin

import typer
import typer.core
from typer.models import CommandInfo, ParameterInfo

from marey_client.cli.completion.found import How, Suggestion, Typed
from marey_client.cli.completion.shells import (
    FILES,
    VARIABLE,
    Line,
    answer_text,
    read_line,
    typed_by_typer,
)
from marey_client.cli.completion.subjects import how_to_complete
from marey_client.cli.terminal.schema_options import SchemaCommand, expanded

MOST_SUGGESTIONS = 1000
log = logging.getLogger(__name__)


def complete(app: typer.Typer, line: Line) -> list[Suggestion] | None:
    """Return suggestions for the word at the end of a line; None if the shell should complete file names."""
    from typer.completion import completion_init  # pyrefly: ignore[implicit-reexport]  # of a private module

    completion_init()
    asked = _ShellRequest(line)
    output = contextlib.redirect_stdout(io.StringIO())
    with _environment(typed_by_typer(line)), output as written, contextlib.suppress(SystemExit):
        asked.prepared(app)(prog_name="marey")
    if asked.found is not None:
        return asked.found[:MOST_SUGGESTIONS]
    return [Suggestion(text) for text in written.getvalue().splitlines() if text] or None


def answer_shell(
    app: Callable[[str | None], typer.Typer], apart: Callable[[list[str]], tuple[list[str], list[str]]]
) -> int:
    """Read a shell's request from environment variables, print suggestions, and return the exit status.

    `app` returns the application with the command of the given name. `apart` separates the global options from the
    other words. If anything fails, nothing is printed, because the text would appear in the line that the user types.
    """
    shell = os.environ[VARIABLE].removeprefix("complete_")
    try:
        given = read_line(os.environ)
        options, words = apart(list(given.words))
        line = Line(tuple(words), given.start, given.raw, tuple(options))
        with contextlib.redirect_stderr(io.StringIO()):
            found = complete(app(next(iter(words), None)), line)
    except Exception:  # a shell would print it between the prompt and the command
        log.debug("a question of a shell failed", exc_info=True)
        return 1
    if found is None:
        return FILES
    text = answer_text(shell, given, found)
    sys.stdout.write(f"{text}\n" if text else "")
    return 0


class _ShellRequest:
    """Request of a shell for completion.

    `found` holds the suggestions; None if `SUBJECTS` has no entry for the parameter.
    """

    def __init__(self, line: Line) -> None:
        self.line = line
        self.found: list[Suggestion] | None = None

    def prepared(self, app: typer.Typer, names: tuple[str, ...] = ()) -> typer.Typer:
        """Return a copy of an application whose parameters are completed by the functions in `SUBJECTS`."""
        made = copy.copy(app)
        made.registered_commands = [self._command(one, names) for one in app.registered_commands]
        made.registered_groups = [copy.copy(one) for one in app.registered_groups]
        for one in made.registered_groups:
            if one.typer_instance is not None:
                one.typer_instance = self.prepared(one.typer_instance, (*names, str(one.name)))
        return made

    def _command(self, command: CommandInfo, names: tuple[str, ...]) -> CommandInfo:
        assert command.callback is not None
        made = copy.copy(command)
        name = command.name or typer.main.get_command_name(command.callback.__name__)
        function: Callable[..., Any] = command.callback
        if command.cls is not None and issubclass(command.cls, SchemaCommand):
            function = self._without_models(command.cls)
            made.cls = typer.core.TyperCommand
        made.callback = self._completed(function, (*names, name))
        return made

    def _without_models(self, command: type[SchemaCommand]) -> Callable[..., Any]:
        """Return the function of a command without the options that come from models, because models load slowly.

        If the line contains an option that the function does not declare itself, the options from models are included.
        """
        options = [word.partition("=")[0] for word in (*self.line.words, self.line.start) if word.startswith("-")]
        if set(options) <= {"--json", *_own_options(command.function, command.groups)}:
            return _reduced(command.function, command.groups)
        return expanded(command.function, command.groups)

    def _completed(self, function: Callable[..., Any], command: tuple[str, ...]) -> Callable[..., Any]:
        """Return a function without effect, with the parameters of `function`, which typer completes by `SUBJECTS`."""

        def run(**_: Any) -> None: ...

        signature = inspect.signature(function, eval_str=True)
        parameters = []
        for name, parameter in signature.parameters.items():
            how = how_to_complete(command, name)
            made = parameter if how is None else _with_completion(parameter, self._answering(how, len(command)))
            parameters.append(made.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        run.__name__, run.__doc__ = function.__name__, function.__doc__
        run.__signature__ = inspect.Signature(parameters)  # pyrefly: ignore[missing-attribute]  # read by `inspect`
        run.__annotations__ = {one.name: one.annotation for one in parameters}
        return run

    def _answering(self, how: How, depth: int) -> Callable[..., list[str]]:
        """Return the function that typer calls to complete a parameter of a command whose name has `depth` words."""

        def answer(ctx: typer.Context, incomplete: str) -> list[str]:
            root = ctx.find_root().params
            token_file = root.get("token_file")
            typed = Typed(
                incomplete,
                self._values(ctx, depth),
                root.get("server"),
                None if token_file is None else os.fspath(token_file),
            )
            cut = self.line.start.removesuffix(incomplete)  # `--option=` if the value follows it without a space
            self.found = []
            first: dict[str, Suggestion] = {}  # a dataset and an item may have the same name
            for one in how(typed):
                if one.text.startswith(incomplete):
                    first.setdefault(one.text, Suggestion(cut + one.text, one.remark))
            self.found = list(first.values())
            return [one.text for one in self.found]

        return answer

    def _values(self, ctx: typer.Context, depth: int) -> Mapping[str, Any]:
        """Return the values of the parameters before the word at the cursor.

        If this word is the value of an option, typer has parsed no arguments yet. Then the line is parsed without the
        option.
        """
        words = list(self.line.words)
        if not words or not words[-1].startswith("-"):
            return ctx.params
        rest = words[depth:-1]
        return ctx.command.make_context(ctx.info_name, rest, parent=ctx.parent, resilient_parsing=True).params


def _with_completion(parameter: inspect.Parameter, answer: Callable[..., list[str]]) -> inspect.Parameter:
    """Return a copy of a parameter that typer completes by calling `answer`."""
    if get_origin(parameter.annotation) is not Annotated:
        return parameter
    kind, *declared = get_args(parameter.annotation)
    made = [copy.copy(one) for one in declared]
    for one in made:
        if isinstance(one, ParameterInfo):
            one.autocompletion = answer
    return parameter.replace(annotation=Annotated[(kind, *made)])


def _reduced(function: Callable[..., Any], groups: Mapping[str, Any]) -> Callable[..., Any]:
    def run(**_: Any) -> None: ...

    parameters = inspect.signature(function, eval_str=True).parameters.items()
    left = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for name, one in parameters if name not in groups]
    run.__name__, run.__doc__ = function.__name__, function.__doc__
    run.__signature__ = inspect.Signature(left)  # pyrefly: ignore[missing-attribute]  # read by `inspect`
    return run


def _own_options(function: Callable[..., Any], groups: Mapping[str, Any]) -> Iterator[str]:
    """Yield the spellings of the options that a function declares itself."""
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if name in groups or get_origin(parameter.annotation) is not Annotated:
            continue
        spelled: Sequence[str] = ()
        for one in get_args(parameter.annotation)[1:]:
            spelled = [text for given in getattr(one, "param_decls", None) or () for text in given.split("/")]
        yield from spelled or (f"--{name.replace('_', '-')}", f"--no-{name.replace('_', '-')}")


@contextlib.contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
