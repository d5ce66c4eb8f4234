"""What `python -m factory.run rounds=5` is where nobody says which clips: small, and told before it is begun."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from factory.config.run import FIRST_LOOK, compose_run
from factory.run import main
from tests.factory.test_wrong_inputs import HEAVY
from tests.pages import REPOSITORY

TOLD = f"""
import sys
import factory.run
factory.run._run = lambda *_: print("loaded:", *sorted(set({HEAVY}) & set(sys.modules))) or 0
sys.exit(factory.run.main(sys.argv[1:]))
"""


def test_without_clips_and_preset_a_run_is_the_first_look_and_every_word_of_it_can_be_said_otherwise() -> None:
    first = compose_run(["rounds=5"])
    assert (
        first == compose_run(["clips=synthetic", *FIRST_LOOK, "rounds=5"]) != compose_run(["preset=none", "rounds=5"])
    )
    clips, seen, drawn = first["clips"], first["clips"]["settings"], first["render"]
    assert clips["n_clips"] == 3, "of one log: one scene is painted and fitted"
    assert len(seen["cameras"]) * seen["width"] * seen["height"] <= 3 * 256 * 144
    assert (drawn["width"], drawn["height"]) == (seen["width"], seen["height"])
    assert drawn["fit"]["iterations"] <= 800 and drawn["fit"]["most_gaussians"] <= 80_000
    assert (
        compose_run(["clips.n_clips=1", "render=map"])["render"] == compose_run(["preset=none", "render=map"])["render"]
    )
    assert compose_run(["clips.n_clips=1"])["clips"]["n_clips"] == 1
    for words in (["clips=synthetic"], ["preset=demo", "clips.n_clips=12", "rounds=1"]):
        assert compose_run(words)["clips"]["n_clips"] == 12, "nothing is set where the clips are said"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["rounds=5"],
            r"clips=synthetic: 3 clips of a drawn town, 3 cameras of 256x144, lidar; rounds=5; pictures of 256x144 "
            r"where there are photos, from scenes fitted in 550 iterations; out=runs/synthetic\n"
            rf"no clips= given, so this is a first look \({' '.join(FIRST_LOOK)}\); your logs: clips=av2\|custom.*\n",
        ),
        (
            ["clips=custom", "clips._target_=tests.factory.street_reader.StreetReader", "render=none"],
            r"clips=custom: rounds=1; no pictures; out=runs/custom\n",
        ),
    ],
    ids=["first look", "own logs"],
)
def test_a_run_says_what_it_is_about_to_do_before_anything_heavy_is_imported(
    words: list[str], told: str, tmp_path: Path
) -> None:
    command = [sys.executable, "-c", TOLD, *words, "executor=local", f"out={tmp_path}"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    said = done.stdout.replace(str(tmp_path), f"runs/{'custom' if 'clips=custom' in words else 'synthetic'}")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(told + "loaded:\n" if "custom" not in words[0] else told + ".*\n", said), said


@pytest.mark.slow
def test_what_the_machine_refuses_is_an_error_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = ["clips.n_clips=1", "clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none"]
    quick = [*blind, "vocabulary.k=64", "experts=[human]", f"out={tmp_path}", f"clips.cache_dir={tmp_path}"]
    assert main([*quick, "executor=local"]) == 0
    capsys.readouterr()
    assert main([*quick, "executor=local", "seed=1"]) == 2
    assert re.fullmatch("error: .*on_change=.*\n", capsys.readouterr().err)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    assert main([*quick, "seed=1"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and re.fullmatch("error: no Ray cluster answers at RAY_ADDRESS=127.0.0.1:1 .*\n", said.err)
