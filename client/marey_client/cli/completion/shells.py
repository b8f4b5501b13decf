"""Protocol between shells and `marey` during completion: scripts for shells, words of a line, and answers."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from marey_client.cli.completion.found import Suggestion
from marey_client.cli.completion.quoting import for_bash, for_powershell, marks

VARIABLE = "_MAREY_COMPLETE"
"""Environment variable that requests completion; the value is `complete_` followed by the name of the shell."""
LINE = "_TYPER_COMPLETE_ARGS"
"""Environment variable that contains the command line up to the cursor, as typed."""
REPLACED = "_MAREY_REPLACED"
"""Environment variable with the part at the end of the line that bash replaces by the chosen suggestion."""
WORD = "_TYPER_COMPLETE_WORD_TO_COMPLETE"
"""Environment variable with the word at the cursor in PowerShell, whose line lacks the space before an empty word."""
FILES = 3
"""Exit status by which `marey` requests that the shell completes file names."""

_BASH = r"""
_marey_completion() {
    local answer state line
    COMPREPLY=()
    [[ $COMP_TYPE == 42 ]] && return  # Alt-* inserts all suggestions and removes the quote before them
    answer=$(_MAREY_COMPLETE=complete_bash _TYPER_COMPLETE_ARGS="${COMP_LINE:0:COMP_POINT}" \
        _MAREY_REPLACED="$2" marey 2>/dev/null)
    state=$?
    while IFS= read -r line; do
        [[ -n $line ]] && COMPREPLY+=("$line")
    done <<< "$answer"
    if [[ $state -eq 3 ]]; then
        compopt -o default -o bashdefault 2>/dev/null
    elif [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[/=] ]]; then
        compopt -o nospace 2>/dev/null
    fi
    return 0
}
complete -F _marey_completion marey
"""
_ZSH = r"""
#compdef marey
_marey_completion() {
    local -a lines folders shown_folders others shown_others
    local line text state answer
    answer=$(_MAREY_COMPLETE=complete_zsh _TYPER_COMPLETE_ARGS="${words[1,$CURRENT]}" marey 2>/dev/null; echo $?)
    lines=("${(@f)answer}")
    state=${lines[-1]}
    lines[-1]=()
    if [[ $state == 3 ]]; then
        _files
        return
    fi
    for line in "${lines[@]}"; do
        text=${line%%$'\t'*}
        if [[ $text == */ ]]; then
            folders+=("$text") shown_folders+=("${line/$'\t'/  -- }")
        else
            others+=("$text") shown_others+=("${line/$'\t'/  -- }")
        fi
    done
    (( $#folders )) && compadd -S '' -l -d shown_folders -a folders
    (( $#others )) && compadd -V marey -l -d shown_others -a others
}
if [[ $funcstack[1] == _marey ]]; then
    _marey_completion "$@"
else
    compdef _marey_completion marey
fi
"""
_FISH = r"""
function __marey_completion
    set -l typed (commandline -cp | string collect)
    set -l lines (env _MAREY_COMPLETE=complete_fish _TYPER_COMPLETE_ARGS="$typed" marey 2>/dev/null)
    if test $status -eq 3
        __fish_complete_path (commandline -ct)
    else
        printf '%s\n' $lines
    end
end
complete --command marey --no-files --keep-order --arguments '(__marey_completion)'
"""
SCRIPTS = {"bash": _BASH.lstrip(), "zsh": _ZSH.lstrip(), "fish": _FISH.lstrip()}
"""Completion script of each shell, by the shell's name."""

POWERSHELLS = ("powershell", "pwsh")


@dataclass(frozen=True)
class Line:
    """Command line up to the cursor, without quotes and without the name of the program."""

    words: tuple[str, ...]
    """Words before the one at the cursor."""
    start: str
    """Beginning of the word at the cursor."""
    raw: str
    """Beginning of the word at the cursor as it was typed, with quotes and backslashes."""
    options: tuple[str, ...] = ()
    """Global options such as `--server`, with their values; typer needs them before all other words."""

    replaced: str | None = None
    """End of `raw` that bash replaces by the chosen suggestion; None if the shell did not send this end."""

    @classmethod
    def parse(cls, text: str, replaced: str | None = None) -> Line:
        """Split a line into words as POSIX shells do; a quote that is still open extends to the end of the line."""
        words, start, begin = [], "", -1
        for mark in marks(text):
            if mark.is_free and mark.typed.isspace():
                if begin >= 0:
                    words.append(start)
                start, begin = "", -1
                continue
            begin = mark.place if begin < 0 else begin
            start += mark.plain
        return cls(tuple(words[1:]), start, text[begin:] if begin >= 0 else "", replaced=replaced)


def read_line(environment: Mapping[str, str]) -> Line:
    """Return the command line that a shell sends in environment variables, by a script of this module or of typer."""
    if LINE in environment:
        ends_with_space = environment.get(WORD) == ""
        return Line.parse(environment[LINE] + " " * ends_with_space, environment.get(REPLACED))
    words = Line.parse(f"{environment.get('COMP_WORDS', '')} ").words
    count = max(0, int(environment.get("COMP_CWORD") or 1) - 1)
    start = words[count] if count < len(words) else ""
    return Line(tuple(words[:count]), start, start)


def answer_text(shell: str, line: Line, found: Iterable[Suggestion]) -> str:
    """Return the suggestions in the form that the script of a shell reads, one per line."""
    lines = (_shown(shell, line, one.text, _one_line(one.remark)) for one in found if one.text.isprintable())
    return "\n".join(one for one in lines if one is not None)


def _shown(shell: str, line: Line, text: str, remark: str) -> str | None:
    """Return a suggestion in the form that the script of a shell reads; None if the shell could misread it."""
    if shell == "bash":
        return for_bash(text, line.raw, line.raw if line.replaced is None else line.replaced)
    if shell in POWERSHELLS:
        return for_powershell(text, remark)
    return f"{text}\t{remark}" if remark else text


def typed_by_typer(line: Line) -> dict[str, str]:
    """Return environment variables by which typer completes `line` and prints one suggestion per line."""
    words = [*line.options, *line.words, line.start]
    return {"COMP_WORDS": shlex.join(["marey", *words]), "COMP_CWORD": str(len(words)), VARIABLE: "complete_bash"}


def _one_line(remark: str) -> str:
    shown = "".join(one if one.isprintable() else " " for one in remark)
    return f"{shown[:79]}…" if len(shown) > 80 else shown
