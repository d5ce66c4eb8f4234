"""What a tree with the sub-score `sl` makes of it: keeps 15 m/s, weighs 3. Run by test_subscores in such a copy."""

from pathlib import Path

import numpy as np
import pyarrow as pa

from factory.stages.rows import label_columns, score_columns
from factory.store.funnel import funnel_of_tables
from factory.store.reader import labels_of
from factory.store.samples import CANDIDATES, OUTCOMES, PLANS, Kind
from factory.store.schema import COLUMNS as STORED
from factory.store.schema import SAMPLES
from factory.views.board.overview import _reasons
from factory.views.status import REASON_WORDS
from planners.data.batch import Needs
from planners.data.decode import BatchBuffer
from planners.models.gtrs_dense import TrajectoryScorer
from planners.models.settings import GtrsDenseSettings, Sizes
from tasks import subscores
from tasks.attempt import ExpertGate, verdict
from tasks.reward.aggregate import COLUMNS, columns_of
from tasks.reward.epdms import Scores, human_filtered, score, score_with_ec, select_rows
from tasks.reward.label_bytes import ARRAYS, N_PLANES, VocabularyLabels
from tasks.stages import STAGES
from tests.factory.store.formats import formats_table
from tests.tasks.reward.straight_street import drive, street
from tests.tasks.test_subscores import docs_table

ROOT = Path(__file__).resolve().parents[2]


def scored() -> Scores:
    """A drive at 8 m/s, one at 16: the best progress, and too fast from the first instant on."""
    scores = score(street(), np.concatenate([drive(8.0), drive(16.0)]))
    assert scores.sl.tolist() == [1.0, 0.0]
    assert scores.first_failures["sl"].tolist() == scores.sl_index.tolist() == [np.inf, 0.0]
    np.testing.assert_allclose(scores.pdm_score, [(5 * 0.5 + 5 + 2 + 2 + 3) / 17, (5 + 5 + 2 + 2) / 17], atol=1e-12)
    with_ec = score_with_ec(scores, np.ones(2))
    np.testing.assert_allclose(with_ec, [(5 * 0.5 + 5 + 2 + 2 + 3 + 2) / 19, (5 + 5 + 2 + 2 + 2) / 19], atol=1e-12)
    filtered = human_filtered(scores, select_rows(scores, [1]))  # the human drives too fast as well
    assert filtered.sl.tolist() == [1.0, 1.0] and filtered.pdm_score[1] == 1.0
    assert columns_of(scores, np.ones(2))[:, COLUMNS.index("sl")].tolist() == [1.0, 0.0]
    return scores


def stored(scores: Scores) -> None:
    """Label bytes and columns of both drives."""
    labels = VocabularyLabels("v", 20.0, **{name: getattr(scores, name) for name in ARRAYS})
    assert N_PLANES == 10
    columns = label_columns(labels)
    assert len(columns["label_subscores"]) == 10 + 4 and labels_of(columns).sl.tolist() == [1.0, 0.0]
    np.testing.assert_allclose(labels_of(columns).pdm_score("batch"), scores.pdm_score, atol=1e-3)
    columns |= score_columns("stage2", scores)
    assert columns["stage2_sl"] == columns["stage2_sl_fails_s"] == 0.0
    assert {"stage1_sl", "stage1_sl_fails_s", "stage2_sl", "stage2_sl_fails_s"} <= set(STORED)
    assert "HC SL of K trajectories" in formats_table() and "`stage2_sl_fails_s`" in formats_table()


def learned() -> None:
    """A batch's labels, the heads of GTRS-Dense and their weights in its loss."""
    labels = BatchBuffer(1, Needs(labels="v"), 2).batch(["a"], np.zeros(1, bool), np.zeros(1, bool)).labels
    assert labels is not None and labels["sl"].shape == (1, 2)
    settings = GtrsDenseSettings(sizes=Sizes(width=8, heads=1, hidden=8, layers=1))
    assert "sl" in TrajectoryScorer(settings).heads and "sl" in settings.sub_scores


def told(scores: Scores) -> None:
    """Gate, funnel, report and docs."""
    rejected = verdict(scores, ExpertGate())
    assert rejected is not None and (rejected.reason, rejected.detail) == ("sl", "sl=0")
    assert "sl" in next(stage.reasons for stage in STAGES if stage.name == "reward")
    outcome = {"clip_id": "c", "candidate_index": 0, "expert": "human", "kind": Kind.REJECTED, "error_kind": ""}
    outcome |= {"stage": rejected.stage, "reason": rejected.reason}
    outcome |= {"expert_digest": "d", "settings_hash": "s", "stage_versions": "{}"}
    empty = [spec.schema.empty_table() for spec in (SAMPLES, CANDIDATES, PLANS)]
    funnel = funnel_of_tables(empty[0], pa.Table.from_pylist([outcome], OUTCOMES.schema), *empty[1:], [])
    assert funnel.rows[0].reasons == {"reward.sl": 1} and "sl 1" in funnel.text()
    assert _reasons(funnel)[0]["words"] == REASON_WORDS["sl"] == "drove too fast"
    assert "| SL | `speed_limit_compliance` | 0, 1 | weighs 3 | 2m | drove too fast |" in docs_table()


if __name__ == "__main__":
    assert Path(subscores.__file__).is_relative_to(ROOT) and Path.cwd() == ROOT
    scores = scored()
    stored(scores)
    learned()
    told(scores)
    print("sl is everywhere")
