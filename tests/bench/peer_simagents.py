"""The public sim-agents metric on the same rollouts: `PYTHON tests/bench/peer_simagents.py IN.npz OUT.npz`.

Needs waymo-research/waymo-open-dataset's own Python (its protocol buffers compiled, `src` on PYTHONPATH, TensorFlow
with TensorFlow Probability), nothing of this project: tests.bench.bench_realism starts it. IN holds `boxes`
(2, S, N, 5), those of the log and of a rollout, their presence `valid`, the numbers `rows` of vehicles that are judged,
the drivable area's outline `edge_xy` in rings that end at `edge_ends`, and `edge_steps`, the steps at which distances
to it are asked for. OUT gets each feature (2, S, R), absent where its vehicle is, and, under `likelihood <name>`, the
challenge's likelihoods of those that are there at all steps.
"""

import sys
from pathlib import Path

import numpy as np
import tensorflow as tf
from google.protobuf import text_format
from waymo_open_dataset.protos import map_pb2, sim_agents_metrics_pb2
from waymo_open_dataset.wdl_limited.sim_agents_metrics import (
    estimators,
    interaction_features,
    map_metric_features,
    trajectory_features,
)

STEP_S = 0.1
CONFIG = Path(estimators.__file__).with_name("challenge_2025_sim_agents_config.textproto")
NAMES = {  # ours: the public configuration's
    "speed": "linear_speed",
    "acceleration": "linear_acceleration",
    "yaw rate": "angular_speed",
    "yaw acceleration": "angular_acceleration",
    "distance to nearest": "distance_to_nearest_object",
    "time to collision": "time_to_collision",
    "collision": "collision_indication",
}


def features(boxes, valid, rows, edges, edge_steps):
    """Each feature (S, R) of tracks (S, N, 5)."""
    x, y, heading, length, width = (tf.constant(np.nan_to_num(boxes[..., k]).T, tf.float32) for k in range(5))
    flat = {"center_z": tf.zeros_like(x), "height": tf.ones_like(x)}
    judged = np.isin(np.arange(boxes.shape[1]), rows)
    there = {"valid": tf.constant(valid.T), "evaluated_object_mask": tf.constant(judged)}
    box = {"center_x": x, "center_y": y, "length": length, "width": width, "heading": heading}
    moving = trajectory_features.compute_kinematic_features(
        *(tf.gather(of, rows) for of in (x, y, flat["center_z"], heading)), seconds_per_step=STEP_S
    )
    out = dict(zip(("speed", "acceleration", "yaw rate", "yaw acceleration"), moving))
    near = interaction_features.compute_distance_to_nearest_object(**box, **flat, **there)
    out["distance to nearest"] = near
    out["collision"] = near < interaction_features.COLLISION_DISTANCE_THRESHOLD
    out["time to collision"] = interaction_features.compute_time_to_collision_with_object_in_front(
        **box, **there, seconds_per_step=STEP_S
    )
    road = np.full((len(rows), len(boxes)), np.nan)
    for step in edge_steps.tolist():  # one by one: points times segments are held at once
        at = {name: value[:, step : step + 1] for name, value in {**box, **flat, "valid": there["valid"]}.items()}
        found = map_metric_features.compute_distance_to_road_edge(
            **at, evaluated_object_mask=there["evaluated_object_mask"], road_edge_polylines=edges
        )
        road[:, step] = found[:, 0]
    out["distance to road edge"] = road
    absent = ~valid[:, rows]
    answer = {}
    for name, value in out.items():
        values = np.asarray(value, np.float64).T
        answer[name] = np.where(absent, np.nan, values)
    return answer


def likelihoods(config, logged, simulated):
    """exp of the mean log-likelihood, as compute_scenario_metrics_for_features_bundle takes it, of whole tracks.

    Without the steps at either end that no difference is known for: `tfp.stats.histogram` counts what is no number in
    the highest bin, so that the challenge has a step or two there of each of its rollouts of 80.
    """
    out = {}
    for name, of in NAMES.items():
        setting = getattr(config, of)
        log, sim = (np.ascontiguousarray(values[name].T, np.float32) for values in (logged, simulated))
        if name == "collision":
            scores = estimators.log_likelihood_estimate_scenario_level(
                setting, tf.constant(log.any(axis=1)), tf.constant(sim.any(axis=1))[None]
            )
            out[name] = float(np.exp(np.mean(scores)))
        else:
            known = np.isfinite(log).all(axis=0) & np.isfinite(sim).all(axis=0)
            log, sim = np.ascontiguousarray(log[:, known]), np.ascontiguousarray(sim[:, known])
            scores = estimators.log_likelihood_estimate_timeseries(setting, tf.constant(log), tf.constant(sim)[None])
            out[name] = float(np.exp(np.asarray(scores).mean()))
    return out


def main():
    with np.load(sys.argv[1]) as given:
        arrays = dict(given)
    config = text_format.Parse(CONFIG.read_text(), sim_agents_metrics_pb2.SimAgentMetricsConfig())
    rings = np.split(arrays["edge_xy"], arrays["edge_ends"][:-1])
    edges = [[map_pb2.MapPoint(x=x, y=y, z=0.0) for x, y in ring.tolist()] for ring in rings]
    rows, steps = arrays["rows"], arrays["edge_steps"]
    both = [features(boxes, valid, rows, edges, steps) for boxes, valid in zip(arrays["boxes"], arrays["valid"])]
    out = {name: np.stack([of[name] for of in both]) for name in both[0]}
    whole = arrays["valid"][:, :, rows].all(axis=(0, 1))
    if whole.any():
        kept = [{name: values[:, whole] for name, values in of.items()} for of in both]
        out.update({f"likelihood {name}": value for name, value in likelihoods(config, *kept).items()})
    np.savez(sys.argv[2], **out)


if __name__ == "__main__":
    main()
