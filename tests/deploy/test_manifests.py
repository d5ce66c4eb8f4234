"""Manifests say what Ray, Kubernetes and KubeRay understand, and agree with each other and with the project."""

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

ray_autoscaler = pytest.importorskip("ray.autoscaler")
kubernetes_validate = pytest.importorskip("kubernetes_validate", reason="an extra of [dev]")

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
KUBERNETES = "1.30"  # an older one than most clusters have
# Fields and values of ray.io/v1: the KubeRay CRD API reference of v1.6.2,
# https://docs.ray.io/en/master/cluster/kubernetes/references/api.html, and ray-operator/apis/ray/v1/*_types.go.
FIELDS = {
    "RayClusterSpec": (
        "authOptions autoscalerOptions enableInTreeAutoscaling gcsFaultToleranceOptions headGroupSpec "
        "headServiceAnnotations managedBy rayVersion suspend upgradeStrategy workerGroupSpecs"
    ),
    "HeadGroupSpec": "enableIngress headService labels rayStartParams resources serviceType template",
    "WorkerGroupSpec": (
        "groupName idleTimeoutSeconds labels maxReplicas minReplicas numOfHosts rayStartParams replicas resources "
        "scaleStrategy suspend template"
    ),
    "AutoscalerOptions": (
        "env envFrom idleTimeoutSeconds image imagePullPolicy resources securityContext upscalingMode version "
        "volumeMounts"
    ),
    "RayJobSpec": (
        "activeDeadlineSeconds backoffLimit clusterSelector deletionStrategy entrypoint entrypointNumCpus "
        "entrypointNumGpus entrypointResources jobId managedBy metadata preRunningDeadlineSeconds rayClusterSpec "
        "runtimeEnvYAML shutdownAfterJobFinishes submissionMode submitterConfig submitterPodTemplate suspend "
        "ttlSecondsAfterFinished"
    ),
}
UPSCALING = {"Default", "Aggressive", "Conservative"}
SUBMISSION = {"K8sJobMode", "HTTPMode", "InteractiveMode", "SidecarMode"}


def loaded(name: str) -> dict[str, Any]:
    (document,) = yaml.safe_load_all((DEPLOY / name).read_text())
    assert isinstance(document, dict)
    return document


def cluster_spec(name: str) -> dict[str, Any]:
    spec = loaded(name)["spec"]
    return spec.get("rayClusterSpec", spec)


CLUSTERS = ("kuberay/ray_cluster.yaml", "kuberay/ray_job.yaml")


def groups(spec: dict[str, Any]) -> list[dict[str, Any]]:
    return [spec["headGroupSpec"], *spec["workerGroupSpecs"]]


def test_the_cluster_launchers_file_fits_rays_own_schema() -> None:
    config = loaded("ray_cluster.yaml")
    schema = json.loads((Path(ray_autoscaler.__file__).parent / "ray-schema.json").read_text())
    jsonschema.validate(config, schema)
    assert config["head_node_type"] in config["available_node_types"]
    for name, kind in config["available_node_types"].items():
        assert set(kind) <= {"docker", "max_workers", "min_workers", "node_config", "resources"}, name
    most = sum(kind.get("max_workers", 0) for kind in config["available_node_types"].values())
    assert most == config["max_workers"]


@pytest.mark.parametrize("name", CLUSTERS)
def test_pods_fit_the_schema_of_kubernetes(name: str) -> None:
    for group in groups(cluster_spec(name)):
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "pod"}, **group["template"]}
        kubernetes_validate.validate(pod, KUBERNETES, strict=True)
        with pytest.raises(kubernetes_validate.ValidationError):
            kubernetes_validate.validate({**pod, "spec": {**pod["spec"], "volume": []}}, KUBERNETES, strict=True)


def test_the_cache_volume_fits_the_schema_and_is_the_one_that_is_mounted() -> None:
    claim = loaded("kuberay/cache_volume.yaml")
    kubernetes_validate.validate(claim, KUBERNETES, strict=True)
    assert "ReadWriteMany" in claim["spec"]["accessModes"]
    for name in CLUSTERS:
        for group in groups(cluster_spec(name)):
            volumes = {volume["name"]: volume for volume in group["template"]["spec"]["volumes"]}
            assert volumes["cache"]["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
            for container in group["template"]["spec"]["containers"]:
                assert {mount["name"] for mount in container["volumeMounts"]} == set(volumes)


@pytest.mark.parametrize("name", CLUSTERS)
def test_custom_resources_have_the_fields_of_their_definitions(name: str) -> None:
    document, spec = loaded(name), cluster_spec(name)
    assert document["apiVersion"] == "ray.io/v1"
    assert set(document) == {"apiVersion", "kind", "metadata", "spec"}
    assert set(spec) <= set(FIELDS["RayClusterSpec"].split()) and {"headGroupSpec", "rayVersion"} <= set(spec)
    assert spec["authOptions"] == {"mode": "token"}
    assert set(spec["headGroupSpec"]) <= set(FIELDS["HeadGroupSpec"].split())
    assert set(spec["autoscalerOptions"]) <= set(FIELDS["AutoscalerOptions"].split())
    assert spec["autoscalerOptions"]["upscalingMode"] in UPSCALING
    for group in groups(spec):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    for group in spec["workerGroupSpecs"]:
        assert set(group) <= set(FIELDS["WorkerGroupSpec"].split())
        assert 0 <= group["minReplicas"] <= group["maxReplicas"]
        assert re.fullmatch(r"[a-z]([-a-z0-9]*[a-z0-9])?", group["groupName"])
    if document["kind"] == "RayJob":
        job = document["spec"]
        assert set(job) <= set(FIELDS["RayJobSpec"].split()) and job["submissionMode"] in SUBMISSION
        assert job["ttlSecondsAfterFinished"] >= 0 and job["backoffLimit"] >= 0


def test_the_job_runs_on_the_cluster_that_the_other_file_describes() -> None:
    assert cluster_spec("kuberay/ray_job.yaml") == cluster_spec("kuberay/ray_cluster.yaml")


def test_gpus_are_asked_for_by_one_group_and_the_head_runs_no_tasks() -> None:
    spec = cluster_spec("kuberay/ray_cluster.yaml")
    assert spec["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    for group in groups(spec):
        (container,) = group["template"]["spec"]["containers"]
        asks = "nvidia.com/gpu" in container["resources"]["requests"]
        assert asks == (group.get("groupName") == "gpu") == container["image"].endswith(":cuda")
        assert container["envFrom"] == [{"secretRef": {"name": "factory-object-store"}}]
        assert {"name": "metrics", "containerPort": 8080} in container["ports"]
    kinds = loaded("ray_cluster.yaml")["available_node_types"]
    assert {name for name, kind in kinds.items() if kind["resources"].get("GPU")} == {"gpu"}
    assert kinds["head"]["resources"]["CPU"] == 0


def test_the_command_of_the_job_is_one_that_the_factory_takes() -> None:
    from factory.config.run import load_config

    python, _, module, *overrides = loaded("kuberay/ray_job.yaml")["spec"]["entrypoint"].split()
    assert (python, module) == ("python", "factory.run")
    config = load_config(overrides)
    assert config.workers is not None, "a cluster that begins with no worker has no cores to count"


def test_versions_are_those_of_the_constraints() -> None:
    pinned = re.search(r"^ray==(.*)$", (ROOT / "constraints.txt").read_text(), re.M)
    assert pinned is not None
    assert {cluster_spec(name)["rayVersion"] for name in CLUSTERS} == {pinned[1]}


def instructions() -> list[tuple[str, str]]:
    """(instruction, rest) of the Dockerfile, continued lines joined, comments left out."""
    lines = [line for line in (DEPLOY / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines()
    return [tuple(line.split(None, 1)) for line in joined if line.strip()]  # type: ignore[misc]


def test_the_image_is_built_of_what_is_there_pinned_and_without_root() -> None:
    found = instructions()
    assert [rest for word, rest in found if word == "USER"][-1] != "root"
    for word, rest in found:
        if word == "COPY":
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists(), source
        if word == "FROM":
            base = rest.split()[0]
            assert base.startswith("base-") or re.search(r":.*\$\{(UBUNTU|CUDA)\}", base), f"{base} has no version"
        if word == "RUN" and "apt-get install" in rest:
            assert "--no-install-recommends" in rest and "rm -rf /var/lib/apt/lists" in rest
        if word == "RUN" and "pip install" in rest:
            assert "--no-cache-dir" in rest and "-c constraints.txt" in rest
    assert {rest.split(" AS ")[1] for word, rest in found if word == "FROM" and " AS " in rest} == {
        "base-cpu",
        "base-cuda",
    }


def test_the_build_context_holds_what_is_copied() -> None:
    kept = {line[1:] for line in (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = {source for word, rest in instructions() if word == "COPY" for source in rest.split()[:-1]}
    assert kept == copied


def test_both_prometheus_files_load_the_rules_and_scrape_every_node() -> None:
    local, cluster = loaded("prometheus/prometheus.yml"), loaded("prometheus/prometheus_kubernetes.yml")
    for config in (local, cluster):
        assert config["rule_files"] == ["alerts.yml"]
        assert [job["job_name"] for job in config["scrape_configs"]] == ["ray"]
    kept = next(rule for rule in cluster["scrape_configs"][0]["relabel_configs"] if rule.get("action") == "keep")
    assert re.fullmatch(kept["regex"] if isinstance(kept["regex"], str) else "", "yes;metrics")
