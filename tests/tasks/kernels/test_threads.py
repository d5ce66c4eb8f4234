"""Work dealt out to threads."""

import os
import time

import pytest

from tasks.kernels.threads import run_in_chunks


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_chunks_come_back_in_order_on_any_number_of_threads(threads: int) -> None:
    def work(first: int, last: int) -> tuple[int, int]:
        time.sleep(0.002 if first % 2 else 0.0)
        return first, last

    assert run_in_chunks(work, 10, 3, threads) == [(0, 3), (3, 6), (6, 9), (9, 10)]
    assert run_in_chunks(work, 0, 3, threads) == []


def test_work_may_deal_out_work_itself() -> None:
    def outer(first: int, last: int) -> int:
        return sum(run_in_chunks(lambda a, b: first * (b - a), 4, 1, 2))

    assert run_in_chunks(outer, 6, 1, 2) == [4 * k for k in range(6)]


@pytest.mark.parametrize("bad", [0, 3])
def test_a_fault_on_any_thread_is_raised(bad: int) -> None:
    def work(first: int, last: int) -> int:
        time.sleep(0.002)
        return 1 // (first - bad)

    with pytest.raises(ZeroDivisionError):
        run_in_chunks(work, 4, 1, 2)


def test_a_forked_process_has_threads_of_its_own() -> None:
    run_in_chunks(lambda first, last: time.sleep(0.001), 4, 1, 2)
    child = os.fork()
    if child == 0:
        run_in_chunks(lambda first, last: time.sleep(0.001), 4, 1, 2)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


def test_no_threads_do_no_work() -> None:
    with pytest.raises(ValueError, match="threads is 0"):
        run_in_chunks(lambda first, last: None, 4, 1, 0)
