"""What a user can get wrong, row by row: the exit code, one line that says what and how, nothing written."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow.feather import write_feather

from factory.__main__ import main
from factory.datasets.av2 import INTRINSICS, POSES
from factory.setup.vocabulary import save_recovery_table
from tasks.experts.recovery import RecoveryTable
from tasks.world.vocabulary import kinematic_trajectories

REPOSITORY = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "numba", "scipy", "shapely", "pyarrow", "deltalake", "ray", "torch", "cv2")
NO_HYDRA = ("Hydra", "hydra", "override", "Lexer", "EOF", "in struct", "Traceback", "pydantic", "Input should")


@dataclass(frozen=True)
class Wrong:
    """A command line behind `python -m factory`, and what its one line must say."""

    argv: tuple[str, ...]
    says: tuple[str, ...]
    code: int = 2


def run(*argv: str, says: Sequence[str]) -> Wrong:
    return Wrong(("run", *argv), tuple(says))


STREET = ("clips=custom", "clips._target_=tests.factory.street_reader.StreetReader")
MISTYPED = [  # told before anything heavy is imported
    run("rounsd=5", says=["rounsd: there is no such setting", "did you mean rounds=?"]),
    run("preset=dmeo", says=["demo, hard_benchmark", "did you mean preset=demo?"]),
    run("presset=demo", says=["presset: there is no such setting; did you mean preset=?"]),
    run("CLIP=av2", says=["CLIP: there is no such setting; did you mean clips=?"]),
    run("expert=human", says=["expert: there is no such setting; did you mean experts=?"]),
    run("planner=ltf", says=["planner: there is no such setting"]),
    run("clips=argoverse2", says=["clips=argoverse2: give clips=av2 clips.root=", "or clips=py123d clips.root="]),
    run("clips=nuPlan", says=["give clips=navsim", "clips.maps=", "or clips=py123d", "or clips=scenarionet"]),
    run("clips=waymo_open", says=["or clips=scenarionet clips.root=", "docs/tutorials/nuscenes.md"]),
    run("traffic=fast", says=["traffic=fast: there is custom, idm, navsim, replay"]),
    run("--rounds", "5", says=["settings have no dashes: rounds=5"]),
    run("rounds", "5", says=["'rounds': expected key=value"]),
    run("rounds=five", says=["rounds: must be a whole number (got 'five')"]),
    run("rounds=0", says=["rounds=0: at least one round"]),
    run("limit=0", says=["limit=0: must be positive"]),
    run("shard_seconds=0", says=["shard_seconds=0"]),
    run("experts=[human,human]", says=["each expert once"]),
    run("graph.memory_gb.rendr=3", says=["there is no such task; did you mean render"]),
    run("rounds=1,2", says=["several runs are several commands"]),
    run("rounds=[1", says=["rounds=[1", "a list is"]),
    run("executor=lcoal", says=["must be ray or local; did you mean local?"]),
    run("retry_failed=maybe", says=["retry_failed: must be true or false"]),
    run("experts=[recovry]", says=["recovry", "did you mean recovery?"]),
    run("experts=recovery,human", says=["experts=[recovery,human]"]),
    run("~rounds", says=["'~rounds': expected key=value"]),
    run(
        "clips.root=/logs",
        says=["clips.root is a setting of clips=av2, clips=navsim, clips=py123d, clips=scenarionet: choose one"],
    ),
    run("clips=av2", says=["clips.root is missing: give clips.root=<folder>"]),
    run("--multirun", "rounds=1,2", says=["several commands", "out="]),
    run("--config-dir", "nowhere", says=["nowhere: there is no such folder"]),
    run("--cfg", "all", says=["--cfg all: the settings of the run alone are shown"]),
    run("vocabulary.k=99999999", says=["k=99999999", "at most 131,072"]),
    run("perturb.epdms_min=high", says=["perturb.epdms_min: must be a number (got 'high')"]),
    run("render.mode=atuo", says=["render.mode: must be auto, map, painter or none; did you mean auto?"]),
    run("reward.full=[nc,comfort]", says=["full names comfort"]),
    run("traffic.headway_s=-1", says=["headway_s must be positive"]),
    run("render.gate.vehicle_min=2", says=["render gate vehicle_min must be from 0 to 1"]),
    run("render.scene=disc", says=["render.scene: must be discs or fit; did you mean"]),
    run("expert.recovery.match=maybe", says=["expert.recovery.match: must be log or paper (got 'maybe')"]),
    run("expert.recovery.mach=log", says=["did you mean expert.recovery.match=?"]),
    run("clips.n_clisp=3", says=["clips.n_clisp: there is no such setting", "did you mean clips.n_clips=?"]),
    run("clips.n_clips=many", says=["clips.n_clips: must be a whole number (got 'many')"]),
    run("clips.settings.cameras=[nope]", says=["unknown cameras ['nope']; known: ring_front_center"]),
    run("clips=av2", "clips.root=nowhere", says=["nowhere: no such folder"]),
    run("render=map", "render.cameras=[nope]", says=["no camera nope; this rig has ring_front_left, ring_front_"]),
    run("clips=synthetic_towns", "clips.logs_per_town=19", says=["a town has 1 to 18 logs"]),
    run("clips=av2", "clips.root=x", "clips.split=tset", says=["must be train, val or test; did you mean test?"]),
    run(
        "clips=custom", "clips._target_=nowhere.Reader", says=["clips: nowhere.Reader: there is no module", "installed"]
    ),
    run("clips=custom", "clips._target_=facotry.Reader", says=["no module facotry; did you mean factory?"]),
    run("clips=custom", "clips._target_=Reader", says=["clips: Reader: name a class with its module"]),
    run("+expert.x._target_=nowhere.Expert", says=["expert.x: nowhere.Expert: there is no module nowhere"]),
    run("+expert.x.speed=3", "experts=[x]", says=["expert.x._target_ is missing: name the class"]),
    run("clips=av2", "clips.root=a_file", says=["a_file: no such folder"]),
    run("clips=av2", "clips.root=a_folder", says=["a_folder: no Argoverse 2 sensor log here"]),
    run("out=", says=["out= is empty", "variable"]),
    run("out=a_file", says=["a_file is not a folder"]),
    run("out=nowhere/../a_file/x", says=["a_file is not a folder"]),
    run("out=/proc/nowhere", says=["out=/proc/nowhere: cannot be written"]),
]
A_SCENE = ("clips=scenarionet", "clips.root=a_scene.pkl")
WRONG = [
    run("out=ftp://host/x", says=["a URL of s3, gs"]),
    run("clips=scenarionet", "clips.root=a_folder", says=["a_folder: no scenario here"]),
    run("clips=custom", "clips._target_=factory.datasets.av2.reader.AV2Raeder", says=["did you mean AV2Reader?"]),
    run(
        "clips=custom", "clips._target_=factory.datasets.av3.Reader", says=["factory.datasets has no av3", "mean av2?"]
    ),
    run("clips=custom", "clips._target_=a_module.Reader", says=["a_module cannot be imported: KeyError: 'x'"]),
    run("+expert.x._target_=tasks.experts.protocol.Humann", "experts=[x]", says=["has no Humann; did you mean Human?"]),
    run(
        "clips=av2", "clips.root=a_log", "render=auto", "render.cameras=[nope]", says=["this rig has ring_front_center"]
    ),
    run(
        "clips=av2", "clips.root=a_rigless_log", "render=auto", "render.cameras=[nope]", says=["no log under a_rigless"]
    ),
    run("clips=scenarionet", "clips.root=a_folder", "render=map", "render.cameras=[nope]", says=["rig has front_left"]),
    run(
        "clips=scenarionet",
        "clips.root=a_folder",
        "render=auto",
        "render.cameras=[front]",
        says=["no log under a_folder", "clips.cameras=<sidecar> brings some"],
    ),
    run(*A_SCENE, "clips.cameras=a_rig", "render=auto", "render.cameras=[nope]", says=["this rig has CAM_FRONT"]),
    run(*A_SCENE, "clips.cameras=a_folder", says=["clips.cameras=a_folder: no cameras.json here"]),
    run(*A_SCENE, "clips.camera=a_rig", says=["clips.camera", "did you mean clips.cameras=?"]),
    run(*A_SCENE, says=["recovery table", "a_scene.pkl: pickle: truncated or not a pickle"]),
    run("executor=ray", "vocabulary.file=nowhere.npy", says=["nowhere.npy", "No such file"]),
    run("vocabulary.file=broken.npy", says=["broken.npy: not readable as a numpy file: it holds no plain numbers"]),
    run("vocabulary.file=shape.npy", says=["shape.npy: trajectories have shape (3, 4), expected (K >= 1, 40, 3)"]),
    run(
        "vocabulary.file=degrees.npy", says=["degrees.npy: headings are ", "off the direction of motion", "in degrees"]
    ),
    run("vocabulary.file=now.npy", says=["now.npy: the first row lies 0.00 m from the start", "it is the row of now"]),
    run(*STREET, "reward.label_vocabulary=swapped.npy", says=["swapped.npy: motion begins 90 deg off x", "swapped?"]),
    run("expert.recovery.vocabularies=[swapped.npy]", says=["swapped.npy: motion begins 90 deg off x", "swapped?"]),
    run("expert.recovery.table=degrees.npz", says=["degrees.npz: headings are ", "they are in degrees"]),
    run(*STREET, "render=map", "render.cameras=[nowhere]", says=["no camera nowhere; this rig has front_left, front"]),
    run("expert.recovery.table=nowhere.npz", says=["nowhere.npz: there is no such file"]),
    run(*STREET, "reward.label_vocabulary=shape.npy", says=["shape.npy: trajectories have shape (3, 4), expected (K"]),
    run("reward.labels=none", "reward.label_vocabulary=x.npy", says=["label_vocabulary=x.npy is for labels=vocab"]),
    Wrong(("vocabulary", "clip=av2", "out=x.npy"), ("did you mean clips?",)),
    Wrong(("plan", "rounsd=5"), ("did you mean rounds=?",)),
    Wrong(("rnu",), ("there is no command rnu", "did you mean run?")),
    Wrong(("train", "planner=ltf"), ("python -m planners train",)),
    *(Wrong((name, "out=a_folder"), ("a_folder: give the out= of a run",)) for name in ("status", "report", "retry")),
    Wrong(("show", "out=a_folder", "sample=0"), ("no store at",)),
    Wrong(("dashboard", "out=a_folder"), ("no store at",)),
    Wrong(("verify", "a_folder"), ("no store at",)),
    *(Wrong((name, "out=a_folder"), ("no store at",)) for name in ("clean", "compact")),
    Wrong(("clean", "out=a_folder", "older_than=soon"), ("older_than=soon: must be a number of days, hours or",)),
    Wrong(("status", "out=  "), ("out= is empty",)),
    Wrong(("dashboard", "out=a_folder", "port=99999"), ("port=99999: must be a number below 65536",)),
    Wrong(("vocabulary", "kinematic=true", "k=4", "out=/proc/x.npy"), ("No such file",)),
    Wrong(("scene", "info", "broken.npy"), ("broken.npy: cannot be read",)),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "a_file").write_text("")
    (tmp_path / "a_folder").mkdir()
    (tmp_path / "broken.npy").write_bytes(b"\x00broken")
    (tmp_path / "a_module.py").write_text("{}['x']")
    np.save(tmp_path / "shape.npy", np.zeros((3, 4)))
    drives = kinematic_trajectories(60, 0)
    np.save(tmp_path / "degrees.npy", drives * (1.0, 1.0, 180.0 / np.pi))
    np.save(tmp_path / "now.npy", np.concatenate([np.zeros((60, 1, 3)), drives[:, :-1]], axis=1))
    np.save(tmp_path / "swapped.npy", drives[..., [1, 0, 2]])
    save_recovery_table(tmp_path / "degrees.npz", RecoveryTable(drives * (1.0, 1.0, 180.0 / np.pi)), {})
    (tmp_path / "a_scene.pkl").write_bytes(b"broken")  # that the rig's names are looked for before shows
    (tmp_path / "a_rig").mkdir()
    (tmp_path / "a_rig" / "cameras.json").write_text('{"cameras": {"CAM_FRONT": {}}}')
    for name in ("a_log", "a_rigless_log"):  # broken from the poses on: they are not looked at
        (tmp_path / name).mkdir()
        (tmp_path / name / POSES).write_bytes(b"broken")
    (tmp_path / "a_log" / "calibration").mkdir()
    write_feather(
        pa.table({"sensor_name": ["ring_front_center", "stereo_front_left"]}), tmp_path / "a_log" / INTRINSICS
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # of a_module: that is no work of the command
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder: Path) -> list[tuple[str, int]]:
    return sorted((str(path.relative_to(folder)), path.stat().st_mtime_ns) for path in folder.rglob("*"))


def whole(wrong: Wrong) -> list[str]:
    """The command line of a row; a run writes nowhere else, draws nothing that is not asked for, and is in this process
    but where Ray is named."""
    if wrong.argv[0] != "run" or any(word.startswith("out=") for word in wrong.argv):
        return list(wrong.argv)
    return [
        "run",
        "render=none",
        *([] if "executor=ray" in wrong.argv else ["executor=local"]),
        *wrong.argv[1:],
        "out=here",
    ]


def unlike(wrong: Wrong, code: int, said: str) -> list[str]:
    """What is not as it must be."""
    is_line = said.startswith("error: ") and said.count("\n") == 1
    found = [] if code == wrong.code and is_line else [f"exit code {code}, {said!r}"]
    found += [f"not said: {words}" for words in wrong.says if words not in said]
    return found + [f"said: {word}" for word in NO_HYDRA if word in said]


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG, ids=[" ".join(wrong.argv) for wrong in WRONG])
def test_a_wrong_input_ends_with_its_code_and_one_line_and_writes_nothing(
    wrong: Wrong, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = contents(folder)
    code = main(whole(wrong))
    assert not unlike(wrong, code, capfd.readouterr().err)
    assert contents(folder) == before


def python(cwd: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"PYTHONPATH": str(REPOSITORY), "PYTHONDONTWRITEBYTECODE": "1"} | environment
    return subprocess.run([sys.executable, *arguments], cwd=cwd, env=env, capture_output=True, text=True, timeout=240)


ASK_ALL = f"""
import contextlib, io, json, sys
from factory.__main__ import main
for argv in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(argv)
    print(json.dumps([code, said.getvalue()]))
print(json.dumps([name for name in {HEAVY} if name in sys.modules]))
"""


@pytest.mark.slow
def test_a_mistyped_word_is_told_likewise_before_anything_heavy_is_imported(folder: Path) -> None:
    before = contents(folder)
    done = python(folder, "-c", ASK_ALL, json.dumps([whole(wrong) for wrong in MISTYPED]))
    *told, loaded = map(json.loads, done.stdout.splitlines())
    assert len(told) == len(MISTYPED) and loaded == [], done.stderr
    found = {" ".join(wrong.argv): unlike(wrong, *answer) for wrong, answer in zip(MISTYPED, told)}
    assert not {line: what for line, what in found.items() if what}
    assert contents(folder) == before


def test_a_plus_before_a_setting_may_stand_or_not(capsys: pytest.CaptureFixture[str]) -> None:
    for word in ("rounds=7", "+rounds=7", "expert.mine._target_=mine.Expert"):
        assert main(["run", "--cfg", word]) == 0
        assert word.rpartition(".")[2].lstrip("+").replace("=", ": ") in capsys.readouterr().out


def test_a_bucket_without_credentials_is_refused_before_any_work(folder: Path) -> None:
    nobody = {name: "" for name in os.environ if name.startswith("AWS_")} | {"AWS_EC2_METADATA_DISABLED": "true"}
    done = python(folder, "-m", "factory.run", "out=s3://nobody/x", HOME=str(folder), **nobody)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith("error: out=s3://nobody/x: ") and done.stderr.count("\n") == 1, done.stderr
    assert "AWS_ACCESS_KEY_ID" in done.stderr


def test_one_expert_needs_no_brackets_and_odd_paths_no_quotes(folder: Path) -> None:
    from factory.config.run import compose_run, typed_run_config

    values = compose_run(["experts=recovery", "render.cameras=front", "out=~/my (first) run=a", "render=none"])
    config = typed_run_config(values)
    assert config.experts == ("recovery",) and config.render.cameras == ("front",)
    assert config.out == str(Path.home() / "my (first) run=a")


def test_hydra_s_habits_work(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a_folder" / "render").mkdir()
    (folder / "a_folder" / "render" / "mine.yaml").write_text("defaults:\n  - map\n  - _self_\nwidth: 640\n")
    for show in (["--cfg=job"], ["-c", "job"]):
        assert main(["run", *show, "--config-dir", "a_folder", "render=mine", "rounds=7"]) == 0
        shown = capsys.readouterr().out
        assert "width: 640" in shown and "mode: map" in shown and "rounds: 7" in shown
    assert main(["run", "--config-dir=a_folder", "render=mien"]) == 2
    assert "did you mean render=mine?" in capsys.readouterr().err
