# SPDX-License-Identifier: Apache-2.0
"""`blitzgs.raw_rasterization` equals `blitzgs.rasterization` of activated parameters."""

import pytest
import torch

import blitzgs
from blitzgs.optim import LazyAdam
from tests.helpers import other_defaults, random_scene, refused, relative_error

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")


def raw_parameters(scene):
    """Leaves, as gsplat's trainer has them."""
    values = {
        "means": scene.means, "quats": scene.quats, "scales": scene.scales.log(),
        "opacities": scene.opacities.logit(), "sh0": scene.colors[:, :1], "shN": scene.colors[:, 1:],
    }  # fmt: skip
    return {name: value.detach().clone().requires_grad_() for name, value in values.items()}


def spread(scene):
    """Put half of the Gaussians where few views see them."""
    scene.means[::2] *= 5.0
    return scene


def activated(p, scene, **options):
    return blitzgs.rasterization(
        p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(),
        torch.cat([p["sh0"], p["shN"]], dim=1), scene.viewmats, scene.Ks, scene.width, scene.height,
        **{"sh_degree": 3, **options},
    )  # fmt: skip


def raw(p, scene, **options):
    return blitzgs.raw_rasterization(
        *p.values(), scene.viewmats, scene.Ks, scene.width, scene.height, **options
    )


@pytest.mark.parametrize("sparse_grad", [True, False])
@pytest.mark.parametrize("cameras", [1, 40])
def test_parameters_of_nerfstudio_and_inria_are_taken_as_they_are(device, sparse_grad, cameras):
    scene = spread(random_scene(n=80, cameras=cameras, width=24, height=20, device=device))
    runs = []
    for other in (False, True):
        p = raw_parameters(scene)
        if other:  # opacities [N, 1], features_dc [N, 3]
            p["opacities"] = p["opacities"].detach()[:, None].requires_grad_()
            p["sh0"] = p["sh0"].detach()[:, 0].requires_grad_()
        optimizer = LazyAdam([{"params": [value], "lr": 0.01, "name": name} for name, value in p.items()])
        for _ in range(3):
            image = raw(p, scene, sparse_grad=sparse_grad, optimizers=optimizer)[0]
            optimizer.zero_grad()
            image.square().sum().backward()
            for value in p.values():
                assert value.is_leaf and value.grad.shape == value.shape
                assert value.grad.is_sparse == sparse_grad
            optimizer.step()
        optimizer.catch_up()
        runs.append([image, *p.values()])
    for actual, expected in zip(*reversed(runs), strict=True):
        actual, expected = actual.detach().reshape(expected.shape), expected.detach()
        # On CUDA, sums of gradients differ by rounding, and Adam takes whole steps for gradients that small.
        assert torch.equal(actual, expected) if device == "cpu" else relative_error(actual, expected) < 0.05


@pytest.mark.parametrize(
    "options", [{}, {"render_mode": "RGB+ED"}, {"rasterize_mode": "antialiased"}], ids=str
)
@pytest.mark.parametrize("cameras", [1, 3, 40])
def test_it_renders_what_activated_parameters_render(backend, options, cameras):
    device, dtype = backend
    scene = spread(random_scene(n=80, cameras=cameras, width=24, height=20, dtype=dtype, device=device))
    bound = 1e-11 if dtype == torch.float64 else 1e-4
    expected, actual = raw_parameters(scene), raw_parameters(scene)
    for _ in range(2):  # on CUDA the second call of `rasterization` is queued
        image, alphas, meta = activated(expected, scene, **options)
        own_image, own_alphas, own_meta = raw(actual, scene, **options)
    assert relative_error(own_image, image) < bound and relative_error(own_alphas, alphas) < bound
    for name in ("camera_ids", "gaussian_ids", "radii", "tiles_per_gauss"):
        assert torch.equal(own_meta[name], meta[name]), name
    assert relative_error(own_meta["means2d"], meta["means2d"]) < bound
    image.square().sum().backward()
    own_meta["means2d"].retain_grad()
    own_image.square().sum().backward()
    visible = meta["gaussian_ids"].unique()
    for name in NAMES:
        gradient = actual[name].grad
        assert gradient.is_sparse and torch.equal(gradient.coalesce().indices()[0], visible), name
        assert relative_error(gradient.to_dense(), expected[name].grad) < 10 * bound, name
    assert own_meta["means2d"].grad.any()


def test_gradients_may_be_dense_and_sh_one_tensor(device):
    scene = spread(random_scene(n=60, device=device))
    expected, split = raw_parameters(scene), raw_parameters(scene)
    whole = torch.cat([split.pop("sh0"), split.pop("shN")], dim=1).detach().requires_grad_()
    activated(expected, scene, sh_degree=2)[0].square().sum().backward()
    split |= {"sh0": whole, "shN": None}
    raw(split, scene, sh_degree=2, sparse_grad=False)[0].square().sum().backward()
    for name in NAMES[:4]:
        assert relative_error(split[name].grad, expected[name].grad) < 1e-4, name
    joined = torch.cat([expected["sh0"].grad, expected["shN"].grad], dim=1)
    assert relative_error(whole.grad, joined) < 1e-4


def test_images_that_do_not_fit_into_memory_are_named(monkeypatch):
    scene = random_scene(n=5, width=24, height=20)

    def fails(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("blitzgs.call.render.rasterize", fails)
    for call in (raw, activated):
        message = "not enough memory to render 2 views of 24 x 20 pixels with 5 Gaussians"
        refused(MemoryError, message, call, raw_parameters(scene), scene)


def test_depth_has_no_gradient_of_sh():
    scene = random_scene(n=30)
    p = raw_parameters(scene)
    image, _, _ = raw(p, scene, render_mode="D")
    image.sum().backward()
    assert p["means"].grad is not None and p["sh0"].grad is None and p["shN"].grad is None


def test_nothing_visible_is_an_empty_image(device):
    scene = random_scene(n=20, device=device)
    scene.means += 1e4
    p = raw_parameters(scene)
    image, alphas, meta = raw(p, scene, backgrounds=torch.full((2, 3), 0.5, device=device))
    assert (image == 0.5).all() and not alphas.any() and len(meta["gaussian_ids"]) == 0
    image.sum().backward()
    assert p["means"].grad.coalesce().values().shape == (0, 3)


def test_gradients_add_up_after_a_view_of_nothing(device):
    """Torch adds to an empty sparse gradient in place."""
    scene = spread(random_scene(n=60, cameras=3, width=20, height=16, device=device))
    scene.viewmats[0, 2, 3] -= 1e4
    sparse, dense = raw_parameters(scene), raw_parameters(scene)
    for p, is_sparse in ((sparse, True), (dense, False)):
        for view, mode in enumerate(("RGB", "D", "RGB")):
            raw(p, scene.view(view), render_mode=mode, sparse_grad=is_sparse)[0].square().sum().backward()
    for name in NAMES:
        assert relative_error(sparse[name].grad.to_dense(), dense[name].grad) < 1e-4, name


@pytest.mark.parametrize("in_one", [True, False])
def test_lazy_steps_are_those_of_dense_adam(backend, in_one):
    """Views take turns, so most rows have pending steps when they are next seen."""
    device, dtype = backend
    scene = spread(random_scene(n=60, cameras=6, width=20, height=16, dtype=dtype, device=device))
    dense, lazy = raw_parameters(scene), raw_parameters(scene)
    rates = dict(zip(NAMES, (2.0**-9, 2.0**-10, 2.0**-8, 2.0**-6, 2.0**-8, 2.0**-10), strict=True))
    groups = [{"params": [p], "lr": rates[name], "name": name} for name, p in lazy.items()]
    adam = torch.optim.Adam([{"params": [p], "lr": rates[name]} for name, p in dense.items()], eps=1e-15)
    if in_one:
        optimizers = LazyAdam(groups, eps=1e-15)
    else:  # in the form that gsplat's strategies need
        optimizers = {group["name"]: LazyAdam([group], eps=1e-15) for group in groups}
    generator = torch.Generator().manual_seed(2)
    for _ in range(14):
        one = scene.view(torch.randint(6, (1,), generator=generator).item())
        target = torch.rand(1, 16, 20, 3, generator=generator).to(device, dtype)
        for p, image in ((dense, activated(dense, one)[0]), (lazy, raw(lazy, one, optimizers=optimizers)[0])):
            for param in p.values():
                param.grad = None
            blitzgs.l1_ssim(image, target).backward()
        adam.step()
        for optimizer in [optimizers] if in_one else optimizers.values():
            optimizer.step()
    for optimizer in [optimizers] if in_one else optimizers.values():
        optimizer.catch_up()
    for name in NAMES:
        assert relative_error(lazy[name], dense[name]) < (1e-9 if dtype == torch.float64 else 2e-3), name


@pytest.mark.parametrize("name", NAMES)
def test_what_is_not_finite_is_named(name):
    scene = random_scene(n=40, cameras=1)
    p = raw_parameters(scene)
    seen = int(raw(p, scene)[2]["gaussian_ids"][0])
    p[name].data[seen] = torch.nan
    with pytest.warns(RuntimeWarning, match=rf"blitzgs.raw_rasterization: NaN or infinite values in {name};"):
        image, _, meta = raw(p, scene)
    assert image.isfinite().all()
    assert {key: value.tolist() for key, value in meta["non_finite"].items()} == {name: [seen]}


@pytest.mark.filterwarnings("ignore:blitzgs.raw_rasterization. NaN or infinite values")
def test_sh_that_are_not_read_are_not_named():
    scene = random_scene(n=40, cameras=1)
    p = raw_parameters(scene)
    p["shN"].data[7, 8] = torch.nan
    assert raw(p, scene, sh_degree=2)[2]["non_finite"] == {}
    p["sh0"].data[7] = torch.nan
    assert raw(p, scene, render_mode="D")[2]["non_finite"] == {}
    p["shN"].data[5, 7] = torch.nan
    found = raw(p, scene, sh_degree=2)[2]["non_finite"]
    assert {key: value.tolist() for key, value in found.items()} == {"sh0": [7], "shN": [5]}


def test_infinite_logits_are_fine(recwarn):
    scene = random_scene(n=40, cameras=1)
    p = raw_parameters(scene)
    p["opacities"].data[:20], p["scales"].data[5] = torch.inf, -torch.inf
    image, _, meta = raw(p, scene)
    assert image.isfinite().all() and meta["non_finite"] == {}
    assert not [w for w in recwarn if "blitzgs" in str(w.message)]


def test_what_gsplats_trainer_passes_is_accepted_where_it_has_no_effect():
    scene = random_scene(n=20)
    p = raw_parameters(scene)
    passed = {
        "packed": True, "absgrad": False, "sparse_grad": True, "rasterize_mode": "classic", "covars": None,
        "distributed": False, "camera_model": "".join(["pin", "hole"]), "with_ut": False,
        "with_eval3d": False, "channel_chunk": 8, "segmented": True, "tile_size": None,
    }  # fmt: skip
    assert torch.equal(raw(p, scene, **passed)[0], raw(p, scene)[0])


@pytest.mark.parametrize(
    "option",
    [{"packed": False}, {"distributed": True}, {"camera_model": "fisheye"}, {"covars": 3}, {"with_ut": True}],
    ids=str,
)
def test_what_only_rasterization_or_gsplat_supports_is_refused(option):
    ((name, value),) = option.items()
    scene = random_scene(n=20)
    message = f"blitzgs.raw_rasterization does not support {name}={value!r}; leave it out"
    refused(ValueError, message, raw, raw_parameters(scene), scene, **option)
    with pytest.raises(TypeError, match=r"raw_rasterization\(\) got an unexpected keyword argument 'packd'"):
        raw(raw_parameters(scene), scene, packd=value)


SHARERS = (
    {},
    {"sh0": lambda t: t.squeeze(1), "means": lambda t: t},
    {"shN": lambda t: t.detach().requires_grad_()},
)


@pytest.mark.parametrize("others", SHARERS, ids=len)
def test_rows_catch_up_behind_what_shares_their_memory(device, others):
    """As in an evaluation of detached parameters, or of views of them."""
    scene = spread(random_scene(n=60, device=device))
    p = raw_parameters(scene)
    optimizer = LazyAdam(p.values(), lr=0.1)
    for number in (0, 0, 1):  # the view of the last step sees other Gaussians
        raw(p, scene.view(number), optimizers=optimizer)[0].square().sum().backward()
        optimizer.step()
        optimizer.zero_grad()
    with torch.no_grad():
        shared = {name: others.get(name, torch.Tensor.detach)(t) for name, t in p.items()}
        image = raw(shared, scene, optimizers=optimizer)[0]
        optimizer.catch_up()
        assert torch.equal(image, raw(p, scene)[0])


def test_optimizers_may_be_one_of_any_class():
    scene = random_scene(n=20)
    p = raw_parameters(scene)
    expected = raw(p, scene)[0]
    for optimizer_class in (torch.optim.Adam, LazyAdam):
        assert torch.equal(raw(p, scene, optimizers=optimizer_class(p.values()))[0], expected)
    refused(TypeError, "optimizers must be .* mapping or a sequence .* NoneT", raw, p, scene, optimizers=None)
    for mistaken, named in ((p, "Tensor among them"), (p.keys(), "str among them")):
        refused(TypeError, f"optimizers must be optimisers, got {named}", raw, p, scene, optimizers=mistaken)


def test_wrong_shapes_are_refused_by_name():
    scene = random_scene(n=20)
    p = raw_parameters(scene)
    refused(ValueError, r"shN must be .* N = 20, got \[19, 15, 3\]", raw, {**p, "shN": p["shN"][:19]}, scene)
    refused(ValueError, r"means must be .*, got \[1, 20, 3\]", raw, {**p, "means": p["means"][None]}, scene)
    refused(ValueError, "shN is on meta .* cpu; move one", raw, {**p, "shN": p["shN"].to("meta")}, scene)
    with pytest.raises(TypeError, match=r"quats must be a torch\.Tensor, got ndarray"):
        raw({**p, "quats": p["quats"].detach().numpy()}, scene)
    with pytest.raises(ValueError, match="sh_degree 3 needs 16 SH coefficients, got 4"):
        raw({**p, "shN": p["shN"][:, :3]}, scene, sh_degree=3)
    refused(ValueError, "raw_rasterization takes sh_degree 0 to 3, got 4", raw, p, scene, sh_degree=4)


def test_sparse_gradients_need_leaves():
    scene = random_scene(n=20)
    p = raw_parameters(scene)
    p["quats"] = torch.nn.functional.normalize(p["quats"], dim=1)
    refused(ValueError, "quats is not a leaf, and its gradient would be sparse", raw, p, scene)
    raw(p, scene, sparse_grad=False)[0].sum().backward()
    with torch.no_grad():
        raw(p, scene)
    p = raw_parameters(scene)
    p["sh0"] = p["sh0"] * 2
    raw(p, scene, render_mode="D")[0].sum().backward()  # SH get no gradient


def test_gradients_of_two_views_may_come_at_once(device):
    """The second view catches up rows that the first one read, which must not spoil the first's gradient."""
    scene = random_scene(n=50, cameras=2, width=20, height=16, device=device)
    together, one_by_one = raw_parameters(scene), raw_parameters(scene)
    options = [
        {"optimizers": LazyAdam([{"params": [t], "name": name} for name, t in p.items()], lr=0.0)}
        for p in (together, one_by_one)
    ]
    views = [scene.view(number) for number in range(2)]
    for _ in range(2):
        images = [raw(together, view, **options[0])[0] for view in views]
        sum(image.square().sum() for image in images).backward()
        for view in views:
            raw(one_by_one, view, **options[1])[0].square().sum().backward()
        for name in NAMES:
            expected = one_by_one[name].grad.to_dense()
            assert relative_error(together[name].grad.to_dense(), expected) < 1e-5, name
        for option in options:
            option["optimizers"].step()
            option["optimizers"].zero_grad(set_to_none=True)


@pytest.mark.cuda
def test_a_call_is_repeated_if_there_was_too_little_room():
    """A first view sees a few Gaussians, so that the next one needs more than was estimated."""
    scene = random_scene(n=2000, cameras=2, width=96, height=80, device="cuda")
    scene.viewmats[1, 2, 3] += 200.0  # far away: Gaussians that are splats become few and small
    expected, actual = raw_parameters(scene), raw_parameters(scene)
    optimizers = LazyAdam([{"params": [t], "lr": 2.0**-12, "name": name} for name, t in actual.items()])
    dense = torch.optim.Adam([{"params": [t], "lr": 2.0**-12} for t in expected.values()], eps=1e-8)
    for number in (1, 1, 0, 1, 0):
        view = scene.view(number)
        image = activated(expected, view)[0]
        own = raw(actual, view, optimizers=optimizers)[0]
        assert relative_error(own, image) < 1e-4
        for optimizer, picture in ((dense, image), (optimizers, own)):
            optimizer.zero_grad(set_to_none=True)
            picture.square().sum().backward()
            optimizer.step()
    optimizers.catch_up()
    for name in NAMES:
        assert relative_error(actual[name], expected[name]) < 2e-3, name


@pytest.mark.cuda
def test_memory_follows_what_is_visible():
    scene = random_scene(n=1000, cameras=1, device="cuda")
    p = raw_parameters(scene)
    far = {name: t.detach().repeat(1000, *(1,) * (t.dim() - 1)) for name, t in p.items()}
    far["means"][1000:] += 1e4
    far = {name: t.requires_grad_() for name, t in far.items()}
    for _ in range(3):
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        raw(far, scene)[0].sum().backward()
        torch.cuda.synchronize()
        peak = torch.cuda.max_memory_allocated() - before
        for t in far.values():
            t.grad = None
    assert peak < 40e6  # 1 M Gaussians have 236 MB of parameters


def test_the_defaults_of_torch_have_no_effect(device):
    scene = spread(random_scene(n=40, device=device))
    targets = torch.full((2, scene.height, scene.width, 3), 0.5, device=device)

    def train():
        params = raw_parameters(scene)
        optimizers = {name: LazyAdam([{"params": [param], "name": name}]) for name, param in params.items()}
        for _ in range(3):
            for _ in range(2):  # gradients are accumulated
                renders, _, _ = raw(params, scene, optimizers=optimizers)
                blitzgs.l1_ssim(renders, targets).backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
                optimizer.load_state_dict(optimizer.state_dict())
        return params

    expected = train()
    with other_defaults():
        actual = train()
    for name, param in expected.items():
        assert relative_error(actual[name], param) < 1e-5, name
