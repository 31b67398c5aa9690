# SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: pages that are made from other files, links into the sources, and equations.

README.md is the site's first page. Every source file that a page links to becomes a page with its text, so
that the site needs no other server. The pages of the API are lists of names for mkdocstrings. Equations
become MathML, which browsers show without scripts and fonts.
"""

from __future__ import annotations

import html
import posixpath
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
# Pages outside docs/ -> their place on the site. All others keep their path below docs/.
OUTSIDE = {
    "README.md": "index.md",
    "CHANGELOG.md": "project/CHANGELOG.md",
    "CONTRIBUTING.md": "project/CONTRIBUTING.md",
}
LANGUAGES = {".h": "cpp", ".cpp": "cpp", ".cu": "cuda", ".cuh": "cuda", ".py": "python", ".yaml": "yaml",
             ".json": "json"}  # fmt: skip
FENCED = re.compile(r"^( *)(`{3,})(\w*)\n.*?^\1\2", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def place(path: str) -> str:
    """Return where a file of the repository is on the site."""
    if path in OUTSIDE:
        return OUTSIDE[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else f"source/{path}.md"


def origin(uri: str) -> str:
    """Return the file of the repository that is at a place of the site."""
    return {made: path for path, made in OUTSIDE.items()}.get(uri, f"docs/{uri}")


def with_links(text: str, path: str) -> str:
    """Return a page's text with the links of its file of the repository turned into those of the site."""
    here = posixpath.dirname(place(path))

    def turn(match: re.Match[str]) -> str:
        if re.match(r"\w+:", match[2]):
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), match[2]))
        return match[1] + posixpath.relpath(place(target), here or ".") + match[3]

    parts, end = [], 0
    for block in FENCED.finditer(text):
        parts += [LINK.sub(turn, text[end : block.start()]), block[0]]
        end = block.end()
    return "".join([*parts, LINK.sub(turn, text[end:])])


def linked_sources(pages: list[str]) -> set[str]:
    """Return the files outside docs/ to which pages link."""
    found = set()
    for path in pages:
        for match in LINK.finditer(FENCED.sub("", (ROOT / path).read_text())):
            if not re.match(r"\w+:", match[2]):
                found.add(posixpath.normpath(posixpath.join(posixpath.dirname(path), match[2])))
    return {path for path in found if path not in OUTSIDE and not path.startswith("docs/")}


def source_page(path: str) -> str:
    """Return the page of a source file; of a folder, that of its files' names."""
    if (ROOT / path).is_dir():
        names = "\n".join(f"- `{file.name}`" for file in sorted((ROOT / path).iterdir()) if file.is_file())
        return f"# {path}\n\n{names}\n"
    text = (ROOT / path).read_text()
    return f"# {path}\n\n``````{LANGUAGES.get(Path(path).suffix, 'text')}\n{text}``````\n"


def public_names() -> list[str]:
    """Return the names that docs/guide/own-trainer.md promises."""
    section = (ROOT / "docs/guide/own-trainer.md").read_text().split("## Public names")[1].split("\n## ")[0]
    exports = re.search(r"__all__ = \[(.*?)\]", (ROOT / "blitzgs/__init__.py").read_text(), re.DOTALL)
    first = [f"blitzgs.{name}" for name in re.findall(r'"(\w+)"', exports[1]) if name != "optim"]
    named = re.findall(r"`(blitzgs(?:\.\w+){2,})`", section)
    return list(dict.fromkeys([*first, *named]))


def api_pages() -> dict[str, str]:
    """Return the text of the pages of the API by place: the public names, then a page for each room."""
    lines = ["# Public names", "", "[What stays stable](../guide/own-trainer.md#public-names).", ""]
    # The page of the room is what links to a name lead to.
    second = "    options:\n      skip_local_inventory: true\n"
    pages = {"api/public.md": "\n".join([*lines, *(f"::: {name}\n{second}" for name in public_names())])}
    for room in sorted((ROOT / "blitzgs").iterdir()):
        modules = [file for file in sorted(room.glob("*.py")) if file.stem not in ("__init__", "__main__")]
        if modules:
            names = "\n".join(f"::: blitzgs.{room.name}.{file.stem}\n" for file in modules)
            pages[f"api/{room.name}.md"] = f"# blitzgs.{room.name}\n\n{names}"
    return pages


def on_config(config: MkDocsConfig) -> None:
    """Add the pages of the API to the navigation."""
    config.nav.insert(-1, {"API": list(api_pages())})


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that are no files in docs/."""
    for path, uri in OUTSIDE.items():
        files.append(File.generated(config, uri, content=(ROOT / path).read_text()))
    pages = [origin(file.src_uri) for file in files.documentation_pages()]
    for path in sorted(linked_sources(pages)):
        made = File.generated(config, place(path), content=source_page(path))
        made.inclusion = made.inclusion.NOT_IN_NAV
        files.append(made)
    for uri, text in api_pages().items():
        files.append(File.generated(config, uri, content=text))


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Turn links of the repository into links of the site."""
    uri = page.file.src_uri
    if uri.startswith("source/"):  # a word of the pages would find every header first
        page.meta["search"] = {"exclude": True}
    if uri == "index.md":
        page.meta["hide"] = ["navigation"]
    return markdown if uri.startswith(("api/", "source/")) else with_links(markdown, origin(uri))


def on_page_content(content: str, **_: Any) -> str:
    """Turn equations into MathML."""

    def mathml(match: re.Match[str]) -> str:
        return convert(html.unescape(match[2]), display="block" if match[1] == "div" else "inline")

    return EQUATION.sub(mathml, content)
