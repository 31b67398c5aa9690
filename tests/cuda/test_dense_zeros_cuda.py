# SPDX-License-Identifier: Apache-2.0
"""Dense gradients are set to zero on another stream while the device composites."""

import gc

import pytest
import torch

from tests.helpers import PARAMETERS, random_scene, rasterize_scene, relative_error

TABLES = PARAMETERS[:5]


@pytest.fixture(autouse=True)
def deterministic(monkeypatch):
    """Gradients are equal bit for bit; torch does not fill new memory by itself."""
    monkeypatch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.fixture(params=[True, False], ids=["threads", "one thread"])
def multithreading(request):
    """Autograd runs the backward pass in its own thread, or in that of the caller."""
    with torch.autograd.set_multithreading_enabled(request.param):
        yield


def partly_visible(n=4000, every=4, **options):
    """A scene in which one of `every` Gaussians is before the cameras, and the others are far above them."""
    scene = random_scene(**{"n": n, "width": 70, "height": 50, "device": "cuda", **options})
    scene.means[torch.arange(n) % every > 0, 1] += 1e3
    return scene


def tables_of(scene):
    leaves = scene.leaves()
    return leaves, [getattr(leaves, name) for name in TABLES]


def sparse_gradients(scene, **options):
    leaves, tables = tables_of(scene)
    image, _, _ = rasterize_scene(leaves, sparse_grad=True, **options)
    found = [torch.zeros_like(table) for table in tables]
    for whole, sparse in zip(found, torch.autograd.grad(image.square().sum(), tables), strict=True):
        whole[sparse._indices()[0]] = sparse._values()
    return found


def node_of(image):
    """The projection's node."""
    return image.grad_fn.next_functions[3][0]


@pytest.mark.usefixtures("multithreading")
@pytest.mark.parametrize(
    "options", [{}, {"packed": False}, {"render_mode": "RGB+D"}, {"absgrad": True}], ids=str
)
@pytest.mark.parametrize("cameras", [1, 3])
def test_dense_gradients_are_the_sparse_ones(cameras, options):
    scene = partly_visible(cameras=cameras)
    expected = sparse_gradients(scene, **options)
    for stream in (torch.cuda.current_stream(), torch.cuda.Stream()):
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            leaves, tables = tables_of(scene)
            image, _, _ = rasterize_scene(leaves, **options)
            for retain in (True, True, False):
                found = torch.autograd.grad(image.square().sum(), tables, retain_graph=retain)
                for name, actual, wanted in zip(TABLES, found, expected, strict=True):
                    assert torch.equal(actual, wanted), name
        torch.cuda.current_stream().wait_stream(stream)
        torch.cuda.synchronize()


@pytest.mark.usefixtures("multithreading")
def test_gradients_of_two_passes_have_memory_of_their_own():
    scene = partly_visible()
    expected = sparse_gradients(scene)
    leaves, tables = tables_of(scene)
    image, _, _ = rasterize_scene(leaves)
    first = torch.autograd.grad(image.square().sum(), tables, retain_graph=True)
    second = torch.autograd.grad(image.square().sum(), tables)
    for a, b, wanted in zip(first, second, expected, strict=True):
        assert a.data_ptr() != b.data_ptr()
        a.fill_(torch.nan)
        assert torch.equal(b, wanted)
    image, _, _ = rasterize_scene(leaves)
    image.square().sum().backward(retain_graph=True)
    image.square().sum().backward()
    for table, wanted in zip(tables, expected, strict=True):
        assert torch.equal(table.grad, 2 * wanted)


def test_compositing_makes_the_zeros(monkeypatch):
    scene = partly_visible()
    leaves, tables = tables_of(scene)
    image, _, _ = rasterize_scene(leaves)
    dense, taken = node_of(image).dense_zeros, []
    take = dense.take
    monkeypatch.setattr(dense, "take", lambda: taken.append(take()) or taken[-1])
    found = torch.autograd.grad(image.square().sum(), tables)
    assert [x.data_ptr() for x in found] == [x.data_ptr() for x in taken[0]]


def test_zeros_that_a_pass_does_not_take_serve_the_next_one():
    scene = partly_visible(cameras=1)
    expected = sparse_gradients(scene)
    leaves, tables = tables_of(scene)
    image, _, meta = rasterize_scene(leaves)
    torch.autograd.grad(image.square().sum(), meta["means2d"], retain_graph=True)
    assert node_of(image).dense_zeros.missing() == []
    found = torch.autograd.grad(image.square().sum(), tables)
    assert all(map(torch.equal, found, expected))
    # Zeros that no pass takes are freed with the graph.
    del found, expected, leaves, tables, image, meta
    gc.collect()
    before = torch.cuda.memory_allocated()
    image, _, meta = rasterize_scene(scene.leaves())
    torch.autograd.grad(image.square().sum(), meta["means2d"])
    del image, meta
    gc.collect()
    assert torch.cuda.memory_allocated() == before


@pytest.mark.parametrize("with_sh", [True, False])
def test_gradients_of_colours_alone(with_sh):
    scene = partly_visible()
    if not with_sh:
        scene.sh_degree, scene.colors = None, scene.colors[:, 0].sigmoid()
    found = []
    for only in (True, False):
        leaves, tables = tables_of(scene)
        image, _, _ = rasterize_scene(leaves)
        found.append(torch.autograd.grad(image.square().sum(), [leaves.colors] if only else tables)[-1])
    assert torch.equal(*found) and found[0].any()


def test_no_gaussian_is_visible():
    scene = partly_visible()
    torch.full((4000 * 59,), torch.nan, device="cuda")  # what the gradients would hold otherwise
    leaves, tables = tables_of(scene)
    for _ in range(3):
        image, _, _ = rasterize_scene(leaves, near_plane=1e9)
        found = torch.autograd.grad(image.square().sum(), tables)
        assert not any(x.any() for x in found)


def test_an_error_between_compositing_and_projection_leaves_memory_alone():
    scene = partly_visible(n=1_000_000, every=100, scale=0.01)

    def refuse(_):
        raise RuntimeError("refused")

    for _ in range(20):
        leaves, tables = tables_of(scene)
        image, _, meta = rasterize_scene(leaves)
        meta["means2d"].register_hook(refuse)
        with pytest.raises(RuntimeError, match="refused"):
            image.square().sum().backward()
        sizes = [table.shape for table in tables]
        del leaves, tables, image, meta
        ones = [torch.ones(size, device="cuda") for size in sizes]
        torch.cuda.synchronize()
        assert all(bool((x == 1).all()) for x in ones)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
def test_a_device_that_is_not_the_current_one():
    for device in ("cuda:1", "cuda:0"):
        scene = partly_visible(device=device)
        expected = sparse_gradients(scene)
        leaves, tables = tables_of(scene)
        image, _, _ = rasterize_scene(leaves)
        found = torch.autograd.grad(image.square().sum(), tables)
        assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("exact", [True, False])
def test_gradients_repeat_whatever_memory_they_get(exact):
    """Memory is freed and allocated again on the caller's stream while the other stream may be late.

    Setting the gradients to zero takes longer than compositing.
    """
    scene = partly_visible(n=1_000_000, every=100, scale=0.01)
    expected = sparse_gradients(scene)
    hidden = (expected[0] == 0).all(dim=1)
    torch.use_deterministic_algorithms(exact)  # other kernels composite
    sizes = [x.shape for x in expected]
    leaves, tables = tables_of(scene)
    for repeat in range(40):
        # The device is behind, so that all of a pass is queued at once.
        if repeat % 2:
            torch.cuda._sleep(5_000_000)
        image, _, _ = rasterize_scene(leaves)
        # Kernels that still write the memory which the gradients get next.
        del [torch.full(size, torch.nan, device="cuda") for size in sizes][:]
        found = torch.autograd.grad(image.square().sum(), tables)
        copies = [x.clone() for x in found]
        del found, image
        # The memory of the gradients, written at once by the caller.
        ones = [torch.ones(size, device="cuda") for size in sizes]
        for actual, wanted in zip(copies, expected, strict=True):
            assert torch.equal(actual, wanted) if exact else relative_error(actual, wanted) < 1e-4
            assert not actual[hidden].any()
        assert all(bool((x == 1).all()) for x in ones), repeat
        del copies, ones
