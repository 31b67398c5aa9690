# SPDX-License-Identifier: Apache-2.0
"""`python -m blitzgs.cli`: the same as `python -m blitzgs`."""

import sys

from blitzgs.cli import main

sys.exit(main())
