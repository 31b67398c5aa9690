# SPDX-License-Identifier: Apache-2.0
"""Non-finite values stop a run, and the message names the step and the op."""

import pytest
import torch

from blitzgs.distributed.group import Ranks
from blitzgs.runs.guard import LossGuard, NonFiniteError
from blitzgs.training.trainer import Trainer
from tests.training.tiny import tiny_config, tiny_scene


class Broken:
    """A frame that names CUDA as its device, so that the guard reads sums a step later, as on CUDA."""

    def __init__(self, frame, device="cpu"):
        self._frame, self._device = frame, device

    def __getattr__(self, name):
        found = getattr(self._frame, name)
        if name == "renders" and self._device == "cuda":
            return OnCuda(found)
        return found


class OnCuda:
    device = torch.device("cuda")

    def __init__(self, tensor):
        self._tensor = tensor

    def __getattr__(self, name):
        return getattr(self._tensor, name)


class Sums:
    def __init__(self, *values):
        self._values = values

    def read(self):
        return torch.tensor(self._values)


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    config = tiny_config("schedule.batch_size=2")
    running = Trainer(config, *tiny_scene(), tmp_path_factory.mktemp("frame"), Ranks())
    batch = running.loader.get(0, 1)
    rendered, *_ = running.state.stepper.forward(1, running.state.render_options, batch)
    running.close()
    return running.state.table, rendered


@pytest.mark.parametrize("name", ["means2d", "conics", "depths", "opacities", "colors"])
def test_the_guard_names_op_gaussian_and_view(frame, name):
    table, rendered = frame
    column = getattr(rendered.projected, name).clone()
    column[5] = float("inf")
    splats = rendered.projected._replace(**{name: column})
    wanted = int(table["id"][splats.gaussian_ids[5]]), ("a", "b")[splats.camera_ids[5]]
    with pytest.raises(NonFiniteError) as failure:
        LossGuard().check(
            9, ("a", "b"), Sums(0, 0, float("nan"), 0), table, rendered._replace(projected=splats)
        )
    assert str(failure.value) == (
        "step 9: the loss of view 'a' is not finite; it first appears in op project, output "
        f"{name}: Gaussian id {wanted[0]} in view '{wanted[1]}', and 0 more"
    )


def test_the_guard_names_the_pixel_and_says_what_it_has_looked_at(frame):
    table, rendered = frame
    images = rendered.renders.clone()
    images[1, 7, 11, 2] = float("nan")
    bad = Sums(0, float("nan"), 0, 0)
    with pytest.raises(NonFiniteError, match=r"op rasterize, output renders: view 'b', pixel \(11, 7\)"):
        LossGuard().check(9, ("a", "b"), bad, table, rendered._replace(renders=images))
    with pytest.raises(
        NonFiniteError, match="projected Gaussians and images are finite: it comes from op photom"
    ):
        LossGuard().check(9, ("a", "b"), bad, table, rendered)
    # A step later, the message does not name data that no longer exist.
    guard, late = LossGuard(), Broken(rendered, "cuda")
    guard.check(9, ("a", "b"), bad, table, late)
    with pytest.raises(NonFiniteError) as failure:
        guard.check(10, ("c", "d"), Sums(0, 0, 0, 0), table, late)
    text = str(failure.value)
    assert text.startswith("step 9: the loss of view 'b' is not finite; the data of step 9 no longer exist;")
    assert "in step 10 the parameters are finite" in text and "view 'c', 'd'" in text
    guard.check(9, ("a", "b"), bad, table, late)
    splats = rendered.projected._replace(depths=rendered.projected.depths * torch.inf)
    spoiled = Broken(rendered._replace(projected=splats), "cuda")
    with pytest.raises(NonFiniteError, match="found in step 10: .* op project, output depths"):
        guard.check(10, ("c", "d"), Sums(0, 0, 0, 0), table, spoiled)


@pytest.mark.parametrize("bad", [(0, float("inf"), 0, 0), (float("inf"), 0, float("-inf"), 0)])
def test_infinite_sums_stop_the_run_but_not_large_ones(frame, bad):
    table, rendered = frame
    LossGuard().check(1, ("a", "b"), Sums(*[torch.finfo(torch.float32).max] * 4), table, rendered)
    with pytest.raises(NonFiniteError, match=f"the loss of view '{'ba'[bad[0] > 0]}' is not finite"):
        LossGuard().check(1, ("a", "b"), Sums(*bad), table, rendered)
