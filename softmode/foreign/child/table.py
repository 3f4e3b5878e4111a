"""Read a Parquet file with pyarrow and write it plainly, as an Arrow file without compression."""

from __future__ import annotations

import importlib
from typing import Any

from .answer import Arrays
from .limits import Budget


def read(budget: Budget, request: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Write the table of a file to another; nothing else is sent.

    Args:
        budget: Allowed for the file already.
        request: `columns` to read, None for all; `copy`: where the Arrow file goes.
        arrays: Not used.
    """
    pyarrow = importlib.import_module("pyarrow")
    with pyarrow.parquet.ParquetFile(request["file"], page_checksum_verification=True) as file:
        table = file.read(columns=request["columns"], use_threads=False)
    table.validate(full=True)
    with pyarrow.OSFile(request["copy"], "wb") as out, pyarrow.ipc.new_file(out, table.schema) as writer:
        writer.write_table(table)
    return {}
