"""`make bench`: every table, one after the other."""

from pathlib import Path

from tests.bench import bench_render, bench_rollout, bench_stages

LOGS = Path("../shared/data/av2/sensor/val")

bench_stages.main(LOGS)
if LOGS.is_dir():
    bench_rollout.main(LOGS)
bench_render.main()
