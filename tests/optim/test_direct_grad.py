# SPDX-License-Identifier: Apache-2.0
"""`raw_rasterization(..., direct_grad=True)` trains bit for bit as gradients in `.grad` do."""

import copy
import pickle

import pytest
import torch

import blitzgs
from blitzgs.optim import LazyAdam, step_together
from tests.call.test_raw_rasterization import NAMES, raw, raw_parameters, spread
from tests.helpers import BACKENDS, random_scene, relative_error

CPU = ("cpu", torch.float64)
CAMERAS = 40


class Arm:
    """Parameters, and one `LazyAdam` for each or one for all of them."""

    def __init__(self, direct, backend=CPU, in_one=False, frozen=()):
        device, dtype = backend
        self.direct = direct
        self.scene = spread(
            random_scene(n=60, cameras=CAMERAS, width=20, height=16, dtype=dtype, device=device)
        )
        self.params = raw_parameters(self.scene)
        for name in frozen:
            self.params[name].requires_grad_(False)
        groups = [
            {"params": [p], "lr": 2.0 ** -(6 + number), "name": name}
            for number, (name, p) in enumerate(self.params.items())
        ]
        self.optimizers = {group["name"]: LazyAdam([group], eps=1e-15) for group in groups}
        if in_one:
            self.optimizers = {"all": LazyAdam(groups, eps=1e-15)}

    def render(self, *views, **options):
        """Render views of the scene; the options of `raw_rasterization` may change."""
        view = random_scene(n=1, cameras=1, width=20, height=16)
        view.viewmats, view.Ks = self.scene.viewmats[list(views)], self.scene.Ks[list(views)]
        options = {"optimizers": self.optimizers, "direct_grad": self.direct, **options}
        return raw(self.params, view, **options)

    def backward(self, *views, **options):
        image, _, _ = self.render(*views, **options)
        blitzgs.l1_ssim(image, torch.full_like(image, 0.3)).backward()

    def step(self, *names):
        """Take the step of all optimisers, or of some by themselves."""
        if names:
            for name in names:
                self.optimizers[name].step()
        else:
            step_together(self.optimizers)

    def zero_grad(self, **options):
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(**options)

    def renew(self, change):
        """Replace parameters by those that `change` returns for each optimiser."""
        for optimizer in self.optimizers.values():
            self.params.update(change(optimizer))

    def has_grads(self):
        return any(p.grad is not None for p in self.params.values())


def require_same(script, backend=CPU, **options):
    """Run a script with both kinds of gradients and compare all parameters and their state."""
    plain, direct = (Arm(kind, backend, **options) for kind in (False, True))
    for arm in (plain, direct):
        script(arm)
    for name in NAMES:
        ours, theirs = (
            next(o for o in arm.optimizers.values() if id(arm.params[name]) in o.param_ids())
            for arm in (direct, plain)
        )
        ours.catch_up()
        theirs.catch_up()
        pairs = [(direct.params[name], plain.params[name])]
        mine, other = ours.state.get(direct.params[name], {}), theirs.state.get(plain.params[name], {})
        assert mine.keys() == other.keys(), name
        pairs += [(mine[key], other[key]) for key in mine]
        for own, expected in pairs:
            if backend[0] == "cpu":
                assert torch.equal(own, expected), name
            else:  # sums of atomic additions
                assert relative_error(own.double(), expected.double()) < 2e-3, name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("in_one", [True, False])
def test_steps_are_the_same_without_sparse_tensors(backend, in_one):
    def script(arm):
        for step in range(8):
            arm.backward(step % 5)
            assert arm.has_grads() != arm.direct
            arm.step()
            assert arm.has_grads() != arm.direct
            arm.zero_grad()

    require_same(script, backend, in_one=in_one)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("in_one", [True, False])
def test_rows_change_between_steps(backend, in_one):
    def append(optimizer):
        names = [group["name"] for group in optimizer.param_groups]
        return optimizer.append({name: arm_now.params[name].detach()[:7].clone() for name in names})

    def script(arm):
        nonlocal arm_now
        arm_now = arm
        device = arm.scene.means.device
        for change in (
            append,
            lambda optimizer: optimizer.keep(torch.arange(67, device=device) % 4 > 0),
            lambda optimizer: optimizer.permute(torch.arange(50, device=device).flip(0)),
        ):
            for pending in (False, True):
                arm.backward(1)
                arm.step()
                arm.zero_grad()
                arm.backward(2)
                if not pending:
                    arm.step()
                    arm.zero_grad()
            arm.renew(change)  # the last gradients are lost with their parameters
            arm.step()
        arm.backward(3)
        arm.step()

    arm_now = None
    require_same(script, backend, in_one=in_one)


def test_a_strategy_replaces_one_parameter():
    def script(arm):
        for step in range(6):
            arm.backward(step % 3)
            if step == 3:  # as gsplat's reset_opa, here before the step
                optimizer, old = arm.optimizers["opacities"], arm.params["opacities"]
                new = torch.nn.Parameter(old.detach().clamp(max=-1.0))
                optimizer.state[new] = optimizer.state.pop(old)
                optimizer.param_groups[0]["params"] = [new]
                arm.params["opacities"] = new
            arm.step()
            arm.zero_grad()

    require_same(script)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("in_one", [True, False])
def test_gradients_of_several_passes_add_up(backend, in_one):
    def script(arm):
        for step in range(4):
            arm.backward(0)
            arm.backward(1)
            if step % 2:
                arm.backward(1, 2)
            arm.step()
            if step != 2:  # without it, the next gradients are added
                arm.zero_grad()

    require_same(script, backend, in_one=in_one)


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("apart", [True, False])
def test_other_terms_of_the_loss_count(before, apart):
    def script(arm):
        for step in range(6):
            image, _, _ = arm.render(step % 4)
            loss = blitzgs.l1_ssim(image, torch.full_like(image, 0.3))
            terms = 0.1 * arm.params["opacities"].sigmoid().mean() + arm.params["scales"].exp().mean()
            if not apart:
                (loss + terms).backward()
            else:
                for term in (terms, loss) if before else (loss, terms):
                    term.backward()
            arm.step()
            arm.zero_grad()

    require_same(script)


@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_is_visible(backend):
    def script(arm):
        arm.scene.viewmats[3, 2, 3] -= 1e4
        for view in (0, 3, 1, 3, 3):
            arm.backward(view)
            arm.step()
            arm.zero_grad()

    require_same(script, backend)


@pytest.mark.parametrize("set_to_none", [True, False])
def test_zero_grad_drops_gradients(set_to_none):
    def script(arm):
        arm.backward(0)
        arm.zero_grad(set_to_none=set_to_none)
        arm.step()
        arm.backward(1)
        arm.optimizers["means"].zero_grad(set_to_none=set_to_none)
        arm.step()
        arm.zero_grad()
        for _ in range(2):
            arm.backward(2)
            step_together(arm.optimizers, set_to_none=True)
        arm.step()

    require_same(script)


def test_some_optimisers_take_steps():
    def script(arm):
        for step in range(8):
            arm.backward(step % 5)
            arm.step(*(NAMES, ("means", "shN"), NAMES[1:], ())[step % 4])
            if step % 4 != 1:
                arm.zero_grad()

    require_same(script)


@pytest.mark.parametrize("frozen", [("scales",), ("sh0", "shN"), NAMES])
def test_frozen_parameters_stay(frozen):
    def script(arm):
        for view in range(4):
            if len(frozen) < len(NAMES):
                arm.backward(view)
            else:
                assert not arm.render(view)[0].requires_grad
            arm.step()
            arm.zero_grad()

    require_same(script, frozen=frozen)


def test_parameters_frozen_before_the_backward_pass_stay():
    def script(arm):
        for view in range(4):
            image = arm.render(view)[0]
            arm.params["scales"].requires_grad_(view != 1)
            image.square().sum().backward()
            arm.step()
            arm.zero_grad()

    require_same(script)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("frozen", [(), ("quats", "sh0")])
def test_many_views(backend, frozen):
    def script(arm):
        for _ in range(3):
            arm.backward(*range(CAMERAS))
            assert arm.has_grads() != arm.direct
            arm.step()
            arm.zero_grad()

    require_same(script, backend, frozen=frozen)


@pytest.mark.parametrize("direct", [True, False])
def test_an_optimiser_under_several_names_takes_one_step(direct):
    shared, alone = Arm(direct, in_one=True), Arm(direct, in_one=True)
    shared.optimizers = dict.fromkeys(NAMES, shared.optimizers["all"])
    for arm in (shared, alone):
        for view in range(4):
            arm.backward(view)
            arm.step()
            arm.zero_grad()
        arm.optimizers.popitem()[1].catch_up()
    for name in NAMES:
        assert torch.equal(shared.params[name], alone.params[name]), name


def test_depth_alone():
    def script(arm):
        for view in range(3):
            arm.render(view, render_mode="D")[0].sum().backward()
            arm.step()
            arm.zero_grad()

    require_same(script)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("views", [2, CAMERAS])
def test_other_gradients_are_the_same(backend, views):
    """Those of poses, backgrounds and splats, which strategies read."""
    found = []
    for direct in (False, True):
        arm = Arm(direct, backend)
        poses = arm.scene.viewmats = arm.scene.viewmats.requires_grad_()
        backgrounds = torch.full((views, 3), 0.2).to(poses).requires_grad_()
        image, _, meta = arm.render(*range(views), backgrounds=backgrounds, absgrad=True)
        meta["means2d"].retain_grad()
        (v_poses,) = torch.autograd.grad(image.square().sum(), [poses], retain_graph=True)
        assert not arm.has_grads() and not any(o.handed for o in arm.optimizers.values())
        image.square().sum().backward()
        means2d = meta["means2d"]
        found.append((v_poses, poses.grad, backgrounds.grad, means2d.grad, means2d.absgrad))
    for own, expected in zip(*found, strict=True):
        assert own.any() and relative_error(own, expected) < (1e-11 if backend[0] == "cpu" else 1e-3)


@pytest.mark.parametrize("copy_of", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_and_saved_states_have_no_gradients(copy_of):
    arm = Arm(True)
    arm.backward(0)
    optimizer = arm.optimizers["means"]
    assert optimizer.handed and copy_of(optimizer).handed == []
    assert optimizer.state_dict()["state"] == {} and optimizer.handed


def test_a_loaded_state_leaves_gradients_alone():
    def script(arm):
        for step in range(6):
            arm.backward(step % 4)
            if step == 3:  # `.grad` stays too
                for optimizer in arm.optimizers.values():
                    optimizer.load_state_dict(copy.deepcopy(optimizer.state_dict()))
            arm.step()
            arm.zero_grad()

    require_same(script)


def test_autograd_does_not_return_the_gradients():
    arm = Arm(True)
    image, _, _ = arm.render(0)
    with pytest.raises(RuntimeError, match="appears to not have been used in the graph"):
        torch.autograd.grad(image.sum(), [arm.params["means"]])
    assert not any(optimizer.handed for optimizer in arm.optimizers.values())


def test_a_second_derivative_is_refused():
    arm = Arm(True)
    arm.scene.viewmats.requires_grad_()
    arm.render(0)[0].sum().backward(create_graph=True)
    with pytest.raises(RuntimeError, match="has first derivatives only"):
        arm.scene.viewmats.grad.square().sum().backward()


def test_what_is_not_possible_is_refused():
    arm = Arm(True)
    others = {**arm.optimizers, "quats": torch.optim.Adam([arm.params["quats"]])}
    for optimizers in (others, list(others.values())):
        with pytest.raises(ValueError, match=r"no LazyAdam in `optimizers` has quats; pass"):
            arm.render(0, optimizers=optimizers)
    with pytest.raises(ValueError, match="has means, quats, scales, opacities, sh0, shN; pass"):
        arm.render(0, optimizers=())
    with pytest.raises(ValueError, match="direct_grad=True needs sparse_grad=True"):
        arm.render(0, sparse_grad=False)
    with torch.no_grad():
        arm.render(0, optimizers=())
