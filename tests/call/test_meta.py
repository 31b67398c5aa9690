# SPDX-License-Identifier: Apache-2.0
"""`meta` of `blitzgs.rasterization`: gsplat's keys, order and gradients, in a lazy dict."""

import copy
import io
import json
import pickle
from collections import OrderedDict

import pytest
import torch
from torch.utils._pytree import tree_map

from blitzgs.call import bad_values
from blitzgs.call.meta import LATER, LateMapping, LazyDict
from tests.helpers import random_scene, rasterize_scene, reference_images, refused, relative_error


@pytest.fixture(autouse=True)
def _first_calls():
    """Forget the calls of other tests: on CUDA, the first call with a number of Gaussians checks them."""
    bad_values._calls.cache_clear()


@pytest.mark.parametrize("packed", [True, False])
def test_absgrad_and_the_gradient_of_means2d(packed):
    scene = random_scene(n=25, cameras=1, width=12, height=9, dtype=torch.float64).leaves()
    renders, _, meta = rasterize_scene(scene, packed=packed, absgrad=True)
    assert torch.equal(meta["means2d"].absgrad, torch.zeros_like(meta["means2d"]))  # as in gsplat
    meta["means2d"].retain_grad()
    reference = reference_images(scene)[0]
    weights = torch.randn(9, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (renders[0] * weights).sum().backward()
    signed = torch.zeros(25, 2, dtype=torch.float64)
    absolute = torch.zeros_like(signed)
    for pixel in (reference.image * weights).sum(dim=-1).reshape(-1):
        gradient = torch.autograd.grad(pixel, reference.splats.means2d, retain_graph=True)[0]
        signed[reference.splats.ids] += gradient
        absolute[reference.splats.ids] += gradient.abs()
    actual, actual_absolute = meta["means2d"].grad, meta["means2d"].absgrad
    rows = (meta["gaussian_ids"],) if packed else (slice(None),)
    actual, actual_absolute = (t if packed else t[0] for t in (actual, actual_absolute))
    assert relative_error(actual, signed[rows]) < 1e-10
    assert relative_error(actual_absolute, absolute[rows]) < 1e-10


def test_packed_and_dense_meta_say_the_same():
    scene = random_scene(n=50, cameras=3)
    scene.means[::2] *= 6.0  # some are seen by no view
    image, alpha, packed = rasterize_scene(scene, packed=True)
    dense_image, dense_alpha, dense = rasterize_scene(scene, packed=False)
    assert torch.equal(image, dense_image) and torch.equal(alpha, dense_alpha)
    cameras, gaussians = packed["camera_ids"], packed["gaussian_ids"]
    assert 0 < len(cameras) < 150
    assert dense["camera_ids"] is None and dense["gaussian_ids"] is None
    for name, shape in {
        "radii": (3, 50, 2),
        "means2d": (3, 50, 2),
        "depths": (3, 50),
        "conics": (3, 50, 3),
        "opacities": (3, 50),
        "tiles_per_gauss": (3, 50),
    }.items():
        assert dense[name].shape == shape, name
        assert torch.equal(dense[name][cameras, gaussians], packed[name]), name
    rows = cameras * 50 + gaussians
    assert torch.equal(dense["flatten_ids"].long(), rows[packed["flatten_ids"].long()])
    assert torch.equal(dense["isect_ids"], packed["isect_ids"])
    invisible = torch.ones(3, 50, dtype=torch.bool)
    invisible[cameras, gaussians] = False
    assert (dense["radii"][invisible] == 0).all()


def test_meta_may_be_changed_in_place(device):
    scene = random_scene(n=40, device=device).leaves()
    for _ in range(2):  # the second call has enough capacity
        _, _, meta = rasterize_scene(scene)
        for name in ("means2d", "conics", "depths", "opacities", "radii", "tiles_per_gauss"):
            meta[name].mul_(2)
    meta["means2d"].sum().backward()
    assert scene.means.grad.any()


def test_meta_read_late_is_differentiable_as_the_call_was():
    scene = random_scene(n=20).leaves()
    with torch.no_grad():
        _, _, constant = rasterize_scene(scene, packed=False)
    _, _, meta = rasterize_scene(scene, packed=False)
    with torch.no_grad():
        depths = meta["depths"]
    assert depths.requires_grad and not constant["depths"].requires_grad
    depths.sum().backward()
    assert scene.means.grad.any()


@pytest.mark.parametrize("packed", [False, True])
def test_meta_lists_only_what_touches_a_tile(device, packed):
    """The lists of meta leave out Gaussians whose colour is not finite."""
    scene = random_scene(n=90, cameras=2, width=50, height=37, device=device)
    scene.colors[::3, 0] = float("nan")
    _, _, meta = rasterize_scene(scene, packed=packed)
    listed = int(meta["tiles_per_gauss"].sum())
    assert 0 < listed == len(meta["flatten_ids"]) == len(meta["isect_ids"])
    rows = meta["flatten_ids"].long()
    gaussians = meta["gaussian_ids"][rows] if packed else rows % 90
    assert (gaussians % 3 != 0).all()


def test_meta_lists_are_sorted_and_consistent(device):
    scene = random_scene(n=90, cameras=2, width=50, height=37, device=device)
    _, _, meta = rasterize_scene(scene, tile_size=8)
    assert (meta["tile_width"], meta["tile_height"]) == (7, 5)
    assert meta["isect_offsets"].shape == (2, 5, 7)
    assert meta["tiles_per_gauss"].sum() == len(meta["flatten_ids"]) == len(meta["isect_ids"])
    keys = meta["isect_ids"]
    assert (keys[1:] >= keys[:-1]).all()
    bits = (7 * 5).bit_length()
    tile, camera = (keys >> 32) & ((1 << bits) - 1), keys >> (32 + bits)
    assert torch.equal(camera, meta["camera_ids"][meta["flatten_ids"].long()])
    starts = meta["isect_offsets"].reshape(2, -1)
    for c in range(2):
        for t in (0, 17, 34):
            assert ((camera < c) | ((camera == c) & (tile < t))).sum() == starts[c, t]
    for name in ("width", "height", "tile_size", "n_cameras"):
        assert meta[name] == {"width": 50, "height": 37, "tile_size": 8, "n_cameras": 2}[name]


LAID_OUT = ("means2d", "conics", "opacities", "depths")


def test_packed_rows_stand_image_after_image(device):
    scene = random_scene(n=70, cameras=3, device=device)
    _, _, meta = rasterize_scene(scene)
    views = [rasterize_scene(scene.view(view))[2] for view in range(3)]
    lengths = torch.tensor([len(one["gaussian_ids"]) for one in views])
    assert torch.equal(meta["camera_ids"].cpu(), torch.arange(3).repeat_interleave(lengths))
    assert not meta["batch_ids"].any() and len(meta["batch_ids"]) == len(meta["camera_ids"])
    for name in ("gaussian_ids", "radii", "tiles_per_gauss", *LAID_OUT):
        assert torch.equal(meta[name], torch.cat([one[name] for one in views])), name
    starts = lengths.cumsum(0) - lengths
    rows = [one["flatten_ids"] + start for one, start in zip(views, starts.tolist(), strict=True)]
    assert torch.equal(meta["flatten_ids"], torch.cat(rows).int())


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("cameras", [1, 3])
def test_rendered_columns_of_meta_have_gradients(device, packed, cameras):
    scene = random_scene(n=40, cameras=cameras, device=device).leaves()
    renders, _, meta = rasterize_scene(scene, packed=packed, render_mode="RGB+D", absgrad=True)
    gradients = torch.autograd.grad(
        renders.square().sum(), [meta[name] for name in LAID_OUT], retain_graph=True
    )
    for name in LAID_OUT:
        meta[name].retain_grad()
    renders.square().sum().backward()
    for name, gradient in zip(LAID_OUT, gradients, strict=True):
        assert relative_error(meta[name].grad, gradient) < 1e-6, name
        assert gradient.shape == meta[name].shape and gradient.any(), name
    assert (meta["means2d"].absgrad >= meta["means2d"].grad.abs() * 0.999 - 1e-6).all()
    if not packed:
        _, _, rows = rasterize_scene(scene, packed=True)
        for gradient in (*gradients, meta["means2d"].absgrad):
            unseen = torch.ones(cameras, 40, dtype=torch.bool, device=device)
            unseen[rows["camera_ids"], rows["gaussian_ids"]] = False
            assert not gradient[unseen].any()


def test_packed_and_dense_meta_have_the_same_gradients(device):
    dtype, bound = (torch.float64, 1e-12) if device == "cpu" else (torch.float32, 1e-4)
    scene = random_scene(n=40, cameras=3, dtype=dtype, device=device).leaves()
    found = []
    for packed in (True, False):
        renders, _, meta = rasterize_scene(scene, packed=packed, render_mode="RGB+D")
        found.append(torch.autograd.grad(renders.square().sum(), [meta[name] for name in LAID_OUT]))
        if packed:
            places = meta["camera_ids"], meta["gaussian_ids"]
    for name, rows, dense in zip(LAID_OUT, *found, strict=True):
        assert relative_error(dense[places], rows) < bound, name


def test_dense_opacities_are_those_of_all_gaussians():
    scene = random_scene(n=30, cameras=2).leaves()
    scene.means.data[::2] *= 9.0  # some are seen by no view
    _, _, meta = rasterize_scene(scene, packed=False)
    assert torch.equal(meta["opacities"], scene.opacities.expand(2, 30))
    meta["opacities"].sum().backward()
    assert torch.equal(scene.opacities.grad, torch.full((30,), 2.0))


def test_absgrad_needs_no_gradient_of_a_leaf(device):
    scene = random_scene(n=30, cameras=1, device=device).leaves()
    found = []
    for differentiate in (
        lambda loss: loss.backward(),
        lambda loss: torch.autograd.grad(loss, scene.colors),
        lambda loss: torch.autograd.grad(loss, scene.means),
    ):
        renders, _, meta = rasterize_scene(scene, absgrad=True)
        differentiate(renders.square().sum())
        found.append(meta["means2d"].absgrad)
    assert found[0].any()
    bound = 0 if device == "cpu" else 1e-5
    assert all(relative_error(absolute, found[0]) <= bound for absolute in found)


def test_tree_map_reaches_into_meta(device):
    _, _, meta = rasterize_scene(random_scene(n=30, device=device))
    doubled = tree_map(lambda value: value * 2 if isinstance(value, torch.Tensor) else value, meta)
    assert type(doubled) is dict and doubled.keys() == meta.keys()
    for name in ("radii", "isect_ids", "means2d"):
        assert torch.equal(doubled[name], meta[name] * 2)
    assert doubled["width"] == meta["width"]


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"])
def test_what_is_not_finite_is_named(device, name):
    scene = random_scene(n=31, cameras=2, device=device)
    seen = int(rasterize_scene(scene)[2]["gaussian_ids"][0])
    at = 1 if name in ("viewmats", "Ks") else seen
    getattr(scene, name)[at] = torch.nan
    bad_values._calls.cache_clear()  # so that the next call checks the Gaussians on CUDA, too
    with pytest.warns(RuntimeWarning, match=rf"NaN or infinite values in {name};"):
        image, _, meta = rasterize_scene(scene)
    assert image.isfinite().all()
    assert {key: value.tolist() for key, value in meta["non_finite"].items()} == {name: [at]}


@pytest.mark.parametrize("name", ["viewmats", "Ks"])
def test_a_bad_camera_is_named_in_every_call(device, name):
    scene = random_scene(n=44, cameras=2, device=device)
    for _ in range(3):  # on CUDA, only the first call checks the Gaussians
        rasterize_scene(scene)
    getattr(scene, name)[1, 0, 0] = torch.nan
    with pytest.warns(RuntimeWarning, match=f"NaN or infinite values in {name};"):
        rasterize_scene(scene)


@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("channels", [4, 150])
def test_a_colour_that_is_not_finite_is_named(device, per_view, channels):
    n = 45
    scene = random_scene(n=n, cameras=2, device=device)
    scene.means[5] = 0.0  # in the middle of all views
    scene.sh_degree = None
    scene.colors = torch.rand(*([2] if per_view else []), n, channels).to(device)
    scene.colors[..., 5, channels - 1] = torch.inf
    with pytest.warns(RuntimeWarning, match="NaN or infinite values in colors;"):
        image, _, meta = rasterize_scene(scene)
    assert image.isfinite().all()
    assert {key: value.tolist() for key, value in meta["non_finite"].items()} == {"colors": [5]}


@pytest.mark.parametrize("length", [0.0, 1e-40])
def test_a_zero_quaternion_is_the_identity_and_not_named(device, length, recwarn):
    scene = random_scene(n=49, cameras=2, device=device)
    scene.quats = torch.full_like(scene.quats, length, requires_grad=True)
    image, _, meta = rasterize_scene(scene)
    assert meta["non_finite"] == {} and not [w for w in recwarn if "blitzgs" in str(w.message)]
    image.sum().backward()
    assert scene.quats.grad.shape == scene.quats.shape and not scene.quats.grad.any()
    scene.quats = torch.tensor([[1.0, 0, 0, 0]], device=device).repeat(len(scene.quats), 1)
    assert torch.equal(image, rasterize_scene(scene)[0])


@pytest.mark.filterwarnings("ignore:blitzgs.rasterization. NaN or infinite values")
@pytest.mark.parametrize("per_view", [False, True])
def test_large_finite_values_are_not_named(per_view):
    scene = random_scene(n=30)
    scene.colors = torch.full((2, 30, 4) if per_view else (30, 4), 3e38)  # their sums overflow
    scene.sh_degree = None
    rows = scene.colors[1] if per_view else scene.colors
    rows[7, 2] = torch.inf
    found = rasterize_scene(scene)[2]["non_finite"]
    assert {key: value.tolist() for key, value in found.items()} == {"colors": [7]}
    rows[7, 2] = 3e38
    assert rasterize_scene(scene)[2]["non_finite"] == {}


@pytest.mark.parametrize("per_view", [False, True])
def test_sh_above_the_degree_are_not_named(per_view):
    scene = random_scene(n=30)
    scene.colors[7, 9] = torch.nan
    if per_view:
        scene.colors = scene.colors.repeat(2, 1, 1, 1)
    image, _, meta = rasterize_scene(scene, sh_degree=2)
    assert image.isfinite().all() and meta["non_finite"] == {} and 7 in meta["gaussian_ids"]


def test_reading_all_of_meta_reads_no_parameter(monkeypatch):
    def fail(gaussians):
        raise AssertionError("non_finite was not looked into")

    monkeypatch.setattr("blitzgs.call.meta.non_finite", fail)
    _, _, meta = rasterize_scene(random_scene(n=30))
    assert len(list(meta.values())) == len(meta)
    refused(AssertionError, "looked into", len, meta["non_finite"])


PLAIN = {"image": 1, "ids": [2, 3], "mask": None}
READERS = {
    "dict": dict,
    "unpacked": lambda d: {**d},
    "keyword arguments": lambda d: dict(**d),
    "update": lambda d: updated({}, d),
    "union": lambda d: d | {},
    "union of another": lambda d: {} | d,
    "copy": lambda d: d.copy(),
    "shallow copy": copy.copy,
    "deep copy": copy.deepcopy,
    "pickle": lambda d: pickle.loads(pickle.dumps(d)),
    "torch.load": lambda d: torch.load(saved(d)),
    "json": lambda d: json.loads(json.dumps(d)),
    "repr": lambda d: eval(repr(d)),
    "items": lambda d: dict(d.items()),
    "values": lambda d: dict(zip(d, d.values(), strict=True)),
    "get": lambda d: {key: d.get(key) for key in d},
    "setdefault": lambda d: {key: d.setdefault(key, 0) for key in d},
    "pop": lambda d: {key: d.pop(key) for key in list(d)},
    "popitem": lambda d: dict(reversed([d.popitem() for _ in range(len(d))])),
}


def saved(values):
    file = io.BytesIO()
    torch.save(values, file)
    file.seek(0)
    return file


def updated(target, source):
    target.update(source)
    return target


def lazy():
    """A `LazyDict` that reads as PLAIN, and the keys it has computed so far."""
    computed = []

    def compute(key):
        computed.append(key)
        return PLAIN[key]

    return LazyDict({"image": 1, "ids": LATER, "mask": LATER}, compute), computed


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
def test_every_reader_finds_values(reader):
    result = reader(lazy()[0])
    assert type(result) in (dict, OrderedDict)
    assert list(result.items()) == list(PLAIN.items())


def test_a_value_is_computed_once_and_only_when_read():
    values, computed = lazy()
    assert list(values) == list(values.keys()) == list(PLAIN)
    assert len(values) == 3 and "ids" in values and isinstance(values, dict)
    assert values["image"] == 1 and values.get("depths", 7) == 7
    assert computed == []
    assert values["ids"] is values["ids"] is values.get("ids")
    assert computed == ["ids"]


def test_equality_compares_values():
    empty, plain = {}, dict(PLAIN)
    assert lazy()[0] == plain and plain == lazy()[0] and lazy()[0] == lazy()[0]
    assert lazy()[0] != empty and empty != lazy()[0]
    refused(TypeError, "unhashable", hash, lazy()[0])


def test_values_may_be_replaced_and_deleted():
    values, computed = lazy()
    values["ids"] = 4
    del values["mask"]
    values |= {"depths": 5}
    assert values == {"image": 1, "ids": 4, "depths": 5} and computed == []
    assert values.pop("mask", None) is None and values.setdefault("mask", 6) == 6
    with pytest.raises(KeyError):
        values["radii"]


LATE_READERS = (
    "dict", "unpacked", "keyword arguments", "update", "shallow copy", "deep copy", "pickle", "torch.load",
    "repr",
)  # fmt: skip


@pytest.mark.parametrize("reader", [READERS[name] for name in (*LATE_READERS, "items", "values")])
def test_a_mapping_is_computed_once_and_only_when_it_is_looked_into(reader):
    computed, plain = [], dict(PLAIN)
    late = LateMapping(lambda: computed.append(0) or PLAIN)
    whole = LazyDict({"found": late}, PLAIN.get)
    assert list(whole.values())[0] is late and computed == []
    result = reader(late)
    assert type(result) in (dict, OrderedDict) and list(result.items()) == list(PLAIN.items())
    assert len(late) == 3 and "ids" in late and late == PLAIN and plain == late and late != {}
    assert tree_map(lambda value: value, whole) == {"found": PLAIN}
    assert computed == [0]
