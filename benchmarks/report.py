# SPDX-License-Identifier: Apache-2.0
"""Write the tables of `PAGES` from the results in benchmarks/results.

    python benchmarks/report.py           # writes the tables
    python benchmarks/report.py --check   # fails when a page differs from the results

Every result is a JSON file that a benchmark wrote with --json; `COMMANDS` names the file and the command. A
page has a pair of comments around each table, `<!-- table: NAME -->` and `<!-- end: NAME -->`; the text
between them is replaced. The files must come from one commit, because figures of different code do not
compare; those of `APART` may come from others. In place of a table whose file is absent the page names the
command that makes it.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from harness import ROOT, make_parser
from report_tables import SECTIONS, Json

RESULTS = ROOT / "benchmarks" / "results"
PAGES = (*(ROOT / "docs" / name for name in ("performance.md", "city.md")), ROOT / "README.md")
TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end: \2 -->)", re.DOTALL)

Results = dict[str, Json]

# File in benchmarks/results (without .json) -> the command that writes it.
COMMANDS = {
    "gpu_record": "make gpu-record",
    "render": "python benchmarks/bm_render.py",
    "step_1": "python benchmarks/bm_step.py --views 1",
    "step_4": "python benchmarks/bm_step.py --views 4",
    "accuracy": "python benchmarks/bm_accuracy.py --exact-library build-exact/lib",
    "offload": "python benchmarks/bm_offload.py --ratios 2 4",
    "exchange": (
        "python benchmarks/bm_exchange.py --gaussians 16000000 --device cuda --batch 4 16 --batches 3 "
        "--ranks 1 2 4"
    ),
    "drop_in_full": ("python benchmarks/bm_drop_in.py CAPTURE --steps 30000 --arms four gsplat --one-thread"),
    "quality": (
        "python benchmarks/bm_quality.py --out runs/quality --capture NAME=CAPTURE "
        "--recipe aerial=configs/aerial.yaml --recipe compact=configs/compact.yaml --seeds 0 1 2"
    ),
    "city": ("python benchmarks/bm_city.py CITY --out runs/city --popping --scale 5 --seconds-per-run 400"),
    "city_ranks": (
        "python benchmarks/bm_city.py CITY --out runs/city_ranks --ranks 1 2 4 --arms all_off "
        "--batch-sizes 16 --scale 13.85 --seconds-per-run 540"
    ),
}
# Results that compare with no other: the record of the tests, and what the recipes reach.
APART = ("gpu_record", "quality")


class ReportError(Exception):
    """The results cannot be reported; the message says why."""


def load_results(folder: Path = RESULTS) -> Results:
    """Read every result.

    ReportError: a file has no known name, does not name its commit, or is of several or another one.
    """
    results: Results = {}
    for path in sorted(folder.glob("*.json")):
        if path.stem not in COMMANDS:
            raise ReportError(f"{path}: no table is made of it; known names: {', '.join(COMMANDS)}")
        results[path.stem] = json.loads(path.read_text())
        commit = results[path.stem].get("commit", "unknown")
        if commit == "unknown" or commit.endswith("+changes"):
            raise ReportError(
                f"{path}: its commit is {commit}; measure a clean checkout, or a copy of one "
                "with its commit in BLITZGS_COMMIT"
            )
        if " and " in commit:
            raise ReportError(f"{path} is of commit {commit}: measure all of its runs on one")
        first = next((name for name in results if name not in APART), path.stem)
        expected = results[first]["commit"]
        if commit != expected and path.stem not in APART:
            raise ReportError(
                f"{path} is of commit {commit}, {first}.json of {expected}: measure both on one"
            )
    return results


def machine_of(file: Json) -> str:
    """Return the hardware, versions and commit of a result as text."""
    about = file["environment"]
    machine = about.get("device", about["processor"])
    peers = f", gsplat {about['gsplat']}" if "gsplat" in about else ""
    return f"{machine}, torch {about['torch']}{peers}, commit {file['commit']}"


def machine_lines(files: list[Json]) -> list[str]:
    """Return a line for each machine and commit: the commands that ran there, and what it is."""
    commands: dict[str, list[str]] = {}
    for file in files:
        commands.setdefault(machine_of(file), []).append(f"`{file['command']}`")
    return [f"- {', '.join(found)}: {machine}." for machine, found in commands.items()]


def section_lines(name: str, results: Results) -> list[str]:
    """Return the lines of one table, or the commands that would make it."""
    section = SECTIONS[name]
    missing = [file for file in section.files if file not in results]
    if missing:
        # gpu_record.py, which `make` runs, writes its file itself.
        commands = [
            COMMANDS[file] + ("" if file == "gpu_record" else f" --json benchmarks/results/{file}.json")
            for file in missing
        ]
        return ["Not measured yet. The commands that measure it:", "",
                *(f"    {command}" for command in commands)]  # fmt: skip
    files = [results[file] for file in section.files]
    return [*section.lines(*files), *(["", *machine_lines(files)] if section.origin else [])]


def render_page(text: str, results: Results) -> str:
    """Return a page with every table replaced (ReportError: the page names an unknown table)."""

    def replace(match: re.Match[str]) -> str:
        if match[2] not in SECTIONS:
            raise ReportError(f"no table is called {match[2]}; known: {', '.join(SECTIONS)}")
        lines = "\n".join(section_lines(match[2], results))
        return f"{match[1]}\n{lines}\n\n{match[3]}"

    return TABLE.sub(replace, text)


def main(arguments: list[str] | None = None) -> int:
    """Write or check the pages; returns the exit status."""
    parser = make_parser(__doc__, device=None, writes_json=False)
    parser.add_argument(
        "--check", action="store_true", help="change nothing; fail when a page is out of date"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the results (%(default)s)")
    args = parser.parse_args(arguments)
    status = 0
    try:
        results = load_results(args.results)
        for page in PAGES:
            text = page.read_text()
            made = render_page(text, results)
            if args.check and made != text:
                print(f"{page} differs from the results: run python benchmarks/report.py", file=sys.stderr)
                status = 1
            elif made != text:
                page.write_text(made)
                print(f"wrote {page}")
    except ReportError as error:
        print(f"report.py: {error}", file=sys.stderr)
        return 1
    return status


if __name__ == "__main__":
    sys.exit(main())
