# SPDX-License-Identifier: Apache-2.0
"""`python -m blitzgs`: the command line, also for `torchrun -m blitzgs`."""

import sys

from blitzgs.cli import main

sys.exit(main())
