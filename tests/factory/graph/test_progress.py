"""Progress: lines where there is no terminal."""

import io

import pytest

from factory.graph.progress import ProgressLine, RunCounts
from factory.wording import rate_text, time_text


def test_without_a_terminal_there_is_one_plain_line_at_the_end() -> None:
    stream = io.StringIO()
    with ProgressLine(4, lambda elapsed_s: 0.0, stream) as progress:
        for clips in range(5):
            progress.show(RunCounts(clips, accepted=3 * clips, rejected=clips, failed=1))
        progress.show(RunCounts(4, 12, 4, 1), last=True)
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("clips 4/4 ") and "12 accepted, 4 rejected, 1 failed" in line and line.endswith("ETA 0 s")


def test_rate_and_time_left_are_told() -> None:
    progress = ProgressLine(10, lambda elapsed_s: 4.0 * elapsed_s if elapsed_s > 1.0 else None, io.StringIO())
    assert progress.text(RunCounts(clips=2), elapsed_s=4.0).startswith("30.00 clips/min")
    assert progress.text(RunCounts(clips=2), elapsed_s=4.0).endswith("ETA 16 s")
    assert progress.text(RunCounts(), elapsed_s=0.5).endswith("ETA ?")


def test_the_line_ends_with_how_far_long_tasks_are() -> None:
    stream = io.StringIO()
    with ProgressLine(10, lambda elapsed_s: 1.0, stream, doing=lambda: "fit 500/8000") as progress:
        progress.show(RunCounts(clips=2), last=True)
    assert stream.getvalue().endswith("  fit 500/8000\n")


@pytest.mark.parametrize(
    ("per_s", "said"), [(0.0, "0/s"), (1.0, "1.00/s"), (0.02, "1.20/min"), (0.003, "10.80/h"), (1e-4, "0.36/h")]
)
def test_a_slow_rate_is_told_in_a_longer_unit(per_s: float, said: str) -> None:
    assert rate_text(per_s) == said


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.2, "0 s"), (119.4, "119 s"), (3077.0, "51 min"), (7170.0, "2 h 00 min"), (90e3, "25 h 00 min")],
)
def test_a_long_time_is_told_in_minutes_and_hours(seconds: float, said: str) -> None:
    assert time_text(seconds) == said
