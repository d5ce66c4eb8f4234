"""Commands that look at a run: status, failed, lineage, show, explain, report, dashboard."""

import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from factory.config.arguments import POSITIONAL, RUN_SETTINGS, Refused
from factory.config.run import compose_run, typed_run_config
from factory.exits import COMPLETE, COMPLETE_WITH_FAILURES
from factory.views.sample_text import (
    find_sample_id,
    label_lines,
    labelled_trajectories,
    logged_drive,
    open_samples,
    sample_fact_lines,
)
from factory.views.sample_text import lineage as lineage_parts
from factory.views.status import failed_lines, open_store, status_lines

if TYPE_CHECKING:
    from factory.readers.base import ClipRef
    from factory.store.reader import SampleTable
    from factory.store.samples import Store


@dataclass(frozen=True)
class FolderRequest:
    """The command line."""

    out: str


def status(request: FolderRequest) -> None:
    """`python -m factory status out=<folder or URL>`: what a run holds, and how its newest start ended.

        python -m factory status out=runs/demo        tables, counts, acceptance funnel, the newest run

    One sample: python -m factory show.
    """
    for line in status_lines(open_store(request.out)):
        print(line, flush=True)


def failed(request: FolderRequest) -> None:
    """`python -m factory failed out=<folder or URL>`: failed attempts: file, field, message, how to retry."""
    print("\n".join(failed_lines(open_store(request.out))))


@dataclass(frozen=True)
class LineageRequest:
    """The command line."""

    out: str
    sample: str = field(metadata=POSITIONAL)


def lineage(request: LineageRequest) -> None:
    """`python -m factory lineage out=<folder or URL> sample=<id>`: where a sample, or any other attempt, comes from.

        python -m factory lineage 3fa9 out=runs/demo            an id, the beginning of one, or an ordinal
        python -m factory lineage sample=0 out=s3://bucket/samples

    Run -> clip -> candidate -> attempt -> sample, with digests, versions and files.
    """
    for title, facts in lineage_parts(open_store(request.out), request.sample):
        print(title)
        for name, value in facts:
            if value not in (None, ""):
                print(f"  {name:<18}{value}")


@dataclass(frozen=True)
class ShowRequest:
    """The command line."""

    out: str
    sample: str | None = field(default=None, metadata=POSITIONAL)  # attempt_id, its beginning, or an ordinal
    list: bool = False  # the ids, one a line, and no sample
    to: str | None = None  # folder or .png of the picture
    film: bool = False  # beside the picture
    vocabulary: str | None = None  # .npy that the labels are of; without it the kinematic one, where they are of that

    def __post_init__(self) -> None:
        if (self.sample is not None) == self.list:
            raise ValueError("choose one of sample=<id> and list=true; python -m factory status shows the run")
        if self.list and (self.to is not None or self.film or self.vocabulary is not None):
            raise ValueError("to=, film= and vocabulary= are of sample=; give sample= too, without list=true")


def show(request: ShowRequest) -> None:
    """`python -m factory show out=<folder or URL> sample=<id>`: one sample: numbers, a picture, a film.

        python -m factory show out=runs/demo list=true        sample ids, one a line
        python -m factory show out=runs/demo sample=0         one sample: numbers, and a picture in the current folder
        python -m factory show 3fa9 out=runs/demo             the same by its id, or the beginning of it
        python -m factory show out=runs/demo sample=0 to=x.png    ... the picture there (a folder, or a .png file)
        python -m factory show out=runs/demo sample=0 film=true   ... and a film of it beside the picture (.mp4)
        python -m factory show out=runs/av2 sample=0 vocabulary=human.npy   ... with the labelled trajectories by score

    The run as a whole: python -m factory status. Where the block's scene is still in the run's cache, a sample's
    picture also shows the log's photos, the scene from the same poses, and the sample's now as seen from up to 2 m to
    either side.
    """
    store = open_store(request.out)
    table, which = open_samples(store), request.sample
    for line in table.attempt_ids if which is None else draw_and_describe_sample(store, table, which, request):
        print(line, flush=True)


def draw_and_describe_sample(store: "Store", table: "SampleTable", which: str, request: ShowRequest) -> Iterator[str]:
    """One sample's numbers; writes its picture and says where it is."""
    from factory.views.pictures import encode_image, sample_sheet
    from factory.views.rendered_again import (
        load_scene,
        photos_and_renderings_sheet,
        sample_film,
        scene_digest_of,
        stack_vertically,
    )

    attempt_id = find_sample_id(table, store, which)
    row = table[attempt_id]
    target = Path(request.to or ".")
    is_png = target.suffix.lower() == ".png"
    if target.suffix and not is_png and not target.is_dir():
        raise Refused(f"to={request.to}: the picture is a PNG; name a file ending in .png, or a folder")
    path = target if is_png else target / f"sample_{attempt_id}.png"
    drawn = labelled_trajectories(row, request.vocabulary)
    yield from sample_fact_lines(row)
    yield from label_lines(row, drawn is not None)
    logged = logged_drive(store, row["clip_id"], row["settings_hash"])
    sheets = [sample_sheet(row, logged, vocabulary=drawn)]
    digest = scene_digest_of(store, row)
    scene = None if digest is None else load_scene(store, digest)
    if digest is not None and scene is None:
        yield f"              scene {digest} is not in the run's cache: nothing is rendered anew"
    if scene is not None and (again := photos_and_renderings_sheet(store, row, scene)) is not None:
        sheets.append(again)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_image(stack_vertically(sheets), ".png"))
        yield f"picture       {path.resolve()}"
        if request.film:
            from factory.views.pictures import write_mp4

            write_mp4(path.with_suffix(".mp4"), sample_film(row, scene, logged))
            yield f"film          {path.with_suffix('.mp4').resolve()}"
    except OSError as error:
        raise Refused(f"to={request.to or '.'}: the picture cannot be written: {error}") from error


@dataclass(frozen=True)
class ExplainRequest:
    """The command line."""

    clip: str = "0"  # clip id or its beginning, or the clip's place in the reader's list
    expert: str = "pdm_closed"
    tries: int = 6  # candidates to try before giving up on an accepted one
    to: str = "explain"  # folder for the pictures
    settings: tuple[str, ...] = field(default=(), metadata=RUN_SETTINGS)


MOST_REPAIRS = 20  # one by one, the others are counted


def explain(request: ExplainRequest) -> int:
    """`python -m factory explain clip=... expert=...`: why one clip gives the samples it gives.

    Runs ONE clip in this process: what was repaired in its log, the candidates over the grid and why each fell, every
    attempt of the walk with its sub-scores, and the last attempt's two rollouts as a picture and a film. Takes the
    settings of `python -m factory.run`.

        python -m factory explain clips=av2 clips.root=<logs> clip=0 expert=recovery
        python -m factory explain preset=demo clip=3fa9 tries=20 to=looks    an id, its beginning or a place in the list

    Exit code 3: the clip cannot be read.
    """
    from factory.readers.base import BadClip

    try:
        _explain_clip(request)
    except BadClip as error:
        print(f"bad clip: {error}", file=sys.stderr)
        return COMPLETE_WITH_FAILURES
    return COMPLETE


def clip_named(refs: Sequence["ClipRef"], wanted: str) -> "ClipRef":
    """The clip of that id, beginning of an id, or place in the list. Raises Refused."""
    if wanted.isdigit() and int(wanted) < len(refs):
        return refs[int(wanted)]
    found = [ref for ref in refs if ref.clip_id.startswith(wanted)]
    if len(found) != 1:
        raise Refused(f"clip={wanted}: {len(found)} of {len(refs)} clips fit; give an id or a number below the count")
    return found[0]


def _explain_clip(request: ExplainRequest) -> None:
    """Compose the settings, run the clip, print and draw."""
    import cv2

    from factory.graph.plan import candidate_order
    from factory.setup.settings import assemble
    from factory.views.pictures import attempt_picture, candidates_picture, rollout_film, write_mp4
    from tasks.stages import Rejected
    from tasks.subscores import OF_ONE_PLAN
    from tasks.world.repair.records import counts_text, repair_counts, repair_lines

    expert, to = request.expert, Path(request.to)
    config = typed_run_config(compose_run(request.settings) | {"experts": [expert]})
    run = assemble(config)
    ref = clip_named((*run.index.refs, *run.index.broken), request.clip)
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
    if clip.repairs:
        print(f"repaired: {counts_text(repair_counts(clip.repairs))}")
        print("\n".join(f"  {line}" for line in repair_lines(clip.repairs, MOST_REPAIRS)))
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
            write_mp4(Path(f"{stem}.mp4"), rollout_film(clip, shown.candidate, shown.judged))
    written = ", ".join(str(path) for path in sorted(to.glob(f"{stem.name}*")))
    print(f"{time.perf_counter() - began:.1f} s; look at {written}")


@dataclass(frozen=True)
class ReportRequest:
    """The command line."""

    out: str
    to: str | None = None  # another file; null: in the run's folder, with the card


def report(request: ReportRequest) -> None:
    """`python -m factory report out=<folder or URL>`: a run as one HTML file, for sharing.

        python -m factory report out=runs/demo                  writes runs/demo/report.html and, beside it, README.md,
                                                                the data set's card, as a run does at its end
        python -m factory report out=s3://bucket/samples to=run.html

    It is the dashboard with its answers and some pictures inside: the same page, the same numbers, nothing fetched.
    """
    from factory.views.board.report import write_report
    from factory.views.card import write_card

    store = open_store(request.out)
    print(write_report(store, request.to))
    if request.to is None:
        print(write_card(store))


@dataclass(frozen=True)
class DashboardRequest:
    """The command line."""

    out: str
    port: int = 8266  # 0: any free one; Ray's own dashboard is at 8265
    host: str = "127.0.0.1"  # 0.0.0.0: for others too

    def __post_init__(self) -> None:
        if self.port >= 2**16:
            raise ValueError(f"port={self.port}: must be a number below 65536, 0 for any free one")


def dashboard(request: DashboardRequest) -> None:
    """`python -m factory dashboard out=<folder or URL>`: a live page of a run, in the browser.

        python -m factory dashboard out=runs/demo               then open the address that it prints
        python -m factory dashboard out=s3://bucket/samples port=9000
        python -m factory dashboard out=runs/demo host=0.0.0.0  for others too: who reaches the port sees the data

    Works while a run goes on, and after it; it only reads. Ctrl-C ends it.
    """
    from factory.views.board.server import LOOPBACK, Board, Server

    store = open_store(request.out)
    board = Board(store)
    try:
        server = Server(board, request.host, request.port)
    except OSError as error:
        raise Refused(f"host={request.host} port={request.port}: {error}; choose another port=") from error
    print(f"reading {store.location.uri}", flush=True)
    board.answer("/api/overview")  # now, not when the page is opened
    host = f"[{request.host}]" if ":" in request.host else request.host
    print(f"{store.location.uri} is shown at http://{host}:{server.server_address[1]}/ until Ctrl-C", flush=True)
    if request.host not in LOOPBACK:
        print("warning: everyone who reaches this port sees the run's data and pictures; there is no password")
    with server, suppress(KeyboardInterrupt):
        server.serve_forever()
    print()
