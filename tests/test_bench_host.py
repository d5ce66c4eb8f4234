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

    for name in ("cuda", "BATCH_PIXELS"):  # which the bench replaces
        monkeypatch.setattr(on_device, name, getattr(on_device, name))
    monkeypatch.setattr(bench_host, "nothing_is_drawn", counted)
    monkeypatch.setattr(bench_host, "SIZES", ((64, 36),))
    monkeypatch.setattr(bench_host, "NODE", 50)
    monkeypatch.setattr(bench_host, "LOOKS", 3)
    bench_host.main({"gaussians": "400", "vehicles": "3", "instants": "2", "repeats": "1"})
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if "64x36" in line]
    assert all(float(cell) >= 0.0 for row in rows for cell in row[1:])
    assert [(name.strip(), float(calls), float(fetched)) for name, calls, fetched, _ in rows[1:]] == [
        ("the gate, 64x36", 1, 3),
        ("the gate, 64x36", 3, 9),
    ]
    assert asked[:2] == [((2, 400 + 3 * 50, 3), (2, 8, 3, 3))] * 2, "one sample that warms up, one that is timed"
    assert [cameras[:2] for _, cameras in asked[2:4]] == [(1, 8)] * 2, "the same of an instant alone"
    assert asked[4][1][:2] == (3, 8) and asked[-1][1][:2] == (1, 8), "the gate's instants together, then one by one"
