"""The bench of what a GPU leaves to the host runs, and its device is asked for all that a GPU is."""

import pytest

from tasks.render.scene import on_device
from tests.bench import bench_host


def test_it_asks_a_device_for_all_instants_of_a_sample(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[tuple[int, ...], ...]] = []
    drawn = bench_host.nothing_is_drawn

    def counted(**given: object) -> object:
        asked.append((tuple(given["means"].shape), tuple(given["Ks"].shape)))  # type: ignore[attr-defined]
        return drawn(**given)

    monkeypatch.setattr(on_device, "cuda", on_device.cuda)  # which the bench replaces
    monkeypatch.setattr(bench_host, "nothing_is_drawn", counted)
    monkeypatch.setattr(bench_host, "SIZES", ((64, 36),))
    monkeypatch.setattr(bench_host, "NODE", 50)
    bench_host.main({"gaussians": "400", "vehicles": "3", "instants": "2", "repeats": "1"})
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 64x36 |")]
    assert all(float(cell) >= 0.0 for cell in row.split("|")[2:-1])
    assert asked == [((2, 400 + 3 * 50, 3), (2, 8, 3, 3))] * 2, "one sample that warms up, one that is timed"
