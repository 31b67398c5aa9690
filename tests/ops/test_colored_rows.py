# SPDX-License-Identifier: Apache-2.0
"""The colours of splats that were projected without SH are those of a projection with SH, bit for bit."""

import pytest
import torch

from blitzgs.ops.projection import ProjectionInputs, ProjectionOptions, colored_rows, project_splats
from tests.helpers import BACKENDS, random_scene


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("cameras", [1, 4])
@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
def test_gathered_rows_have_the_splats_of_their_own_projection(backend, cameras, degree):
    device, dtype = backend
    scene = random_scene(n=90, cameras=cameras, width=24, height=20, dtype=dtype, device=device)
    scene.opacities[::3] = 0  # seen by no view
    scene.colors[1::7] = torch.nan
    options = ProjectionOptions(24, 20, sh_degree=degree or 0, raw=False)
    views, geometry = (scene.viewmats, scene.Ks), [scene.means, scene.quats, scene.scales, scene.opacities]
    whole = project_splats(ProjectionInputs(geometry, views, options))
    visible = whole.visible_ids.long()
    rows = [column[visible] for column in [*geometry, *([] if degree is None else [scene.colors])]]
    inputs = ProjectionInputs(rows, views, options)
    expected, actual = project_splats(inputs), colored_rows(whole, inputs)
    assert 0 < len(visible) < 90 and (degree is None or not expected.opacities.all())
    for name, column in expected._asdict().items():
        if name != "counts":
            assert torch.equal(getattr(actual, name), column), name
    assert actual.counts.tolist()[:2] == expected.counts.tolist()[:2]


def test_errors_name_the_argument():
    scene = random_scene(n=5, cameras=1)
    options = ProjectionOptions(scene.width, scene.height, sh_degree=3, raw=False)
    gaussians = [scene.means, scene.quats, scene.scales, scene.opacities, scene.colors]
    inputs = ProjectionInputs(gaussians, (scene.viewmats, scene.Ks), options)
    splats = project_splats(inputs)
    with pytest.raises(RuntimeError, match="color_splats_: camera_ids must be Int, got Long"):
        colored_rows(splats._replace(camera_ids=splats.camera_ids.long()), inputs)
    with pytest.raises(RuntimeError, match=r"color_splats_: radii must have shape"):
        colored_rows(splats._replace(radii=splats.radii[:-1]), inputs)
