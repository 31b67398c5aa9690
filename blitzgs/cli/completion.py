# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs completion`: what the Tab key completes, as a script for a shell."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

from blitzgs.cli import COMMANDS, parser_of
from blitzgs.cli.arguments import Commands, add_command
from blitzgs.config.files import REMOVED

HELP = """\
Print a script that lets the Tab key complete commands, flags and fields of the configuration:

  bash   blitzgs completion bash > ~/.local/share/bash-completion/completions/blitzgs
  zsh    blitzgs completion zsh >> ~/.zshrc
  fish   blitzgs completion fish > ~/.config/fish/completions/blitzgs.fish
"""

# zsh runs the script of bash.
_BASH = """\
_blitzgs() {
  local current=${COMP_WORDS[COMP_CWORD]} previous=${COMP_WORDS[COMP_CWORD-1]} command=${COMP_WORDS[1]}
  local flags='' words=''
  if [ "$COMP_CWORD" = 1 ]; then
    words='@commands@'
  else
    case "$command" in
@flags@
    esac
    case "$command $previous" in
@choices@
    esac
  fi
  case "$current" in -*) words=$flags ;; esac
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}
complete -o default -F _blitzgs blitzgs
"""


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    add_command(commands, "completion", run, summary, HELP, "shell bash|zsh|fish  the shell")


def run(args: argparse.Namespace) -> None:
    """Print the script."""
    print(script(args.shell))


def script(shell: str) -> str:
    """Return the script for a shell."""
    commands = parser_of(COMMANDS)[1]
    if shell == "fish":
        return "\n".join(line for name, parser in commands.items() for line in _fish(name, parser))
    flags, choices = [], []
    for name, parser in commands.items():
        words, actions = _after(parser)
        flags.append(f"      {name}) flags='{' '.join(actions)}' ;;")
        after = {flag: _choices(action) for flag, action in actions.items()} | {name: words}
        lists = ((before, " ".join(few)) for before, few in after.items() if few)
        choices += [f"      '{name} {before}') words='{few}' ;;" for before, few in lists]
    parts = {"@commands@": " ".join(commands), "@flags@": "\n".join(flags), "@choices@": "\n".join(choices)}
    text = re.sub("@[a-z]+@", lambda match: parts[match[0]], _BASH)
    return text if shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{text}"


def _after(parser: argparse.ArgumentParser) -> tuple[list[str], dict[str, argparse.Action]]:
    """Return the words that may follow a command, such as `fit` after `gate`, and its flags."""
    words: list[str] = []
    flags: dict[str, argparse.Action] = {}
    for action in parser._actions:  # argparse has no public list of them
        if not action.option_strings:
            words += _choices(action)
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                flags |= _after(each)[1]
        flags |= {flag: action for flag in action.option_strings if flag.startswith("--")}
    return words, {flag: action for flag, action in flags.items() if flag[2:] not in REMOVED}


def _choices(action: argparse.Action) -> list[str]:
    return [str(choice) for choice in action.choices or ()]


def _fish(name: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    yield f"complete -c blitzgs -n __fish_use_subcommand -f -a {name} -d {_quoted(COMMANDS[name][1])}"
    used = f"complete -c blitzgs -n '__fish_seen_subcommand_from {name}'"
    words, flags = _after(parser)
    if words:
        yield f"{used} -f -a {_quoted(' '.join(words))}"
    for flag, action in flags.items():
        few = _choices(action)
        value = f" -x -a {_quoted(' '.join(few))}" if few else " -r" * (action.nargs != 0)
        meaning = "a field" if action.help == argparse.SUPPRESS else (action.help or "")
        meaning = meaning.partition(";")[0].replace("%", "")
        yield f"{used} -l {flag[2:]}{value} -d {_quoted(meaning)}"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
