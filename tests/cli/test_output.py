# SPDX-License-Identifier: Apache-2.0
"""Commands: output that goes nowhere, what their start costs, what Tab completes, and the doctor."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch
from torch.distributed.run import get_args_parser

from blitzgs._built import LIBRARY_DIR
from blitzgs.cli import COMMANDS, doctor, main
from blitzgs.cli import doctor_probes as probes
from blitzgs.cli.completion import script
from tests.training.tiny import OVERRIDES, as_flags

TRAIN = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.3", "log.every=1")


def shell(script, **variables):
    """Run a script of bash, in which $BLITZGS is the command; return its status, output and errors."""
    environment = os.environ | {"BLITZGS": f"{sys.executable} -m blitzgs"} | variables
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, timeout=200, env=environment
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("command", ["train", "eval", "render"])
def test_torchrun_takes_no_flag_of_ours_for_its_own(command, capsys):
    """Torchrun reads an abbreviation of its flags even behind the program that it starts."""
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    flags = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out)) - {"--max-restarts", "--help"}
    assert {"--resume", "--out"} & flags
    for flag in sorted(flags - {"--start"}):  # its help names --model.start
        found = get_args_parser().parse_args(["-m", "blitzgs", command, flag, "1"])
        assert found.training_script_args == [command, flag, "1"]


FULL = "standard output cannot be written (No space left on device)"


def test_a_warning_is_one_line(monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    main([])
    assert warnings.formatwarning("a:\n  b\x07\n", UserWarning, "x.py", 1) == "blitzgs: warning: a: b\\x07\n"


# Without a buffer (PYTHONUNBUFFERED) the first line fails, with one the last flush. What is closed has none.
@pytest.mark.parametrize(
    ("redirection", "unbuffered", "message"),
    [
        ("2>&1 | head -n 1", "1", None),
        ("| head -n 1", "", None),
        (">/dev/full", "", FULL),
        (">/dev/full", "1", FULL),
        (">/dev/full 2>&1", "", None),
        (">&- 2>&-", "", None),
    ],
)
def test_a_training_outlives_its_output(capture, tmp_path, redirection, unbuffered, message):
    run, flags = tmp_path / "run", " ".join(TRAIN)
    script = f"$BLITZGS train --data '{capture}' --out '{run}' {flags} {redirection}; exit ${{PIPESTATUS[0]}}"
    status, _, errors = shell(script, PYTHONUNBUFFERED=unbuffered)
    assert status == 0 and message is None or message in errors
    assert json.loads((run / "summary.json").read_text())["images"] == 30
    assert list((run / "checkpoints").glob("checkpoint_*"))


@pytest.mark.parametrize(
    ("command", "redirection", "status"),
    [
        ("eval RUN --device cpu", "| head -c 1", 0),
        ("eval RUN --device cpu", ">/dev/full", 1),  # what it prints is its result
        ("render RUN --out OUT", "| true", 0),
        ("render RUN --out OUT", ">/dev/full", 0),
        ("export RUN --ply OUT.ply", ">/dev/full", 0),
        ("train --show-config --config smoke", ">/dev/full", 1),
        ("train --help-fields", "| true", 0),
        ("train --help-fields=markdown", ">/dev/full", 1),
        ("--version", ">/dev/full", 1),
    ],
)
def test_every_command_outlives_its_output(trained, tmp_path, command, redirection, status):
    words = command.replace("RUN", f"'{trained[1]}'").replace("OUT", f"'{tmp_path}'/out")
    found, _, errors = shell(f"$BLITZGS {words} {redirection}; exit ${{PIPESTATUS[0]}}")
    assert found == status and "Traceback" not in errors and "Errno" not in errors
    assert ("standard output cannot be written" in errors) == ("/dev/full" in redirection)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["--hel"], []])
def test_help_needs_no_torch(arguments):
    program = (
        "import sys\nfrom blitzgs.cli import main\n"
        f"try:\n    main({arguments!r})\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'numpy', 'cv2', 'rich'} & set(sys.modules)\nsys.exit(','.join(heavy) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    if not arguments:
        listed = set(re.findall(r"^    (\w+)", done.stderr, re.MULTILINE))
        assert listed == set(COMMANDS)  # the whole help, not only the usage


@pytest.mark.parametrize("moment", ["blitzgs.cli.import_module", "blitzgs.cli.train.open_capture"])
def test_ctrl_c_at_the_start_has_no_traceback(capture, tmp_path, moment):
    """The signal comes while modules are imported, or while the capture is read."""
    module, _, name = moment.rpartition(".")
    program = (
        f"import os, signal, sys, {module} as module\nfrom blitzgs.cli import main\n"
        f"real = module.{name}\n"
        "def interrupted(*arguments, **named):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n    return real(*arguments, **named)\n"
        f"module.{name} = interrupted\n"
        f"sys.exit(main(['train', '--data', {str(capture)!r}, '--out', {str(tmp_path / 'r')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert done.returncode == 130 and done.stderr.splitlines()[-1] == "blitzgs train: interrupted", (
        done.stderr
    )
    assert "Traceback" not in done.stderr and not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--help", "downscale"], ["--data.downscale=1   (integer, in [1, 1,000])", "images are reduced"]),
        (["-h", "data.downscale"], ["--data.downscale=1"]),
        (["--help", "lod"], ["lod: The octree", "--lod.visible_threshold=0.9"]),
        (["--help-fields"], ["--seed=0", "--log.every=100", "population: Density control"]),
        (["--help"], ["--extend IMAGES|FACTOR", "--help-fields"]),
    ],
)
def test_help_explains_fields(arguments, texts, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", *arguments])
    shown = capsys.readouterr().out
    assert exit_.value.code == 0 and all(text in shown for text in texts), shown


def test_help_fits_the_terminal(capsys, monkeypatch):
    """Paragraphs are filled to the width; commands keep their lines."""
    monkeypatch.setenv("COLUMNS", "70")
    with pytest.raises(SystemExit):
        main(["eval", "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert "  blitzgs eval RUN" in lines
    assert max(len(line) for line in lines if not line.startswith("  blitzgs")) in range(60, 69)


@pytest.mark.parametrize(
    "words, completed",
    [
        (["tr"], ["train"]),
        ([""], list(COMMANDS)),
        (["gate", ""], ["fit", "sample", "evaluate", "replay"]),
        (["gate", "fit", "--o"], ["--out"]),
        (["train", "--data.downs"], ["--data.downscale"]),
        (["render", "--split", ""], ["test", "train", "all"]),
        (["render", "--split", "t"], ["test", "train"]),
        (["view", ""], []),  # the shell's file names
        (["completion", ""], ["bash", "zsh", "fish"]),
    ],
)
def test_bash_completes(words, completed, tmp_path):
    (tmp_path / "script").write_text(script("bash"))
    program = (
        'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _blitzgs; echo "${COMPREPLY[@]}"'
    )
    command = ["bash", "-c", program, "-", str(tmp_path / "script"), "blitzgs", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == completed and not done.stderr


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("fish", ["-a train -d", "seen_subcommand_from render' -l split -x -a 'test train all'"]),
        ("fish", ["-l data.downscale -r -d 'a field'"]),
        ("zsh", ["autoload -U +X bashcompinit", script("bash")]),  # by the script of bash
    ],
)
def test_other_shells_complete(name, parts, tmp_path):
    assert all(part in script(name) for part in parts)
    if shutil.which(name):
        (tmp_path / "script").write_text(script(name))
        subprocess.run([name, "-n", str(tmp_path / "script")], check=True)


ROOT = Path(__file__).resolve().parents[2]
# The requirement of the sources: an editable installation may be older than they are.
REQUIREMENTS = re.findall(r'"(torch>=2\.11,<2\.14)"', (ROOT / "pyproject.toml").read_text())


def test_this_installation_works(tmp_path):
    command = [sys.executable, "-m", "blitzgs", "doctor", "--json", "--folder", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    lines = {line["name"]: line for line in json.loads(done.stdout)["lines"]}
    assert done.returncode == 0, lines
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
    command = "import sys; from blitzgs.cli import doctor; doctor.TIMEOUT = 3; "
    command += "doctor._PACKAGE = doctor.Path(sys.path[1]) / 'b'; "
    command += "from blitzgs.cli import main; sys.exit(main(['doctor', '--json']))"
    environment = os.environ | {"PYTHONPATH": str(fake.parent)}
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, env=environment)
    lines = {line["name"]: line for line in json.loads(done.stdout)["lines"]}
    assert done.returncode == 1 and time.monotonic() - begin < 60
    assert lines["torch"]["state"] == state and text in lines["torch"]["text"]
    assert lines["torch"]["remedy"] == "pip install 'torch>=2.11,<2.14'"
    assert lines["self-tests"]["state"] == "failed" and "render cpu" not in lines


def test_a_library_that_does_not_load_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "libblitzgs_cpu.so").write_text("damaged")
    monkeypatch.setenv("BLITZGS_LIBRARY_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "_torch", lambda: doctor.Line("torch", "ok", ""))
    monkeypatch.setattr(doctor, "_exchange", lambda _: doctor.found("ok", "not looked at"))
    assert main(["doctor", "--json"]) == 1
    lines = {line["name"]: line for line in json.loads(capsys.readouterr().out)["lines"]}
    assert lines["lib cpu"]["state"] == "failed" and "libblitzgs_cpu.so" in lines["lib cpu"]["text"]
    assert lines["lib io"]["state"] == "missing" and "pip install" in lines["lib io"]["remedy"]
    assert lines["render cpu"]["state"] == "failed"


@pytest.mark.parametrize(
    "version, state", [("2.10.1", "failed"), ("2.11.0+cu130", "ok"), ("2.13.0", "ok"), ("2.14.0", "warning")]
)
def test_the_bounds_of_torch(version, state, monkeypatch):
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: REQUIREMENTS)
    found = {"version": version, "cuda": None, "threads": 2, "gpus": [], "nccl": None}
    monkeypatch.setattr(doctor, "probe", lambda _: found)
    assert doctor._torch().state == state


@pytest.mark.parametrize(
    "requirements, wanted", [(["torchvision>=9", "torch<2.14,>=2.11"], "torch<2.14,>=2.11"), (None, "torch")]
)
def test_the_remedy_names_the_bounds_that_are_known(requirements, wanted, monkeypatch):
    def fails(*_, **__):
        raise doctor.ProbeError("No module named 'torch'")

    monkeypatch.setattr(doctor.metadata, "requires", lambda _: requirements)
    monkeypatch.setattr(doctor, "probe", fails)
    assert doctor._torch().remedy == f"pip install '{wanted}'"


@pytest.mark.parametrize("errors", [(1e-2, 1e-5), (1e-6, 1e-2), (float("nan"), 1e-5)])
def test_a_wrong_rendering_fails(errors, monkeypatch, capsys):
    assert probes.rendered(1e-6, 1e-5, 0.1)["state"] == "ok"
    found = probes.rendered(*errors, 0.1)
    assert found["state"] == "failed" and found["remedy"]
    monkeypatch.setattr(doctor, "examine", lambda *_: [doctor.Line("render cpu", **found)])
    assert main(["doctor"]) == 1
    assert "1 faults" in capsys.readouterr().out


def test_ranks_that_differ_fail(monkeypatch):
    part = {"covered": 0.5, "seconds": 0.1, "backend": "gloo"}
    monkeypatch.setattr(doctor, "probe", lambda _, __, rank, ___: part | {"differing_values": int(rank)})
    assert doctor._exchange("cpu")["state"] == "failed"


def test_a_gpu_that_the_library_was_not_built_for():
    built = "80-real,86-real,90-real,120"
    assert probes.foreign(built, ["sm_80", "sm_90", "sm_120", "sm_87"]) == ["sm_87"]
    assert probes.foreign("native", ["sm_87"]) == []


def test_a_slow_disk_is_a_warning():
    assert probes.measured("/", 12.0, 200.0)["state"] == "warning"


def test_optional_packages_name_their_extra(monkeypatch):
    needed = ["numpy>=1.26", "torch>=2.11,<2.14", 'viser<2,>=1.1; extra == "view"', 'ruff; extra == "lint"']
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: needed)

    def version(name):
        raise doctor.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.metadata, "version", version)
    numpy, viser = doctor._packages()
    assert (numpy.name, numpy.state, numpy.required) == ("numpy", "missing", True)
    assert (viser.remedy, viser.required) == ("pip install 'blitzgs[view]'", False)
