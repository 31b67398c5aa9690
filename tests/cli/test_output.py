# SPDX-License-Identifier: Apache-2.0
"""Commands whose output goes nowhere, what their start costs, and what the Tab key completes."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest

from blitzgs.cli import _NAMED_ERRORS, COMMANDS, _user_errors, main
from blitzgs.cli.completion import script
from tests.training.tiny import OVERRIDES, as_flags, write_tiny_capture

TRAIN = as_flags("config=defaults", *OVERRIDES, "schedule.scale=0.3", "log.every=1", "log.pictures=0")


def shell(script, **variables):
    """Run a script of bash, in which $BLITZGS is the command; return its status, output and errors."""
    environment = os.environ | {"BLITZGS": f"{sys.executable} -m blitzgs"} | variables
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, timeout=200, env=environment
    )
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture")
    write_tiny_capture(folder)
    return folder


FULL = "standard output cannot be written (No space left on device)"


# Without a buffer (PYTHONUNBUFFERED) the first line fails, with one the last flush. What is closed has none.
@pytest.mark.parametrize(
    ("redirection", "unbuffered", "message"),
    [
        ("2>&1 | head -n 1", "1", None),
        ("| head -n 1", "", None),
        ("| head -n 1", "1", None),
        (">/dev/full", "", FULL),
        (">/dev/full", "1", FULL),
        (">/dev/full 2>&1", "", None),
        (">&-", "", None),
        (">&- 2>&-", "1", None),
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
        ("export RUN --ply OUT.ply", "| true", 0),
        ("export RUN --ply OUT.ply", ">/dev/full", 0),
        ("train --show-config --config smoke", "| true", 0),
        ("train --show-config --config smoke", ">/dev/full", 1),
        ("train --help-fields", "| true", 0),
        ("train --help-fields", ">/dev/full", 1),
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


def test_the_errors_that_are_messages_exist():
    assert len(_user_errors()) == len(set(_user_errors())) > len(_NAMED_ERRORS)


@pytest.mark.parametrize("moment", ["blitzgs.cli.import_module", "blitzgs.cli.train.open_capture"])
def test_ctrl_c_at_the_start_has_no_traceback(capture, tmp_path, moment):
    """The signal comes while modules are imported, or while the capture is read."""
    module, _, name = moment.rpartition(".")
    program = (
        f"import os, signal, sys, {module} as module\nfrom blitzgs.cli import main\n"
        # Children of a shell's background jobs ignore Ctrl-C; these tests may be such a job.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"real = module.{name}\n"
        "def interrupted(*arguments):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n    return real(*arguments)\n"
        f"module.{name} = interrupted\n"
        f"sys.exit(main(['train', '--data', {str(capture)!r}, '--out', {str(tmp_path / 'r')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert done.returncode == 130 and done.stderr.splitlines()[-1] == "blitzgs train: interrupted", (
        done.stderr
    )
    assert "Traceback" not in done.stderr and not (tmp_path / "r").exists()


def test_a_field_takes_its_value_after_a_space(capsys):
    flags = ["--data.downscale", "8", "--population.max_gaussians=5", "--seed=3", "--model.near", "1e-3"]
    assert main(["train", "--config", "smoke", "--show-config", *flags]) == 0
    config = json.loads(capsys.readouterr().out)
    assert config["data"]["downscale"] == 8 and config["population"]["max_gaussians"] == 5
    assert config["seed"] == 3 and config["model"]["near"] == 1e-3


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        (["--help", "downscale"], ["--data.downscale=1   (integer, in [1, 1,000])", "images are reduced"]),
        (["-h", "data.downscale"], ["--data.downscale=1"]),
        (["--help", "lod"], ["lod: The octree", "--lod.fork=2.0"]),
        (["--help-fields"], ["--seed=0", "--log.every=100", "population: Density control"]),
        (["--help"], ["--extend IMAGES|FACTOR", "--help-fields"]),
    ],
)
def test_help_explains_fields(arguments, texts, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", *arguments])
    shown = capsys.readouterr().out
    assert exit_.value.code == 0 and all(text in shown for text in texts), shown


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


def test_fish_completes(tmp_path):
    lines = script("fish").splitlines()
    assert any("-a train -d" in line for line in lines)
    assert any("seen_subcommand_from render' -l split -x -a 'test train all'" in line for line in lines)
    assert any("-l data.downscale -r" in line for line in lines)
    if shutil.which("fish"):
        (tmp_path / "script").write_text(script("fish"))
        subprocess.run(["fish", "-n", str(tmp_path / "script")], check=True)


def test_zsh_completes_by_the_script_of_bash(tmp_path):
    assert script("zsh").startswith("autoload -U +X bashcompinit") and script("bash") in script("zsh")
    if shutil.which("zsh"):
        (tmp_path / "script").write_text(script("zsh"))
        subprocess.run(["zsh", "-n", str(tmp_path / "script")], check=True)
