"""`make bench`: every table, one after the other."""

from pathlib import Path

from tests.bench import bench_render, bench_rollout, bench_stages

LOGS = Path("../shared/data/av2/sensor/val")

bench_stages.main(LOGS)
if LOGS.is_dir():
    bench_rollout.main(LOGS)
else:
    print(f"the rollout table is left out: it needs real traffic, and there is no folder {LOGS}")
bench_render.main()
