# SPDX-License-Identifier: Apache-2.0
"""Dense gradients are written into zeros that compositing's backward pass made (CUDA: tests/cuda)."""

import torch

from blitzgs.ops.splat_gradients import DenseZeros
from tests.helpers import PARAMETERS, random_scene, rasterize_scene

TABLES = PARAMETERS[:5]


def call(**options):
    """The leaves of a call that does not see all of its Gaussians, its image and the projection's node."""
    scene = random_scene(n=80, cameras=1)
    scene.means[::2] *= 20.0  # seen by no view
    leaves = scene.leaves()
    image, _, meta = rasterize_scene(leaves, **options)
    return [getattr(leaves, name) for name in TABLES], image, meta["means2d"].grad_fn


def test_zeros_become_the_gradients_of_one_pass():
    tables, image, node = call()
    expected = torch.autograd.grad(image.square().sum(), tables, retain_graph=True)
    zeros = [torch.zeros_like(table) for table in tables]
    places = [x.data_ptr() for x in zeros]
    assert node.dense_zeros.missing() == [80, 16]
    node.dense_zeros.put(zeros)
    assert node.dense_zeros.missing() == []
    del zeros
    first = torch.autograd.grad(image.square().sum(), tables, retain_graph=True)
    assert [x.data_ptr() for x in first] == places
    assert node.dense_zeros.missing() == [80, 16]
    second = torch.autograd.grad(image.square().sum(), tables)
    assert not set(places) & {x.data_ptr() for x in second}
    for a, b, wanted in zip(first, second, expected, strict=True):
        assert torch.equal(a, wanted) and torch.equal(b, wanted)


def test_zeros_become_grad_without_a_copy():
    tables, image, node = call()
    zeros = [torch.zeros_like(table) for table in tables]
    places = [x.data_ptr() for x in zeros]
    node.dense_zeros.put(zeros)
    del zeros
    image.square().sum().backward()
    assert [table.grad.data_ptr() for table in tables] == places


def test_only_calls_that_write_dense_gradients_want_zeros():
    assert call(sparse_grad=True)[2].dense_zeros is None
    scene = random_scene(n=80, cameras=1)
    _, _, meta = rasterize_scene(scene.leaves())  # all Gaussians are visible
    assert meta["means2d"].grad_fn.dense_zeros is None
    scene.means[::2] *= 20.0
    leaves = scene.leaves()
    leaves.quats.requires_grad_(False)
    _, _, meta = rasterize_scene(leaves)
    assert meta["means2d"].grad_fn.dense_zeros is None


def test_no_zeros_are_put_where_none_were_made():
    zeros = DenseZeros(7, 4)
    zeros.put([])
    assert zeros.missing() == [7, 4] and zeros.take() is None
