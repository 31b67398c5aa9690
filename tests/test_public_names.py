# SPDX-License-Identifier: Apache-2.0
"""The public names of `blitzgs` exist after `import blitzgs`, which loads no kernels."""

import subprocess
import sys

import blitzgs

CODE = """
import sys
import blitzgs
assert "torch" not in sys.modules and "blitzgs._library" not in sys.modules
for name in blitzgs.__all__:
    assert getattr(blitzgs, name) is not None
assert issubclass(blitzgs.optim.LazyAdam, object)
"""


def test_public_names_are_loaded_when_they_are_asked_for():
    subprocess.run([sys.executable, "-c", CODE], check=True)


def test_an_unknown_public_name_is_an_error():
    assert not hasattr(blitzgs, "rasterise")
