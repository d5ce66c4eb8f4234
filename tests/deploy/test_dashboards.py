"""Dashboards are what the code builds, of metrics that there are; alerts fire when they should."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from deploy.grafana.build import DASHBOARDS, FOLDER, text_of
from factory.graph.progress import METRICS, Type

ROOT = Path(__file__).resolve().parents[2]
ALERTS = ROOT / "deploy" / "prometheus" / "alerts.yml"
LABELS = {metric.exported: {"run", *metric.labels} for metric in METRICS}
needs_promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed")


def panels(name: str) -> list[dict]:  # type: ignore[type-arg]
    return [panel for panel in json.loads(text_of(name))["panels"] if panel["type"] != "row"]


def expressions() -> list[str]:
    """Of all dashboards and rules."""
    drawn = [target["expr"] for name in DASHBOARDS for panel in panels(name) for target in panel["targets"]]
    rules = [rule["expr"] for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]
    return drawn + rules


@pytest.mark.parametrize("name", DASHBOARDS)
def test_the_file_is_what_the_code_builds(name: str) -> None:
    assert (FOLDER / name).read_text() == text_of(name), "run python -m deploy.grafana.build"


def test_every_metric_is_drawn_and_every_name_and_label_is_one_of_ours() -> None:
    text = "\n".join(expressions())
    suffix = {Type.HISTOGRAM: "_bucket"}
    for metric in METRICS:
        assert metric.exported + suffix.get(metric.type, "") in text, f"nobody looks at {metric.name}"
    for name, selector in re.findall(r"(ray_factory_\w+)(\{[^}]*\})?", text):
        base = name.removesuffix("_bucket")
        assert base in LABELS, name
        assert set(re.findall(r"(\w+)=~?!?", selector.replace("!=", "="))) <= LABELS[base], selector


@pytest.mark.parametrize("name", DASHBOARDS)
def test_panels_fill_the_grid_without_lying_on_each_other(name: str) -> None:
    taken: set[tuple[int, int]] = set()
    numbers = [panel["id"] for panel in json.loads(text_of(name))["panels"]]
    assert len(set(numbers)) == len(numbers)
    for panel in json.loads(text_of(name))["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        cells = {(x + place["x"], y + place["y"]) for x in range(place["w"]) for y in range(place["h"])}
        assert not cells & taken, panel["title"]
        taken |= cells


@needs_promtool
def test_rules_and_configuration_are_ones_that_prometheus_takes(tmp_path: Path) -> None:
    config = ALERTS.with_name("prometheus.yml")
    told = subprocess.run(["promtool", "check", "config", str(config)], capture_output=True, text=True)
    assert told.returncode == 0, told.stdout + told.stderr


@needs_promtool
def test_alerts_fire_when_they_should_and_only_then() -> None:
    cases = Path(__file__).with_name("alert_cases.yml")
    told = subprocess.run(["promtool", "test", "rules", str(cases)], capture_output=True, text=True)
    assert told.returncode == 0, told.stdout + told.stderr


def test_every_alert_has_a_case_that_fires_and_one_that_does_not() -> None:
    alerts = {
        rule["alert"]
        for group in yaml.safe_load(ALERTS.read_text())["groups"]
        for rule in group["rules"]
        if "alert" in rule
    }
    cases = yaml.safe_load(Path(__file__).with_name("alert_cases.yml").read_text())["tests"]
    asked = [rule for case in cases for rule in case.get("alert_rule_test", [])]
    assert {rule["alertname"] for rule in asked if rule["exp_alerts"]} == alerts
