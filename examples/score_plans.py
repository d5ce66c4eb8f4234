"""Score trajectories of one's own on a clip, cell by cell; needs neither Ray nor Hydra.

python -m examples.score_plans
"""

# %% A clip. Any reader will do; this one reads a log that examples/csv_logs.py writes.
import tempfile
from pathlib import Path

import numpy as np

from examples.csv_logs import CsvReader, write_log
from tasks.trajectories import score_trajectories

logs = Path(tempfile.mkdtemp())
write_log(logs / "street")
reader = CsvReader(logs)
clip = reader.read(reader.index().refs[0])

# %% Four plans, (4, 40, 3): x, y [m], heading [rad] in the ego frame, at 0.1 .. 4.0 s.
t = 0.1 * np.arange(1, 41)
plans = {
    "goes on": np.column_stack([8.0 * t, 0.0 * t, 0.0 * t]),
    "rams the car ahead": np.column_stack([20.0 * t, 0.0 * t, 0.0 * t]),
    "leaves the road": np.column_stack([8.0 * t, -1.5 * t, np.full(40, -0.185)]),
    "stands": np.zeros((40, 3)),
}

# %% Scores. Progress is relative to PDM-Closed, as in published numbers.
scores = score_trajectories(clip, np.stack(list(plans.values())))
print(f"{'':<20}{'nc':>6}{'dac':>6}{'ttc':>6}{'ep':>6}{'hc':>6}{'score':>8}")
for k, name in enumerate(plans):
    parts = (scores.nc[k], scores.dac[k], scores.ttc[k], scores.ep[k], scores.hc[k])
    print(f"{name:<20}{''.join(f'{part:>6.2f}' for part in parts)}{scores.pdm_score[k]:>8.3f}")

# %% When a rule was broken first [s]: inf where it never was.
for rule, index in scores.first_failures.items():
    if np.isfinite(index).any():
        print(f"{rule:<20}", np.round(0.1 * index, 1))

# %% Held against each other instead: the best row has EP 1, and so has a car that stops, alone in its batch.
alone = score_trajectories(clip, plans["stands"][None], reference="batch")
print(f"stands, alone in its batch: ep {alone.ep[0]:.2f}, against PDM-Closed: {scores.ep[3]:.2f}")
