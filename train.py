# SPDX-License-Identifier: Apache-2.0
"""`torchrun train.py --config C --data DIR --out RUN`: the same as `blitzgs train`."""

import sys

from blitzgs.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
