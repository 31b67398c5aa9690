# SPDX-License-Identifier: Apache-2.0
"""One training step stays short to read (see tests/walk.py)."""

import pytest
import torch

from blitzgs.distributed.group import Ranks
from tests.walk import cxx_code_lines, kernel_files, python_code_lines, walk_of_a_step, walk_of_ranks

MOST_PYTHON, MOST_KERNELS, MOST_VISITS = 20, 60, 2
# For rank 0 of two, whose tiles are divided by an op with a file of its own.
MOST_PYTHON_OF_RANKS, MOST_STOPS_OF_RANKS = 25, 39
MOST_ARGUMENTS = 12


@pytest.fixture(scope="module")
def walk():
    return walk_of_a_step(Ranks())


def test_a_step_is_read_in_few_files_and_no_file_again_and_again(walk):
    assert walk.stops[0] == "blitzgs/training/step.py"
    assert "blitzgs/frame/frame.py" in walk.files and "blitzgs/ops/project_step.py" in walk.files
    assert len(walk.files) <= MOST_PYTHON, walk.files
    assert max(walk.revisited.values()) <= MOST_VISITS, walk.revisited


def test_a_step_of_two_ranks_goes_back_and_forth_little():
    walk = walk_of_ranks(2)
    assert "blitzgs/frame/transport/collective.py" in walk.files
    assert len(walk.stops) <= MOST_STOPS_OF_RANKS, walk.stops
    assert len(walk.files) <= MOST_PYTHON_OF_RANKS, walk.files
    assert max(walk.revisited.values()) <= MOST_VISITS, walk.revisited


def test_the_kernels_of_a_step_lie_in_few_files(walk):
    assert {"project_fwd", "rasterize_fwd", "project_bwd_step_"} <= set(walk.ops)
    kernels = kernel_files(walk.ops)
    assert "csrc/project/project_step_cuda.cu" in kernels and "csrc/math/tiles.h" in kernels
    assert len(kernels) <= MOST_KERNELS, kernels


def test_lines_of_code_are_those_without_comments():
    python = [
        '"""A',
        'file."""',
        "",
        'x = """a',
        'b"""  # text',
        "# comment",
        "def f():",
        '    """Do."""',
        "    pass",
    ]
    assert python_code_lines("\n".join(python)) == 4
    cxx = [
        "// a file",
        '#include "a.h"',
        "/* two",
        "lines */ int x;",
        'auto s = "// none";',
        "  /* one */",
        "",
    ]
    assert cxx_code_lines("\n".join(cxx)) == 3


def test_ops_take_few_arguments():
    names = [name for name in torch._C._dispatch_get_all_op_names() if name.startswith("blitzgs::")]
    ops = [getattr(torch.ops.blitzgs, name.partition("::")[2]).default for name in names]
    many = {op.name(): len(op._schema.arguments) for op in ops if len(op._schema.arguments) > MOST_ARGUMENTS}
    assert len(ops) > 30 and not many, many
