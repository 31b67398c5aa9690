# SPDX-License-Identifier: Apache-2.0
import pytest
import torch


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Tests of this folder take one thread: they compare bits, and their models are tiny."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
