"""The dashboard's answers are what the tables hold, also while a run goes on; nothing else can be asked out of it."""

import http.client
import io
import json
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factory.commands.table import COMMANDS
from factory.config.run import load_config
from factory.graph.progress import Outlook, ProgressLine, RunCounts
from factory.setup.settings import assemble
from factory.store.reader import SampleTable
from factory.store.samples import QUIET_S, Store
from factory.views.board.overview import overview
from factory.views.board.server import SERVED, STATIC, Board, Server
from factory.views.board.watch import Watch
from factory.views.pictures import crop_to_60_m, encode_image, sample_bev
from factory.views.sample_text import logged_drive
from tasks.caches import json_with_checksum, parse_json_with_checksum
from tests.factory.toy import executed
from tests.factory.views.board.runs import VIEW, counted, run, told

main = COMMANDS["dashboard"].load()
export_main = COMMANDS["export"].load()
status_main = COMMANDS["status"].load()


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    assert run(folder).exit_code == 3
    return folder


@pytest.fixture(scope="module")
def board(out: Path) -> Board:
    return Board(Store(out), look_every_s=0.0)


def get(board: Board, target: str, status: int = 200) -> Any:
    answer = board.answer(target)
    assert answer.status == status, answer.body
    return json.loads(answer.body)


@pytest.mark.slow
def test_the_numbers_are_those_of_the_tables(out: Path, board: Board) -> None:
    answer = get(board, "/api/overview")
    assert told(answer) == counted(out)
    assert answer["state"]["word"] == "complete, with failed attempts"
    assert (
        answer["steps"][0]["left"] - sum(step["dropped"] for step in answer["steps"]) == (answer["steps"][-1]["left"])
    )
    assert answer["steps"][-1]["left"] == answer["counts"]["simulated"]
    assert sum(answer["throughput"]["samples"]) == answer["counts"]["samples"]
    ends = [
        row["candidate_end"] for row in Store(out).samples.read(["candidate_end"]).to_pylist() if row["candidate_end"]
    ]
    inside = sum(abs(end[0]) <= 20 and abs(end[1]) <= 2 for end in ends)
    assert np.sum(answer["coverage"]["accepted"]) == inside


@pytest.mark.slow
def test_the_numbers_are_those_of_the_tables_while_a_run_goes_on(tmp_path: Path) -> None:
    board = Board(Store(tmp_path), look_every_s=0.0)
    seen: list[tuple[dict[str, Any], dict[str, Any]]] = []

    def watching() -> None:  # what it raised would only be a failed attempt
        before = counted(tmp_path)
        answer = get(board, "/api/overview")
        if counted(tmp_path) == before:  # no commit in between
            seen.append((before, answer))

    run(tmp_path, 2, watching)
    assert seen[-1][0]["samples"] > seen[0][0]["samples"]
    for tables, answer in seen:
        assert told(answer) == tables
        assert answer["state"]["live"] and answer["state"]["word"] == "running"
        assert not answer["notes"] and answer["planned"]["planned"] == 6 * (2 + 2 + 1)
    answer = get(board, "/api/overview")
    assert told(answer) == counted(tmp_path) and not answer["state"]["live"]
    run(tmp_path, 3)
    assert told(get(board, "/api/overview")) == counted(tmp_path)


def test_a_run_that_has_only_begun_is_shown(tmp_path: Path) -> None:
    Store(tmp_path).begin_run([])
    board = Board(Store(tmp_path), look_every_s=0.0)
    answer = get(board, "/api/overview")
    assert told(answer) == counted(tmp_path) and answer["counts"]["samples"] == 0
    assert get(board, "/api/samples?simulated=1")["items"] == [] == get(board, "/api/failed")["items"]
    get(board, "/api/samples/nobody", 404)


def test_a_run_that_went_silent_is_said_to_be_quiet_and_to_have_no_end_in_sight(tmp_path: Path) -> None:
    run(tmp_path, 1, n=2)
    shot = Watch(Store(tmp_path)).snapshot()
    began = shot.run.current["began_ms"]
    assert shot.run.last["began_ms"] == began and not shot.run.goes_on
    (tmp_path / "last_run.json").unlink()
    shot = Watch(Store(tmp_path)).snapshot()
    last_s = max(shot.last_commit_ms, shot.run.current["said_ms"]) / 1000.0
    soon, late = (overview(shot, "", last_s + waited) for waited in (1.0, QUIET_S + 1.0))
    assert (soon["state"]["word"], late["state"]["word"]) == ("running", "quiet")
    assert (soon["state"]["left"], late["state"]["left"]) == ("0 s", None) and soon["planned"]["pending"] == 0


def test_a_run_over_a_stopped_one_is_running_and_its_time_left_is_that_of_its_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path, 1, n=2)
    old = parse_json_with_checksum((tmp_path / "last_run.json").read_bytes()) | {
        "exit_code": 4,
        "message": "interrupted; run again",
    }
    (tmp_path / "last_run.json").write_text(json_with_checksum(old))

    def words() -> str:
        status_main([f"out={tmp_path}"])
        answer = overview(Watch(Store(tmp_path)).snapshot(), "", time.time())
        return f"{answer['state']} {answer['notes']} {capsys.readouterr().out}"

    assert "interrupted" in (ended := words()) and "running" not in ended
    told: list[Outlook] = []
    line = ProgressLine(10, lambda elapsed_s: 3077.0, stream := io.StringIO(), note=told.append)
    line.show(RunCounts(2), last=True)
    begun = {"began_ms": old["began_ms"] + 1, "command": None} | asdict(told[0])
    (tmp_path / "current_run.json").write_text(json_with_checksum(begun))
    assert "interrupted" not in (going := words()) and "running" in going
    assert "'left': '51 min'" in going and "ETA 51 min" in going and "ETA 51 min" in stream.getvalue()
    never_began = old | {"began_ms": 0, "ended_ms": begun["began_ms"] + 1}
    (tmp_path / "last_run.json").write_text(json_with_checksum(never_began))
    assert "interrupted" in (ended := words()) and "running" not in ended


def test_the_gallery_holds_every_sample_once_and_filters(out: Path, board: Board) -> None:
    rows = Store(out).samples.read(["attempt_id", "expert", "round", "stage2_score"]).to_pylist()
    pages = [get(board, f"/api/samples?page={n}&size=4") for n in range(1, -(-len(rows) // 4) + 1)]
    assert sorted(item["attempt_id"] for page in pages for item in page["items"]) == sorted(
        r["attempt_id"] for r in rows
    )
    assert {page["total"] for page in pages} == {len(rows)} and pages[0]["pages"] == len(pages)
    times = [item["written_ms"] for page in pages for item in page["items"]]
    assert times == sorted(times, reverse=True)
    some = get(board, "/api/samples?expert=recovery&round=1&size=60")["items"]
    wanted = {r["attempt_id"] for r in rows if r["expert"] == "recovery" and r["round"] == 1}
    assert {item["attempt_id"] for item in some} == wanted
    worst = [item["stage2_score"] for item in get(board, "/api/samples?order=worst&size=60")["items"]]
    assert worst == sorted(worst)
    simulated = get(board, "/api/samples?simulated=1&size=60")["items"]
    assert {i["attempt_id"] for i in simulated} == {r["attempt_id"] for r in rows if r["expert"] != "human"}
    assert get(board, "/api/samples?page=99")["items"] == []


def test_a_sample_s_page_has_its_scores_its_lineage_and_its_siblings(out: Path, board: Board) -> None:
    table, store = SampleTable(out), Store(out)
    outcomes = [o for o in store.outcomes.read().to_pylist() if o["kind"] != "exhausted"]
    for attempt_id in table.attempt_ids:
        row, whole = table[attempt_id], get(board, f"/api/samples/{attempt_id}")
        for one in whole["scores"]:
            assert (one["stage1"], one["stage2"]) == (row[f"stage1_{one['name']}"], row[f"stage2_{one['name']}"])
        assert whole["lineage"]["content_digest"] == row["content_digest"]
        walk = (row["clip_id"], row["expert"])
        fell = {o["attempt_id"]: f"{o['stage']}.{o['reason']}" for o in outcomes if (o["clip_id"], o["expert"]) == walk}
        shown = {s["attempt_id"]: s["reason"] for s in whole["siblings"] if s["kind"] == "rejected"}
        assert shown == {key: why for key, why in fell.items() if why != "."}
        lists = {r["clip_id"]: r["candidates"] for r in store.candidates.read(["clip_id", "candidates"]).to_pylist()}
        if row["candidate_index"] >= 0:
            ends = {s["candidate_index"]: s["end_x_m"] for s in whole["siblings"]}
            assert ends == {c["index"]: c["end_x"] for c in lists[row["clip_id"]]}
    order = [item["attempt_id"] for item in get(board, "/api/samples?size=60")["items"]]
    middle = get(board, f"/api/samples/{order[1]}")
    assert (middle["newer"], middle["older"]) == (order[0], order[2])


def test_failed_attempts_are_shown_with_their_errors(out: Path, board: Board) -> None:
    failed = [o for o in Store(out).outcomes.read().to_pylist() if o["kind"] == "failed"]
    shown = get(board, "/api/failed")
    assert {(f["attempt_id"], f["error"]) for f in shown["items"]} == {(o["attempt_id"], o["error"]) for o in failed}
    assert shown["total"] == len(failed) == 2 and all(f["retry"] for f in shown["items"])


def test_pictures_are_those_of_the_row(out: Path, board: Board) -> None:
    attempt_id = SampleTable(out).attempt_ids[0]
    image = board.answer(f"/picture/{attempt_id}/front.jpg?v=1")
    assert (image.status, image.kind, image.body) == (200, "image/jpeg", VIEW) and "immutable" in image.cache
    images = get(board, f"/api/samples/{attempt_id}")["images"]
    stored = SampleTable(out)[attempt_id]["images"]
    for one in images:
        answer = board.answer(f"/picture/{attempt_id}/{one['index']}.jpg")
        assert answer.body == stored[one["index"]]["jpeg"]
    drawn = cv2.imdecode(np.frombuffer(board.answer(f"/picture/{attempt_id}/bev.jpg").body, np.uint8), cv2.IMREAD_COLOR)
    assert drawn.shape == (300, 300, 3) and drawn.std() > 1
    get(board, f"/picture/{attempt_id}/{len(images)}.jpg", 404)
    get(board, f"/picture/{attempt_id}/bev.jpg?size=9999", 400)
    get(board, f"/picture/{attempt_id}/bev.jpg?step=56", 400)


@pytest.mark.slow
def test_the_whole_logged_drive_is_in_the_picture_and_the_episode_where_the_prepared_clip_is_there(
    tmp_path: Path,
) -> None:
    made = [
        "clips=synthetic_towns",
        f"clips.cache_dir={tmp_path / 'towns'}",
        "clips.n_towns=1",
        "clips.logs_per_town=1",
    ]
    made += ["clips.settings.cameras=[]", "clips.settings.lidar_beams=0", "render=none", "vocabulary.k=2000"]
    work = assemble(load_config([*made, "experts=[pdm_closed]", f"out={tmp_path / 'out'}"])).work
    store = Store(tmp_path / "out")
    executed(work, work.reader.index().refs[:1], ["pdm_closed"], 1, store)
    table = SampleTable(tmp_path / "out")
    row = table[table.attempt_ids[0]]
    drive = logged_drive(store, row["clip_id"], row["settings_hash"])
    assert drive is not None and len(drive) == 81
    shown = {}
    for name, logged in (("whole", drive), ("joined", None)):
        shown[name] = encode_image(crop_to_60_m(sample_bev(row, logged, (800, 800), legend=False)))
    target = f"/picture/{row['attempt_id']}/bev.jpg?size=600"
    assert shown["whole"] != shown["joined"]
    assert Board(store).answer(target).body == shown["whole"]
    small = encode_image(crop_to_60_m(sample_bev(row, None, (400, 400), legend=False)))
    assert Board(store).answer(target.removesuffix("?size=600")).body == small, "a gallery reads no prepared clips"
    path = tmp_path / "one.mcap"
    assert export_main(["mcap", f"out={tmp_path / 'out'}", "sample=0", f"to={path}"]) == 0
    assert Board(store).answer(f"/episode/{row['attempt_id']}.mcap").body == path.read_bytes()
    shutil.rmtree(tmp_path / "out" / "cache")
    assert Board(store).answer(target).body == shown["joined"]


@pytest.mark.parametrize(
    "target, status",
    [
        ("/api/samples/nobody", 404),
        ("/api/samples/..%2F..%2Fetc%2Fpasswd", 404),
        ("/api/samples/../../etc/passwd", 404),
        ("/static/../server.py", 404),
        ("/static/..%2Fserver.py", 404),
        ("/static/", 404),
        ("/picture/nobody/bev.jpg", 404),
        ("/picture/..%2F/bev.jpg", 404),
        ("/episode/nobody.mcap", 404),
        ("/episode/..%2F..%2Fone.mcap", 404),
        ("/elsewhere", 404),
        ("/api/samples?page=0", 400),
        ("/api/samples?page=-1", 400),
        ("/api/samples?size=100000", 400),
        ("/api/samples?colour=red", 400),
        ("/api/samples?round=one", 400),
        ("/api/samples?order=random", 400),
        ("/api/failed?page=x", 400),
    ],
)
def test_what_is_not_there_is_refused_with_a_reason(board: Board, target: str, status: int) -> None:
    assert get(board, target, status)["error"]


def test_the_page_fetches_nothing_from_elsewhere() -> None:
    assert {"index.html", "board.css", "app.js"} <= set(SERVED)
    for path in STATIC.iterdir():
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "//" not in text.replace("\n// ", "\n").removeprefix("// ").replace(" // ", " "), path.name
        assert "innerHTML" not in text and "eval(" not in text


@pytest.fixture()
def served(board: Board) -> Iterator[tuple[str, int]]:
    with Server(board, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield "127.0.0.1", server.server_address[1]
        server.shutdown()
        thread.join()


def ask(at: tuple[str, int], method: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection(*at, timeout=20)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_over_http_only_get_is_answered_with_security_headers(served: tuple[str, int]) -> None:
    for path in ("/", "/static/board.css", "/api/overview"):
        status, headers, body = ask(served, "GET", path)
        assert status == 200 and len(body) == int(headers["Content-Length"])
        assert "default-src 'none'" in headers["Content-Security-Policy"] and "unsafe" not in str(headers)
        assert headers["X-Content-Type-Options"] == "nosniff"
    for method in ("POST", "PUT", "DELETE"):
        assert ask(served, method, "/api/overview")[0] == 501


def test_another_host_name_is_refused_on_loopback(served: tuple[str, int]) -> None:
    assert ask(served, "GET", "/api/overview", Host="localhost:80")[0] == 200
    status, _, body = ask(served, "GET", "/api/overview", Host="evil.example")
    assert status == 403 and b"evil.example" in body


def test_a_taken_port_is_said(out: Path, served: tuple[str, int], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"out={out}", f"port={served[1]}"]) == 2
    assert "choose another port" in capsys.readouterr().err
