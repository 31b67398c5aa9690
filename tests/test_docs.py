# SPDX-License-Identifier: Apache-2.0
"""README and docs name only files, links, modules, configuration fields and commands that exist."""

import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch
import yaml

import blitzgs
from blitzgs import cli
from blitzgs.compat.gsplat import DefaultStrategy
from blitzgs.config.fields import Config
from blitzgs.config.files import to_dict
from tests.training.tiny import OVERRIDES, write_tiny_capture

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
# A decision names what existed when it was taken.
PRESENT = [name for name in NAMES if name != "docs/decisions.md"]
FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
FOLDERS = ("benchmarks", "blitzgs", "cmake", "configs", "csrc", "docs", "examples", "tests")
# The folder benchmarks/results exists only if something was measured.
MADE_LATER = ("benchmarks/results/",)
SHELL = ("sh", "bash")


@cache
def text_of(page):
    return page.read_text()


@cache
def prose(page):
    """The page without its code blocks."""
    kept = FENCED.sub("", text_of(page))
    return "\n".join(line for line in kept.split("\n") if not line.startswith("    "))


def inline_code(page):
    return re.findall(r"`([^`\n]+)`", prose(page))


def code_blocks(page, languages):
    return [body for _, language, body in FENCED.findall(text_of(page)) if language in languages]


def anchors(page):
    heads = re.findall(r"^#+ (.+)$", FENCED.sub("", text_of(page)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name):
    page = ROOT / name
    for link in re.findall(r"\]\(([^)\s]+)\)", FENCED.sub("", text_of(page))):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name} links to {link}, which does not exist"
        assert target.is_relative_to(ROOT), f"{name} links to {link}, outside the repository"
        if anchor:
            assert anchor in anchors(target), f"{name} links to {link}; {path or name} has {anchors(target)}"


def test_every_page_can_be_reached_from_the_readme():
    found, left = set(), [ROOT / "README.md"]
    while left:
        page = left.pop()
        if page in found:
            continue
        found.add(page)
        links = re.findall(r"\]\(([^)\s#]+)(?:#[^)]*)?\)", text_of(page))
        left += [path for link in links if (path := (page.parent / link).resolve()) in PAGES]
    orphans = [name for name in NAMES if ROOT / name not in found]
    assert not orphans, f"no page links to {orphans}"


@pytest.mark.parametrize("name", PRESENT)
def test_files_named_in_the_pages_exist(name):
    for code in inline_code(ROOT / name):
        for word in code.split():
            path = word.strip(',;:()"')
            if not re.match(rf"({'|'.join(FOLDERS)})/", path) or path.startswith(MADE_LATER):
                continue
            pattern = re.sub(r"<\w+>", "*", path.rstrip("/"))
            assert any(ROOT.glob(pattern)), f"{name} names {path}, which does not exist"


@pytest.mark.parametrize("name", PRESENT)
def test_modules_and_their_members_exist(name):
    for code in inline_code(ROOT / name):
        if not (match := re.match(r"(blitzgs(?:\.\w+)+)(\(|$)", code)):
            continue
        parts = match[1].split(".")
        found = importlib.import_module(parts[0])
        for i, part in enumerate(parts[1:], start=2):
            try:
                found = importlib.import_module(".".join(parts[:i]))
            except ModuleNotFoundError:
                assert hasattr(found, part), f"{name} names {match[1]}, but {found} has no {part}"
                found = getattr(found, part)


@cache
def fields():
    sections = to_dict(Config())
    return {
        f"{section}.{field}"
        for section, value in sections.items()
        if isinstance(value, dict)
        for field in value
    }


@pytest.mark.parametrize("name", PRESENT)
def test_configuration_fields_exist(name):
    sections = {field.split(".")[0] for field in fields()}
    for code in inline_code(ROOT / name):
        match = re.match(r"(?:--)?(?!\w+\.jsonl)(\w+\.\w+)(=|$)", code)
        if match and match[1].split(".")[0] in sections:
            assert match[1] in fields(), f"{name} names the field {match[1]}, which does not exist"


def commands(page):
    """Yield the command lines of a page: of its shell blocks, its indented blocks and its inline code."""
    lines = [line for block in code_blocks(page, SHELL) for line in block.replace("\\\n", " ").split("\n")]
    lines += re.findall(r"^    (\S.*)$", FENCED.sub("", text_of(page)), re.MULTILINE)
    lines += inline_code(page)
    for line in lines:
        words = shlex.split(line, comments=True) if line.count("'") % 2 == 0 else line.split()
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):  # variables for the command alone
            del words[0]
        if words and words[0] in ("blitzgs", "python", "torchrun", "make"):
            yield words


def check_blitzgs(words, folder, monkeypatch, capsys):
    """Check a command by running it in a folder without captures and runs: only its usage can be wrong."""
    monkeypatch.chdir(folder)
    (folder / "taken").write_text("")
    words = [str(ROOT / word) if word.startswith("configs/") else word for word in words]
    if words[0] == "train":
        if "--resume" in words and "--config" not in words:
            return
        words.append("--show-config")
    if words[0] == "synth":
        words[1] = "taken"
    status = cli.main(words)
    error = capsys.readouterr().err
    assert status == (0 if words[0] == "train" else 1), f"{shlex.join(words)}: {error}"


def check_script(words):
    script = ROOT / words[0]
    assert script.is_file(), f"{words[0]} does not exist"
    source = script.read_text() + (ROOT / "benchmarks" / "harness.py").read_text()
    for word in words[1:]:
        flag = word.split("=")[0]
        if word.startswith("--") and "." not in flag:
            assert f'"{flag}"' in source, f"{words[0]} has no flag {flag}"


def check_make(words):
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for word in words:
        if "=" not in word and not word.startswith("-"):
            assert word in targets, f"make {word}: no such target"


@pytest.mark.parametrize("name", PRESENT)
def test_commands_are_used_rightly(name, tmp_path, monkeypatch, capsys):
    for words in commands(ROOT / name):
        program, *rest = words
        if program == "torchrun":
            while rest and rest[0].startswith("--") and rest[0] != "-m":
                del rest[0]
            program = "python"
        if program == "python" and rest[:2] == ["-m", "blitzgs"]:
            program, rest = "blitzgs", rest[2:]
        if program == "python" and rest[:1] == ["train.py"]:
            program, rest = "blitzgs", ["train", *rest[1:]]
        # The reader replaces "..." and "COMMAND".
        if not rest or any("..." in word or "COMMAND" in word or "|" in word for word in rest):
            continue
        if program == "make":
            check_make(rest)
        elif program == "blitzgs":
            # A mere mention such as "blitzgs gate fit" has no arguments.
            if not all(word.isalpha() for word in rest):
                check_blitzgs(rest, tmp_path, monkeypatch, capsys)
        elif rest[0].endswith(".py"):
            check_script(rest)


def test_the_paper_page_names_existing_ops_for_every_equation():
    page = text_of(ROOT / "docs/paper.md").split("## Its tables")[0]
    known = set(re.findall(r'm\.def\(\s*"(\w+)', (ROOT / "csrc/registration.cpp").read_text()))
    # A name without a dot is an op; the others are checked as modules and their members.
    named = set(re.findall(r"`(\w+)`", page))
    assert len(named) > 20 and named <= known, named - known
    rows = {cells[0]: cells for line in page.split("\n") if (cells := line.strip("| ").split(" | "))[-1:]}
    for number in range(1, 10):
        _, formula, symbols, files = rows[f"Eq. {number}"]
        assert "$" in formula and "`" in symbols and "](../" in files


def test_every_message_of_the_troubleshooting_page_is_in_the_sources():
    files = [*(ROOT / "blitzgs").rglob("*.py"), *(ROOT / "csrc").rglob("*.cpp")]
    # Neighbouring literals are one text.
    sources = [re.sub(r'"\s*\n\s*f?"', "", path.read_text()) for path in files]
    rows = [line.split(" | ") for line in text_of(ROOT / "docs/guide/troubleshooting.md").split("\n")]
    fragments = [part for row in rows if len(row) == 3 for part in re.findall(r"`([^`]+)`", row[0])]
    assert len(fragments) > 30
    for fragment in fragments:
        assert any(fragment in source for source in sources), f"no message contains {fragment!r}"


def test_the_python_example_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_tiny_capture(tmp_path / "capture")
    flags = [
        "--data",
        "capture",
        "--out",
        "runs/demo/run",
        "--device",
        "cpu",
        *(f"--{o}" for o in ("config=defaults", *OVERRIDES)),
    ]
    assert cli.main(["train", *flags]) == 0
    names = {}
    run_example("README.md", "open_run", names)
    assert names["image"].shape == (600, 800, 3)
    assert (tmp_path / "from_above.png").stat().st_size > 1000


def example_scene():
    """What the examples of the pages take as given."""
    rng = torch.Generator().manual_seed(1)
    means, scales = torch.randn(30, 3, generator=rng), torch.rand(30, 3, generator=rng) * 0.2
    quats, opacities = torch.randn(30, 4, generator=rng), torch.rand(30, generator=rng) * 0.8 + 0.1
    sh = torch.randn(30, 16, 3, generator=rng) * 0.2
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[:, 2, 3] = torch.tensor([5.0, 8.0])
    Ks = torch.tensor([[40.0, 0, 25], [0, 40, 20], [0, 0, 1]]).repeat(2, 1, 1)
    names = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
    return {**names, "viewmats": viewmats, "Ks": Ks, "width": 50, "height": 40, "sh_degree": 3}


def run_example(page, part, names):
    """Run the block of a page with this part as it stands; `names` are given to it and get its results."""
    example = next(block for block in code_blocks(ROOT / page, ["python"]) if part in block)
    exec(compile(example, page, "exec"), names)


def test_the_examples_of_single_calls_run():
    names = example_scene()
    run_example("README.md", "from gsplat", names)
    assert names["renders"].shape == (2, 1064, 1600, 4) and names["alphas"].shape == (2, 1064, 1600, 1)
    run_example("docs/guide/fewer-gaussians.md", "contributions", names)
    assert names["weights"].shape == names["pixels"].shape == names["visible"].shape == (2, 30)
    run_example("docs/guide/own-trainer.md", "contributing_gaussian_ids", names)
    assert names["gaussians"].shape == (2, 1064, 1600, 4) and names["gaussians"].unique().numel() > 20


def test_the_examples_of_the_four_replacements_are_a_training():
    page, names = "docs/guide/own-trainer.md", example_scene()
    raw = {
        "means": names["means"], "quats": names["quats"], "scales": names["scales"].log(),
        "opacities": names["opacities"].logit(), "sh0": names["sh"][:, :1], "shN": names["sh"][:, 1:],
    }  # fmt: skip
    splats = {name: torch.nn.Parameter(value.clone()) for name, value in raw.items()}
    strategy = DefaultStrategy(refine_start_iter=2, refine_every=4)
    names |= {"blitzgs": blitzgs, "splats": splats, "rates": dict.fromkeys(raw, 1e-2), "strategy": strategy}
    names |= {"state": strategy.initialize_state(), "masks": torch.rand(2, 40, 50) > 0.2}
    names["pixels"] = torch.full((2, 40, 50, 3), 200, dtype=torch.uint8)
    losses = []
    run_example(page, "optimizers = {", names)
    for names["step"] in range(25):  # a strategy that refines, and the Morton order in steps 0 and 20
        run_example(page, "optimizers=optimizers", names)
        strategy.step_pre_backward(splats, names["optimizers"], names["state"], names["step"], names["info"])
        run_example(page, "loss = ", names)
        names["loss"].backward()
        losses.append(names["loss"].item())
        run_example(page, "step_post_backward", names)
    assert len(splats["means"]) > 60 and losses[-1] < 0.95 * losses[0]


def test_the_example_of_the_single_ops_renders_the_image_of_the_one_call():
    names = example_scene()
    scene = [names[name] for name in ("means", "quats", "scales", "opacities", "sh", "viewmats", "Ks")]
    renders, alphas, _ = blitzgs.rasterization(*scene, 50, 40, sh_degree=3)
    names |= {"log_scales": names["scales"].log(), "logits": names["opacities"].logit()}
    run_example("docs/guide/own-trainer.md", "import intersect", names)
    assert renders.amax() > 0.1
    torch.testing.assert_close(names["renders"], renders)
    torch.testing.assert_close(names["alphas"][..., None], alphas)


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


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_a_second_demo_continues_the_first(tmp_path):
    def train_command():
        command = ["make", "-n", "demo", f"DEMO={tmp_path}", f"VENV={tmp_path / 'venv'}"]
        lines = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        return next(
            line for line in lines.replace("\\\n", " ").split("\n") if f"--out {tmp_path}/run" in line
        )

    assert "--resume" not in train_command()
    (tmp_path / "run" / "checkpoints" / "checkpoint_000001").mkdir(parents=True)
    assert "--resume" in train_command()
