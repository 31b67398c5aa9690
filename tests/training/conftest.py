# SPDX-License-Identifier: Apache-2.0
import pytest
import torch


@pytest.fixture
def one_thread():
    """Tests that compare bits, or train tiny models, take one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
