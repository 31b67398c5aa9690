# SPDX-License-Identifier: Apache-2.0
"""`blitzgs doctor` finds what works, what does not, and ends in any case."""

import hashlib
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from blitzgs._built import LIBRARY_DIR
from blitzgs.cli import doctor, main

ROOT = Path(__file__).resolve().parents[2]
# The requirement of the sources: an editable installation may be older than they are.
REQUIREMENTS = re.findall(r'"(torch>=2\.11,<2\.14)"', (ROOT / "pyproject.toml").read_text())
GOOD = {"image_error": 1e-6, "gradient_error": 1e-5, "seconds": 0.1}


def report(*arguments, path=None, **variables):
    """Run the command; return its exit status and its lines by name. `path` precedes the import path."""
    environment = os.environ | variables | ({"PYTHONPATH": str(path)} if path else {})
    command = [sys.executable, "-m", "blitzgs", "doctor", "--json", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    found = json.loads(done.stdout)
    return done.returncode, {line["name"]: line for line in found["lines"]}


def test_this_installation_works(tmp_path):
    status, lines = report("--folder", str(tmp_path))
    assert status == 0, lines
    assert lines["torch"]["values"]["version"] == torch.__version__
    assert lines["system"]["values"]["cores"] == len(os.sched_getaffinity(0))
    digest = hashlib.sha256((LIBRARY_DIR / "libblitzgs_cpu.so").read_bytes()).hexdigest()
    assert digest.startswith(lines["lib cpu"]["values"]["sha256"])
    assert lines["lib io"]["values"]["models"] >= 11
    figures = lines["render cpu"]["values"]
    assert 0 < figures["image_error"] < 1e-5 and 0 < figures["gradient_error"] < 1e-3
    ranks = lines["exchange Gloo"]["values"]["ranks"]
    assert [rank["differing_values"] for rank in ranks] == [0, 0]
    assert all(rank["covered"] > 0.3 for rank in ranks)
    assert lines["disk"]["values"]["write_mb_s"] > 0 and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "code, state, text",
    [
        ("raise ModuleNotFoundError(\"No module named 'torch'\")", "missing", "No module named 'torch'"),
        ("raise OSError('libcudart.so.13: cannot open shared object file')", "failed", "libcudart.so.13"),
        ("import os; os.kill(os.getpid(), 11)", "failed", "ended by SIGSEGV"),
        ("import time; time.sleep(600)", "failed", "no answer within 3 s"),
    ],
)
def test_a_torch_that_does_not_load_is_named(code, state, text, tmp_path):
    fake = tmp_path / "site" / "torch.py"
    fake.parent.mkdir()
    fake.write_text(code)
    # The folder of the package comes first in the path of a probe, so the fake lies before a copy of it.
    (fake.parent / "blitzgs").symlink_to(ROOT / "blitzgs")
    facts = ["Metadata-Version: 2.1", "Name: blitzgs", "Version: 1"]
    facts += [f"Requires-Dist: {requirement}" for requirement in REQUIREMENTS]
    (fake.parent / "blitzgs-1.dist-info").mkdir()
    (fake.parent / "blitzgs-1.dist-info" / "METADATA").write_text("\n".join(facts))
    command = "import sys; from blitzgs.cli import doctor; doctor._PACKAGE = doctor.Path(sys.path[1]) / 'b'; "
    command += "from blitzgs.cli import main; sys.exit(main(['doctor', '--json', '--timeout', '3']))"
    environment = os.environ | {"PYTHONPATH": str(fake.parent)}
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, env=environment)
    lines = {line["name"]: line for line in json.loads(done.stdout)["lines"]}
    assert done.returncode == 1 and time.monotonic() - begin < 60
    assert lines["torch"]["state"] == state and text in lines["torch"]["text"]
    assert lines["torch"]["remedy"] == "pip install 'torch>=2.11,<2.14'"
    assert lines["self-tests"]["state"] == "failed" and "render cpu" not in lines


def test_a_library_that_does_not_load_is_named(tmp_path):
    (tmp_path / "libblitzgs_cpu.so").write_text("damaged")
    status, lines = report("--timeout", "60", BLITZGS_LIBRARY_DIR=str(tmp_path))
    assert status == 1
    assert lines["lib cpu"]["state"] == "failed" and "libblitzgs_cpu.so" in lines["lib cpu"]["text"]
    assert lines["lib io"]["state"] == "missing" and "pip install" in lines["lib io"]["remedy"]
    assert lines["render cpu"]["state"] == "failed"


def test_a_process_that_hangs_is_ended_with_its_children(tmp_path):
    command = ["bash", "-c", f"sleep 300 & echo $! > {tmp_path}/child; wait"]
    with pytest.raises(doctor.ProbeError, match="no answer within 1 s"):
        doctor.run_command(command, timeout=1)
    child = int((tmp_path / "child").read_text())
    state = Path(f"/proc/{child}/stat")
    deadline = time.monotonic() + 10
    while state.exists() and state.read_text().split()[2] != "Z" and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not state.exists() or state.read_text().split()[2] == "Z"


def torch_of(version, **more):
    return {"version": version, "cuda": None, "threads": 2, "gpus": [], "nccl": None} | more


@pytest.mark.parametrize(
    "version, state", [("2.10.1", "failed"), ("2.11.0+cu130", "ok"), ("2.13.0", "ok"), ("2.14.0", "warning")]
)
def test_the_bounds_of_torch(version, state, monkeypatch):
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: REQUIREMENTS)
    monkeypatch.setattr(doctor, "probe", lambda *_, **__: torch_of(version))
    assert doctor._torch(1).state == state


@pytest.mark.parametrize(
    "requirements, remedy",
    [
        (["numpy", "torch<2.14,>=2.11"], "pip install 'torch>=2.11,<2.14'"),
        (["torchvision>=9", "torch>=2.11"], "pip install 'torch>=2.11'"),
        (["numpy"], "pip install torch"),
        (None, "pip install torch"),
    ],
)
def test_the_remedy_names_the_bounds_that_are_known(requirements, remedy, monkeypatch):
    def fails(*_, **__):
        raise doctor.ProbeError("No module named 'torch'")

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requirements)
    monkeypatch.setattr(doctor, "probe", fails)
    assert doctor._torch(1).remedy == remedy


@pytest.mark.parametrize(
    "name, value", [("image_error", 1e-2), ("gradient_error", 1e-2), ("image_error", float("nan"))]
)
def test_a_wrong_rendering_fails(name, value, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "probe", lambda *_, **__: GOOD | {name: value})
    line = doctor._render("cpu", 1)
    assert line.state == "failed" and line.remedy
    monkeypatch.setattr(doctor, "examine", lambda *_: [line])
    assert main(["doctor"]) == 1
    assert "1 faults" in capsys.readouterr().out
    monkeypatch.setattr(doctor, "probe", lambda *_, **__: GOOD)
    assert doctor._render("cpu", 1).state == "ok"


def test_ranks_that_differ_fail(monkeypatch):
    part = {"differing_values": 0, "covered": 0.5, "seconds": 0.1, "backend": "gloo"}
    monkeypatch.setattr(
        doctor, "probe", lambda name, device, rank, *_, **__: part | {"differing_values": int(rank)}
    )
    assert doctor._exchange("cpu", 1).state == "failed"


def test_a_gpu_that_the_library_was_not_built_for(monkeypatch, tmp_path):
    (tmp_path / "libblitzgs_cuda.so").write_bytes(b"library")
    monkeypatch.setattr(doctor, "LIBRARY_DIR", tmp_path)
    found = {"cuda": "13.0.88", "architectures": "80-real,86-real,90-real,120", "ops": "0"}
    monkeypatch.setattr(doctor, "probe", lambda *_, **__: dict(found))
    states = [doctor._library("cuda", 1, [{"architecture": f"sm_{n}"}]).state for n in (80, 90, 120, 87)]
    assert states == ["ok", "ok", "ok", "warning"]


def test_a_slow_disk_is_a_warning(monkeypatch):
    found = {"write_mb_s": 12.0, "read_mb_s": 200.0, "free_bytes": 10**9}
    monkeypatch.setattr(doctor, "probe", lambda *_, **__: found)
    assert doctor._disk(Path("/"), 1).state == "warning"


def test_optional_packages_name_their_extra(monkeypatch):
    needed = ["numpy>=1.26", "torch>=2.11,<2.14", 'viser<2,>=1.1; extra == "view"', 'ruff; extra == "lint"']
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: needed)

    def version(name):
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "version", version)
    numpy, viser = doctor._packages()
    assert (numpy.name, numpy.state, numpy.required) == ("numpy", "missing", True)
    assert (viser.remedy, viser.required) == ("pip install 'blitzgs[view]'", False)
