# SPDX-License-Identifier: Apache-2.0
"""The configurations that come with BlitzGS, by name: the files of the folder configs/."""

from __future__ import annotations

import difflib
from pathlib import Path

from blitzgs.config.fields import ConfigError

# The name that stands for the default of every field, without a file.
DEFAULTS = "defaults"
_PACKAGE = Path(__file__).resolve().parent.parent
# In an installed package and in a checkout (setup.py copies the files).
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


def recipe_names() -> list[str]:
    """Return the names of the recipes, in alphabetical order."""
    return sorted({path.stem for folder in _FOLDERS for path in folder.glob("*.yaml")})


def recipe_path(given: str) -> Path | None:
    """Return the file of a configuration.

    Args:
        given: path of a YAML file, or a name of `recipe_names`, or `DEFAULTS`.

    Returns:
        The file; None for `DEFAULTS`.

    Raises:
        ConfigError: there is neither such a file nor such a recipe.
    """
    if Path(given).is_file():
        return Path(given)
    if given == DEFAULTS:
        return None
    if (found := _recipe(given)) is not None:
        return found
    raise ConfigError(f"{given}: no such file or recipe; {_known(given)}")


def base_file(given: str, file: Path) -> Path:
    """Return the file that `base` names in a configuration file.

    Args:
        given: path relative to `file`, or a name of `recipe_names`, with or without ".yaml": a copy of a
            recipe's file names its base so.
        file: the configuration file.

    Raises:
        ConfigError: there is neither such a file nor such a recipe.
    """
    beside = file.parent / given
    if beside.is_file():
        return beside
    if (found := _recipe(given.removesuffix(".yaml"))) is not None:
        return found
    raise ConfigError(
        f"{file}: base: {given}: no such file in {file.parent} and no such recipe; {_known(given)}"
    )


def _recipe(name: str) -> Path | None:
    """Return the file of a recipe; None if there is none of this name."""
    files = (folder / f"{name}.yaml" for folder in _FOLDERS if "/" not in name)
    return next((file for file in files if file.is_file()), None)


def _known(given: str) -> str:
    """Return which recipes there are, and which of them may have been meant."""
    known = [*recipe_names(), DEFAULTS]
    close = difflib.get_close_matches(Path(given).stem, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}recipes are {', '.join(known)}"


def default_recipe(on_gpu: bool) -> str:
    """Return the recipe of a run that names none."""
    return "aerial" if on_gpu else "aerial_cpu"
