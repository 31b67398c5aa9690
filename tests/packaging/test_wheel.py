# SPDX-License-Identifier: Apache-2.0
"""The wheel in dist/ works in fresh environments without a compiler; `make test-wheel` runs this.

Each environment has a torch, which takes gigabytes, so it is removed before the next one is made;
UV_TORCH_BACKEND=cpu takes torch without CUDA. Interpreters that are not there are skipped:
PYTHONS="/path/python3.10 /path/python3.13" names others than those in PATH and of pyenv.
"""

import json
import os
import re
import select
import shutil
import subprocess
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WHEELS, ARCHIVES = (
    sorted((ROOT / "dist").glob(f"blitzgs-*{suffix}"), key=os.path.getmtime)
    for suffix in ("manylinux_2_28_x86_64.whl", ".tar.gz")
)
PYTHONS = os.environ.get("PYTHONS", "python3.10 python3.13").split()
TORCHES = os.environ.get("TORCHES", "2.11.0 2.13.0").split()
CALL = """
import torch, blitzgs
means = torch.tensor([[0.0, 0, 2], [0.2, 0, 3]], requires_grad=True)
image, alpha, meta = blitzgs.rasterization(
    means, torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.2), torch.full((2,), 0.5),
    torch.tensor([[1.0, 0, 0], [0, 1, 0]]), torch.eye(4)[None],
    torch.tensor([[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]]), 32, 32)
image.sum().backward()
assert means.grad.abs().max() > 0
print(float(image[0, 16, 16, 0]), float(image[0, 16, 16, 1]))
"""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


def fresh(folder, python, torch, *packages):
    """Make an environment with a torch and other packages."""
    versions, name = Path.home() / ".pyenv" / "versions", Path(python).name
    found = [python, *map(str, versions.glob(f"{name.removeprefix('python')}.*/bin/{name}"))]
    # Those of pyenv in PATH may do nothing but say that another version is selected.
    found = [
        p for p in found if shutil.which(p) and not subprocess.call([p, "-c", ""], stderr=subprocess.DEVNULL)
    ]
    if not found:
        pytest.skip(f"{python} is not here")
    uv = shutil.which("uv")
    if uv is None:
        pytest.skip("needs uv, whose environments share their files: pip install uv")
    subprocess.run([uv, "venv", "-q", "--seed", "--python", shutil.which(found[0]), folder], check=True)
    install = [uv, "pip", "install", "-q", "--python", folder / "bin" / "python", f"torch=={torch}"]
    subprocess.run([*install, *packages], check=True)
    return folder


@pytest.fixture(scope="module", params=[(p, t) for p in PYTHONS for t in TORCHES], ids="-torch".join)
def environment(request, tmp_path_factory):
    """A fresh environment with the wheel; the PATH of its programs has no compiler."""
    assert WHEELS, "build the wheel first: make wheel"
    folder = tmp_path_factory.mktemp("environment")
    yield fresh(folder, *request.param, f"blitzgs[synth,view] @ file://{WHEELS[-1]}")
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def model(environment):
    """The PLY file of a first model, which the environment has trained."""
    run(environment, "blitzgs", "synth", "city", "--views=24", "--width=96", "--height=64")
    arguments = ("--config=smoke", "--data=city", "--out=run", "--schedule.scale=0.25")
    run(environment, "blitzgs", "train", *arguments)
    run(environment, "blitzgs", "export", "run", "--ply", "model.ply")
    return environment / "model.ply"


def variables(environment):
    """Return the variables for programs of an environment, which find no others."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "BLITZGS", "CUDA_HOME"))}
    return kept | {"PATH": str(environment / "bin"), "PIP_NO_INDEX": "1"}


def run(environment, *command):
    """Run a program of the environment and return its output."""
    done = subprocess.run(
        [environment / "bin" / command[0], *command[1:]], env=variables(environment), cwd=environment,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_doctor_finds_no_fault(environment):
    assert shutil.which("c++", path=str(environment / "bin")) is None
    found = json.loads(run(environment, "blitzgs", "doctor", "--json"))
    lines = {line["name"]: line for line in found["lines"]}
    assert found["ok"] and lines["blitzgs"]["text"].endswith("site-packages/blitzgs")
    assert lines["nvcc"]["state"] == "missing" and lines["exchange Gloo"]["state"] == "ok"


def test_the_public_call(environment):
    red, green = map(float, run(environment, "python", "-c", CALL).split())
    # 0.5 of the first Gaussian near its centre, then a part of the rest from the second, off its centre.
    assert 0.45 < red < 0.5 and 0.0 < green < 0.25


def test_a_first_model(environment, model):
    summary = json.loads((environment / "run" / "summary.json").read_text())
    assert summary["psnr"] > 12 and model.read_bytes().startswith(b"ply\n")


def test_the_viewer_sends_pictures(environment, model):
    command = [environment / "bin" / "blitzgs", "view", model, "--port", "0"]
    page = subprocess.Popen(
        command, env=variables(environment), cwd=environment, stdout=subprocess.PIPE, text=True
    )
    try:
        assert select.select([page.stdout], [], [], 300)[0], "the viewer prints nothing"
        url = re.search(r"http://\S+", page.stdout.readline())[0]
        assert b"<html" in urllib.request.urlopen(url, timeout=60).read().lower()
        version = run(environment, "python", "-c", "import viser; print(viser.__version__)").strip()
        orbit = {"middle": [0, 0, 0], "radius": 4, "height": 3, "size": [160, 90], "moves": True}
        options = {"url": url, "version": version, "warm_up": 1, "seconds": 10} | orbit
        client = str(ROOT / "benchmarks" / "view_client.py")
        assert json.loads(run(environment, "python", client, json.dumps(options)))["pictures"] > 0
        assert page.poll() is None
    finally:
        page.terminate()
        page.wait(60)


def test_the_sources_install(tmp_path):
    """`pip install` of the archive builds the libraries for the torch of its environment."""
    assert ARCHIVES, "build the archive first: make sdist"
    environment = fresh(tmp_path / "environment", PYTHONS[-1], TORCHES[0])
    install = [environment / "bin" / "python", "-m", "pip", "install", "-q", ARCHIVES[-1]]
    subprocess.run(install, check=True, env=os.environ | {"BLITZGS_CUDA": "OFF"}, cwd=tmp_path)
    found = json.loads(run(environment, "blitzgs", "doctor", "--json"))
    lines = {line["name"] for line in found["lines"]}
    assert found["ok"] and {"lib cpu", "lib io"} <= lines and "lib cuda" not in lines
    run(environment, "python", "-c", CALL)
    shutil.rmtree(environment)
