"""Adam for rows, beside the algorithm as published."""

import numpy as np

from tasks.render.fit.state import AdamArray


def test_rows_move_as_by_plain_adam_over_the_steps_they_were_in() -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(size=(6, 3)).astype(np.float32)
    learned = AdamArray.unstepped(start)
    values, first, second, steps = start.astype(np.float64), np.zeros((6, 3)), np.zeros((6, 3)), np.zeros((6, 1))
    for t in range(40):
        rows = np.flatnonzero(rng.uniform(size=6) < 0.6)
        gradient, scale = rng.normal(size=(len(rows), 3)).astype(np.float32), rng.uniform(0.5, 2.0, len(rows))
        rate = 0.1 * 0.97**t
        learned.step(rows, gradient, rate, scale.astype(np.float32))
        steps[rows] += 1
        first[rows] = 0.3 * first[rows] + 0.7 * gradient
        second[rows] = 0.999 * second[rows] + 0.001 * gradient.astype(np.float64) ** 2
        m, v = first[rows] / (1 - 0.3 ** steps[rows]), second[rows] / (1 - 0.999 ** steps[rows])
        values[rows] -= rate * scale[:, None] * m / (np.sqrt(v) + 1e-15)
    np.testing.assert_allclose(learned.values, values, rtol=1e-4, atol=1e-5)


def test_what_is_forgotten_starts_like_new() -> None:
    learned, fresh = AdamArray.unstepped(np.ones((2, 2))), AdamArray.unstepped(np.ones((2, 2)))
    rows, gradient = np.arange(2), np.full((2, 2), 0.3, np.float32)
    learned.step(rows, -gradient, 0.0)
    learned.forget(rows)
    learned.step(rows, gradient, 0.1)
    fresh.step(rows, gradient, 0.1)
    np.testing.assert_array_equal(learned.values, fresh.values)
