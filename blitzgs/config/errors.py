# SPDX-License-Identifier: Apache-2.0
"""The error of the configuration."""


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the field, the value and the remedy."""
