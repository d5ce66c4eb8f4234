"""`README.md` of a run's `out`: a card of its data set, in the convention of Hugging Face, from the tables alone.

What it holds, from which logs and under which licence, how it was made, the acceptance funnel, and what it is not.
Written at the end of a run, interrupted ones too, and by `python -m factory report`.
"""

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from factory import __version__
from factory.store.funnel import Funnel, funnel_of_tables, funnel_tables
from factory.store.samples import FACTS, Kind, Store
from factory.store.schema import SCHEMA_VERSION
from factory.store.table import text_codes
from factory.views.status import STATUS, value_counts

FILE = "README.md"
MARK = "# written by python -m factory, and again by its next run"  # a README without it is the user's own
SOURCE = ["dataset", "licence", "split"]
COLUMNS = [*SOURCE, "log_id", "round", "image_source", "psnr", "tags"]  # beside those of the funnel
SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
LICENCES = {  # as a row's licence begins -> the identifier of the convention
    r"Apache-2\.0\b": "apache-2.0",
    r"CC BY-NC-SA 3\.0\b": "cc-by-nc-sa-3.0",
    r"CC BY-NC-SA 4\.0\b": "cc-by-nc-sa-4.0",
}


def write_card(store: Store) -> str:
    """Write the file; where it is, or why it is not written: a README.md that is not a card stays as it is."""
    there = store.location.read(FILE)
    where = f"{store.location.uri}/{FILE}"
    if there is not None and MARK.encode() not in there:
        return f"{where} is not a card of ours and stays as it is"
    store.location.write(FILE, card(store).encode())
    return where


def written_card(store: Store) -> str | None:
    """Where the card is; None where none of ours is there."""
    there = store.location.read(FILE)
    return f"{store.location.uri}/{FILE}" if there is not None and MARK.encode() in there else None


def card(store: Store) -> str:
    """The text: YAML front matter, then Markdown."""
    samples, outcomes, lists = funnel_tables(store, COLUMNS)
    live = set(store.samples.live_files())
    orphans = sum(name.endswith(".parquet") and name not in live for name in store.samples.location.names())
    parts = (
        _front_matter(samples, orphans),
        _overview_section(store, samples),
        _sources_section(samples),
        _settings_section(store),
        _acceptance_section(funnel_of_tables(samples, outcomes, lists, store.plans.read(), store.runs())),
        _limits_section(store, samples, outcomes, orphans),
    )
    return "\n".join(line for part in parts for line in part) + "\n"


def _front_matter(samples: pa.Table, orphans: int) -> Iterator[str]:
    licences = _values(samples, "licence")
    known = {name for text in licences for pattern, name in LICENCES.items() if re.match(pattern, text)}
    yield "---"
    yield MARK
    yield f"pretty_name: {json.dumps('Driving samples of ' + _datasets(samples), ensure_ascii=False)}"
    if len(licences) == 1 and len(known) == 1:
        yield f"license: {known.pop()}"
    elif licences:
        yield "license: other"
        yield f"license_name: {json.dumps('; '.join(licences), ensure_ascii=False)}"
    yield "task_categories:\n- robotics"
    yield "tags:\n- autonomous-driving\n- end-to-end-driving\n- motion-planning\n- synthetic"
    yield "size_categories:"
    yield "- " + next((name for limit, name in SIZES if samples.num_rows < limit), "n>10M")
    if samples.num_rows and not orphans:  # a pattern would take in files that no commit names
        yield "configs:\n- config_name: samples\n  data_files: samples/round=*/expert=*/*.parquet"
    yield "---"


def _overview_section(store: Store, samples: pa.Table) -> Iterator[str]:
    clips = len(_values(samples, "clip_id"))
    yield f"\n# Driving samples of {_datasets(samples)}\n"
    yield (
        f"{samples.num_rows:,} samples from {clips:,} clips for training end-to-end planners: history, map, agents, "
        "cameras and a 4 s label each."
    )
    yield (
        "`expert=human` is the logged drive; the others begin where no human drove, and a pseudo-expert drove on from "
        f"there in simulation. {_reward_gate_text(store)}"
    )
    yield f"\nThe run is {_state(store)}.\n"
    yield from _table(("expert", "round", "samples"), _counts(samples, ["expert", "round"]))
    yield (
        "\n`samples` is a Delta table of Parquet files, one sample a row; `outcomes` says what became of every other "
        "attempt, `candidates` which perturbations each clip has. Columns, units and frames stand in the factory's "
        f"docs/formats.md (schema version {SCHEMA_VERSION}).\n"
    )
    yield "```python\nfrom deltalake import DeltaTable\n"
    yield 'samples = DeltaTable("samples").to_pyarrow_dataset()  # the files that count\n```'


def _sources_section(samples: pa.Table) -> Iterator[str]:
    yield "\n## Where it comes from\n"
    yield "Every row carries the licence of its source; it covers what is made of it.\n"
    yield from _table((*SOURCE, "logs", "clips", "samples"), _counts(samples, SOURCE, ["log_id", "clip_id"]))


def _settings_section(store: Store) -> Iterator[str]:
    record = _newest_run_record(store)
    told = store.document(FACTS).get("facts", {})
    command = store.newest_run().current.get("command")
    yield "\n## How it was made\n"
    yield f"driving-data-factory {__version__}, settings `{record['settings_hash']}`."
    if command is not None:
        yield f"\n```\npython -m factory.run {_plain(' '.join(command))}\n```\n"
    if told:
        yield from _table(("", ""), list(told.items()))
    versions = ", ".join(f"{stage} {version}" for stage, version in sorted(record["stage_versions"].items()))
    yield f"\nStage versions: {versions}. Vocabulary digest: {record['vocabulary_digest']}.\n"
    yield "<details><summary>All settings</summary>\n"
    yield f"```json\n{json.dumps(record['settings'], indent=1, sort_keys=True)}\n```\n\n</details>"


def _acceptance_section(funnel: Funnel) -> Iterator[str]:
    yield "\n## Acceptance\n"
    yield f"{funnel.clips_prepared:,} clips prepared, {funnel.candidates:,} candidates.\n"
    if funnel.repaired.clips:
        yield f"In their logs: {_plain(funnel.repaired.text)}.\n"
    head = ("expert", "round", "tried", "accepted", "of attempts", "clips", "why not")
    rows = []
    for r in funnel.rows:
        why = ", ".join(f"{name} {n}" for name, n in r.reasons.items())
        share = f"{100.0 * r.attempt_rate:.1f} %" if r.tried else "-"
        rows.append((r.expert, r.round, r.tried, r.accepted, share, f"{r.clips} of {r.clips_before}", why))
    yield from _table(head, rows)


def _limits_section(store: Store, samples: pa.Table, outcomes: pa.Table, orphans: int) -> Iterator[str]:
    """What a user must know; each line only where it is so."""
    yield "\n## Known limits\n"
    simulated = samples.filter(pc.greater_equal(samples["candidate_index"], 0)).select(["image_source", "psnr"])
    sources = value_counts(simulated["image_source"])
    settings = _newest_run_record(store)["settings"]
    if simulated.num_rows:
        yield (
            f"- The labels of {simulated.num_rows:,} samples are simulated drives of a pseudo-expert, not of a human. "
            f"Other agents follow `traffic.mode={settings.get('traffic.mode', 'none')}`; who replays a log does not "
            "wait for the ego."
        )
    if "human" in _values(samples, "expert"):
        yield "- Human samples are scored and never filtered: some break the reward's rules."
    if rendered := sources.get("render", 0):
        psnr = pc.min_max(simulated["psnr"]).as_py()
        worst = "" if psnr["min"] is None else f", {psnr['min']:.1f} to {psnr['max']:.1f} dB on held-out photos"
        yield (
            f"- The pictures of {rendered:,} samples are rendered from reconstructed streets{worst}; "
            "surfaces that no sensor saw are filled in."
        )
    tags = pc.value_counts(pc.list_flatten(samples["tags"])).to_pylist()
    for found in (count["counts"] for count in tags if count["values"] == "photos_only"):
        yield f"- The pictures of {found:,} samples are drawn from photos without lidar, coarse (tag `photos_only`)."
    if drawn := sources.get("map", 0):
        yield f"- The pictures of {drawn:,} samples are drawn from the map, no photos."
    blind = pc.sum(pc.equal(samples["image_source"], "none")).as_py()
    if blind:
        yield f"- {blind:,} samples have no pictures."
    if any(name.startswith("synthetic") for name in _values(samples, "dataset")):
        yield "- `synthetic` is drawn test data: no real street, no real traffic."
    if (lines := len(_values(samples, "settings_hash"))) > 1:
        yield f"- Rows of {lines} different settings stand side by side (column `settings_hash`, file run.json)."
    if failed := value_counts(outcomes["kind"]).get(Kind.FAILED, 0):
        yield f"- {failed:,} attempts failed and are not in it (`python -m factory failed out=...`)."
    if orphans:
        yield f"- {orphans:,} files under `samples` belong to no commit: read the table, not the folder."
    if not samples.num_rows:
        yield "- There is no sample in it yet."


def _reward_gate_text(store: Store) -> str:
    """Which simulated drives became samples."""
    settings = _newest_run_record(store)["settings"]
    full, above = settings.get("reward.full", []), settings.get("reward.progress_above", -1.0)
    asked = [f"full marks in {', '.join(full).upper()}"] if full else []
    asked += [f"EP above {above}"] if above >= 0.0 else []
    ends = ["lead on along the route"] if settings.get("reward.off_route") else []
    ends += ["allow for a second after it without a collision"] if settings.get("reward.after") else []
    scored = f"Such a drive had to earn {' and '.join(asked)}." if asked else "No such drive was refused for its score."
    near = " One that is the log's own was left out." if settings.get("reward.near_log") else ""
    return f"{scored} Its end had to {' and '.join(ends)}.{near}" if ends else scored + near


def _newest_run_record(store: Store) -> dict[str, Any]:
    """The newest of run.json; one that says nothing where that file is lost."""
    lost = {"settings": {}, "settings_hash": "lost", "stage_versions": {}, "vocabulary_digest": "lost"}
    return (store.runs() or [lost])[-1]


def _state(store: Store) -> str:
    """How the newest run ended, in words; one that nothing has ended was killed or still goes on."""
    run = store.newest_run()
    if run.damaged:
        return f"of unknown state ({' and '.join(run.damaged)} not readable)"
    if run.goes_on:
        return "not finished: the same command goes on"
    return STATUS.get(run.last.get("exit_code", -1), ("not finished", ""))[0]


def _counts(samples: pa.Table, by: Sequence[str], distinct: Sequence[str] = ()) -> list[tuple[object, ...]]:
    """Of each group, in order: its values, the different values of other columns, its rows."""
    texts = {name: text_codes(samples[name]) for name in (*by, *distinct) if name != "round"}
    numbers = {name: texts[name][0] if name in texts else samples[name].to_numpy() for name in (*by, *distinct)}
    groups = (
        pa.table(numbers)
        .group_by(list(by))
        .aggregate([*((name, "count_distinct") for name in distinct), ([], "count_all")])
    )
    ordered = groups.sort_by([(name, "ascending") for name in by])
    values = (pa.array(texts[name][1]).take(ordered[name]) if name in texts else ordered[name] for name in by)
    counts = (ordered[name] for name in (*(f"{name}_count_distinct" for name in distinct), "count_all"))
    return list(zip(*(column.to_pylist() for column in (*values, *counts))))


def _values(samples: pa.Table, column: str) -> list[str]:
    """The different texts of a column, sorted."""
    return sorted(value_counts(samples[column]))


def _datasets(samples: pa.Table) -> str:
    return _plain(", ".join(_values(samples, "dataset"))) or "no data set yet"


def _plain(text: str) -> str:
    """One line without markup: names come from data."""
    return " ".join(text.split()).replace("<", "&lt;")


def _table(head: Sequence[str], rows: Sequence[Sequence[object]] | Sequence[tuple[str, str]]) -> Iterator[str]:
    yield _row(head)
    yield _row(["---"] * len(head))
    yield from map(_row, rows)


def _row(cells: Sequence[object]) -> str:
    def text(cell: object) -> str:
        shown = f"{cell:,}" if isinstance(cell, int) else str(cell)
        return _plain(shown).replace("|", "\\|")

    return f"| {' | '.join(map(text, cells))} |"
