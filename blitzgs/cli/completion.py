# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs completion`: what the Tab key completes, as a script for a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

from blitzgs.cli import COMMANDS, parser_of
from blitzgs.cli.arguments import Commands, add_command
from blitzgs.config.fields import Config
from blitzgs.config.files import flat, to_dict

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


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    parser = add_command(commands, "completion", run, summary, HELP)
    parser.add_argument("shell", metavar="SHELL", choices=("bash", "zsh", "fish"))


def run(args: argparse.Namespace) -> int:
    """Print the script; returns the exit status."""
    print(script(args.shell))
    return 0


def script(shell: str) -> str:
    """Return the script for a shell."""
    commands = collect()
    if shell == "fish":
        return "\n".join(_fish(commands))
    flags, choices = [], []
    for name, (words, its_flags) in commands.items():
        flags.append(f"      {name}) flags='{' '.join(flag.name for flag in its_flags)}' ;;")
        after = {flag.name: flag.choices for flag in its_flags} | {name: words}
        choices += [
            f"      '{name} {before}') words='{' '.join(few)}' ;;" for before, few in after.items() if few
        ]
    text = _BASH.replace("@commands@", " ".join(commands)).replace("@flags@", "\n".join(flags))
    text = text.replace("@choices@", "\n".join(choices))
    return text if shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{text}"


def collect() -> dict[str, tuple[list[str], list[Flag]]]:
    """Return the words that may follow each command, such as `fit` after `gate`, and its flags."""
    found: dict[str, tuple[list[str], list[Flag]]] = {}
    for name, parser in parser_of(COMMANDS)[1].items():
        words: list[str] = []
        parsers: list[argparse.ArgumentParser] = [parser]
        for action in parser._actions:  # argparse has no public list of them
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
            if not action.option_strings:
                words += map(str, action.choices or ())
        flags = {flag.name: flag for each in parsers for flag in _flags(each)}
        found[name] = words, list(flags.values())
    found["train"][1].extend(Flag(f"--{name}", True, [], "a field") for name in flat(to_dict(Config())))
    return found


def _flags(parser: argparse.ArgumentParser) -> Iterator[Flag]:
    for action in parser._actions:
        for name in action.option_strings:
            if name.startswith("--"):
                choices = [str(choice) for choice in action.choices or ()]
                yield Flag(name, action.nargs != 0, choices, (action.help or "").partition(";")[0])


def _fish(commands: dict[str, tuple[list[str], list[Flag]]]) -> Iterator[str]:
    for name, (words, flags) in commands.items():
        yield f"complete -c blitzgs -n __fish_use_subcommand -f -a {name} -d {_quoted(COMMANDS[name][1])}"
        used = f"complete -c blitzgs -n '__fish_seen_subcommand_from {name}'"
        if words:
            yield f"{used} -f -a {_quoted(' '.join(words))}"
        for flag in flags:
            value = f" -x -a {_quoted(' '.join(flag.choices))}" if flag.choices else " -r" * flag.takes_value
            yield f"{used} -l {flag.name[2:]}{value} -d {_quoted(flag.help.replace('%', ''))}"


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
