"""Protocol between shells and `marey` during completion: scripts for shells, words of a line, and answers."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from marey_client.cli.completion.found import Suggestion

VARIABLE = "_MAREY_COMPLETE"
"""Environment variable by which a shell asks for completion: `complete_` and the name of the shell."""
LINE = "_TYPER_COMPLETE_ARGS"
"""Environment variable that contains the command line up to the cursor, as typed."""
WORD_BREAKS = "_MAREY_WORD_BREAKS"
"""Environment variable with the characters at which bash splits words for completion, besides white space."""
FILES = 3
"""Exit status that means: complete with files."""

_BASH = r"""
_marey_completion() {
    local IFS=$'\n' state
    COMPREPLY=( $(_MAREY_COMPLETE=complete_bash _TYPER_COMPLETE_ARGS="${COMP_LINE:0:COMP_POINT}" \
        _MAREY_WORD_BREAKS="$COMP_WORDBREAKS" marey 2>/dev/null) )
    state=$?
    if [[ $state -eq 3 ]]; then
        compopt -o default -o bashdefault
    elif [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[/=] ]]; then
        compopt -o nospace
    fi
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
    set -l typed (commandline -cp | string collect --no-trim-newlines)
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
"""Script by the name of its shell."""

_QUOTED_BY_BASH = " \t\"'\\$`&|;<>()*?[]{}!#~"


@dataclass(frozen=True)
class Line:
    """Command line up to the cursor, without quotes and without the name of the program."""

    words: tuple[str, ...]
    """Words before the one at the cursor."""
    start: str
    """Beginning of the word at the cursor."""
    raw: str
    """The same as it was typed, with quotes."""
    options: tuple[str, ...] = ()
    """Global options with their values, which typer needs before all other words."""

    @classmethod
    def parse(cls, text: str) -> Line:
        """Parse a line as POSIX shells split it; a quote that is still open ends with the line."""
        words, start, place, begin = [], "", 0, 0
        quote, inside = "", False
        while place < len(text):
            one = text[place]
            if quote:
                if one == quote:
                    quote = ""
                elif one == "\\" and quote == '"' and text[place + 1 : place + 2] in tuple('"\\$`'):
                    place += 1
                    start += text[place]
                else:
                    start += one
            elif one in "'\"":
                quote, inside, begin = one, True, begin if inside else place
            elif one.isspace():
                if inside:
                    words.append(start)
                start, inside = "", False
            else:
                if not inside:
                    begin, inside = place, True
                if one == "\\" and place + 1 < len(text):
                    place += 1
                start += text[place]
            place += 1
        return cls(tuple(words[1:]), start, text[begin:] if inside else "")


def read_line(environment: Mapping[str, str]) -> Line:
    """Return the line that a shell sends, by a script of this module or by an earlier one made by typer."""
    if LINE in environment:
        return Line.parse(environment[LINE])
    words = Line.parse(f"{environment.get('COMP_WORDS', '')} ").words
    count = max(0, int(environment.get("COMP_CWORD") or 1) - 1)
    start = words[count] if count < len(words) else ""
    return Line(tuple(words[:count]), start, start)


def answer_text(shell: str, line: Line, found: Iterable[Suggestion], word_breaks: str = "") -> str:
    """Return the suggestions in the form that the script of a shell reads: one in each line."""
    fitting = [one for one in found if one.text.isprintable()]
    if shell == "bash":
        return "\n".join(_for_bash(one.text, line, word_breaks) for one in fitting)
    return "\n".join(f"{one.text}\t{_one_line(one.remark)}" if one.remark else one.text for one in fitting)


def typed_by_typer(line: Line) -> dict[str, str]:
    """Return the environment in which typer answers a line with one suggestion in each line, without remarks."""
    words = [*line.options, *line.words, line.start]
    return {"COMP_WORDS": shlex.join(["marey", *words]), "COMP_CWORD": str(len(words)), VARIABLE: "complete_bash"}


def _for_bash(text: str, line: Line, word_breaks: str) -> str:
    """Quote a suggestion as the typed word is quoted, without the part before the last character that splits words."""
    if line.raw.startswith("'"):
        return text.replace("'", "'\\''")
    if line.raw.startswith('"'):
        return "".join(f"\\{one}" if one in '"\\$`' else one for one in text)
    split = max((line.start.rfind(one) for one in word_breaks if not one.isspace() and one not in "'\""), default=-1)
    shown = text[split + 1 :] if text.startswith(line.start[: split + 1]) else text
    special = _QUOTED_BY_BASH + word_breaks.translate(str.maketrans("", "", "@=:"))
    return "".join(f"\\{one}" if one in special else one for one in shown)


def _one_line(remark: str) -> str:
    shown = "".join(one if one.isprintable() else " " for one in remark)
    return f"{shown[:79]}…" if len(shown) > 80 else shown
