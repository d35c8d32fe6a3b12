"""LeRobot's metadata of a dataset, opened without the statistics of its episodes."""

import pyarrow as pa
import pyarrow.parquet as pq
from datasets import Dataset
from datasets.table import table_cast

from bhd_lerobot.datasets.format.state import UNREADABLE, corrupt
from bhd_lerobot.stock import (
    CODEBASE_VERSION,
    EPISODES_DIR,
    LeRobotDatasetMetadata,
    check_version_compatibility,
    load_info,
    load_stats,
    load_tasks,
)


class Metadata(LeRobotDatasetMetadata):
    """The same, but for the time that it takes to open.

    LeRobot's reads all columns of the episodes and drops the statistics, which are most of them. The library that it
    reads them with takes time that grows with the square of their number (a second, where there are 300), and keeps a
    copy in its cache.

    Raises:
        DatasetCorruptError: a file of the episodes cannot be read, or has other columns than the first.
    """

    def _load_metadata(self) -> None:
        self.info = load_info(self.root)
        check_version_compatibility(self.repo_id, self._version, CODEBASE_VERSION)
        self.tasks = load_tasks(self.root) if self.total_tasks > 0 else None
        self.episodes = self._episodes() if self.total_episodes > 0 else None
        self.stats = load_stats(self.root)

    def _episodes(self) -> Dataset:
        folder = self.root / EPISODES_DIR
        tables: list[pa.Table] = []
        for path in sorted(folder.glob("*/*.parquet")):
            try:
                with pq.ParquetFile(path) as file:
                    names = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                    table = file.read(columns=names, use_threads=False).replace_schema_metadata(None)
                # The first states which columns there are, and of which types, as LeRobot has it: merged datasets may
                # have them in another order in every file.
                tables.append(table_cast(table, tables[0].schema) if tables else table)
            except UNREADABLE as error:
                raise corrupt(path, error) from error
        if not tables:  # what LeRobot says then, who looks for it on the Hub
            raise FileNotFoundError(f"{folder} holds no Parquet file.")
        return Dataset(pa.concat_tables(tables))
