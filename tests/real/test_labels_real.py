"""The public metric's recorded sub-scores as vocabulary labels: equal after the table, and small in it."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from factory.stages.rows import label_columns
from factory.store.location import write_shard
from factory.store.reader import SampleTable, labels_of
from factory.store.samples import Store
from factory.store.schema import LABEL_COLUMNS, SAMPLES, Stamp, sample_rows_to_table
from tasks.reward.label_bytes import UNITS_PER_M, VocabularyLabels
from tasks.subscores import JUDGED, RECORDS
from tests.factory.toy import row_of, stream
from tests.real.reference_scenes import RECORDED_K, loader

COLUMN = {record.name: record.long_name for record in RECORDS if record.name in JUDGED}
COLUMN["ep_raw_m"] = "ego_progress_raw_m"
CASES = [(scene, k) for scene, recorded in RECORDED_K.items() for k in recorded]
BYTES_OF_16384, OVERHEAD_BYTES = 40_000, 1_000


@pytest.mark.parametrize(("scene", "k"), CASES)
def test_recorded_scores_come_back_from_the_table_and_take_few_bytes(
    scene: str, k: int, shared_root: Path, tmp_path: Path
) -> None:
    metrics = loader(shared_root).metrics(scene, k)
    scores = {name: metrics[column].astype(np.float64) for name, column in COLUMN.items()}
    labels = VocabularyLabels("reference", 0.0, **scores)
    row = row_of(stream(scene)) | label_columns(labels) | vars(Stamp("a", "human", "d", 0, -1, "v", "s", "{}"))
    store = Store(tmp_path)
    shard = write_shard(store.samples.location, SAMPLES, sample_rows_to_table([row]))
    store.samples.commit([shard])

    back = labels_of(SampleTable(tmp_path)[0])
    for name in COLUMN:
        if name != "ep_raw_m":
            np.testing.assert_array_equal(getattr(back, name), scores[name], err_msg=name)
    assert np.abs(back.ep_raw_m - scores["ep_raw_m"]).max() < 1.0 / UNITS_PER_M
    # One batch, as recorded, and all of it in the vocabulary: the largest compliant progress is among the K.
    np.testing.assert_allclose(back.ep("batch"), metrics["ego_progress"], rtol=0, atol=1.0 / UNITS_PER_M / 5.0)
    np.testing.assert_allclose(back.pdm_score("batch"), metrics["pdm_score"], rtol=0, atol=1e-3)
    group = pq.ParquetFile(tmp_path / "samples" / shard.path).metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    stored = sum(c.total_compressed_size for c in columns if c.path_in_schema in LABEL_COLUMNS)
    assert stored < BYTES_OF_16384 * k / 16384 + OVERHEAD_BYTES
