# SPDX-License-Identifier: Apache-2.0
"""The command `blitzgs synth`: make a synthetic city."""

from __future__ import annotations

import argparse

from blitzgs.cli.arguments import Commands, add_command
from blitzgs_synth import command


def add_to(commands: Commands[argparse.ArgumentParser], summary: str) -> None:
    """Add the command."""
    command.add_arguments(add_command(commands, "synth", command.run, summary))
