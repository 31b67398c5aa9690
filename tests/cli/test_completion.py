# SPDX-License-Identifier: Apache-2.0
"""The Tab key completes commands, flags, fields and choices."""

import shutil
import subprocess

import pytest

from blitzgs.cli import COMMANDS
from blitzgs.cli.completion import script


@pytest.mark.parametrize(
    "words, completed",
    [
        (["tr"], ["train"]),
        ([""], list(COMMANDS)),
        (["gate", ""], ["fit", "sample", "evaluate", "replay"]),
        (["gate", "fit", "--o"], ["--out"]),
        (["train", "--data.downs"], ["--data.downscale"]),
        (["render", "--split", ""], ["test", "train", "all"]),
        (["render", "--split", "t"], ["test", "train"]),
        (["view", ""], []),  # the shell's file names
        (["completion", ""], ["bash", "zsh", "fish"]),
    ],
)
def test_bash(words, completed, tmp_path):
    (tmp_path / "script").write_text(script("bash"))
    program = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _blitzgs; echo "${COMPREPLY[@]}"'
    )
    command = ["bash", "-c", program, "-", str(tmp_path / "script"), "blitzgs", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == completed and not done.stderr


def test_fish(tmp_path):
    lines = script("fish").splitlines()
    assert any("-a train -d" in line for line in lines)
    assert any("seen_subcommand_from render' -l split -x -a 'test train all'" in line for line in lines)
    assert any("-l data.downscale -r" in line for line in lines)
    if shutil.which("fish"):
        (tmp_path / "script").write_text(script("fish"))
        subprocess.run(["fish", "-n", str(tmp_path / "script")], check=True)


def test_zsh_runs_the_script_of_bash(tmp_path):
    assert script("zsh").startswith("autoload -U +X bashcompinit") and script("bash") in script("zsh")
    if shutil.which("zsh"):
        (tmp_path / "script").write_text(script("zsh"))
        subprocess.run(["zsh", "-n", str(tmp_path / "script")], check=True)
