"""Every command of both programs, in trouble made from outside: `python -m experiments.chaos.outside ...`.

    python -m experiments.chaos.outside [rows=sighup,guard:run] [trials=10] [seed=0] [folder=/tmp/here] [keep=true]

A row is a promise: how trouble is made for a command that runs as a process of its own, what it may end with, and the
line that then has to say what happened and how to go on. No traceback, no process left behind; then the same command
again, without trouble, must end with 0 and what it makes must be what undisturbed commands make. Prints

    promise | trials | held | CPU s

and ends with 1 where a promise did not hold in every trial. Rows that mount file systems or change rights need root and
Linux, in name spaces of their own; without, they are left out and named. A trial in which the trouble came too late is
made anew and not counted.
"""

import random
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGKILL, SIGQUIT, SIGTERM
from typing import Any

from experiments.chaos import trouble
from experiments.chaos.trouble import GOES_ON, NOBODY, Command, Harness, Row
from factory.exits import BAD_CONFIG, COMPLETE, DAMAGED, INTERRUPTED

TOWN = "clips.n_clips=2 clips.settings.cameras=[] clips.settings.lidar_beams=0 render=none vocabulary.k=128"
RUN = f"factory run {TOWN} rounds=2 shard_seconds=0.001 out={{out}}"
BENCHMARK = "preset=hard_benchmark clips=synthetic clips.n_clips=3 clips.settings.cameras=[]"
BENCHMARK += " clips.settings.lidar_beams=0 render=none vocabulary.k=512 executor=local"
SUBMISSION = "team_name=ours authors=A email=a@b.org institution=ours country=ours"


# Commands.


COMMANDS: Mapping[str, Command] = {
    "run": Command(f"{RUN} executor=local", goes_on=True),
    "isolated": Command(f"{RUN} executor=local graph.isolated=always", goes_on=True),
    "ray": Command(f"{RUN} executor=ray workers=1", goes_on=True),
    "export ray": Command(
        "factory export navsim out={made}/run missing=none map_location=us-ma-boston to={out} executor=ray workers=1",
        goes_on=True,
    ),
    "drive ray": Command(
        "planners drive planner={made}/train clips.n_clips=1 clips.settings.cameras=[] clips.settings.lidar_beams=0"
        " perturbed=1 films=none executor=ray workers=1 out={out}",
        goes_on=True,
    ),
    "train ray": Command(
        "planners train planner=ego_mlp_small data.real=[{made}/run] data.sim=[{made}/run] steps=60 executor=ray"
        " out={out}",
        goes_on=True,
    ),
    "plan": Command(f"factory plan {TOWN} out={{out}}"),
    "status": Command("factory status out={out}", "run"),
    "failed": Command("factory failed out={out}", "run"),
    "retry": Command("factory retry out={out} executor=local", "run", goes_on=True),
    "lineage": Command("factory lineage 0 out={out}", "run"),
    "show": Command("factory show sample=0 film=true out={made}/run to={out}"),
    "dashboard": Command("factory dashboard out={out} port={port}", "run", ends=False),
    "report": Command("factory report out={out}", "run"),
    "export mcap": Command("factory export mcap out={made}/run sample=0 to={out}"),
    "export mp4": Command("factory export mp4 out={made}/run sample=0 to={out}"),
    "export navsim": Command(
        "factory export navsim out={made}/run missing=none map_location=us-ma-boston to={out} workers=2", goes_on=True
    ),
    "import simscale": Command("factory import simscale root={made}/navsim out={out} pictures=false", goes_on=True),
    "explain": Command(f"factory explain {TOWN} to={{out}}"),
    "vocabulary": Command("factory vocabulary kinematic=true k=64 out={out}/v.npy"),
    "scene": Command("factory scene export {made}/scene/block.safetensors to={out}"),
    "verify": Command("factory verify out={out}", "run"),
    "clean": Command("factory clean out={out} older_than=0h", "run"),
    "compact": Command("factory compact out={out}", "run"),
    "warm": Command("factory warm drive"),
    "completion": Command("factory completion bash"),
    "train": Command(
        "planners train planner=ego_mlp_small data.real=[{made}/run] data.sim=[{made}/run] steps=60 out={out}",
        goes_on=True,
    ),
    "import": Command(
        "planners import {made}/public/ltf.ckpt planner=ltf_public planner.settings.image.width=256"
        " planner.settings.image.height=64 out={out}"
    ),
    "evaluate": Command("planners evaluate benchmark={made}/benchmark planner={made}/train out={out}", goes_on=True),
    "compare": Command("planners compare a={made}/scores/constant_velocity b={made}/scores/pdm_closed out={out}/a.csv"),
    "serve": Command("planners serve planner={made}/train"),
    "submit": Command(
        "planners submit planner=constant_velocity split={made}/split/split.yaml logs={made}/split/navsim_logs/test"
        f" root={{made}}/split/navhard_two_stage out={{out}}/submission.pkl {SUBMISSION}"
    ),
    "drive": Command(
        "planners drive planner={made}/train clips.n_clips=1 clips.settings.cameras=[] clips.settings.lidar_beams=0"
        " perturbed=1 films=none executor=local workers=2 out={out}",
        goes_on=True,
    ),
    "replay": Command("planners replay benchmark={made}/benchmark planner=constant_velocity out={out}/a.mp4"),
}
ON_RAY = ("ray", "export ray", "drive ray", "train ray")
EVERY = tuple(name for name in COMMANDS if name not in ON_RAY)
GO_ON = tuple(name for name in EVERY if COMMANDS[name].goes_on)
WRITE = (*GO_ON, "report", "show", "export mcap", "export mp4", "explain", "vocabulary", "scene", "compact")
WRITE += ("import", "compare", "submit", "replay")
MADE: Mapping[str, str] = {  # folder -> the command that makes it, before all
    "run": f"{RUN.format(out='{made}/run')} executor=local",
    "navsim": "factory export navsim out={made}/run missing=none map_location=us-ma-boston to={made}/navsim",
    "train": "planners train planner=ego_mlp_small data.real=[{made}/run] data.sim=[{made}/run] steps=20"
    " out={made}/train",
    "benchmark": f"factory run {BENCHMARK} out={{made}}/benchmark",
    "scores": "planners evaluate benchmark={made}/benchmark planner=constant_velocity out={made}/scores",
}


def write_files(made: Path) -> None:
    """What no command makes: a scene, a public checkpoint, a split of NAVSIM's."""
    import torch

    from factory.stages.scene_file import write_scene
    from tests.factory.commands.test_scene_command import proper
    from tests.factory.stages.test_scene_file import scene
    from tests.planners.navsim.two_stage_files import log_frames, write_split
    from tests.planners.published.formula import inputs
    from tests.planners.published.ours import formula_weights
    from tests.planners.published.test_parity import recorded

    block, one = scene(), recorded("ltf")
    (made / "scene").mkdir()
    nodes = {name: proper(node) for name, node in block.nodes.items()}
    write_scene(made / "scene" / "block.safetensors", replace(block, background=proper(block.background), nodes=nodes))
    weights = formula_weights(one.names, inputs(*one.picture))
    (made / "public").mkdir()
    named = {f"agent._transfuser_model.{name}": value for name, value in weights.items()}
    torch.save({"state_dict": named, "global_step": 1}, made / "public" / "ltf.ckpt")
    write_split(made / "split", log_frames())


# Promises.


NO_HOME: dict[str, str | None] = {"HOME": None, "XDG_CACHE_HOME": None}
NO_USER = ("unshare", "--user", f"--map-user={NOBODY}", f"--map-group={NOBODY}")
ASCII = {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ENDED = (COMPLETE, INTERRUPTED)
BAD = (*ENDED, BAD_CONFIG)
NO_THREAD_DATA = 127  # glibc's, where a thread's own variables find no place
NONE_ANSWERS = f"{GOES_ON}|unset it"
RAN = ("run", "isolated", "train", "evaluate", "drive", "export navsim", "import simscale")
Same = partial(Row, each_once=True)  # the trouble is always the same: no command is tried twice
Disk = partial(Row, codes=BAD, needs_root=True)
ROWS: Mapping[str, Row] = {
    # What a command is started with.
    "no-home": Same(
        "without HOME, as a user whom the machine does not know",
        trouble.started_with(*NO_USER, **NO_HOME),
        EVERY,
        needs_root=True,
    ),
    "ascii": Same("with LANG=C and an output of ASCII alone", trouble.started_with(**ASCII), EVERY),
    "files": Same("with 64 open files", trouble.started_with("prlimit", "--nofile=64"), EVERY, BAD, "files"),
    # Where it is refused, Rust ends by SIGABRT, other native code by SIGSEGV, glibc by 127 and OpenBLAS by 1, each with
    # a line of its own, the latter without threads by raise(SIGINT).
    "memory": Same(
        "with 512 MB less memory than it takes",
        trouble.short_of_memory,
        EVERY,
        (*BAD, -signal.SIGABRT, -signal.SIGSEGV, DAMAGED, NO_THREAD_DATA),
        "(?i)memory|again|interrupted",
    ),
    "no-shm": Same("without /dev/shm", trouble.no_shared_memory, (*EVERY, "ray"), BAD, needs_root=True),
    "clock": Same("on a clock that jumps by hours and back", trouble.jumping_clock, EVERY),
    "no-reader": Same("with nobody who reads its output", trouble.started_with(stdout="nobody"), EVERY),
    "full-output": Same(
        "with its output into a file on a full disk", trouble.started_with(stdout="/dev/full"), EVERY, BAD
    ),
    # Disks.
    "read-only": Disk("where out is read-only", trouble.read_only_out, EVERY, each_once=True),
    "another-user": Disk("where out is another user's", trouble.of_another_user, EVERY, each_once=True),
    "full-out": Disk("where out fills up", trouble.full("out", 2**21), WRITE),
    "full-cache": Disk("where the cache fills up", trouble.full("XDG_CACHE_HOME", 2**22), RAN),
    "full-tmp": Disk("where the temporary folder fills up", trouble.full("TMPDIR", 2**22), RAN),
    # Signals.
    "sigint": Row("Ctrl-C ends any command with 4", trouble.signalled(SIGINT), EVERY, ENDED, "again|interrupted"),
    "sigterm": Row("SIGTERM: what goes on ends with 4", trouble.signalled(SIGTERM), GO_ON, (*ENDED, -SIGTERM)),
    "sighup": Row("a terminal that closes, alike", trouble.signalled(SIGHUP), GO_ON, (*ENDED, -SIGHUP)),
    "sigquit": Row("Ctrl-\\ ends it at once", trouble.signalled(SIGQUIT), EVERY, (COMPLETE, -SIGQUIT)),
    "sigkill": Row("SIGKILL, alike", trouble.signalled(SIGKILL), EVERY, (COMPLETE, -SIGKILL)),
    "stop": Row("stopped for 3 s it goes on", trouble.signalled(signal.SIGSTOP, signal.SIGCONT), EVERY),
    # Peers.
    "guard": Row("its guard dies", trouble.losing("guard"), ("run", "isolated")),
    "isolated": Row("the process for plug-ins dies", trouble.losing("child"), ("isolated",)),
    "child": Row(
        "a process that it has begun dies",
        trouble.losing("child"),
        ("drive", "export navsim"),
        ENDED,
    ),
    "two-drivers": Row(
        "another driver begins on its out, and wins", trouble.another_driver("run"), ("run",), ENDED, ""
    ),
    "dashboard-clients": Row("clients of the dashboard leave", trouble.clients_leave, ("dashboard",)),
    "serve-clients": Row(
        "who asks planners serve leaves", trouble.half_questions, ("serve",), (COMPLETE, BAD_CONFIG), "error"
    ),
    # Ray.
    "ray-worker": Row("on Ray: a worker dies", trouble.losing("worker"), ("ray",)),
    "ray-agent": Row("an agent of its node dies", trouble.losing("agent"), ("ray",)),
    "ray-raylet": Row("its raylet dies: a new cluster", trouble.losing("raylet"), ("ray",)),
    "ray-gcs": Row("its GCS dies: a new cluster", trouble.losing("gcs"), ("ray",)),
    "ray-sigterm": Row("SIGTERM ends it with 4", trouble.signalled(SIGTERM), ("ray",), (*ENDED, -SIGTERM)),
    "ray-sigkill": Row("SIGKILL ends all of it", trouble.signalled(SIGKILL), ("ray",), (-SIGKILL,)),
    "ray-tmp": Disk("Ray's temporary folder fills up", trouble.full("RAY_TMPDIR", 2**25, 2**16), ("ray",)),
    "ray-store": Disk("the object store's disk fills up", trouble.full("shm", 2**27, 2**20), ("ray",)),
    "ray-and-local": Row(
        "a local driver begins on the out of one on Ray", trouble.another_driver("run"), ("ray",), ENDED, ""
    ),
    "local-and-ray": Row("and one on Ray on that of a local one", trouble.another_driver("ray"), ("run",), ENDED, ""),
    # Bad config where none answers any more when the run comes to it.
    "head": Row("the head node of a standing cluster dies", trouble.losing_a_node("head"), ON_RAY, BAD, NONE_ANSWERS),
    "node": Row("one node of two dies", trouble.losing_a_node("second"), ("ray",), BAD),
    "head-raylet": Row("its raylet alone", trouble.losing_a_node("raylet"), ON_RAY, BAD, NONE_ANSWERS),
    "head-gcs": Row("its GCS alone", trouble.losing_a_node("gcs"), ON_RAY, BAD, NONE_ANSWERS),
}


def main(
    rows: Sequence[str] = (),
    trials: int = 10,
    seed: int = 0,
    folder: str = "",
    keep: bool = False,
) -> int:
    """Prints the table; how many rows did not hold. folder: where to work, and what is made once is kept."""
    asked = [row.partition(":")[::2] for row in rows or ROWS]
    for unknown in {name for name, _ in asked} - {*ROWS} | {only for _, only in asked} - {"", *COMMANDS}:
        raise SystemExit(f"there is no {unknown}: rows are {', '.join(ROWS)}; commands {', '.join(COMMANDS)}")
    trouble.become_parent_of_orphans()
    for number in (SIGINT, SIGHUP, SIGQUIT):  # a shell's background ignores some, and commands would as well
        signal.signal(number, signal.default_int_handler)
    wrong = 0
    with tempfile.TemporaryDirectory(prefix="outside-", dir="/tmp") as own:
        root = Path(folder or own)
        (root / "made").mkdir(parents=True, exist_ok=True)
        place = root / "made" / "place"  # what is made names files by it
        if place.exists() and place.read_text() != str(root):
            raise SystemExit(f"{root} was made as {place.read_text()} and cannot be moved: remove it")
        place.write_text(str(root))
        may_mount = trouble.use_own_mounts()
        harness = Harness(root, COMMANDS, MADE, write_files, random.Random(seed), keep)
        print("| promise | trials | held | CPU s |\n|---|---|---|---|", flush=True)
        for name, only in asked:
            if ROWS[name].needs_root and not may_mount:
                print(f"{name} needs root and is left out", file=sys.stderr)
                continue
            made, held, used = harness.row(name, ROWS[name], trials, only)
            wrong += held < made or not made
            share = f"{100 * held // made} %" if made else "never in time"
            print(f"| {ROWS[name].promise} (`{name}`) | {made} | {share} | {used:.0f} |", flush=True)
    return wrong


def _typed(words: Sequence[str]) -> dict[str, Any]:
    kinds: dict[str, Callable[[str], Any]] = {
        "trials": int,
        "seed": int,
        "folder": str,
        "keep": lambda text: text == "true",
    }
    split = partial(str.split, sep=",")
    return {key: kinds.get(key, split)(value) for key, _, value in (word.partition("=") for word in words)}


if __name__ == "__main__":
    sys.exit(bool(main(**_typed(sys.argv[1:]))))
