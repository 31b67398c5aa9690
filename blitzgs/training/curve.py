# SPDX-License-Identifier: Apache-2.0
"""The training PSNR over a run, and a warning where the run loses what it has learnt."""

from __future__ import annotations

from dataclasses import dataclass, field

# Log records whose mean is compared: the views of one batch differ by more than a fall.
WINDOW = 16
# A fall of the mean by so many dB below its best is reported.
FALL = 3.0


@dataclass
class Curve:
    """Means of the training PSNR in the log records of a run; the same on every rank, and saved."""

    recent: list[float] = field(default_factory=list)  # PSNR of the last `WINDOW` records, dB
    best: float | None = None  # highest mean of so many records, dB; None before there are so many
    best_at: int = 0  # images that the run had seen then
    fall: float = 0.0  # largest fall of the mean below the best one before it, dB
    fall_at: int = 0  # images that the run had seen then
    warned: bool = False  # whether the present fall has been reported

    def add(self, images: int, psnr: float) -> str | None:
        """Add a record; return a warning when the mean has fallen by `FALL` for the first time."""
        self.recent = [*self.recent[1 - WINDOW :], psnr]
        if len(self.recent) < WINDOW:
            return None
        mean = sum(self.recent) / WINDOW
        if self.best is None or mean > self.best:
            self.best, self.best_at = mean, images
        if self.best - mean > self.fall:
            self.fall, self.fall_at = self.best - mean, images
        if self.fall < FALL or self.warned:
            return None
        self.warned = True
        return self.describe()

    def restart(self) -> None:
        """Forget the best mean, because the run changes the model on purpose; the largest fall is kept."""
        self.recent, self.best = [], None

    def describe(self) -> str:
        """Return the warning about the largest fall."""
        best = self.best if self.best is not None else float("nan")
        return (
            f"training PSNR fell by {self.fall:.1f} dB, from {best:.1f} dB after {self.best_at:,} images: "
            "the run goes on unchanged. If it ends below that, train with half of optimiser.position and "
            "optimiser.opacity, or fewer Gaussians (population.max_gaussians)"
        )

    def warnings(self) -> list[str]:
        """Return the warnings for the summary."""
        return [self.describe()] if self.fall >= FALL else []
