"""Progress: lines where there is no terminal."""

import io

from factory.progress import ProgressLine, Tally


def test_without_a_terminal_there_is_one_plain_line_at_the_end() -> None:
    stream = io.StringIO()
    with ProgressLine(4, stream) as progress:
        for clips in range(5):
            progress.show(Tally(clips, accepted=3 * clips, rejected=clips, failed=1))
        progress.show(Tally(4, 12, 4, 1), last=True)
    (line,) = stream.getvalue().splitlines()
    assert line.startswith("clips 4/4 ") and "12 accepted, 4 rejected, 1 failed" in line and line.endswith("ETA 0 s")


def test_the_time_left_follows_from_the_rate() -> None:
    progress = ProgressLine(10, io.StringIO())
    assert progress.text(Tally(clips=2), elapsed_s=4.0).startswith("0.50 clips/s")
    assert progress.text(Tally(clips=2), elapsed_s=4.0).endswith("ETA 16 s")
    assert progress.text(Tally(), elapsed_s=4.0).endswith("ETA ?")


def test_the_line_ends_with_how_far_long_tasks_are() -> None:
    stream = io.StringIO()
    with ProgressLine(10, stream, doing=lambda: "fit 500/8000") as progress:
        progress.show(Tally(clips=2), last=True)
    assert stream.getvalue().endswith("  fit 500/8000\n")
