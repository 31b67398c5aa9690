# SPDX-License-Identifier: Apache-2.0
"""The public names of `blitzgs` exist after `import blitzgs`, which loads no kernels."""

import re
import subprocess
import sys
from pathlib import Path

import blitzgs

ROOT = Path(__file__).resolve().parents[1]
IMPORT = re.compile(r"^from (blitzgs[\w.]*) import ([\w, ]+)", re.MULTILINE)

CODE = """
import sys
import blitzgs
assert "torch" not in sys.modules and "blitzgs._library" not in sys.modules
for name in blitzgs.__all__:
    assert getattr(blitzgs, name) is not None
assert issubclass(blitzgs.optim.LazyAdam, object)
"""

ENVIRONMENT = """
import os
before = dict(os.environ)
import blitzgs
assert dict(os.environ) == before
import cv2
import torch
before = dict(os.environ)  # torch and cv2 may set variables of their own
for name in blitzgs.__all__:
    getattr(blitzgs, name)
assert dict(os.environ) == before, set(os.environ.items()) ^ set(before.items())
"""


def test_import_changes_no_environment_variable():
    subprocess.run([sys.executable, "-c", ENVIRONMENT], check=True)


def test_public_names_are_loaded_when_they_are_asked_for():
    subprocess.run([sys.executable, "-c", CODE], check=True)


def test_every_name_that_the_examples_import_is_said_to_be_public():
    pages = [ROOT / "README.md", *(ROOT / "docs" / "guide").glob("*.md"), *(ROOT / "examples").glob("*.py")]
    imports = [found for page in pages for found in IMPORT.findall(page.read_text())]
    used = {f"{module}.{name.strip()}" for module, names in imports for name in names.split(",")}
    used -= {f"blitzgs.{name}" for name in blitzgs.__all__}
    section = (ROOT / "docs/guide/own-trainer.md").read_text().split("## Public names")[1].split("\n## ")[0]
    assert used and used <= set(re.findall(r"`([^`]+)`", section))


def test_an_unknown_public_name_is_an_error():
    assert not hasattr(blitzgs, "rasterise")
