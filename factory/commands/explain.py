"""`python -m factory explain clip=... expert=...`: why one clip gives the samples it gives.

Runs ONE clip in this process: the candidates over the grid and why each fell, every attempt of the walk with its
sub-scores, and the last attempt's two rollouts as a picture and a film. Takes the settings of `python -m factory.run`.

    python -m factory explain clips=av2 clips.root=<logs> clip=0 expert=recovery
    python -m factory explain preset=demo clip=3fa9 tries=20 to=looks     an id or its beginning, or a place in the list

Exit code 3: the clip cannot be read.
"""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from factory.config.arguments import RUN_SETTINGS, Refused
from factory.config.run import composed_run, run_config
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES

if TYPE_CHECKING:
    from factory.readers.base import ClipRef


@dataclass(frozen=True)
class Request:
    """The command line."""

    clip: str = "0"  # clip id or its beginning, or the clip's place in the reader's list
    expert: str = "pdm_closed"
    tries: int = 6  # candidates to try before giving up on an accepted one
    to: str = "explain"  # folder for the pictures
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS)


def main(request: Request) -> int:
    """Explain the clip; the exit code."""
    from factory.readers.base import BadClip

    try:
        explain(request)
    except BadClip as error:
        print(f"bad clip: {error}", file=sys.stderr)
        return COMPLETE_WITH_FAILURES
    return COMPLETE


def find(refs: Sequence["ClipRef"], wanted: str) -> "ClipRef":
    """The clip of that id, beginning of an id, or place in the list. Raises Refused."""
    if wanted.isdigit() and int(wanted) < len(refs):
        return refs[int(wanted)]
    found = [ref for ref in refs if ref.clip_id.startswith(wanted)]
    if len(found) != 1:
        raise Refused(f"clip={wanted}: {len(found)} of {len(refs)} clips fit; give an id or a number below the count")
    return found[0]


def explain(request: Request) -> None:
    """Compose the settings, run the clip, print and draw."""
    import cv2

    from factory.graph.plan import candidate_order
    from factory.setup.settings import assemble
    from factory.views.bev import attempt_picture, candidates_picture, film, write_mp4
    from tasks.stages import Rejected
    from tasks.subscores import OF_ONE_PLAN

    expert, to = request.expert, Path(request.to)
    config = run_config(composed_run(request.settings) | {"experts": [expert]})
    run = assemble(config)
    ref = find((*run.index.refs, *run.index.broken), request.clip)
    work = run.work
    began = time.perf_counter()
    made = work.read_and_perturb(ref)
    if isinstance(made, Rejected):
        print(f"clip {ref.clip_id}: log {ref.log_id} at {ref.start_ms / 1000:.1f} s")
        print(f"rejected by {made.stage}: {made.reason}: {made.detail}")
        return
    clip, found = made.clip, made.found
    print(
        f"clip {ref.clip_id}: log {ref.log_id} at {ref.start_ms / 1000:.1f} s, {clip.split}, {len(clip.agents)} tracks"
    )
    to.mkdir(parents=True, exist_ok=True)
    stem = to / f"{ref.clip_id}_{expert}"

    if isinstance(found, Rejected):
        print(f"no candidates: rejected by {found.stage}: {found.reason}: {found.detail}")
        if not work.once(expert):
            return
    else:
        print("dropped by gate: " + ", ".join(f"{gate} {count}" for gate, count in found.gate_counts.items()))
        fates = Counter(found.considered.fate)
        print("gated trajectories: " + ", ".join(f"{fate} {count}" for fate, count in fates.most_common()))
        cv2.imwrite(f"{stem}_candidates.png", candidates_picture(clip, found.considered)[..., ::-1])

    prepared = work.prepared_clip(ref, made)
    order = candidate_order(work.once(expert), min(request.tries, len(made.candidates)))
    shown = None
    for candidate in order:
        trace = work.trace(prepared, candidate, expert)
        end = (
            ""
            if trace.candidate is None
            else "  end x {:+6.2f} y {:+5.2f} m {:+5.1f} deg".format(
                *trace.candidate.end_pose[:2], trace.candidate.end_pose[2] * 57.29578
            )
        )
        rejected = trace.rejected or work.unfit(clip, trace)
        verdict = "accepted" if rejected is None else f"rejected by {rejected.stage}: {rejected.detail}"
        print(f"candidate {candidate:2d}{end}  {verdict}")
        if trace.judged is not None:
            shown = trace
            scores = trace.judged.scores
            named = [f"{name} {getattr(scores, name)[1]:.2f}" for name in OF_ONE_PLAN]
            print(f"    EPDMS {scores.pdm_score[1]:.3f}  " + "  ".join(named))
        if rejected is None:
            break
    else:
        left = len(made.candidates) - len(order)
        if not work.once(expert) and left > 0:
            n = len(made.candidates)
            print(f"none accepted: stopped after {len(order)} of {n} candidates, tries={n} goes on to the last")
    if shown is not None and shown.judged is not None:
        title = f"{expert}: {'accepted' if shown.rejected is None else shown.rejected.detail}"
        picture = attempt_picture(clip, shown.candidate, shown.judged, title, (720, 720))
        cv2.imwrite(f"{stem}_rollouts.png", picture[..., ::-1])
        if shown.candidate is not None:
            write_mp4(Path(f"{stem}.mp4"), film(clip, shown.candidate, shown.judged))
    written = ", ".join(str(path) for path in sorted(to.glob(f"{stem.name}*")))
    print(f"{time.perf_counter() - began:.1f} s; look at {written}")
