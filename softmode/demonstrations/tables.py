"""Writing the tables and descriptions of a dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softmode.demonstrations import schema
from softmode.demonstrations.statistics import Statistics


def tasks_table(tasks: Mapping[str, int]) -> Any:
    """Return the table of tasks."""
    return schema.arrow().table([list(tasks.values()), list(tasks)], schema=schema.tasks_schema())


def rows_table(rows: list[dict[str, Any]]) -> Any:
    """Return the table of episodes."""
    return schema.arrow().table({key: [row[key] for row in rows] for key in rows[0]})


def write_table(path: Path, tables: Sequence[Any]) -> Path:
    """Write tables of one schema as a Parquet file with a row group for each."""
    pq = schema.arrow().parquet
    with pq.ParquetWriter(path, tables[0].schema, compression="snappy", write_page_checksum=True) as writer:
        for table in tables:
            writer.write_table(table)
    return path


def write_json(path: Path, content: Mapping[str, Any]) -> Path:
    """Write a JSON file."""
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False, allow_nan=False), encoding="utf-8")
    return path


def listed(statistics: Mapping[str, Statistics]) -> dict[str, dict[str, Any]]:
    """Return statistics as lists."""
    return {name: {key: value.tolist() for key, value in values.items()} for name, values in statistics.items()}
