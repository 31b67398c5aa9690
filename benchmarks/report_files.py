# SPDX-License-Identifier: Apache-2.0
"""The files of benchmarks/results: the command that writes each, and which of them are of one commit."""

# File in benchmarks/results (without .json) -> the command that writes it.
PLAN = "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml"
COMMANDS = {
    "gpu_record": "make gpu-record",
    "render": "python benchmarks/bm_render.py",
    "step_1": "python benchmarks/bm_step.py --views 1",
    "step_4": "python benchmarks/bm_step.py --views 4",
    "photometric": "python benchmarks/bm_photometric.py",
    "accuracy": "python benchmarks/bm_accuracy.py",
    "offload": "python benchmarks/bm_offload.py --ratios 2 4",
    "exchange": (
        "python benchmarks/bm_exchange.py --gaussians 16000000 --device cuda --batch 4 --batches 4 "
        "--ranks 1 2 4"
    ),
    "drop_in_full": "python benchmarks/bm_drop_in.py CAPTURE --steps 30000 --one-thread",
    "quality": (
        "python benchmarks/bm_quality.py --out runs/quality --capture NAME=CAPTURE "
        '--recipe aerial=configs/aerial.yaml --recipe "aerial_half=configs/aerial.yaml --schedule.scale=0.5" '
        "--seeds 0 1 2"
    ),
    "compact": f'{PLAN} --out runs/compact --capture "NAME=CAPTURE --schedule.scale=0.5"',
    "town_parts": f"{PLAN} --out runs/town_parts --capture town=DATA/town --seeds 0 1 2",
    "city": "python benchmarks/bm_city.py CITY --out RESULTS --gpus 2 --ranks 1 --popping --scale 0.6",
    "city_ranks": (
        "python benchmarks/bm_city.py CITY --out RESULTS --gpus 4 --ranks 4 --arms all_off "
        "--batch-sizes 4 16 --scale 0.6"
    ),
}
# The files of a group are of one commit, and so are those that are in no group. Comparisons of whole
# trainings take many minutes and depend on the recipe more than on the kernels, and the city has a page of
# its own.
GROUPS = (
    ("quality",),
    ("compact",),
    ("town_parts",),
    ("exchange", "city_ranks", "drop_in_full"),
    ("city",),
    ("gpu_record",),
)
# After commands that take no --json: gpu_record.py writes its file itself, bm_quality.py collects all of its
# runs in one file.
COPIED = {"gpu_record": "python benchmarks/report.py"} | {
    name: f"cp runs/{name}/quality.json benchmarks/results/{name}.json"
    for name in ("quality", "compact", "town_parts")
}
