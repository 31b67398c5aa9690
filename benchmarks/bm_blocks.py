# SPDX-License-Identifier: Apache-2.0
"""Measures the time to find the active set of an aerial view, and its size relative to the visible set.

python benchmarks/bm_blocks.py [--device cuda] [--rows 16000000] [--views 1]
"""

from __future__ import annotations

import torch
from harness import make_parser, write_json
from scenes import aerial
from timing import median_ms
from torch import Tensor

from blitzgs.ops.blocks import ActiveRows
from blitzgs.ops.lazy_adam import AdamSchedule
from blitzgs.ops.project import project
from blitzgs.table.blocks import BlockIndex, morton_order
from blitzgs.table.table import PARAMETERS, GaussianTable


def main() -> None:
    parser = make_parser(__doc__, repeats=20)
    parser.add_argument("--rows", type=int, default=16_000_000)
    parser.add_argument("--views", type=int, default=1)
    args = parser.parse_args()
    device, n = args.device, args.rows
    scene = aerial(n, device)
    raw = scene.raw()
    table = GaussianTable.create(raw | {"sh": raw["sh"][:, :1].contiguous()})
    views = scene.viewmats[:1].repeat(args.views, 1, 1), scene.Ks[:1].repeat(args.views, 1, 1)
    schedule = AdamSchedule(torch.full((100, 6), 1e-3, device=device), 0.9, 0.999, 1e-15).table
    sort = median_ms(lambda means: morton_order(means), [(table["means"],)], 3, 1)
    table.permute(morton_order(table["means"]))
    index = BlockIndex(table, schedule)

    def cull(*cameras: Tensor) -> ActiveRows:
        return index.active(table, *cameras, scene.width, scene.height, 0.1, 1e6)

    active, active_views = cull(*views).listed()

    def rows_of(**options: Tensor) -> int:
        columns = (table[name] for name in PARAMETERS)
        return len(
            project(*columns, *views, scene.width, scene.height, near_plane=0.1, **options).visible_ids
        )

    visible = rows_of(active_ids=active, active_views=active_views)
    print(f"{n} rows, {args.views} view(s), {device}: {len(active)} active, {visible} visible")
    if visible != rows_of():
        raise SystemExit("the active set misses visible rows")
    timings = {
        "Morton order of all rows": sort,
        "bounds of all blocks": median_ms(lambda _: index.update(table, None), [views[:1]], 5),
        "active set": median_ms(cull, [views], args.repeats),
        "bounds after a step": median_ms(lambda ids: index.update(table, ids), [(active,)], args.repeats),
        "projection of the active set": median_ms(
            lambda ids, bits: rows_of(active_ids=ids, active_views=bits),
            [(active, active_views)],
            args.repeats,
        ),
        "projection of all rows": median_ms(lambda _: rows_of(), [views[:1]], args.repeats),
    }
    for name, milliseconds in timings.items():
        print(f"{name:32s} {milliseconds:8.3f} ms")
    if args.json:
        counts = {"rows": n, "views": args.views, "active": len(active), "visible": visible}
        write_json(args.json, device, **counts, ms=timings)


if __name__ == "__main__":
    main()
