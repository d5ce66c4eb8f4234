"""Builds the Grafana dashboards from a list of panels; `python -m deploy.grafana.build` writes the JSON files.

A test holds the files against this list, and every expression against a Prometheus that scrapes a run.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
SOURCE = {"type": "prometheus", "uid": "${datasource}"}
RUN = 'run=~"$run"'
WIDTH, HEIGHT = 24, 8  # of a dashboard's grid; of a panel
TRIED = f'ray_factory_outcomes_total{{{RUN}, expert!="", kind=~"accepted|rejected|failed"}}'
FAILED, BLOCKS, HITS = 'kind="failed"', 'task="reconstruct"', 'hit="true"'
ACCEPTED = f'ray_factory_outcomes_total{{{RUN}, expert!="", kind="accepted"}}'


@dataclass(frozen=True)
class Panel:
    """One picture: a line per expression, named by its legend."""

    title: str
    expressions: Mapping[str, str]  # legend -> PromQL
    unit: str = "short"
    about: str = ""
    kind: str = "timeseries"  # or stat
    stacked: bool = False
    most: float | None = None  # of the axis


@dataclass(frozen=True)
class Row:
    title: str
    panels: Sequence[Panel]


def of(metric: str, more: str = "") -> str:
    """A metric of the chosen runs."""
    return f"ray_{metric}{{{RUN}{', ' + more if more else ''}}}"


def rate(by: str, metric: str, more: str = "") -> str:
    """Its rate, summed over workers."""
    return f"sum by ({by}) (rate({of(metric, more)}[$__rate_interval]))"


def quantile(q: float, by: str, metric: str, more: str = "") -> str:
    return f"histogram_quantile({q}, sum by (le, {by}) (rate({of(metric + '_bucket', more)}[$__rate_interval])))"


def share(some: str, all_of_it: str) -> str:
    """A ratio that is 0 where there is nothing to count yet: a counter that never counted has no series."""
    return f"({some} or 0 * {all_of_it}) / {all_of_it}"


RUN_ROWS = (
    Row(
        "At a glance",
        (
            Panel("Samples", {"": f"sum({of('factory_samples_total')})"}, kind="stat", about="Committed."),
            Panel("Samples a minute", {"": f"60 * sum(rate({of('factory_samples_total')}[10m]))"}, kind="stat"),
            Panel("Attempts accepted", {"": share(f"sum({ACCEPTED})", f"sum({TRIED})")}, "percentunit", kind="stat"),
            Panel("Failed", {"": f"sum({of('factory_outcomes_total', FAILED)}) or vector(0)"}, kind="stat"),
            Panel("Clips left", {"": f"sum({of('factory_clips_left')})"}, kind="stat"),
            Panel(
                "Time left",
                {"": f"sum({of('factory_clips_left')}) / (0 - sum(deriv({of('factory_clips_left')}[30m])))"},
                "s",
                kind="stat",
                about="At the pace of the last half hour.",
            ),
        ),
    ),
    Row(
        "Acceptance",
        (
            Panel(
                "Attempts accepted, by expert",
                {
                    "{{expert}}": share(
                        f"sum by (expert) (increase({ACCEPTED}[1h]))", f"sum by (expert) (increase({TRIED}[1h]))"
                    )
                },
                "percentunit",
                "Over the hour before.",
                most=1.0,
            ),
            Panel(
                "Attempts accepted, by expert and round",
                {
                    "{{expert}} {{round}}": share(
                        f"sum by (expert, round) ({ACCEPTED})", f"sum by (expert, round) ({TRIED})"
                    )
                },
                "percentunit",
                "Since the drivers began. The paper has clips, not attempts: see the run's own dashboard for those.",
                most=1.0,
            ),
        ),
    ),
    Row(
        "Why not",
        (
            Panel(
                "Rejected, by stage and reason",
                {"{{stage}} {{reason}}": rate("stage, reason", "factory_outcomes_total", 'kind="rejected"')},
                "ops",
                stacked=True,
            ),
            Panel(
                "Failed, by kind of error",
                {"{{reason}}": rate("reason", "factory_outcomes_total", FAILED)},
                "ops",
                stacked=True,
            ),
        ),
    ),
    Row(
        "Throughput",
        (
            Panel("Samples", {"{{expert}}": rate("expert", "factory_samples_total")}, "ops", stacked=True),
            Panel("Bytes of shards", {"{{expert}}": rate("expert", "factory_sample_bytes_total")}, "Bps", stacked=True),
            Panel("In flight", {"{{what}}": f"sum by (what) ({of('factory_in_flight')})"}),
            Panel(
                "Clips",
                {"begun with": f"sum({of('factory_clips')})", "left": f"sum({of('factory_clips_left')})"},
            ),
        ),
    ),
    Row(
        "Pictures",
        (
            Panel(
                "PSNR of held-out photos",
                {
                    "median {{of}}": quantile(0.5, "of", "factory_psnr_db"),
                    "worst tenth {{of}}": quantile(0.1, "of", "factory_psnr_db"),
                },
                "dB",
                "Of blocks as they are built, of accepted samples as they are drawn. The paper's gate is at 27 dB.",
            ),
            Panel("Blocks built", {"blocks": f"sum({of('factory_tasks_total', BLOCKS)})"}),
        ),
    ),
)

MACHINE_ROWS = (
    Row(
        "Where the time goes",
        (
            Panel(
                "Workers busy, by stage",
                {"{{stage}}": rate("stage", "factory_stage_spent_seconds_total")},
                about="Seconds of work a second: how many workers are in a stage on average.",
                stacked=True,
            ),
            Panel(
                "Time in a stage",
                {
                    "median {{stage}}": quantile(0.5, "stage", "factory_stage_seconds"),
                    "95 % {{stage}}": quantile(0.95, "stage", "factory_stage_seconds"),
                },
                "s",
            ),
            Panel(
                "Waiting to begin, 95 %",
                {"{{task}}": quantile(0.95, "task", "factory_queue_wait_seconds")},
                "s",
                "Long with idle workers: the driver or the object store holds up. Long with busy ones: add workers.",
            ),
            Panel("Tasks", {"{{task}} {{result}}": rate("task, result", "factory_tasks_total")}, "ops", stacked=True),
        ),
    ),
    Row(
        "Store and caches",
        (
            Panel(
                "Found in the cache",
                {
                    "{{cache}}": share(
                        f"sum by (cache) ({of('factory_cache_lookups_total', HITS)})",
                        f"sum by (cache) ({of('factory_cache_lookups_total')})",
                    )
                },
                "percentunit",
                most=1.0,
            ),
            Panel(
                "A commit, 95 %",
                {
                    "seconds": "histogram_quantile(0.95, sum by (le) "
                    f"(rate({of('factory_commit_seconds_bucket')}[$__rate_interval])))"
                },
                "s",
            ),
            Panel(
                "Free where samples are written",
                {"{{run}}": f"min by (run) ({of('factory_disk_free_bytes')})"},
                "bytes",
            ),
            Panel(
                "Object store in use",
                {"{{NodeAddress}}": "sum by (NodeAddress) (ray_object_store_used_memory)"},
                "bytes",
            ),
        ),
    ),
    Row(
        "Machines",
        (
            Panel("CPU", {"{{NodeAddress}}": "avg by (NodeAddress) (ray_node_cpu_utilization)"}, "percent", most=100.0),
            Panel(
                "Memory",
                {
                    "{{NodeAddress}}": "sum by (NodeAddress) (ray_node_mem_used) "
                    "/ sum by (NodeAddress) (ray_node_mem_total)"
                },
                "percentunit",
                most=1.0,
            ),
            Panel(
                "GPU busy",
                {"{{NodeAddress}} {{GpuIndex}}": "avg by (NodeAddress, GpuIndex) (ray_node_gpus_utilization)"},
                "percent",
                "Nothing where no node has a GPU.",
                most=100.0,
            ),
            Panel(
                "GPU memory",
                {"{{NodeAddress}} {{GpuIndex}}": "sum by (NodeAddress, GpuIndex) (ray_node_gram_used)"},
                "decmbytes",
            ),
            Panel("Free disk", {"{{NodeAddress}}": "min by (NodeAddress) (ray_node_disk_free)"}, "bytes"),
            Panel(
                "CPUs claimed",
                {
                    "used": 'sum(ray_resources{Name="CPU", State="USED"})',
                    "free": 'sum(ray_resources{Name="CPU", State="AVAILABLE"})',
                },
                stacked=True,
            ),
        ),
    ),
)

DASHBOARDS = {
    "factory_run.json": ("factory-run", "Factory: a run", RUN_ROWS),
    "factory_machines.json": ("factory-machines", "Factory: time and machines", MACHINE_ROWS),
}


def dashboard(uid: str, title: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Grafana's model of a dashboard (schema version 39)."""
    panels: list[dict[str, Any]] = []
    y = 0
    for row in rows:
        panels.append(
            {
                "id": len(panels) + 1,
                "type": "row",
                "title": row.title,
                "collapsed": False,
                "panels": [],
                "gridPos": {"x": 0, "y": y, "w": WIDTH, "h": 1},
            }
        )
        y += 1
        in_line = len(row.panels) if row.panels[0].kind == "stat" else 2
        width, height = WIDTH // in_line, 4 if row.panels[0].kind == "stat" else HEIGHT
        for i, panel in enumerate(row.panels):
            place = {"x": i % in_line * width, "y": y + i // in_line * height, "w": width, "h": height}
            panels.append(_panel(len(panels) + 1, panel, place))
        y += -(-len(row.panels) // in_line) * height
    return {
        "uid": uid,
        "title": title,
        "tags": ["driving-data-factory"],
        "schemaVersion": 39,
        "editable": True,
        "refresh": "30s",
        "time": {"from": "now-6h", "to": "now"},
        "timezone": "",
        "templating": {"list": [_source_variable(), _run_variable()]},
        "panels": panels,
    }


def _panel(number: int, panel: Panel, place: Mapping[str, int]) -> dict[str, Any]:
    custom = {"fillOpacity": 25 if panel.stacked else 8, "stacking": {"mode": "normal" if panel.stacked else "none"}}
    defaults: dict[str, Any] = {"unit": panel.unit, "min": 0}
    if panel.most is not None:
        defaults["max"] = panel.most
    if panel.kind == "timeseries":
        defaults["custom"] = custom
    return {
        "id": number,
        "type": panel.kind,
        "title": panel.title,
        "description": panel.about,
        "datasource": SOURCE,
        "gridPos": dict(place),
        "fieldConfig": {"defaults": defaults, "overrides": []},
        "targets": [
            {"refId": chr(ord("A") + i), "datasource": SOURCE, "expr": expression, "legendFormat": legend}
            for i, (legend, expression) in enumerate(panel.expressions.items())
        ],
    }


def _source_variable() -> dict[str, Any]:
    return {"name": "datasource", "label": "Prometheus", "type": "datasource", "query": "prometheus"}


def _run_variable() -> dict[str, Any]:
    query = "label_values(ray_factory_outcomes_total, run)"
    return {
        "name": "run",
        "label": "Run",
        "type": "query",
        "datasource": SOURCE,
        "query": {"query": query, "refId": "run"},
        "definition": query,
        "refresh": 2,
        "includeAll": True,
        "multi": True,
        "allValue": ".*",
        "current": {"text": ["All"], "value": ["$__all"]},
    }


def text_of(name: str) -> str:
    """What the file of that name should hold."""
    return json.dumps(dashboard(*DASHBOARDS[name]), indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    """Write every dashboard."""
    for name in DASHBOARDS:
        (FOLDER / name).write_text(text_of(name))


if __name__ == "__main__":
    main()
