"""Manifests say what Ray, Kubernetes and KubeRay understand, and agree with each other and with the project."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from tasks.caches import user_cache
from tests.factory.test_packaging import TINY

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


def test_versions_are_those_of_the_lock_files() -> None:
    pinned = re.search(r"^ray==(\S+)", (ROOT / "locks/run.lock").read_text(), re.M)
    assert pinned is not None
    assert {cluster_spec(name)["rayVersion"] for name in CLUSTERS} == {pinned[1]}


def pods(name: str) -> list[dict[str, Any]]:
    """Of the head, the groups of workers and, where there is one, the submitter."""
    submitter = loaded(name)["spec"].get("submitterPodTemplate")
    return [*(group["template"] for group in groups(cluster_spec(name))), *([submitter] if submitter else [])]


@pytest.mark.parametrize("name", CLUSTERS)
def test_pods_fit_the_security_level_restricted_with_a_root_that_is_read_only(name: str) -> None:
    """https://kubernetes.io/docs/concepts/security/pod-security-standards/"""
    locked = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
    autoscaler = cluster_spec(name)["autoscalerOptions"]
    assert autoscaler["securityContext"] == locked
    for pod in (template["spec"] for template in pods(name)):
        user = pod["securityContext"]
        assert user["runAsNonRoot"] and user["runAsUser"] and user["seccompProfile"] == {"type": "RuntimeDefault"}
        assert not {"hostNetwork", "hostPID", "hostIPC", "initContainers"} & set(pod)
        assert all({"emptyDir", "persistentVolumeClaim"} & set(volume) for volume in pod["volumes"])
        for container in (*pod["containers"], autoscaler):
            assert container["securityContext"] == locked
            assert {"/tmp", "/home/ubuntu"} <= {mount["mountPath"] for mount in container["volumeMounts"]}


@pytest.mark.parametrize("name", CLUSTERS)
def test_the_containers_of_ray_alone_have_the_cloud_s_keys_and_the_autoscaler_alone_the_cluster_s(name: str) -> None:
    assert "envFrom" not in cluster_spec(name)["autoscalerOptions"]
    for pod in (template["spec"] for template in pods(name)):
        (container,) = pod["containers"]
        keys = [{"secretRef": {"name": "factory-object-store"}}]
        assert container.get("envFrom") == (keys if container["name"].startswith("ray-") else None)
        assert pod.get("automountServiceAccountToken") is (None if container["name"] == "ray-head" else False)


@pytest.mark.parametrize("name", CLUSTERS)
def test_only_who_needs_a_port_of_the_cluster_reaches_it(name: str) -> None:
    policy = loaded("kuberay/network_policy.yaml")
    kubernetes_validate.validate(policy, KUBERNETES, strict=True)
    chosen = policy["spec"]["podSelector"]["matchLabels"].items()
    within, *others = policy["spec"]["ingress"]
    assert policy["spec"]["policyTypes"] == ["Ingress"]
    assert within == {"from": [{"podSelector": policy["spec"]["podSelector"]}]}
    (head,) = cluster_spec(name)["headGroupSpec"]["template"]["spec"]["containers"]
    port = {entry["name"]: entry["containerPort"] for entry in head["ports"]}
    opened = {
        (peer["podSelector"]["matchLabels"]["app.kubernetes.io/name"], entry["port"])
        for rule in others
        for peer in rule["from"]
        for entry in rule["ports"]
    }
    dashboard = {("kuberay-operator", port["dashboard"]), ("factory-submitter", port["dashboard"])}
    assert opened == {*dashboard, ("prometheus", port["metrics"])}
    for template in pods(name):
        is_submitter = template["spec"]["containers"][0]["name"] == "submitter"
        labels = {"app.kubernetes.io/name": "factory-submitter"}.items() if is_submitter else chosen
        assert labels <= template["metadata"]["labels"].items()


READ_ONLY_ROOT = """
set -e
mount --make-rprivate /
for folder in $WRITABLE; do mount --bind $folder $folder; done
for folder in / "$PWD" "$PREFIX"; do mount --bind "$folder" "$folder"; mount -o remount,bind,ro "$folder"; done
cd "$PWD"
for folder in /etc "$PWD" "$PREFIX"; do touch "$folder/probe" 2>&1 | grep -q "Read-only"; done
exec setpriv --no-new-privs --inh-caps=-all --bounding-set=-all "$@"
"""


@pytest.mark.ray
@pytest.mark.slow
def test_a_run_needs_to_write_nowhere_but_where_pods_have_a_volume(tmp_path: Path) -> None:
    """Without capabilities and new privileges, too, in a mount namespace of its own."""
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-m", "true"]).returncode:
        pytest.skip("mounts need root and unshare")
    cache = user_cache().parent
    cache.mkdir(parents=True, exist_ok=True)
    stands_for = {"/tmp": "/tmp", "/dev/shm": "/dev/shm", "/home/ubuntu": str(tmp_path), "/cache": str(cache)}
    for group in (group for name in CLUSTERS for group in groups(cluster_spec(name))):
        (container,) = group["template"]["spec"]["containers"]
        assert {mount["mountPath"] for mount in container["volumeMounts"]} == set(stands_for)
    env = os.environ | {"WRITABLE": " ".join(stands_for.values()), "PREFIX": sys.prefix}
    env |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(cache)}
    run = [sys.executable, "-m", "factory.run", *TINY.split(), f"out={tmp_path / 'out'}"]
    command = ["unshare", "-m", "sh", "-c", READ_ONLY_ROOT, "sh", *run]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    assert "│ human    │ 0     │ 1" in done.stdout


def instructions() -> list[tuple[str, str]]:
    """(instruction, rest) of the Dockerfile, continued lines joined, comments left out."""
    lines = [line for line in (DEPLOY / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines()
    return [tuple(line.split(None, 1)) for line in joined if line.strip()]  # type: ignore[misc]


def test_the_image_is_built_of_what_is_there_pinned_and_without_root() -> None:
    found = instructions()
    (pin,) = (rest.removeprefix("PIN=").strip('"') for _, rest in found if rest.startswith("PIN="))
    assert [rest for word, rest in found if word == "USER"][-1] != "root"
    for word, rest in found:
        if word == "COPY":
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists(), source
        if word == "FROM":
            assert re.fullmatch(r"base-\$\{VARIANT\}|\$\{(UBUNTU|CUDA)\} AS base-(cpu|cuda)", rest)
        if word == "ARG" and not rest.startswith(("VARIANT=", "PIN=")):
            assert re.fullmatch(r"(UBUNTU|CUDA)=[\w./-]+:[\w.-]*24\.04@sha256:[0-9a-f]{64}", rest), "tag and digest"
        if word == "RUN" and "apt-get install" in rest:
            assert "--no-install-recommends" in rest and "rm -rf /var/lib/apt/lists" in rest
        for command in rest.replace("$PIN", pin).split("&&") if word == "RUN" else ():
            if "pip install" in command:
                assert {"--no-cache-dir", "--no-deps", "--no-build-isolation"} <= set(command.split())
                assert "--require-hashes" in command or command.split()[-1] == ".", "all but the project has a hash"
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
