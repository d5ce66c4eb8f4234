"""Processes that draw share a machine's GPUs evenly, each keeping its own."""

import multiprocessing as mp
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import pytest

from tasks.render.splatting import gsplat_backend
from tasks.render.splatting.gsplat_backend import own_place, take_gpu


def _draws(told: Connection, folder: str) -> None:
    tempfile.tempdir = folder
    told.send((own_place(), own_place()))
    told.recv()


def test_each_process_has_the_first_place_that_is_free_for_as_long_as_it_lives(tmp_path: Path) -> None:
    context = mp.get_context("spawn")
    alive = []

    def begins() -> int:
        here, there = context.Pipe()
        process = context.Process(target=_draws, args=(there, str(tmp_path)), daemon=True)
        process.start()
        place, again = here.recv()
        assert place == again
        alive.append((process, here))
        return int(place)

    assert [begins() for _ in range(4)] == [0, 1, 2, 3]
    process, _ = alive[1]
    process.kill()
    process.join()
    assert [begins(), begins()] == [1, 4], "what was killed left its place"
    for process, here in alive:
        if process.is_alive():
            here.send(None)
            process.join()


def test_places_go_round_the_gpus_that_torch_sees(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[int] = []
    cuda = SimpleNamespace(device_count=lambda: 3, set_device=chosen.append)
    monkeypatch.setattr(gsplat_backend, "require", lambda: (SimpleNamespace(cuda=cuda), None))
    for place in range(7):
        monkeypatch.setattr(gsplat_backend, "own_place", lambda place=place: place)
        take_gpu()
    assert chosen == [0, 1, 2, 0, 1, 2, 0]
