# SPDX-License-Identifier: Apache-2.0
"""The help of the fields: every field has a meaning, its kind, its default and its range."""

import dataclasses
import re
import typing
from pathlib import Path

import pytest

from blitzgs.cli import main
from blitzgs.config.describe import _meanings, describe, describe_all
from blitzgs.config.fields import Config
from blitzgs.config.files import ConfigError, load_config
from blitzgs.config.ranges import RANGES

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"
SECTIONS = {
    name: kind for name, kind in typing.get_type_hints(Config).items() if dataclasses.is_dataclass(kind)
}
FIELDS = [
    f"{section}.{field.name}" for section, kind in SECTIONS.items() for field in dataclasses.fields(kind)
]


@pytest.mark.parametrize("name", [*FIELDS, "seed"])
def test_every_field_is_explained(name):
    head, _, meaning = describe(name).partition("\n")
    assert head.startswith(f"--{name}=") and len(meaning.split()) >= 2
    assert name not in RANGES or str(RANGES[name]) in head
    # The flag that is shown sets the default.
    assert load_config(None, [head.split("   (")[0]]) == Config()
    assert head in describe_all()


@pytest.mark.parametrize("kind", [Config, *SECTIONS.values()], ids=lambda kind: kind.__name__)
def test_no_field_that_is_gone_is_explained(kind):
    names = {field.name for field in dataclasses.fields(kind)}
    assert set(_meanings(kind)) == names - (set(SECTIONS) if kind is Config else set())


@pytest.mark.parametrize(
    ("wanted", "message"),
    [("downscal", "did you mean downscale"), ("data.zzz", "no such field"), ("", "no such field")],
)
def test_an_unknown_field_is_named(wanted, message):
    if wanted:
        with pytest.raises(ConfigError, match=message):
            describe(wanted)


def test_the_page_of_the_configuration_is_up_to_date(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["train", "--help-fields=markdown"])
    made = capsys.readouterr().out
    assert PAGE.read_text() == made, "blitzgs train --help-fields=markdown > docs/configuration.md"
    rows = [line.split("|") for line in made.splitlines() if line.count("|") == 2]
    assert sorted(re.findall("`([^`]+)`", ",".join(row[0] for row in rows))) == sorted([*FIELDS, "seed"])
    assert all(len(row) == 3 and row[2].count("(") == row[2].count(")") for row in rows)
