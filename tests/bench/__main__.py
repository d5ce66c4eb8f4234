"""`make bench`: every table, one after the other."""

from pathlib import Path

from tests.bench import bench_labels, bench_render, bench_reward, bench_rollout

SHARED = Path("../shared")


def main(shared: Path) -> None:
    """Prints the tables, without those whose data are not there."""
    logs = shared / "data/av2/sensor/val"
    bench_reward.main(shared)
    if logs.is_dir():
        bench_rollout.main(logs)
        bench_labels.main(shared)
    else:
        print(f"the tables of rollouts and labels are left out: they need real traffic, and there is no folder {logs}")
    bench_render.main()


if __name__ == "__main__":
    main(SHARED)
