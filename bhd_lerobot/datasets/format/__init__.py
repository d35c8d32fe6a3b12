"""What is in the files of a dataset."""

__all__ = [
    "columns",
    "episode_table",
    "expected",
    "features",
    "identity",
    "info",
    "meta_files",
    "parquet_rescue",
    "schema",
    "state",
    "statistics",
    "summary",
    "thrift_compact",
    "video",
    "video_splice",
]
