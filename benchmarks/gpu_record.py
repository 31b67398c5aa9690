# SPDX-License-Identifier: Apache-2.0
"""Run the CUDA tests and a small bench on this machine's GPU, and write one JSON file about them.

    python benchmarks/gpu_record.py                       # or: make gpu-record
    python benchmarks/gpu_record.py --out DIR --commit C  # a copy of the sources without .git
    python benchmarks/gpu_record.py --age                 # how many commits ago the record was made

Needs built kernels, torch and pytest; the package need not be installed. The tests run in one pytest process
for each entry of tests/, --jobs at a time, and DIR/gpu_record.json is written again after each, so a run that
is cut off leaves what it had ("complete" is then false). After --minutes it ends by itself, and an entry is
cut off after --entry-minutes; --resume goes on with a record of the same commit and card, and repeats what
was cut off. A file that cannot be collected counts as an error; where a process dies, its files are run one
by one. Exit status: 0 if all ran and passed. `benchmarks/report.py` puts the record into README and docs.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import harness
import torch

NAME = "gpu_record.json"
OLD = 200  # commits after which the record says little
COUNTS = ("passed", "failed", "errors", "skipped")
# What pytest's XML calls them; a test that failed may also have an error at its end.
KINDS = {"error": "errors", "failure": "failed", "skipped": "skipped"}
GRACE = 30  # seconds that an interrupted pytest has to write its results
BENCHES = {
    "render": ("bm_render.py", "--scenes", "aerial1", "aerial4", "--repeats", "10"),
    "step": ("bm_step.py", "--views", "4", "--scenes", "aerial4", "--repeats", "10"),
}


@dataclass
class Outcome:
    """The tests of one entry of tests/."""

    passed: int = 0
    failed: int = 0
    errors: int = 0
    skipped: int = 0
    seconds: float = 0.0
    state: str = "done"  # "cut off" by the time limit; or "died": the process ended without results
    # Name and first line of each failure and error.
    problems: list[dict[str, str]] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Add the tests of a file."""
        for name in (*COUNTS, "seconds", "problems"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        if other.state != "done":
            self.state = other.state


def read_junit(path: Path) -> Outcome:
    """Return the counts of a file that pytest wrote with --junitxml."""
    outcome = Outcome()
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        if not case.get("name"):  # the test that an interrupt ended
            continue
        outcome.seconds += float(case.get("time", 0))
        problem = next((found for kind in KINDS if (found := case.find(kind)) is not None), None)
        count = "passed" if problem is None else KINDS[problem.tag]
        setattr(outcome, count, getattr(outcome, count) + 1)
        if count in ("errors", "failed"):
            name = ".".join(filter(None, (case.get("classname"), case.get("name"))))
            reason = (problem.get("message") or "").split("\n")[0]
            if reason == "collection failure":  # the last line of the text says why
                lines = [line for line in (problem.text or "").splitlines() if line.startswith("E ")]
                reason = lines[-1][1:].strip() if lines else reason
            outcome.problems.append({"name": name, "message": reason[:300]})
    return outcome


def run_pytest(target: Path, mark: str, folder: Path, end: float) -> Outcome:
    """Run a file or folder of tests.

    `mark`: the expression of pytest's -m. `folder`: for the log and the results of pytest. `end`: of
    `time.monotonic`; pytest is interrupted then, and writes what it has.
    """
    name = "_".join(target.with_suffix("").parts[-2:])
    results = folder / f"{name}.xml"
    results.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", str(target), "-m", mark, "-v", "--tb", "short",
               "--continue-on-collection-errors", "--junitxml", str(results)]  # fmt: skip
    begin, state = time.monotonic(), "done"
    with (folder / f"{name}.log").open("w") as log:
        process = subprocess.Popen(
            command,
            cwd=harness.ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            # A job in a shell's background ignores interrupts, and its children would too.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        try:
            process.wait(max(end - begin, 0))
        except subprocess.TimeoutExpired:
            state = "cut off"
            process.send_signal(signal.SIGINT)
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    if results.exists():
        outcome = read_junit(results)
        outcome.state = state
        return outcome
    if state == "cut off":
        return Outcome(state=state, seconds=time.monotonic() - begin)
    if target.is_dir():
        outcome = Outcome()
        for file in sorted(target.rglob("test_*.py")):
            outcome.add(run_pytest(file, mark, folder, end))
        return outcome
    message = f"the process ended with status {process.returncode}; see {name}.log"
    return Outcome(state="died", errors=1, problems=[{"name": str(target.name), "message": message}])


def entries(tests: list[Path]) -> list[Path]:
    """Return the folders and files of tests directly below the given folders."""
    found: list[Path] = []
    for path in tests:
        inner = [path] if path.is_file() else sorted(path.iterdir())
        found += [p for p in inner if (p.is_dir() and any(p.rglob("test_*.py"))) or p.match("test_*.py")]
    return found


def bench(name: str, folder: Path, end: float) -> dict[str, Any]:
    """Run one of `BENCHES`; returns its JSON, or {"error": why there is none}."""
    script, *flags = BENCHES[name]
    path = folder / f"bench_{name}.json"
    command = [sys.executable, str(harness.ROOT / "benchmarks" / script), *flags, "--json", str(path)]
    try:
        done = subprocess.run(
            command, cwd=harness.ROOT, capture_output=True, text=True, timeout=max(end - time.monotonic(), 1)
        )
    except subprocess.TimeoutExpired:
        return {"error": "took too long"}
    if done.returncode or not path.exists():
        return {"error": (done.stderr.strip() or f"status {done.returncode}").splitlines()[-1][:300]}
    return json.loads(path.read_text())


def bench_rows(name: str, result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return rows with "work", "ms" and "peak_gb", or "work" and "error"."""
    if "error" in result:
        return [{"work": name, "error": result["error"]}]
    rows = []
    for found in result["results"]:
        ours, views = found["blitzgs"], found.get("views")
        work = f"training step of {views} views" if views else "render forward + backward"
        ms = ours["ms"]["total"] if views else ours["total"]
        rows.append({"work": f"{work}, {found['scene']}", "ms": ms, "peak_gb": ours["peak_gb"]})
    return rows


def environment() -> dict[str, Any]:
    """Return card, driver and versions (SystemExit: there is no CUDA device)."""
    if not torch.cuda.is_available():
        raise SystemExit("gpu_record.py: torch finds no CUDA device here; run it on a machine with a GPU")
    found = harness.environment("cuda")
    found["memory_gb"] = round(torch.cuda.get_device_properties(0).total_memory / 1e9, 1)
    found["gpus"] = torch.cuda.device_count()
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader", "--id=0"]
    try:
        found["driver"] = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        found["driver"] = "unknown"
    return found


class Record:
    """The file, written again whenever something is added."""

    def __init__(self, path: Path, about: dict[str, Any], resume: bool) -> None:
        self.path, self.content = path, about | {"complete": False, "bench": {}, "rooms": {}}
        if resume and path.exists():
            earlier = json.loads(path.read_text())
            for key in ("commit", "environment"):
                if earlier[key] != about[key]:
                    raise SystemExit(
                        f"gpu_record.py: {path} has another {key} ({earlier[key]}, now {about[key]}); "
                        "leave out --resume to begin again"
                    )
            self.content["bench"] = earlier["bench"]
            self.content["rooms"] = {k: v for k, v in earlier["rooms"].items() if v["state"] != "cut off"}
        self.write()

    def write(self) -> None:
        """Write the file with the sums over all rooms, in one move."""
        rooms = self.content["rooms"].values()
        sums = {name: sum(room[name] for room in rooms) for name in (*COUNTS, "seconds")}
        self.content["tests"] = sums | {"problems": [p for room in rooms for p in room["problems"]]}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps(self.content, indent=1) + "\n")
        new.replace(self.path)


def make_record(
    record: Record,
    tests: list[Path],
    mark: str,
    folder: Path,
    end: float,
    longest: float = float("inf"),
    jobs: int = 1,
) -> bool:
    """Fill the record, which is written after each step, until it is complete or the time is over.

    `tests`: folders or files. `folder`: for logs. `end`: of `time.monotonic`. `longest`: seconds that an
    entry of the tests may take. `jobs`: entries that run side by side. Returns whether all ran and passed.
    """
    for name in BENCHES:
        if not record.content["bench"].get(name) or "error" in record.content["bench"][name][0]:
            record.content["bench"][name] = bench_rows(name, bench(name, folder, end))
            record.write()
    rooms = record.content["rooms"]

    def run(target: Path) -> Outcome:
        if time.monotonic() >= end:
            return Outcome(state="cut off")
        return run_pytest(target, mark, folder, min(end, time.monotonic() + longest))

    def size(target: Path) -> int:
        return sum(p.stat().st_size for p in (target, *target.rglob("test_*.py")))

    # The largest first, so that none runs alone in the end.
    todo = {f"{t.parent.name}/{t.stem}": t for t in sorted(entries(tests), key=size, reverse=True)}
    with ThreadPoolExecutor(jobs) as pool:
        names = {pool.submit(run, target): name for name, target in todo.items() if name not in rooms}
        for done in as_completed(names):
            outcome, name = done.result(), names[done]
            rooms[name] = asdict(outcome)
            record.write()
            counts = ", ".join(f"{getattr(outcome, kind)} {kind}" for kind in COUNTS)
            print(f"{name}: {counts} in {outcome.seconds:.0f} s ({outcome.state})", flush=True)
    record.content["complete"] = all(room["state"] != "cut off" for room in rooms.values())
    record.write()
    sums = record.content["tests"]
    broken = any("error" in row for found in record.content["bench"].values() for row in found)
    return record.content["complete"] and not (sums["failed"] or sums["errors"] or broken)


def age(path: Path) -> str:
    """Return a sentence about how old a record is."""
    again = "make gpu-record on a machine with a GPU makes a new one"
    if not path.exists():
        return f"GPU record: there is none at {path}; {again}."
    commit = json.loads(path.read_text())["commit"].removesuffix("+changes")
    count = ["git", "-C", str(harness.ROOT), "rev-list", "--count", f"{commit}..HEAD"]
    try:
        commits = int(subprocess.run(count, capture_output=True, text=True, check=True).stdout)
    except (OSError, subprocess.CalledProcessError):
        return (
            f"GPU record: made at commit {commit}, which this checkout does not have, so its age is unknown."
        )
    if commits > OLD:
        return (
            f"GPU record: {commits} commits old (made at {commit}, at most {OLD} are meant); no GPU test "
            f"vouches for what changed since. {again[0].upper()}{again[1:]}."
        )
    return f"GPU record: {commits} commits old (made at {commit})."


def main(arguments: list[str] | None = None) -> int:
    """Make a record or tell its age; returns the exit status."""
    parser = harness.make_parser(__doc__, device=None, writes_json=False)
    parser.add_argument("--out", type=Path, default=harness.ROOT / "benchmarks" / "results",
                        help="folder of gpu_record.json (%(default)s)")  # fmt: skip
    parser.add_argument("--commit", help="of these sources, where there is no .git")
    parser.add_argument("--minutes", type=float, default=60, help="end after this time (%(default)s)")
    parser.add_argument("--entry-minutes", type=float, default=20,
                        help="cut off a folder of tests after this time (%(default)s)")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=max(1, (os.cpu_count() or 1) // 4),
                        help="entries of tests/ that run side by side (%(default)s)")  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="go on with a record that was cut off")
    parser.add_argument("--age", action="store_true", help="only tell the age of the record; status 0")
    args = parser.parse_args(arguments)
    path = args.out.resolve() / NAME
    if args.age:
        print(age(path))
        return 0
    end = time.monotonic() + 60 * args.minutes
    if args.commit:
        os.environ["BLITZGS_COMMIT"] = args.commit
    if (commit := harness.commit()) == "unknown":
        parser.error("the commit of these sources is unknown: name it with --commit")
    # Tests and benchmarks start further processes, which have to find the package.
    os.environ["PYTHONPATH"] = harness.child_environment(1)["PYTHONPATH"]
    about = {
        "command": "python benchmarks/gpu_record.py",
        "commit": commit,
        "date": datetime.now(timezone.utc).date().isoformat(),
        "environment": environment(),
    }
    logs = path.parent / "gpu_record"
    logs.mkdir(parents=True, exist_ok=True)
    record = Record(path, about, args.resume)
    tests, mark = [harness.ROOT / "tests"], "cuda and not slow"
    passed = make_record(record, tests, mark, logs, end, 60 * args.entry_minutes, args.jobs)
    print(f"{path}: {'complete' if record.content['complete'] else 'cut off; go on with --resume'}")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
