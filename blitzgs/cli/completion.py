# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs completion`: what the Tab key completes, as a script for a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from blitzgs.cli import COMMANDS, parser_of
from blitzgs.cli.arguments import Commands, add_command
from blitzgs.config.fields import Config
from blitzgs.config.files import to_dict

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


class Flag(NamedTuple):
    """A flag of a command."""

    name: str  # with its dashes
    takes_value: bool
    choices: list[str]  # where the values are few
    help: str


class Command(NamedTuple):
    """A command."""

    summary: str
    flags: list[Flag]  # also of its actions
    actions: list[str]  # words that may follow it, such as `fit` after `gate`


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "completion", run, summary, HELP)
    parser.add_argument("shell", choices=("bash", "zsh", "fish"))


def run(args: argparse.Namespace) -> int:
    """Print the script; returns the exit status."""
    print(script(args.shell))
    return 0


def script(shell: str) -> str:
    """Return the script for a shell."""
    commands = collect()
    if shell == "fish":
        return "\n".join(_fish(commands))
    flags = [f"      {name}) flags='{' '.join(f.name for f in c.flags)}' ;;" for name, c in commands.items()]
    choices = [
        f"      '{name} {flag.name}') words='{' '.join(flag.choices)}' ;;"
        for name, command in commands.items()
        for flag in command.flags
        if flag.choices
    ]
    choices += [
        f"      '{name} {name}') words='{' '.join(command.actions)}' ;;"
        for name, command in commands.items()
        if command.actions
    ]
    text = _BASH.replace("@commands@", " ".join(commands)).replace("@flags@", "\n".join(flags))
    text = text.replace("@choices@", "\n".join(choices))
    return text if shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{text}"


def collect() -> dict[str, Command]:
    """Return all commands with their flags, from their parsers."""
    found = {name: _command(sub, COMMANDS[name][1]) for name, sub in parser_of(COMMANDS)[1].items()}
    for section, values in to_dict(Config()).items():
        names = [f"{section}.{name}" for name in values] if isinstance(values, dict) else [section]
        found["train"].flags.extend(Flag(f"--{name}", True, [], "a field") for name in names)
    return found


def _command(parser: argparse.ArgumentParser, summary: str) -> Command:
    flags = {flag.name: flag for flag in _flags(parser)}
    actions = _children(parser)
    for action in actions.values():
        flags |= {flag.name: flag for flag in _flags(action)}
    positional = [a for a in parser._actions if not a.option_strings and a.choices and not actions]
    words = [*actions, *(str(choice) for a in positional for choice in a.choices or ())]
    return Command(summary, list(flags.values()), words)


def _children(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:  # argparse has no public list of them
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _flags(parser: argparse.ArgumentParser) -> Iterator[Flag]:
    for action in parser._actions:
        for name in action.option_strings:
            if name.startswith("--"):
                choices = [str(choice) for choice in action.choices or ()]
                yield Flag(name, action.nargs != 0, choices, (action.help or "").partition(";")[0])


def _fish(commands: dict[str, Command]) -> Iterator[str]:
    for name, command in commands.items():
        yield f"complete -c blitzgs -n __fish_use_subcommand -f -a {name} -d {_quoted(command.summary)}"
        used = f"complete -c blitzgs -n '__fish_seen_subcommand_from {name}'"
        if command.actions:
            yield f"{used} -f -a {_quoted(' '.join(command.actions))}"
        for flag in command.flags:
            value = f" -x -a {_quoted(' '.join(flag.choices))}" if flag.choices else " -r" * flag.takes_value
            yield f"{used} -l {flag.name[2:]}{value} -d {_quoted(flag.help.replace('%', ''))}"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
