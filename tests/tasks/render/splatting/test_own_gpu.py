"""Processes that draw share a machine's GPUs evenly, each keeping its own."""

import multiprocessing as mp
import tempfile
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import pytest

from tasks.render.splatting import gsplat_backend
from tasks.render.splatting.gsplat_backend import FITS_AT_ONCE, fit_turn, own_place, take_gpu


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


def test_fits_of_a_gpu_take_turns_and_who_is_stopped_waits_no_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(gsplat_backend, "LOOK_S", 0.01)
    turns, stops, has_begun, end = [], threading.Event(), list[int](), threading.Event()

    def fits(number: int, gpu: int, stopped: Callable[[], bool]) -> None:
        with fit_turn(gpu, stopped):
            has_begun.append(number)
            end.wait(20.0)

    def begins(number: int, gpu: int, stopped: Callable[[], bool] = lambda: False) -> None:
        turns.append(threading.Thread(target=fits, args=(number, gpu, stopped)))
        turns[-1].start()

    for number in range(FITS_AT_ONCE):
        begins(number, 0)
    _until(lambda: len(has_begun) == FITS_AT_ONCE)
    begins(7, 0)
    begins(8, 0, stops.is_set)
    begins(9, 1)
    _until(lambda: 9 in has_begun)
    assert sorted(has_begun) == [*range(FITS_AT_ONCE), 9], "another GPU has turns of its own"
    stops.set()
    _until(lambda: 8 in has_begun)
    assert 7 not in has_begun
    end.set()
    _until(lambda: 7 in has_begun)
    for turn in turns:
        turn.join()


def _until(holds: Callable[[], bool]) -> None:
    began = time.monotonic()
    while not holds():
        assert time.monotonic() - began < 10.0
        time.sleep(0.005)
