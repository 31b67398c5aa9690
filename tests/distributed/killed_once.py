# SPDX-License-Identifier: Apache-2.0
"""`blitzgs train` under torchrun, whose rank 1 is killed once, in the middle of a step."""

import os
import signal
import sys

from blitzgs.cli import main
from blitzgs.training.trainer import Trainer

step = Trainer.step


def killed_once(self, number):
    first = os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
    if number == 25 and first and self.state.ranks.rank == 1:
        (self.state.folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    step(self, number)


if __name__ == "__main__":
    Trainer.step = killed_once
    sys.exit(main())
