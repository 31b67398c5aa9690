# SPDX-License-Identifier: Apache-2.0
"""The files of benchmarks/results: the command that writes each, and which of them are of one commit."""

# File in benchmarks/results (without .json) -> the command that writes it.
EXCHANGE = "python benchmarks/bm_exchange.py --gaussians 16000000 --device cuda --batch 4 --batches 4"
TRAINING = "benchmarks/bm_training.py --data CAPTURE --config configs/aerial.yaml --images 3000"
EARLY_GATE = (
    "configs/compact.yaml --schedule.t1=8999 --population.pass1_keep=1 --schedule.gate_from=2000 "
    "--population.pass2_keep=0.7"
)
COMMANDS = {
    "render": "python benchmarks/bm_render.py",
    "call": "python benchmarks/bm_render.py --scenes aerial1 aerial4",
    "step_1": "python benchmarks/bm_step.py --views 1",
    "step_4": "python benchmarks/bm_step.py --views 4",
    "exchange": f"{EXCHANGE} --ranks 1 2 4",
    "training": f"python {TRAINING}",
    "training_2": f"torchrun --nproc-per-node=2 {TRAINING}",
    "drop_in_full": "python benchmarks/bm_drop_in.py CAPTURE --steps 30000 --one-thread",
    "importance": "python benchmarks/bm_importance.py",
    "gate": "python benchmarks/bm_gate.py",
    "scratch": "python benchmarks/bm_scratch.py",
    "photometric": "python benchmarks/bm_photometric.py",
    "accuracy": "python benchmarks/bm_accuracy.py",
    "lineage": "python benchmarks/bm_lineage.py",
    "lineage_training": (
        "python benchmarks/bm_lineage.py --data CAPTURE --config configs/compact.yaml --images 15000"
    ),
    "quality": (
        "python benchmarks/bm_quality.py --out runs/quality --capture NAME=CAPTURE "
        '--recipe aerial=configs/aerial.yaml --recipe "aerial_half=configs/aerial.yaml --schedule.scale=0.5" '
        "--seeds 0 1 2"
    ),
    "ablation": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/ablation "
        "--capture NAME=CAPTURE --per-gpu 3"
    ),
    "energy": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/energy "
        '--capture "NAME=CAPTURE --population.score=energy" --per-gpu 3'
    ),
}
COMMANDS |= {
    "compact": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/compact "
        '--capture "NAME=CAPTURE --schedule.scale=0.5"'
    ),
    "compact_later": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/compact_later "
        '--capture "NAME=CAPTURE --schedule.scale=0.5"'
    ),
    "gate_random": (
        "python benchmarks/bm_quality.py --out runs/gate_random "
        '--capture "NAME=CAPTURE --schedule.scale=0.5" '
        f'--recipe "rank={EARLY_GATE} --population.gate=GATE" '
        f'--recipe "sample={EARLY_GATE} --population.gate=GATE --population.gate_rule=sample" '
        f'--recipe "random={EARLY_GATE} --population.gate=random" --seeds 0 1 2 3 4 --per-gpu 4'
    ),
    "gate_random_town": (
        "python benchmarks/bm_quality.py --out runs/gate_random_town "
        '--capture "town=DATA/town --schedule.scale=0.5" '
        f'--recipe "rank={EARLY_GATE} --population.gate=GATE" '
        f'--recipe "sample={EARLY_GATE} --population.gate=GATE --population.gate_rule=sample" '
        f'--recipe "random={EARLY_GATE} --population.gate=random" --seeds 0 1 2 --per-gpu 9'
    ),
    "town_parts": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/town_parts "
        "--capture town=DATA/town --seeds 0 1 2"
    ),
    "town": (
        "python benchmarks/bm_quality.py --plan benchmarks/ablation.yaml --out runs/town "
        "--capture town=DATA/town --seeds 0 1"
    ),
    "adaptive": (
        "python benchmarks/bm_quality.py --plan benchmarks/adaptive.yaml --out runs/adaptive "
        "--capture NAME=CAPTURE --per-gpu 3"
    ),
    "oracle": "blitzgs gate replay GATE RUN --out REPLAY",
    "gate_judged": "blitzgs gate evaluate GATE RUN RUN --out JUDGED",
    "offload": "python benchmarks/bm_offload.py --ratios 2 4",
    "city": "python benchmarks/bm_city.py CITY --out RESULTS --gpus 2 --ranks 1 --popping --scale 0.6",
    "city_ranks": (
        "python benchmarks/bm_city.py CITY --out RESULTS --gpus 4 --ranks 4 --arms all_off "
        "--batch-sizes 4 16 --scale 0.6"
    ),
    "city_exchange": (
        "python benchmarks/bm_exchange.py --data CITY --downscale 1 --visible-threshold 0 "
        "--device cuda --ranks 1 2 4"
    ),
}
# The files of a group are of one commit, and so are those that are in no group. Comparisons of whole
# trainings take many minutes and depend on the recipe more than on the kernels, and the city has a page of
# its own.
GROUPS = (
    ("quality",),
    ("ablation",),
    ("oracle", "gate_judged"),
    ("energy",),
    ("compact",),
    ("compact_later",),
    ("gate_random",),
    ("gate_random_town", "town_parts"),
    ("town",),
    ("adaptive",),
    ("call", "importance", "lineage", "lineage_training"),
    ("scratch",),
    ("exchange", "training", "training_2", "city_ranks", "city_exchange", "drop_in_full"),
    ("city",),
)
# bm_quality.py takes no --json: it collects all of its runs in one file.
COPIED = {
    "quality": "cp runs/quality/quality.json benchmarks/results/",
    "ablation": "cp runs/ablation/quality.json benchmarks/results/ablation.json",
    "energy": "cp runs/energy/quality.json benchmarks/results/energy.json",
    "compact": "cp runs/compact/quality.json benchmarks/results/compact.json",
    "compact_later": "cp runs/compact_later/quality.json benchmarks/results/compact_later.json",
    "gate_random": "cp runs/gate_random/quality.json benchmarks/results/gate_random.json",
    "gate_random_town": ("cp runs/gate_random_town/quality.json benchmarks/results/gate_random_town.json"),
    "town_parts": "cp runs/town_parts/quality.json benchmarks/results/town_parts.json",
    "town": "cp runs/town/quality.json benchmarks/results/town.json",
    "adaptive": "cp runs/adaptive/quality.json benchmarks/results/adaptive.json",
}
