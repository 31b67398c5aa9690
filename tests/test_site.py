# SPDX-License-Identifier: Apache-2.0
"""What the hooks of the documentation site make of the pages; `make docs` builds and checks the whole."""

import importlib.util
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def hooks():
    pytest.importorskip("mkdocs", reason="needs pip install 'blitzgs[docs]'")
    pytest.importorskip("latex2mathml", reason="needs pip install 'blitzgs[docs]'")
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "site" / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_links_of_the_repository_become_links_of_the_site(hooks):
    text = "[a](docs/guide/view.md#x) [b](csrc/math/vec.h) [c](https://a.b/c.md)\n```md\n[d](docs/image.md)\n```\n"
    turned = "[a](guide/view.md#x) [b](source/csrc/math/vec.h.md) [c](https://a.b/c.md)\n```md\n[d](docs/image.md)\n```\n"
    assert hooks.with_links(text, "README.md") == turned
    assert (
        hooks.with_links("[a](../../README.md#try-it)", "docs/guide/README.md") == "[a](../index.md#try-it)"
    )
    assert hooks.with_links("[a](docs/paper.md)", "CONTRIBUTING.md") == "[a](../paper.md)"


def test_equations_become_mathml(hooks):
    page = r'<td><span class="arithmatex">\(a&lt;\hat{C}\)</span></td>'
    math = ElementTree.fromstring(hooks.on_page_content(page))[0]
    assert math.tag.endswith("math") and "".join(math.itertext()) == "a<C^"
    assert [part.tag.rpartition("}")[2] for part in math.iter()].count("mover") == 1


def test_the_api_has_every_public_name(hooks):
    names = hooks.public_names()
    assert {"blitzgs.rasterization", "blitzgs.optim.LazyAdam", "blitzgs.formats.ply.write_ply"} <= set(names)
    assert "api/ops.md" in hooks.api_pages() and "blitzgs.ops.project\n" in hooks.api_pages()["api/ops.md"]


def test_every_page_is_in_the_navigation():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    named = set(re.findall(r"[\w/.-]+\.md", str(nav)))
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert pages <= named, pages - named
