"""Every expression of the dashboards and every rule, asked of a Prometheus that scrapes a run on Ray."""

import json
import shutil
import socket
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from deploy.grafana.build import DASHBOARDS, text_of
from factory.graph.execute import Execution, RunSummary, execute
from factory.store.samples import Store
from tests.factory.toy import ToyWork, refs

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("prometheus") is None, reason="prometheus is not installed"),
]
PROMETHEUS = Path(__file__).resolve().parents[2] / "deploy" / "prometheus"
GPU_ONLY = ("ray_node_gpus_utilization", "ray_node_gram_used")
EXPERTS = ["recovery", "pdm_closed", "human"]
TROUBLE = {"log0:2000:recovery:0": "bug", "log1:1000": "bad"}
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Scraped:
    """A run that was made while Prometheus looked on."""

    address: str
    out: Path
    summary: RunSummary

    def ask(self, path: str, **parameters: str) -> Any:
        query = urllib.parse.urlencode(parameters)
        with urllib.request.urlopen(f"{self.address}/api/v1/{path}?{query}", timeout=10) as answer:
            document = json.load(answer)
        assert document["status"] == "success", document
        return document["data"]

    def values(self, expression: str) -> list[float]:
        return [float(found["value"][1]) for found in self.ask("query", query=expression)["result"]]


def free_port() -> int:
    with socket.socket() as each:
        each.bind(("127.0.0.1", 0))
        return int(each.getsockname()[1])


@pytest.fixture(scope="module")
def scraped(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scraped]:
    from factory.graph.on_ray.graph import ray  # with the environment that keeps it on loopback

    home, exported, listening = tmp_path_factory.mktemp("prometheus"), free_port(), free_port()
    config = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text())
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    config["rule_files"] = [str(PROMETHEUS / "alerts.yml")]
    (job,) = config["scrape_configs"]
    del job["file_sd_configs"]  # Ray writes it for clusters with a dashboard
    job["static_configs"] = [{"targets": [f"127.0.0.1:{exported}"]}]
    (home / "prometheus.yml").write_text(yaml.safe_dump(config))
    command = ["prometheus", f"--config.file={home / 'prometheus.yml'}", f"--storage.tsdb.path={home / 'data'}"]
    command += [f"--web.listen-address=127.0.0.1:{listening}", "--log.level=error"]
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        _metrics_export_port=exported,
        _system_config={"metrics_report_interval_ms": 1000},
    )
    with open(home / "log", "w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        work = ToyWork(trouble=TROUBLE, blocks=True, seconds=0.05)
        store = Store(home / "out")
        summary = execute(
            work, refs(12), EXPERTS, 3, store, Execution("ray", 2, shard_seconds=2.0), say=lambda line: None
        )
        yield Scraped(f"http://127.0.0.1:{listening}", home / "out", summary)
    finally:
        process.terminate()
        process.wait(30)
        ray.shutdown()


def eventually(what: Callable[[], object]) -> None:
    """Until `what` is true; values come by the report of Ray's processes and the next scrape."""
    began = time.monotonic()
    while not what():
        assert time.monotonic() - began < PATIENCE_S, what
        time.sleep(0.5)


def with_variables(expression: str) -> str:
    """As Grafana asks it, of all runs and over some scrapes."""
    return expression.replace("$__rate_interval", "60s").replace("$run", ".*")


def test_prometheus_sees_what_the_tables_say(scraped: Scraped) -> None:
    samples = len(Store(scraped.out).samples)
    assert samples > 20
    run = f'run="{scraped.out}"'
    accepted = f'sum(ray_factory_outcomes_total{{kind="accepted", {run}}})'
    eventually(lambda: scraped.values(accepted) == [samples])
    eventually(lambda: scraped.values(f"sum(ray_factory_samples_total{{{run}}})") == [samples])
    eventually(lambda: scraped.values(f"sum(ray_factory_clips_left{{{run}}})") == [0])
    failed = f'sum by (reason) (ray_factory_outcomes_total{{kind="failed", {run}}})'
    assert sorted(scraped.values(failed)) == [1, 1]
    assert scraped.values(f'sum(ray_factory_cache_lookups_total{{cache="block", {run}}})') == [2]


@pytest.mark.parametrize("name", DASHBOARDS)
def test_every_panel_has_something_to_draw(scraped: Scraped, name: str) -> None:
    asked = [
        (panel["title"], target["expr"])
        for panel in json.loads(text_of(name))["panels"]
        for target in panel.get("targets", ())
    ]
    missing = list(asked)

    def all_drawn() -> bool:
        missing[:] = [(title, text) for title, text in missing if not scraped.values(with_variables(text))]
        return all(any(metric in text for metric in GPU_ONLY) for _, text in missing)

    try:
        eventually(all_drawn)
    except AssertionError:
        raise AssertionError(f"nothing to draw: {missing}") from None


def test_every_rule_is_healthy_and_every_recording_records(scraped: Scraped) -> None:
    def rules() -> list[dict[str, Any]]:
        return [rule for group in scraped.ask("rules")["groups"] for rule in group["rules"]]

    eventually(lambda: all(rule["health"] == "ok" for rule in rules()))
    assert {rule["name"] for rule in rules() if rule["type"] == "alerting"} >= {"FactoryNoProgress"}
    for rule in rules():
        if rule["type"] == "recording":
            eventually(lambda name=rule["name"]: scraped.values(name))
    assert scraped.values("sum by (run) (factory:failed:increase30m)")[0] == 2


def test_the_list_of_runs_of_the_dashboards_is_found(scraped: Scraped) -> None:
    (run,) = (
        v["query"]["query"] for v in json.loads(text_of("factory_run.json"))["templating"]["list"] if v["name"] == "run"
    )
    metric = run.removeprefix("label_values(").split(",")[0]
    eventually(lambda: scraped.ask("series", **{"match[]": metric}))
    assert {series["run"] for series in scraped.ask("series", **{"match[]": metric})} == {str(scraped.out)}
