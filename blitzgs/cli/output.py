# SPDX-License-Identifier: Apache-2.0
"""Output of commands that survives a closed terminal."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class Output(io.FileIO):
    """One of the process's output streams, which keeps the program running when it cannot be written."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self.lost: str | None = None  # why text was lost; None: all was written
        # False: the reader has gone (a pipe that `head` closed, a terminal that hung up).
        self.has_reader = True

    def write(self, data: Any) -> int:
        """Write all of the data; after the first error, to nowhere."""
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self.fileno(), view) :]
        except OSError as error:
            self.lost = error.strerror or str(error)
            self.has_reader = error.errno not in (errno.EPIPE, errno.EIO, errno.EBADF)
            # So that later text of this process, and of its libraries and children, goes nowhere as well.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
        return len(data)


@contextlib.contextmanager
def surviving_output() -> Iterator[dict[str, Output]]:
    """Let `sys.stdout` and `sys.stderr` survive errors while the context lasts: text is lost, nothing else.

    Names that are not valid UTF-8 are printed with escapes. A stream that is no file of the process, as in
    tests and notebooks, stays as it is. Yields the streams that were replaced, "stdout" and "stderr".
    """
    outputs: dict[str, Output] = {}
    previous: dict[str, TextIO | None] = {}
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # the process was started without it
            previous[name] = None
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
            continue
        buffer = getattr(stream, "buffer", None)
        raw = getattr(buffer, "raw", buffer)  # python -u has no buffer
        if type(stream) is not io.TextIOWrapper or not isinstance(raw, io.FileIO):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
            continue
        with contextlib.suppress(OSError):
            stream.flush()
        previous[name] = stream
        outputs[name] = Output(stream.fileno())
        text = io.TextIOWrapper(
            io.BufferedWriter(outputs[name]),
            stream.encoding,
            "backslashreplace",
            line_buffering=name == "stderr" or stream.line_buffering,
            write_through=stream.write_through,
        )
        setattr(sys, name, text)
    try:
        yield outputs
    finally:
        for name, stream in previous.items():
            getattr(sys, name).flush()
            setattr(sys, name, stream)


# Commands whose result is what they print.
_PRINTING = (
    "eval", "completion", "--json", "--show-config", "--check", "--help", "--help-fields", "-h", "--version"
)  # fmt: skip


def report_lost(given: list[str], outputs: dict[str, Output]) -> int:
    """Say that a part of the output was lost; return 1 if it was the result of the command, else 0.

    A reader that closes its end, as `head` does, wants no more: this is no failure.
    """
    for name in outputs:
        getattr(sys, name).flush()
    lost = {name: output.lost for name, output in outputs.items() if output.lost and output.has_reader}
    for name, reason in lost.items():
        title = {"stdout": "standard output", "stderr": "standard error"}[name]
        text = f"blitzgs: {title} cannot be written ({reason}): what was printed there is incomplete"
        print(f"{text}; files are complete", file=sys.stderr)
    return int("stdout" in lost and any(text.partition("=")[0] in _PRINTING for text in given))
