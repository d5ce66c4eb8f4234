"""`make bench`: every table, one after the other."""

from pathlib import Path

from tests.bench import bench_labels, bench_render, bench_reward, bench_rollout, bench_rules, bench_stages

SHARED = Path("../shared")
LOGS = SHARED / "data/av2/sensor/val"

bench_reward.main(SHARED)
if (SHARED / "reference").is_dir():
    bench_rules.main(SHARED)
bench_stages.main(LOGS)
if LOGS.is_dir():
    bench_rollout.main(LOGS)
    bench_labels.main(SHARED)
else:
    print(f"the tables of rollouts and labels are left out: they need real traffic, and there is no folder {LOGS}")
bench_render.main()
