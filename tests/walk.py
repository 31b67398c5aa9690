# SPDX-License-Identifier: Apache-2.0
"""Counts the files that a reader opens to follow one training step, and the stops: `python -m tests.walk`.

Python is traced while a trainer takes a step: every function of `blitzgs/` counts at its first call, in the
order of these calls. Functions of one file that follow each other are one stop. C++ and CUDA are counted from
the ops that the step calls: the files of `csrc/` that check and register an op and that launch its kernels,
and all that they include from there. The lines of a file are all its lines, and those of them with code.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tempfile
import tokenize
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch

from blitzgs.distributed.group import Ranks
from blitzgs.training.trainer import Trainer
from tests.distributed.rank_harness import run_ranks
from tests.training.tiny import tiny_config, tiny_scene

T = TypeVar("T")
ROOT = Path(__file__).resolve().parents[1]
STEPS_BEFORE = 3  # steps of warm-up; the first steps have no estimates of sizes
# Ops that CUDA calls instead of the CPU's, and additional ops that it calls.
ON_CUDA = {"rasterize_bwd": "rasterize_bwd_packed_"}
MORE_ON_CUDA = ("copy_to_host_",)


class Walk(NamedTuple):
    """The files and ops of one step.

    Attributes:
        stops: files of `blitzgs/`, in the order in which their functions are first called.
        ops: the called ops, in order.
    """

    stops: list[str]
    ops: list[str]

    @property
    def files(self) -> list[str]:
        """The different files, in the order of the first visit."""
        return list(dict.fromkeys(self.stops))

    @property
    def revisited(self) -> dict[str, int]:
        """Files with more than one visit."""
        return {file: n for file, n in Counter(self.stops).items() if n > 1}


class _Trace:
    """Records the files of functions at their first calls, while the functions given to `of` run."""

    def __init__(self) -> None:
        self.files: dict[object, str] = {}

    def _note(self, frame: Any, event: str, _: object) -> None:
        if event == "call":
            self.files.setdefault(frame.f_code, frame.f_code.co_filename)

    def of(self, call: Callable[..., T]) -> Callable[..., T]:
        def traced(*arguments: Any, **options: Any) -> T:
            before = sys.getprofile()
            sys.setprofile(self._note)
            try:
                return call(*arguments, **options)
            finally:
                sys.setprofile(before)

        return traced


def walk_of_a_step(ranks: Ranks, *overrides: str, whole: bool = False) -> Walk:
    """Train a few steps and follow the next one on this thread; `whole`: with the trainer's own functions."""
    scene, images = tiny_scene()
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        shared = Path(ranks.broadcast_object(folder))
        trainer = Trainer(tiny_config(*overrides), scene, images, shared, ranks)
        trainer.state.start_clock()
        for step in range(1, STEPS_BEFORE + 1):
            trainer.step(step)
        trace = _Trace()
        stepper = trainer.state.stepper
        stepper.forward, stepper.backward = trace.of(stepper.forward), trace.of(stepper.backward)
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
            (trace.of(trainer.step) if whole else trainer.step)(STEPS_BEFORE + 1)
        trainer.close()
    own = str(ROOT / "blitzgs") + "/"
    files = [str(Path(file).relative_to(ROOT)) for file in trace.files.values() if file.startswith(own)]
    ops = [e.name.partition("::")[2] for e in profile.events() if e.name.startswith("blitzgs::")]
    return Walk([file for file, _ in groupby(files)], list(dict.fromkeys(ops)))


def walk_of_ranks(world_size: int) -> Walk:
    """Follow a step of rank 0 of `world_size` ranks, which send splats by collectives."""
    from tests import walk  # ranks import this file by its name, also if it is the program

    return run_ranks(walk.walk_of_a_step, world_size)[0]


@cache
def _included(file: Path) -> frozenset[Path]:
    """Return a file and all of `csrc/` that it includes."""
    found = {file}
    for name in re.findall(r'#include "([^"]+)"', file.read_text()):
        if (ROOT / "csrc" / name).exists():
            found |= _included(ROOT / "csrc" / name)
    return frozenset(found)


def kernel_files(ops: Iterable[str]) -> list[str]:
    """Return the files of `csrc/` behind ops on CUDA: argument checks and kernels, with includes."""
    files = {ROOT / "csrc" / "registration.cpp"}
    for name in (*(ON_CUDA.get(op, op) for op in ops), *MORE_ON_CUDA):
        for check in ROOT.glob("csrc/*/*_op.cpp"):
            if f'm.impl("{name}"' in check.read_text():
                files |= _included(check)
                for kernels in check.parent.glob("*_cuda.cu"):
                    files |= _included(kernels)
    return sorted(str(file.relative_to(ROOT)) for file in files)


def lines_of(files: Iterable[str]) -> tuple[int, int]:
    """Return the number of all lines of files, and of those with code."""
    texts = [(file.endswith(".py"), (ROOT / file).read_text()) for file in files]
    code = [python_code_lines(text) if is_python else cxx_code_lines(text) for is_python, text in texts]
    return sum(len(text.splitlines()) for _, text in texts), sum(code)


def python_code_lines(text: str) -> int:
    """Count the lines that hold more than space, comments and docstrings."""
    layout = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    spans = [(t.start[0], t.end[0]) for t in tokens if t.type not in layout | {tokenize.COMMENT}]
    lines = {line for first, last in spans for line in range(first, last + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def cxx_code_lines(text: str) -> int:
    """Count the lines that hold more than space and comments."""
    comment_or_string = r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"'
    bare = re.sub(
        comment_or_string,
        lambda found: found[0] if found[0].startswith('"') else "\n" * found[0].count("\n"),
        text,
        flags=re.DOTALL,
    )
    return sum(bool(line.strip()) for line in bare.splitlines())


def _report(title: str, walk: Walk) -> None:
    kernels = kernel_files(walk.ops)
    print(f"{title}: {len(walk.files)} Python and {len(kernels)} C++/CUDA files, {len(walk.stops)} stops")
    for name, files in (("Python", walk.files), ("C++/CUDA", kernels)):
        lines, code = lines_of(files)
        print(f"  {name}: {lines:,} lines, {code:,} of them with code")
    print("  ops:", *walk.ops)
    for stop in walk.stops:
        print("   ", stop)
    print("  revisited:", walk.revisited or "none")
    print("  C++/CUDA:", *kernels, sep="\n    ")


if __name__ == "__main__":
    _report("one rank", walk_of_a_step(Ranks()))
    _report("one rank, with the trainer's loop", walk_of_a_step(Ranks(), whole=True))
    _report("two ranks", walk_of_ranks(2))
